"""Honest intervals: sweeps of one object are not independent, so objects are resampled."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Interval", "accuracy", "bootstrap"]

LEVELS = (2.5, 97.5)  # percentiles


@dataclass(frozen=True)
class Interval:
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{100 * self.value:.1f} % [{100 * self.low:.1f}, {100 * self.high:.1f}]"


def accuracy(correct: NDArray[Any], objects: NDArray[np.str_], resamples: int = 2000) -> Interval:
    """A mean over sweeps with a percentile bootstrap over objects.

    Args:
        correct: (sweep,) whether each was right; or the difference of two such arrays, for the
            points that one condition loses to another on the same sweeps; or (seed, sweep), whose
            seeds are then resampled too.
        objects: (sweep,) object of each sweep.
        resamples: bootstrap resamples.
    """
    runs = np.atleast_2d(correct).astype(np.float64)
    _, which = np.unique(objects, return_inverse=True)
    count = np.bincount(which)
    right = np.stack([np.bincount(which, weights=run) for run in runs])  # (seed, object)
    rng = np.random.default_rng(0)
    drawn = rng.integers(0, len(count), (resamples, len(count)))
    seeds = rng.integers(0, len(right), (resamples, len(right)))
    total = np.zeros(resamples)
    for seed in seeds.T:
        total += right[seed[:, None], drawn].sum(axis=1)
    means = total / len(right) / count[drawn].sum(axis=1)
    low, high = np.percentile(means, LEVELS)
    return Interval(float(runs.mean()), float(low), float(high))


def bootstrap(
    statistic: Callable[[NDArray[np.int64]], float],
    objects: NDArray[np.str_],
    resamples: int = 300,
) -> Interval:
    """Any statistic of a set of sweeps with a percentile bootstrap over objects.

    Args:
        statistic: of the sweeps with these indices (k,), some of which may come more than once.
        objects: (sweep,) object of each sweep.
        resamples: bootstrap resamples.
    """
    _, which = np.unique(objects, return_inverse=True)
    of = np.split(np.argsort(which, kind="stable"), np.cumsum(np.bincount(which))[:-1])
    rng = np.random.default_rng(0)
    values = [
        statistic(np.concatenate([of[k] for k in rng.integers(0, len(of), len(of))]))
        for _ in range(resamples)
    ]
    low, high = np.percentile(values, LEVELS)
    return Interval(statistic(np.arange(len(objects))), float(low), float(high))
