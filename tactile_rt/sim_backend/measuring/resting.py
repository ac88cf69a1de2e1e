"""Measurement of a whisker's readings at rest: level, noise, rounding and drift.

`rounding_step` finds the step that readings are rounded to, `find_rest` the times at rest with
level and noise, and `drift_likelihood` the likelihood of every size of the drift.

Method: samples are cut into short blocks, and each is detrended, so that little of a slow change
remains. A block is at rest if it is not much noisier than the quietest quarter, if its level is
close to the usual level, and if its neighbours are at rest, too. The noise is the median over
blocks, which an undetected tap does not affect. Changes of level between blocks are drift, of the
simulation's model with a time constant of a minute; its size is the most likely.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TO_SIGMA = 1.4826  # standard deviation of normal noise over its median absolute deviation
BLOCK = 32  # samples at least
REMEMBERED = 16.0  # block length times bandwidth: a hundred time constants of the low-pass
QUIETEST, NOISIER, AWAY = 0.25, 2.0, 8.0
LEAST_BLOCKS, LEAST_S = 8, 3.0
FINEST = 16  # smallest step, in units of single precision's spacing
FORGETS_S = 60.0  # time constant of the drift: `sensor_model.SensorModel.drift_time_s`
BINS = 100  # levels that the likelihood of a drift is computed from
WHITER = np.geomspace(0.5, 30, 15)  # candidate ratios of a level's white variance to the predicted


class Rest(NamedTuple):
    """Statistics of a whisker's readings while nothing touches it.

    Attributes:
        at_s: The (block,) middle times of the blocks at rest, s.
        levels: The (block, channel) mean readings of these blocks.
        noise: The (channel,) standard deviation of a sample about its level, rounding included.
        block_s: The duration of a block, s.
        step: The (channel,) step that readings are rounded to; 0 if none is found.
    """

    at_s: Floats
    levels: Floats
    noise: Floats
    size: int
    block_s: float
    step: Floats

    @property
    def level(self) -> Floats:
        """The (channel,) mean readings at rest."""
        mean: Floats = self.levels.mean(axis=0)
        return mean

    @property
    def level_error(self) -> Floats:
        """The (channel,) standard error of `level`, without the error that drift causes."""
        white: Floats = self.noise / np.sqrt(len(self.levels) * self.size)
        return np.where(self.coarse, self.step / 12**0.5, white)

    @property
    def coarse(self) -> NDArray[np.bool_]:
        """The (channel,) flags: rounding hides the noise, which is below half a step."""
        return self.noise**2 < (1 / 4 + 1 / 12) * self.step**2


def rounding_step(values: NDArray[np.float32]) -> float:
    """Find the step that (n,) readings are rounded to; return 0 if there is none."""
    levels = np.unique(values)
    levels = levels[1:-1] if len(levels) > 8 else levels  # saturated readings are off the grid
    if len(levels) < 2:
        return 0.0
    unit = float(np.spacing(np.abs(levels).max()))
    gaps = np.diff(levels.astype(np.float64))
    gaps = gaps[gaps > 2 * unit]
    if not len(gaps) or gaps.min() < FINEST * unit:
        return 0.0
    step = float(gaps.min())
    for reach in (1.5, 20.0, np.inf):  # longer gaps, once in whole steps, refine the step
        some = gaps[gaps < reach * step]
        step = float(some.sum() / np.rint(some / step).sum())
    off = np.abs(gaps - np.rint(gaps / step) * step)
    return step if np.quantile(off, 0.95) < max(0.1 * step, 2 * unit) else 0.0


def find_rest(values: NDArray[np.float32], rate_hz: float, bandwidth_hz: float) -> Rest | None:
    """Measure a whisker's readings at rest; return None for less than 3 s of rest.

    Args:
        values: (n, channel) readings, none missing.
        bandwidth_hz: corner of the sensor's low-pass, which correlates noise; 0 without one.
    """
    step = np.array([rounding_step(of_channel) for of_channel in values.T])
    size = max(BLOCK, round(REMEMBERED * rate_hz / bandwidth_hz) if bandwidth_hz else 0)
    first = values[0].astype(np.float64)  # subtracted, so that constant readings are exactly 0
    blocks = (values[: len(values) // size * size] - first).reshape(-1, size, len(step))
    if len(blocks) < LEAST_BLOCKS:
        return None
    levels = blocks.mean(axis=1)
    line = np.linspace(-1, 1, size)[:, None]
    slopes = (blocks * line).sum(axis=1) / (line**2).sum()
    left = blocks - levels[:, None] - slopes[:, None] * line
    spread = np.sqrt((left**2).sum(axis=1) / (size - 2))
    usual = np.maximum(np.quantile(spread, QUIETEST, axis=0), 0.3 * step)
    still = (spread <= NOISIER * usual).all(axis=1)
    if still.sum() < LEAST_BLOCKS:
        return None
    levels += first
    centre = np.median(levels[still], axis=0)
    wander = TO_SIGMA * np.median(np.abs(levels[still] - centre), axis=0)
    there = (np.abs(levels - centre) <= AWAY * np.maximum(usual, wander)).all(axis=1)
    beside = np.concatenate([[True], still & there, [True]])
    resting = beside[:-2] & beside[1:-1] & beside[2:]  # blocks whose neighbours rest, too
    if resting.sum() < max(LEAST_BLOCKS, LEAST_S * rate_hz / size):
        return None
    freedom = size - 2  # the median of a chi-square distribution (Wilson and Hilferty)
    noise: Floats = (
        np.sqrt(np.median(spread[resting] ** 2, axis=0)) / (1 - 2 / (9 * freedom)) ** 1.5
    )
    at_s = np.arange(0.5, len(blocks), dtype=np.float64)[resting] * (size / rate_hz)
    return Rest(at_s, levels[resting], noise, size, size / rate_hz, step)


def drift_likelihood(rest: Rest, channel: int, sizes: Floats) -> Floats:
    """Compute the (size,) log-likelihoods of standard deviations of the drift.

    Levels are modelled as an unknown constant, an Ornstein-Uhlenbeck process, and white errors,
    whose variance may differ from what the noise of samples predicts.
    """
    together = max(1, round(np.ptp(rest.at_s) / BINS / rest.block_s))
    bins = np.rint((rest.at_s - rest.at_s[0]) / rest.block_s).astype(int) // together
    counts = np.bincount(bins)
    full = counts == together if (counts == together).sum() > BINS / 4 else counts > 0
    at_s = np.bincount(bins, rest.at_s)[full] / counts[full]
    levels = np.bincount(bins, rest.levels[:, channel])[full] / counts[full]
    # Errors of coarse readings are correlated: their mean is no better than a single reading.
    alone = rest.coarse[channel]
    noise = rest.step[channel] / 12**0.5 if alone else rest.noise[channel]
    white = noise**2 / (1 if alone else counts.max() * rest.size)
    centring = np.eye(len(at_s)) - 1 / len(at_s)
    # The drift also moves within a bin, so that the variance of the mean is less.
    alike = np.exp(-np.abs(at_s[:, None] - at_s) / FORGETS_S)
    alike[np.diag_indices_from(alike)] -= together * rest.block_s / (3 * FORGETS_S)
    shares, modes = np.linalg.eigh(centring @ alike @ centring)
    shares, seen = shares[1:], (modes.T @ levels)[1:] ** 2  # the first is the constant
    variances = sizes[:, None, None] ** 2 * shares + (WHITER * white)[:, None]
    fits: Floats = -0.5 * (np.log(variances) + seen / variances).sum(axis=2)
    return np.asarray(fits.max(axis=1))
