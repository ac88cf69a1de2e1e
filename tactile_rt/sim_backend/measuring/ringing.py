"""Frequency and damping of the free swings of plucked whiskers.

Method: a stretch in which a whisker is away from its rest is a pluck if it ends in a free swing.
It starts where the whisker first passes its rest after its largest deflection and is free. The
swing is projected onto the direction of its largest variance among channels. Its first, large part
is left out: large swings are nonlinear and contain other modes. A decaying sinusoid with an offset
is fitted to the rest by least squares. Its phase and decay may bend with the square of its size, as
those of a whisker do; the result is the limit of small swings. A fit that leaves more than a tenth
of the energy was not a free swing of one whisker.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Floats = NDArray[np.float64]

HEARD = 0.45  # of the sample rate: a faster swing may be the alias of another swing
AWAY, LARGE = 6.0, 20.0  # least deflection of a sample, and of a pluck's peak: in noise sigmas
APART_S = 0.25  # calm between two plucks
LOUDER = 5.0  # a simultaneous swing this much smaller than another is its echo in the mount
SMALL, CLEAR = 1 / 3, 20.0  # of the largest swing, and in noise sigmas: where the fit may begin
FEWEST = 12  # samples
LONGEST = 4000  # samples that are fitted
PERIODS = 1.0  # at least
BENDS = 0.3  # prior standard deviation of a large swing's bend of phase, rad, and of log decay
RATIOS = (0.003, 0.01, 0.03, 0.1, 0.3)  # initial damping ratios of the fit
LEFT = 0.1  # of the energy, at most


class Ring(NamedTuple):
    """The frequency and damping of a whisker's free swing, with standard errors.

    Attributes:
        hz: The undamped natural frequency, Hz.
        ratio: The damping ratio; 1 is critical.
        hz_error: The standard error of the frequency, Hz.
    """

    hz: float
    ratio: float
    hz_error: float
    ratio_error: float


class Swing(NamedTuple):
    """A stretch of samples in which a whisker is away from its rest.

    Attributes:
        begin, end: The indices of the first sample, and of a sample shortly after the last.
        size: The largest distance from rest, in standard deviations of the noise.
    """

    element: int
    begin: int
    end: int
    size: float


def find_swings(away: Sequence[NDArray[np.float32]], rate_hz: float) -> list[Swing]:
    """Find the swings of all whiskers, except those that another whisker's larger swing excites.

    Args:
        away: whiskers' (n, channel) distances from rest, in standard deviations of the noise.
    """
    found, tail = [], round(APART_S / 4 * rate_hz)
    for element, values in enumerate(away):
        size = np.abs(values).max(axis=1, initial=0.0)
        at = np.flatnonzero(size > AWAY)
        parts = np.split(at, np.flatnonzero(np.diff(at) > APART_S * rate_hz) + 1)
        found += [
            Swing(element, int(p[0]), int(p[-1]) + tail, float(size[p].max()))
            for p in parts
            if len(p)
        ]
    return [
        s
        for s in found
        if s.size > LARGE
        and not any(
            o.begin < s.end and s.begin < o.end and o.size > LOUDER * s.size
            for o in found
            if o.element != s.element
        )
    ]


def fit_ring(away: NDArray[np.float32], rate_hz: float) -> Ring | None:
    """Fit the free swing at the end of a stretch; None if it has none.

    Args:
        away: (n, channel) distances from rest, in standard deviations of the noise.
    """
    furthest = int(np.argmax((away**2).sum(axis=1)))
    side = away[furthest:] @ away[furthest]
    passed = np.flatnonzero(side < 0)
    if not len(passed):
        return None
    free = away[furthest + int(passed[0]) :][:LONGEST].astype(np.float64)
    if len(free) < FEWEST:
        return None
    _, _, directions = np.linalg.svd(free, full_matrices=False)
    x = free @ directions[0]
    size = np.abs(x)
    seen = _find_end(size > AWAY)
    x = x[min(_find_end(size > max(SMALL * size.max(), CLEAR)), seen // 2) :]
    t = np.arange(len(x)) / rate_hz

    def compute_residuals(guess: Floats) -> Floats:
        hz, ratio = np.exp(guess[:2])
        bends = guess[2:]  # of phase and of log decay, in proportion to the square of the size
        omega = 2 * np.pi * hz
        large = -np.expm1(-2 * ratio * omega * t)
        decay = np.exp(-ratio * omega * t + bends[1] * large)
        phase = np.sqrt(1 - ratio**2) * omega * t + bends[0] * large
        shapes = np.stack([decay * np.cos(phase), decay * np.sin(phase), np.ones_like(t)], axis=1)
        away = x - shapes @ np.linalg.lstsq(shapes, x, rcond=None)[0]
        return np.concatenate([away, bends / BENDS])

    spectrum = np.abs(np.fft.rfft(x - x.mean(), 8 * len(x)))
    guess = max(int(spectrum.argmax()), 1) * rate_hz / (8 * len(x))
    low = [*np.log([0.3 * guess, 1e-4]), -1, -1]
    high = [*np.log([min(3 * guess, 0.6 * rate_hz), 0.95]), 1, 1]
    begins = [[*np.log([guess, ratio]), 0, 0] for ratio in RATIOS]
    fits = [least_squares(compute_residuals, begin, bounds=(low, high)) for begin in begins]
    best = min(fits, key=lambda fit: fit.cost)
    hz, ratio = np.exp(best.x[:2])
    damped = hz * np.sqrt(1 - ratio**2)
    energy = 2 * best.cost
    if (
        energy > LEFT * ((x - x.mean()) ** 2).sum()
        or damped * seen / rate_hz < PERIODS
        or damped > HEARD * rate_hz
        or np.any(best.active_mask)
    ):
        return None
    spread = max(energy / max(len(x) - 7, 1), 1.0) * np.linalg.pinv(best.jac.T @ best.jac)
    hz_error, ratio_error = np.sqrt(np.diag(spread)[:2])
    return Ring(float(hz), float(ratio), float(hz * hz_error), float(ratio * ratio_error))


def _find_end(which: NDArray[np.bool_]) -> int:
    """Return the index after the last True; 0 if there is none."""
    return int(np.flatnonzero(which)[-1]) + 1 if which.any() else 0
