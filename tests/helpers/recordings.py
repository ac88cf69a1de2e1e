"""Recordings for tests: chunks with all that a stream may have, and what writes them."""

import time
from dataclasses import replace

import numpy as np

from tactile_rt.recording import StreamWriter
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, cut, small_spec
from tests.helpers.waiting import PATIENCE_S

SPEC = small_spec()


def parts(chunk):
    return tuple(getattr(chunk, name).tobytes() for name in ("seq", "t_ns", "values", "valid"))


def all_parts(chunks):
    return [parts(chunk) for chunk in chunks]


def noise(n, shape=SPEC.shape, seed=0):
    return np.random.default_rng(seed).normal(size=(n, *shape)).astype(np.float32)


def odd_chunks():
    """Chunks with all that a stream may have: gaps, invalid elements, NaN, -0, large numbers."""
    chunks = cut(noise(50), 1000.0, samples=7, start_ns=123_456_789)
    values = chunks[1].values.copy()
    values[0, 0], values[1, 1] = np.nan, -0.0
    values[2, 2] = np.float32(1e-42), np.finfo(np.float32).max
    valid = np.isfinite(values).all(axis=2)
    chunks[1] = replace(chunks[1], values=values, valid=valid)
    far = chunks[3]
    chunks[3:] = [replace(c, seq=c.seq + 10**15, t_ns=c.t_ns + 2**60) for c in chunks[3:]]
    assert far.seq[0] != chunks[3].seq[0]
    return chunks


def write(path, chunks, spec=SPEC, **further):
    with StreamWriter(path, ArraySource(spec, chunks), **further) as recorder:
        for chunk in chunks:
            recorder.push(chunk)
    return path


def record_device(fake, path, samples, during=lambda n: None, suffix="", **further):
    """Record what a driver reads of an emulated device: (chunks, statistics)."""
    chunks, n, end = [], 0, time.monotonic() + PATIENCE_S
    with (
        fake,
        open_source(fake.url + suffix) as source,
        StreamWriter(path, source, **further) as recorder,
    ):
        while n < samples:
            assert time.monotonic() < end, f"{n} of {samples} samples"
            during(n)
            chunk = source.read(0.05)
            if chunk is not None:
                recorder.push(chunk)
                chunks.append(chunk)
                n += len(chunk)
        stats = replace(source.stats)
    assert recorder.stats.samples == n
    return chunks, stats
