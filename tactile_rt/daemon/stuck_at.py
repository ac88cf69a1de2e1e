"""Stuck-at faults: a device hangs on one value; its samples come, in time, and say nothing.

A sensor whose noise is above its resolution cannot give the same values twice; one that is coarse
gives the same ones for as long as it rests. So equal samples are a fault only where the noise is
known, or somebody says for how long is too long.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk
from tactile_rt.core.stream.sensor_spec import SensorSpec

__all__ = ["StuckAtDetector", "derive_stuck_at_s"]

LEAST_S = 0.25  # a hiccup of a driver that repeats a sample is no device that hangs
LEAST_EACH_S = 2.0  # of one element: a firm touch may hold it at the end of its range
LEAST_PAIRS = 3
IMPOSSIBLE = 1e-12  # probability


class StuckAtDetector:
    """Measures for how long the values have been the same.

    Attributes:
        after_s: The time for which they may be, s; infinite: for ever, and nothing is looked at.
        each_after_s: The same of one element, while others change.
        seconds: The time for which no value has changed, s; 0 unless that is longer than it may be.
        elements: The numbers of elements of which no value has changed for too long.
    """

    def __init__(self) -> None:
        self.after_s = self.each_after_s = math.inf
        self._last: NDArray[np.float32] | None = None
        self._since_ns = 0
        self._each_ns: NDArray[np.int64] | None = None  # since when, of each element
        self.seconds, self.elements = 0.0, tuple[int, ...]()

    def add(self, chunk: Chunk) -> None:
        """Take the next samples of the stream; those without any valid element say nothing."""
        if math.isinf(self.after_s):
            self._last, self._each_ns, self.seconds, self.elements = None, None, 0.0, ()
            return
        values = chunk.values.view(np.uint32)  # bits: what is no number is equal to itself, too
        last, self._last = self._last, values[-1]
        useless = np.asarray(~chunk.valid.any(axis=1))
        changed = useless[1:] | (values[1:] != values[:-1]).any(axis=(1, 2))
        first = last is None or last.shape != values[0].shape or bool((values[0] != last).any())
        if changed.any():
            self._since_ns = int(chunk.t_ns[1 + int(np.flatnonzero(changed)[-1])])
        elif first or useless[0]:
            self._since_ns = int(chunk.t_ns[0])
        same_s = (int(chunk.t_ns[-1]) - self._since_ns) / NS_PER_S
        self.seconds = same_s if same_s > self.after_s else 0.0
        if last is None or last.shape != values[0].shape or self._each_ns is None:
            self._each_ns = np.full(values.shape[1], chunk.t_ns[0], dtype=np.int64)
            last = values[0]
        before = np.concatenate([last[None], values[:-1]])
        moved = (values != before).any(axis=2) | ~chunk.valid
        newest = np.where(moved, chunk.t_ns[:, None], self._each_ns).max(axis=0)
        self._each_ns = np.maximum(self._each_ns, newest)
        still_s = (int(chunk.t_ns[-1]) - self._each_ns) / NS_PER_S
        stuck = () if self.seconds else np.flatnonzero(still_s > self.each_after_s)
        self.elements = tuple(map(int, stuck))


def derive_stuck_at_s(spec: ArraySpec, sensor: SensorSpec, each: bool = False) -> float:
    """Derive from the noise for how long samples may be equal, s; infinite: for ever.

    Args:
        each: of one element, not of all together.

    Two readings of a channel with white noise of standard deviation s, rounded to steps of q, are
    equal with a probability of about q / (2 s sqrt(pi)), and at most 1; channels are independent.
    """
    log_p = 0.0
    for channel in sensor.channels:
        s = channel.noise_density * math.sqrt(spec.rate_hz / 2)
        if not s:
            continue
        if not channel.resolution:
            log_p = -math.inf
            break
        log_p += (1 if each else len(spec.elements)) * min(
            0.0, math.log(channel.resolution / (2 * s * math.sqrt(math.pi)))
        )
    if not log_p:
        return math.inf
    pairs = max(LEAST_PAIRS, math.ceil(math.log(IMPOSSIBLE) / log_p))
    return max(LEAST_EACH_S if each else LEAST_S, pairs / spec.rate_hz)
