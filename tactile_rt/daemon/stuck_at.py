"""Stuck-at faults: a device hangs, so that its samples come in time, but no value changes.

A sensor whose noise is above its resolution cannot give the same values twice; a coarse sensor
gives the same values for as long as it rests. So equal samples are a fault only if the noise is
known, or if a limit of time is configured.

Without a description of the sensor, noise is inferred if three of four readings differ from the one
before: in the tare, at rest before a lesson, or in each half minute of the stream. Noise above a
step of the resolution has that effect. A quarter of this noise, as when motors stop, still changes
one reading of ten at any level.
"""

import math

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, concatenate
from tactile_rt.core.stream.sensor_spec import SensorSpec

LEAST_S = 0.25  # a shorter repetition is a hiccup of a driver, and no fault
LEAST_EACH_S = 2.0  # for one element: a firm touch may hold it at the end of its range
LEAST_PAIRS = 3
IMPOSSIBLE = 1e-12  # probability
OFTEN, SELDOM = 0.75, 0.1  # shares of readings that differ from the one before: see above
WINDOW_S, WINDOW_SAMPLES = 30.0, 2000  # in which they are counted, at least


class StuckAtDetector:
    """The detector of stuck-at faults, which measures how long values stay the same.

    Attributes:
        after_s: The longest time without a change of any value, s; infinite: no limit.
        each_after_s: The longest time without a change for one element while others change, s.
        noisy: Whether some values of the stream change often, also at rest.
        seconds: The time without a change of any value, s; 0 unless it exceeds the limit.
        elements: The numbers of elements of which no value has changed for too long.
        zeros: Whether all values have been 0 since the first sample, for two seconds or more.
    """

    def __init__(self, rate_hz: float = 1000.0) -> None:
        self.after_s = self.each_after_s = math.inf
        self.noisy = self._rested = False
        self._window = max(WINDOW_SAMPLES, WINDOW_S * rate_hz)
        self._last: NDArray[np.uint32] | None = None
        self._began_ns = self._since_ns = self._counted = 0
        self.seconds, self.elements, self.zeros = 0.0, tuple[int, ...](), False

    def expect(
        self, spec: ArraySpec, sensor: SensorSpec | None, changes: float, after_s: float = 0.0
    ) -> None:
        """Set the limits `after_s` and `each_after_s` from what is known of the sensor.

        Args:
            changes: Share of readings at rest that differ from the one before, for the element
                that repeats most; 0 if unknown.
            after_s: The configured limit for all elements together, s; 0 for none.
        """
        noisy = changes > OFTEN and not self._rested
        self.after_s = after_s or derive_stuck_at_s(spec, sensor, noisy=noisy or self.noisy)
        self.each_after_s = derive_stuck_at_s(spec, sensor, each=True, noisy=noisy)

    def add(self, *chunks: Chunk) -> None:
        """Update with the next samples; invalid values end a stretch of equal samples."""
        chunk = concatenate(list(chunks))
        values = (chunk.values + 0.0).view(np.uint32)  # bits: NaN is equal to NaN, and -0 to 0
        last, self._last = self._last, values[-1]
        if last is None or last.shape != values[0].shape:
            self._began_ns, last = int(chunk.t_ns[0]), ~values[0]
            self._each_ns = np.zeros(len(last), np.int64)  # time of each element's last change
            self._differed, self._changes = np.zeros(last.shape, np.int64), np.ones(last.shape)
        differs = (values != np.concatenate([last[None], values[:-1]])) & chunk.valid[..., None]
        moved, useful = differs.any(axis=2), chunk.valid.any(axis=1)
        if (new := np.flatnonzero(moved.any(axis=1) | ~useful)).size:
            self._since_ns = int(chunk.t_ns[new[-1]])
        same_s = (int(chunk.t_ns[-1]) - self._since_ns) / NS_PER_S
        before_s, self.seconds = self.seconds, same_s if same_s > self.after_s else 0.0
        newest = np.where(moved | ~chunk.valid, chunk.t_ns[:, None], self._each_ns).max(axis=0)
        self._each_ns = np.maximum(self._each_ns, newest)
        still = (int(chunk.t_ns[-1]) - self._each_ns) / NS_PER_S > self.each_after_s
        self.elements = () if self.seconds else tuple(map(int, np.flatnonzero(still)))
        first = self._since_ns == self._began_ns and same_s > LEAST_EACH_S
        self.zeros = first and not chunk.values[-1].any()
        if before_s and not self.seconds:
            noisy = self._changes > OFTEN
            if (differs[moved.any(axis=1).argmax()] & noisy).sum() < noisy.sum() / 2:
                self._changes[:], self.noisy, self._rested = 0.0, False, True  # it was at rest
        self._counted += int(useful.sum())
        self._differed += differs.sum(axis=0)
        if self._counted >= self._window and not self.seconds:
            self._changes = np.minimum(self._changes, self._differed / self._counted)
            self.noisy = bool((self._changes > OFTEN).any())
        if self._counted >= self._window or self.seconds:  # a fault tells nothing about the noise
            self._counted, self._differed[:] = 0, 0


def derive_stuck_at_s(
    spec: ArraySpec, sensor: SensorSpec | None, each: bool = False, noisy: bool = False
) -> float:
    """Return for how long noise allows samples to be equal, s, or infinity if unknown.

    Args:
        each: Whether the limit is for one element instead of all together.
        noisy: Whether some values change often; used without a sensor.

    Two readings of a channel with white noise of standard deviation s, rounded to steps of q, are
    equal with a probability of about q / (2 s sqrt(pi)), and at most 1; channels are independent.
    """
    p = 1 - SELDOM if noisy and sensor is None else 1.0
    for channel in sensor.channels if sensor is not None else ():
        if s := channel.noise_density * math.sqrt(spec.rate_hz / 2):
            p *= min(1.0, channel.resolution / (2 * s * math.sqrt(math.pi)))
    if p == 1:
        return math.inf
    log_p = math.log(max(p, IMPOSSIBLE)) * (1 if each or sensor is None else len(spec.elements))
    pairs = max(LEAST_PAIRS, math.ceil(math.log(IMPOSSIBLE) / log_p))
    return max(LEAST_EACH_S if each else LEAST_S, pairs / spec.rate_hz)
