"""Whiskers that were bent and let go: how fast they swing, and how soon that is over.

Plan. A stretch in which a whisker is away from its rest is a pluck if it ends in a free swing:
that begins where the whisker first passes its rest after having been furthest from it, as nothing
holds it there. The swing is taken in the direction, among the channels, in which most of it is. Its
beginning is left out where it is large: large swings are not linear, and other modes are in them.
One decaying sinusoid with an offset is fitted to the rest by least squares, whose phase and decay
may bend with the square of its size, as theirs do; what is told is what it tends to. Where that
leaves more than a tenth of it, it was no free swing, or one of two whiskers.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

Floats = NDArray[np.float64]

HEARD = 0.45  # of the sample rate: a faster swing may be the alias of another one
AWAY, LARGE = 6.0, 20.0  # of any sample, and of the furthest: in standard deviations of the noise
APART_S = 0.25  # calm between two plucks
LOUDER = 5.0  # a swing that another one drowns is its echo in the mount
SMALL, CLEAR = 1 / 3, 20.0  # of the largest swing, and in standard deviations of the noise
FEWEST = 12  # samples
LONGEST = 4000  # samples that are fitted
PERIODS = 1.0  # at least
BENDS = 0.3  # standard deviation of what a large swing adds to phase, rad, and log of decay
RATIOS = (0.003, 0.01, 0.03, 0.1, 0.3)  # damping ratios from which the fit begins
LEFT = 0.1  # of the energy


class Ring(NamedTuple):
    """A free swing.

    Attributes:
        hz: The natural frequency, Hz: that of the same whisker without damping.
        ratio: The damping ratio; 1 is critical.
        hz_error: The standard error of the frequency, Hz.
    """

    hz: float
    ratio: float
    hz_error: float
    ratio_error: float


class Swing(NamedTuple):
    """A stretch in which a whisker is away from its rest.

    Attributes:
        begin, end: The indices of the first sample, and of one a little after the last.
        size: The largest distance from rest, in standard deviations of the noise.
    """

    element: int
    begin: int
    end: int
    size: float


def find_swings(away: Sequence[NDArray[np.float32]], rate_hz: float) -> list[Swing]:
    """All stretches of all whiskers but those that are the echo of a larger one.

    Args:
        away: (n, channel) of every whisker, distance from rest in standard deviations of the noise.
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
    """The free swing that a stretch ends with; None: there is none.

    Args:
        away: (n, channel) distance from rest in standard deviations of the noise.
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
    seen = _last(size > AWAY)
    x = x[min(_last(size > max(SMALL * size.max(), CLEAR)), seen // 2) :]
    t = np.arange(len(x)) / rate_hz

    def left(guess: Floats) -> Floats:
        hz, ratio = np.exp(guess[:2])
        bends = guess[2:]  # of phase and of decay, where the swing is large, as its square
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
    fits = [least_squares(left, begin, bounds=(low, high)) for begin in begins]
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


def _last(which: NDArray[np.bool_]) -> int:
    """The index after the last one; 0: there is none."""
    return int(np.flatnonzero(which)[-1]) + 1 if which.any() else 0
