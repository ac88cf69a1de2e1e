"""Recordings of touches that are quickly made: each kind of thing has loads of its own."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.testing import cut_chunks
from tests.helpers.recordings import write
from tests.helpers.tiny_sweeps import plate

ARRAY = replace(plate(2, 2), rate_hz=250.0)
KINDS = ("cup", "mug")
REST_S, TOUCH_S = 2.2, 1.2  # longer than a full rest, and than a window
NOISE = {"N": 8e-6, "N m": 4e-8}


def touched(
    kinds: list[str],
    seed: int = 0,
    spec: ArraySpec = ARRAY,
    rest_s: float = REST_S,
    after_s: float = 0.5,
) -> np.ndarray:
    """(n, element, channel) a rest and a touch for each of these kinds, with noise on an offset."""
    rng = np.random.default_rng(seed)
    unit = np.array([NOISE[u] for u in spec.units])
    rest, touch = (round(s * spec.rate_hz) for s in (rest_s, TOUCH_S))
    values = np.zeros((len(kinds) * (rest + touch) + round(after_s * spec.rate_hz), *spec.shape))
    for k, kind in enumerate(kinds):
        of = np.random.default_rng(sum(map(ord, kind)))
        begin = k * (rest + touch) + rest
        wave = np.sin(np.arange(touch) / spec.rate_hz * of.uniform(6, 30))[:, None, None]
        values[begin : begin + touch] = (1 + wave) * of.normal(size=spec.shape) * 60 * unit
    values += unit * (rng.normal(size=values.shape) + 20)
    return values.astype(np.float32)


def chunks_of_touches(kinds: list[str], start_ns: int = 10**9, **how) -> list[Chunk]:
    """The same as a stream that began at `start_ns`."""
    spec = how.get("spec", ARRAY)
    return cut_chunks(touched(kinds, **how), spec.rate_hz, 5, start_ns)


def record_touches(path: Path, kinds: list[str], **how) -> Path:
    """The same as a recording."""
    return write(path, chunks_of_touches(kinds, **how), how.get("spec", ARRAY))


def times(k: int) -> tuple[float, float]:
    """The interval that holds the k-th touch, s."""
    begin = k * (REST_S + TOUCH_S)
    return begin + REST_S - 1, begin + REST_S + TOUCH_S
