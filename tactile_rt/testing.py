"""For your own tests: a small array, chunks of any signal, and a source that needs no device.

spec = small_spec()
source = ArraySource(spec, cut(signal, spec.rate_hz))
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from tactile_rt.stream import ArraySpec, Chunk, EndOfStream, Source
from tactile_rt.timebase import NS_PER_S

__all__ = ["ArraySource", "cut", "small_spec"]


def small_spec(elements: int = 3, rate_hz: float = 1000.0) -> ArraySpec:
    """A row of elements 2 mm apart that measure one force and one moment."""
    return ArraySpec(
        name="small",
        elements=tuple(f"A{i}" for i in range(elements)),
        grid=tuple((0, i) for i in range(elements)),
        positions=tuple((0.0, 0.002 * i, 0.0) for i in range(elements)),
        orientations=((1.0, 0.0, 0.0, 0.0),) * elements,
        channels=("fy", "mz"),
        units=("N", "N m"),
        rate_hz=rate_hz,
        frame="mount",
    )


def cut(values: ArrayLike, rate_hz: float, samples: int = 9, start_ns: int = 0) -> list[Chunk]:
    """Cut a signal into chunks of evenly spaced, wholly valid samples.

    Args:
        values: (n, element, channel) SI.
        rate_hz: sample rate.
        samples: of each chunk; the last one may be shorter.
        start_ns: time of the first sample.
    """
    signal = np.asarray(values, dtype=np.float32)
    seq = np.arange(len(signal), dtype=np.int64)
    t_ns = start_ns + np.round(seq * (NS_PER_S / rate_hz)).astype(np.int64)
    return [
        Chunk(
            seq[i : i + samples],
            t_ns[i : i + samples],
            signal[i : i + samples],
            np.ones(signal[i : i + samples].shape[:2], dtype=np.bool_),
        )
        for i in range(0, len(signal), samples)
    ]


class ArraySource(Source):
    """Chunks in memory as a source: one per read, at once, then the end.

    Args:
        spec: what the samples are.
        chunks: what to deliver.
        live: claim to be a device, so that a `Session` reads in a thread of its own.

    Raises:
        ValueError: a chunk is not of `spec.shape`.
    """

    def __init__(self, spec: ArraySpec, chunks: Sequence[Chunk], live: bool = False) -> None:
        super().__init__(spec)
        self.live = live
        for chunk in chunks:
            if chunk.values.shape[1:] != spec.shape:
                raise ValueError(f"chunk of shape {chunk.values.shape}, not (n, *{spec.shape})")
        self._left = list(chunks)[::-1]  # the next one last

    def read(self, timeout: float | None = None) -> Chunk | None:
        if not self._left:
            raise EndOfStream
        chunk = self._left.pop()
        self.stats.delivered += len(chunk)
        return chunk

    def close(self) -> None:
        self._left.clear()
