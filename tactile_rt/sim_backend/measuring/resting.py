"""How a whisker reads while nothing touches it: its level, noise, rounding and drift.

Operations: the step that readings are rounded to; where the whisker is at rest, its level and its
noise there; how likely every size of a drift is.

Plan. Samples are cut into short blocks, and a line is taken off each, so that what is left of a
slow change is little. A block is at rest if it is not much noisier than the quietest quarter, if
its level is where levels usually are, and if its neighbours are at rest, too. The noise is the
median of the blocks, which a tap that was missed does not move. What levels do from block to block
is drift: the simulation's, which forgets in a minute, of the size that makes it most likely.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

TO_SIGMA = 1.4826  # standard deviation of normal noise over its median absolute deviation
BLOCK = 32  # samples at least
REMEMBERED = 16.0  # times the inverse bandwidth: a hundred times what a low-pass remembers
QUIETEST, NOISIER, AWAY = 0.25, 2.0, 8.0
LEAST_BLOCKS, LEAST_S = 8, 3.0
FINEST = 16  # of a step, in units of single precision's own
FORGETS_S = 60.0  # the drift: `sensor.SensorModel.drift_time_s`
BINS = 100  # levels that the likelihood of a drift is made from
WHITER = np.geomspace(0.5, 30, 15)  # the variance of levels over that of white noise


class Rest(NamedTuple):
    """One whisker while nothing touches it.

    Attributes:
        at_s: The (block,) middle times of the blocks at rest, s.
        levels: The (block, channel) mean readings of these blocks.
        noise: The (channel,) standard deviation of a sample about its level, rounding included.
        block_s: The duration of a block, s.
        step: The (channel,) step that readings are rounded to; 0: none is seen.
    """

    at_s: Floats
    levels: Floats
    noise: Floats
    size: int
    block_s: float
    step: Floats

    @property
    def level(self) -> Floats:
        """(channel,) the mean reading."""
        mean: Floats = self.levels.mean(axis=0)
        return mean

    @property
    def level_error(self) -> Floats:
        """(channel,) standard error of that, but for what is drift."""
        white: Floats = self.noise / np.sqrt(len(self.levels) * self.size)
        return np.where(self.coarse, self.step / 12**0.5, white)

    @property
    def coarse(self) -> NDArray[np.bool_]:
        """(channel,) whether noise is less than half a step, so that rounding hides its size."""
        return self.noise**2 < (1 / 4 + 1 / 12) * self.step**2


def rounding_step(values: NDArray[np.float32]) -> float:
    """The step that (n,) readings are rounded to; 0 if they lie on no grid that can be seen."""
    levels = np.unique(values)
    levels = levels[1:-1] if len(levels) > 8 else levels  # a saturated one is off the grid
    if len(levels) < 2:
        return 0.0
    unit = float(np.spacing(np.abs(levels).max()))
    gaps = np.diff(levels.astype(np.float64))
    gaps = gaps[gaps > 2 * unit]
    if not len(gaps) or gaps.min() < FINEST * unit:
        return 0.0
    step = float(gaps.min())
    for reach in (1.5, 20.0, np.inf):  # a longer gap tells the step better, once it is counted
        some = gaps[gaps < reach * step]
        step = float(some.sum() / np.rint(some / step).sum())
    off = np.abs(gaps - np.rint(gaps / step) * step)
    return step if np.quantile(off, 0.95) < max(0.1 * step, 2 * unit) else 0.0


def find_rest(values: NDArray[np.float32], rate_hz: float, bandwidth_hz: float) -> Rest | None:
    """Find where a whisker is at rest, and how it reads there; None: less than 3 s of it.

    Args:
        values: (n, channel) readings, nothing missing.
        bandwidth_hz: of the sensor's low-pass, whose noise is alike from sample to sample; 0: none.
    """
    step = np.array([rounding_step(of_channel) for of_channel in values.T])
    size = max(BLOCK, round(REMEMBERED * rate_hz / bandwidth_hz) if bandwidth_hz else 0)
    first = values[0].astype(np.float64)  # without which what never changes is exactly 0
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
    resting = beside[:-2] & beside[1:-1] & beside[2:]  # those of which the neighbours rest too
    if resting.sum() < max(LEAST_BLOCKS, LEAST_S * rate_hz / size):
        return None
    freedom = size - 2  # the median of a chi-square distribution (Wilson and Hilferty)
    noise: Floats = (
        np.sqrt(np.median(spread[resting] ** 2, axis=0)) / (1 - 2 / (9 * freedom)) ** 1.5
    )
    at_s = np.arange(0.5, len(blocks), dtype=np.float64)[resting] * (size / rate_hz)
    return Rest(at_s, levels[resting], noise, size, size / rate_hz, step)


def drift_likelihood(rest: Rest, channel: int, sizes: Floats) -> Floats:
    """(size,) log-likelihood of each size of the drift, one standard deviation.

    Levels are an unknown constant, an Ornstein-Uhlenbeck process, and an error of each that is
    white; how large that is may differ from what the noise of samples makes of it.
    """
    together = max(1, round(np.ptp(rest.at_s) / BINS / rest.block_s))
    bins = np.rint((rest.at_s - rest.at_s[0]) / rest.block_s).astype(int) // together
    counts = np.bincount(bins)
    full = counts == together if (counts == together).sum() > BINS / 4 else counts > 0
    at_s = np.bincount(bins, rest.at_s)[full] / counts[full]
    levels = np.bincount(bins, rest.levels[:, channel])[full] / counts[full]
    # Coarse readings err together: their mean is no better than one of them.
    alone = rest.coarse[channel]
    noise = rest.step[channel] / 12**0.5 if alone else rest.noise[channel]
    white = noise**2 / (1 if alone else counts.max() * rest.size)
    centring = np.eye(len(at_s)) - 1 / len(at_s)
    # Within a bin it moves, too, so that the variance of the mean is less.
    alike = np.exp(-np.abs(at_s[:, None] - at_s) / FORGETS_S)
    alike[np.diag_indices_from(alike)] -= together * rest.block_s / (3 * FORGETS_S)
    shares, modes = np.linalg.eigh(centring @ alike @ centring)
    shares, seen = shares[1:], (modes.T @ levels)[1:] ** 2  # the first is the constant's
    variances = sizes[:, None, None] ** 2 * shares + (WHITER * white)[:, None]
    fits: Floats = -0.5 * (np.log(variances) + seen / variances).sum(axis=2)
    return np.asarray(fits.max(axis=1))
