"""Recordings for tests: chunks with all that a stream may have, and what writes them."""

import time
from dataclasses import replace

import msgspec
import numpy as np

from tactile_rt.core.stream import Chunk
from tactile_rt.recording import StreamWriter
from tactile_rt.recording.layout import encode_samples
from tactile_rt.recording.writer import McapFile
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.waiting import PATIENCE_S

SPEC = small_spec()


def parts(chunk):
    return tuple(getattr(chunk, name).tobytes() for name in ("seq", "t_ns", "values", "valid"))


def all_parts(chunks):
    return [parts(chunk) for chunk in chunks]


def noise(n, shape=SPEC.shape, seed=0):
    return np.random.default_rng(seed).normal(size=(n, *shape)).astype(np.float32)


def odd_chunks():
    """Chunks with gaps, lost elements, all kinds of NaN, -0, the least and largest numbers."""
    chunks = cut_chunks(noise(60), 1000.0, samples=7, start_ns=123_456_789)
    values, valid = chunks[1].values.copy(), chunks[1].valid.copy()
    values[0, 0], values[1, 1] = np.nan, -0.0
    values[2, 2] = np.float32(1e-45), np.finfo(np.float32).max
    values[3, 1] = np.inf, -np.inf
    values.view(np.uint32)[4, 2] = 0xFFC01234, 0x7F800001  # NaN that carry something
    valid[0, 0] = valid[5, 1] = False
    chunks[1] = replace(chunks[1], values=values, valid=valid)
    chunks[3:] = [replace(c, seq=c.seq + 10**15, t_ns=c.t_ns + 2**60) for c in chunks[3:]]
    chunks[5] = Chunk(*(getattr(chunks[5], n)[:1] for n in ("seq", "t_ns", "values", "valid")))
    return chunks


def write_as_daemon(path, about, chunks):
    """A recording with all topics; when things were recorded is not when they happened."""
    with path.open("wb") as file:
        made = McapFile(file, about)
        for k, chunk in enumerate(chunks):
            made.add("samples", encode_samples(chunk), int(chunk.t_ns[-1]) + 777 * k)
            text = {"type": "decision", "label": f"m\u00fcg \u2028 {k}\n", "step": k, "p": 0.1 * k}
            made.add("decisions", msgspec.json.encode(text), int(chunk.t_ns[-1]) - 10**9)
        made.add("events", b'{"type": "contact",  "touching": true,"model":"m"}', 5)
        made.add("health", b'{"state":"closed","t_ns":5}', 2**60)
        made.finish()
    return path


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
