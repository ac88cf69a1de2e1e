"""Corrections of a stale baseline: drift at rest, and levels of rest found within a contact."""

from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# A level to which the signal returns this often within one contact is rest: the baseline was
# measured during a touch.
RETURNS = 3
LEVELS = 8  # remembered at a time
STRETCH_SAMPLES = 20
WILD_Z2, WILD_SAMPLES = 60.0, 2  # distance from the median, and outliers allowed beyond it
SAME_Z2 = 60.0  # at most, between the medians of two stretches of one level
# A drift is a line through the means of the latest blocks of quiet samples.
BLOCK_SAMPLES, FEWEST_BLOCKS, MOST_BLOCKS = 20, 8, 30
DRIFTS = 6.0  # standard errors from zero beyond which a slope counts as drift
STRAIGHT = 4.0  # largest residual variance of a straight line, in variances of a block's mean

Floats = NDArray[np.float32]


class Drift:
    """An estimator of linear drift, fitted to block means of the latest quiet samples.

    Attributes:
        found: Whether any channel drifts.
        straight: Whether all channels lie on lines, apart from noise.
        slope: (element, channel) The drift, SI per sample; 0 where it may be noise.
        span: The number of samples over which the drift was observed.
    """

    def __init__(self) -> None:
        self.found = self.straight = False
        self.slope, self.span = np.zeros(()), 0.0
        self._block: list[tuple[int, NDArray[np.float64], NDArray[np.bool_]]] = []
        self._blocks: deque[tuple[float, NDArray[np.float64]]] = deque(maxlen=MOST_BLOCKS)

    def add(self, at: int, sample: NDArray[Any], valid: NDArray[np.bool_], sigma: Floats) -> bool:
        """Add the sample with number `at`; return whether it completes a block.

        Args:
            sigma: (element, channel) The noise per sample, SI.
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
        slope = np.tensordot(t, means, 1) / np.square(t).sum()  # NaN where a mean is unknown
        self._mean = means.mean(axis=0)
        residual = means - self._mean - t[:, None, None] * slope
        noise = sigma**2 / BLOCK_SAMPLES
        variance = np.square(residual).sum(axis=0) / (len(t) - 2)
        lines = variance <= STRAIGHT * noise  # a step is no line, however steep its slope
        self.straight = bool((lines | np.isnan(variance)).all())
        if not self.straight and len(self._blocks) > FEWEST_BLOCKS:
            self._blocks.popleft()  # the drift may have begun later
        self._error = np.sqrt(np.maximum(variance, noise) / np.square(t).sum())  # of the slope
        certain = lines & (np.abs(slope) > DRIFTS * self._error)
        self.slope, self.found = np.where(certain, slope, 0.0), bool(certain.any())
        return True

    def leads_to(self, at: float, level: NDArray[Any], sigma: Floats) -> bool:
        """Return whether the fitted lines pass through `level` at sample number `at`."""
        if not (self.found and self.straight):
            return False
        there = self._mean + (at - self._middle) * self.slope
        error = np.hypot((at - self._middle) * self._error, sigma)
        return not (np.abs(there - level) > DRIFTS * error).any()


class RestLevels:
    """A detector of levels to which a signal keeps returning within a contact.

    Attributes:
        block: The samples of the current stretch, with their validity.
    """

    def __init__(self) -> None:
        self.block: list[tuple[Floats, NDArray[np.bool_]]] = []
        self._levels: deque[_Level] = deque(maxlen=LEVELS)
        self._current: _Level | None = None  # None while the signal moves

    def confirm_rest(
        self, sample: Floats, known: NDArray[np.bool_], sigma: Floats, quiet: int
    ) -> bool:
        """Add one sample; return whether it confirms that the signal is at rest.

        Args:
            sample: (element, channel) The values, SI.
            known: (element,) Whether the element is trusted.
            sigma: (element, channel) The noise per sample, SI.
            quiet: The number of samples that were quiet on the present baseline.
        """
        if len(self.block) == STRETCH_SAMPLES:
            self.block = []
        self.block.append((sample.copy(), known))
        if len(self.block) < STRETCH_SAMPLES:
            return False
        stretch = np.array([values for values, _ in self.block])[:, known := self._find_trusted()]
        median = np.median(stretch, axis=0)
        away = np.square((stretch - median) / sigma[known]).sum(axis=2)  # (sample, element)
        if not known.any() or ((away > WILD_Z2).sum(axis=0) > WILD_SAMPLES).any():
            self._current = None
            return False
        level = np.full(sigma.shape, np.nan, dtype=np.float32)
        level[known] = median
        if self._current is None or not self._current.near(level, sigma):
            near = (other for other in self._levels if other.near(level, sigma))
            self._current = next(near, None) or self._add_level(level)
            self._current.returns += 1
        self._current.samples += STRETCH_SAMPLES
        return self._current.returns >= RETURNS and self._current.samples > quiet

    def _find_trusted(self) -> NDArray[np.bool_]:
        """Return whether each element is trusted in the whole stretch, (element,)."""
        trusted: NDArray[np.bool_] = np.logical_and.reduce([known for _, known in self.block])
        return trusted

    def _add_level(self, median: Floats) -> "_Level":
        self._levels.append(level := _Level(median))
        return level


@dataclass
class _Level:
    median: Floats  # (element, channel) NaN: unknown
    returns: int = 0
    samples: int = 0

    def near(self, median: Floats, sigma: Floats) -> bool:
        """Return whether another stretch's median (element, channel) is the same within noise."""
        # The variance of a median is pi / 2 times that of a mean, and two medians are compared.
        z2 = np.square((median - self.median) / sigma).sum(axis=1) * STRETCH_SAMPLES / np.pi
        return not (z2 > SAME_Z2).any()
