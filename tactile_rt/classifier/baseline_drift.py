"""Rest that a baseline does not know: its drift, and a level to which a touched signal returns."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# A level to which the signal returns so often within one contact is that of rest: the baseline
# was taken while something was touched.
RETURNS = 3
LEVELS = 8  # that are remembered
STRETCH_SAMPLES = 20
WILD_Z2, WILD_SAMPLES = 60.0, 2  # from the median: so many of a still stretch may be further away
SAME_Z2 = 60.0  # of the medians of two stretches
# A drift is a line through means of quiet samples, the latest blocks of so many.
BLOCK_SAMPLES, FEWEST_BLOCKS, MOST_BLOCKS = 20, 8, 30
DRIFTS = 6.0  # standard errors of a slope, beyond which it is one
STRAIGHT = 4.0  # times the variance of such a mean: as far from the line as they are, at most

Floats = NDArray[np.float32]


class Drift:
    """The slope of quiet samples, where there is one for certain.

    Attributes:
        found: Whether any channel drifts.
        straight: Whether all samples lie on a line, but for noise.
        slope: (element, channel) SI per sample; 0 where it may be noise.
        span: The number of samples over which it was seen.
    """

    def __init__(self) -> None:
        self.found = self.straight = False
        self.slope, self.span = np.zeros(()), 0.0
        self._block: list[tuple[int, NDArray[np.float64], NDArray[np.bool_]]] = []
        self._blocks: deque[tuple[float, NDArray[np.float64]]] = deque(maxlen=MOST_BLOCKS)

    def add(self, at: int, sample: NDArray[Any], valid: NDArray[np.bool_], sigma: Floats) -> bool:
        """Take a sample, whose number is `at`; return True if it completes a block.

        Args:
            sigma: (element, channel) the noise per sample, SI.
        """
        self._block.append((at, sample, valid))
        if len(self._block) < BLOCK_SAMPLES:
            return False
        times, samples, trusted = zip(*self._block, strict=True)
        mean = np.mean(samples, axis=0)
        mean[~np.all(trusted, axis=0)] = np.nan
        self._blocks.append((float(np.mean(times)), mean))
        self._block = []
        if len(self._blocks) < FEWEST_BLOCKS:
            return True
        t = np.array([time for time, _ in self._blocks])
        means = np.array([mean for _, mean in self._blocks])
        self.span, self._middle = t[-1] - t[0], float(t.mean())
        t -= self._middle
        slope = np.tensordot(t, means, 1) / np.square(t).sum()  # NaN where any is not known
        self._mean = means.mean(axis=0)
        left = means - self._mean - t[:, None, None] * slope
        noise = sigma**2 / BLOCK_SAMPLES
        variance = np.square(left).sum(axis=0) / (len(t) - 2)
        lines = variance <= STRAIGHT * noise  # a step is none, steep as its slope may be
        self.straight = bool((lines | np.isnan(variance)).all())
        if not self.straight and len(self._blocks) > FEWEST_BLOCKS:
            self._blocks.popleft()  # it began later: look back less far
        self._error = np.sqrt(np.maximum(variance, noise) / np.square(t).sum())  # of the slope
        certain = lines & (np.abs(slope) > DRIFTS * self._error)
        self.slope, self.found = np.where(certain, slope, 0.0), bool(certain.any())
        return True

    def leads_to(self, at: float, level: NDArray[Any], sigma: Floats) -> bool:
        """Return whether the slope of the samples was at this level then."""
        if not (self.found and self.straight):
            return False
        there = self._mean + (at - self._middle) * self.slope
        error = np.hypot((at - self._middle) * self._error, sigma)
        return not (np.abs(there - level) > DRIFTS * error).any()


class RestLevels:
    """The level to which a signal keeps coming back within a contact.

    Attributes:
        block: The samples of the stretch under way, with their validity.
    """

    def __init__(self) -> None:
        self.block: list[tuple[Floats, NDArray[np.bool_]]] = []
        self._levels: deque[_Level] = deque(maxlen=LEVELS)
        self._at: _Level | None = None  # None: it moves

    def found(self, sample: Floats, known: NDArray[np.bool_], sigma: Floats, quiet: int) -> bool:
        """Take one sample; whether it completes a stretch of rest.

        Args:
            sample: (element, channel) SI.
            known: (element,) elements to trust.
            sigma: (element, channel) the noise per sample, SI.
            quiet: samples that were ever quiet on the baseline.
        """
        if len(self.block) == STRETCH_SAMPLES:
            self.block = []
        self.block.append((sample.copy(), known))
        if len(self.block) < STRETCH_SAMPLES:
            return False
        stretch = np.array([values for values, _ in self.block])[:, known := self._known()]
        median = np.median(stretch, axis=0)
        away = np.square((stretch - median) / sigma[known]).sum(axis=2)  # (sample, element)
        if not known.any() or ((away > WILD_Z2).sum(axis=0) > WILD_SAMPLES).any():
            self._at = None
            return False
        level = np.full(sigma.shape, np.nan, dtype=np.float32)
        level[known] = median
        if self._at is None or not self._at.near(level, sigma):
            near = (other for other in self._levels if other.near(level, sigma))
            self._at = next(near, None) or self._new(level)
            self._at.returns += 1
        self._at.samples += STRETCH_SAMPLES
        return self._at.returns >= RETURNS and self._at.samples > quiet

    def _known(self) -> NDArray[np.bool_]:
        """(element,) those that are to be trusted in all of the stretch."""
        all_of_them: NDArray[np.bool_] = np.logical_and.reduce([known for _, known in self.block])
        return all_of_them

    def _new(self, median: Floats) -> "_Level":
        self._levels.append(level := _Level(median))
        return level


@dataclass
class _Level:
    median: Floats  # (element, channel) NaN: not known
    returns: int = 0
    samples: int = 0

    def near(self, median: Floats, sigma: Floats) -> bool:
        """Whether the median of another stretch is the same, but for noise."""
        # The variance of a median is pi / 2 times that of a mean, and there are two of them.
        z2 = np.square((median - self.median) / sigma).sum(axis=1) * STRETCH_SAMPLES / np.pi
        return not (z2 > SAME_Z2).any()
