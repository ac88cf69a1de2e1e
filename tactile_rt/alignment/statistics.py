"""Leave-one-animal-out choice of a layer, and permutation tests over relabelled stimuli.

Six stimuli can be relabelled in 720 ways, so the null distribution is exact; for more than seven
stimuli it is sampled (`rdm.relabellings`). Every step that uses the neural data, including the
choice of a layer, is repeated for each relabelling.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.rdm import Floats, count_stimuli, normalise_vectors, relabellings

# Values that Student's t exceeds with probability 1/8 or 1/10, for 1, 2, ... degrees of freedom;
# the last value, for more degrees, is that of the normal distribution.
STUDENT = {
    8: (2.414, 1.604, 1.423, 1.344, 1.301, 1.273, 1.254, 1.240, 1.230, 1.221, 1.214, 1.209, 1.204,
        1.200, 1.197, 1.194, 1.191, 1.189, 1.187, 1.185, 1.183, 1.182, 1.180, 1.179, 1.178, 1.177,
        1.176, 1.175, 1.174, 1.173, 1.150),
    10: (3.078, 1.886, 1.638, 1.533, 1.476, 1.440, 1.415, 1.397, 1.383, 1.372, 1.363, 1.356, 1.350,
         1.345, 1.341, 1.337, 1.333, 1.330, 1.328, 1.325, 1.323, 1.321, 1.319, 1.318, 1.316, 1.315,
         1.314, 1.313, 1.311, 1.310, 1.282),
}  # fmt: skip
Statistic = Callable[[Floats], Floats]

TIE = 1e-12  # rounding error of relabellings that do not change an RDM, and so its statistic
AT_ONCE = 1 << 24  # numbers per batch: 50 stimuli and many layers would need gigabytes at once


@dataclass(frozen=True, eq=False)
class Permutations:
    """A statistic and its null distribution over relabelled stimuli."""

    statistic: float  # statistic of the true labels; NaN if it cannot be computed
    null: Floats  # (way,) statistics of all relabellings, the identity first: 720 for six stimuli
    p: float  # share of relabellings that reach the statistic, the identity included
    percentile_95: float  # of `null`


def held_out(values: ArrayLike) -> tuple[Floats, NDArray[np.intp]]:
    """Score each animal by the layer with the best mean over all other animals.

    Args:
        values: (..., layer, animal), finite.

    Returns:
        Scores (..., animal) and indices of the chosen layers (..., animal). With fewer than two
        animals, or without layers, all are NaN and -1.
    """
    values = np.asarray(values, dtype=np.float64)
    layers, animals = values.shape[-2:]
    shape = (*values.shape[:-2], animals)
    if animals < 2 or layers == 0:
        return np.full(shape, np.nan), np.full(shape, -1, dtype=np.intp)
    others = (values.sum(axis=-1, keepdims=True) - values) / (animals - 1)
    chosen = np.argmax(others, axis=-2)
    scores = np.take_along_axis(values, chosen[..., None, :], axis=-2)[..., 0, :]
    return np.asarray(scores), np.asarray(chosen)


def mean_held_out(values: Floats) -> Floats:
    """Average the scores of `held_out` over animals: (..., layer, animal) -> (...)."""
    return np.asarray(held_out(values)[0].mean(axis=-1))


def highest(values: Floats) -> Floats:
    """Return the maximum over layers and targets, as published: (..., layer, target) -> (...)."""
    if values.shape[-1] * values.shape[-2] == 0:
        return np.full(values.shape[:-2], np.nan)
    return np.asarray(values.max(axis=(-2, -1)))


def max_statistic(
    rdms: ArrayLike, targets: ArrayLike, factors: ArrayLike, statistic: Statistic = mean_held_out
) -> Permutations:
    """Run a permutation test of a statistic over layers and targets, relabelling the stimuli.

    Args:
        rdms: (layer, pair) of a model; a layer with a NaN is left out.
        targets: (target, pair), finite.
        factors: (target,), finite; they correct a target's correlations for its noise.
        statistic: function of corrected correlations (..., layer, target).
    """
    unit = normalise_vectors(rdms)  # (layer, pair): relabelling keeps mean and length
    unit = unit[np.isfinite(unit).all(axis=-1)]
    goal = normalise_vectors(targets) * np.asarray(factors, dtype=np.float64)[:, None]
    ways = relabellings(count_stimuli(unit.shape[-1]))
    if unit.size and goal.size:
        together = max(1, AT_ONCE // unit.size)
        parts = (ways[at : at + together] for at in range(0, len(ways), together))
        # (way, layer, pair) by (pair, target)
        null = np.concatenate([statistic(unit[:, p].swapaxes(0, 1) @ goal.T) for p in parts])
    else:
        null = np.full(len(ways), np.nan)
    if np.isnan(null).any():
        nan = float("nan")
        return Permutations(nan, null, nan, nan)
    observed = float(null[0])
    return Permutations(
        statistic=observed,
        null=null,
        p=float((null >= observed - TIE).mean()),
        percentile_95=float(np.percentile(null, 95)),
    )


def standard_error(values: ArrayLike, ddof: int = 1) -> float:
    """Compute the standard error of the mean of finite values; NaN if too few.

    Args:
        ddof: degrees of freedom deducted for the mean; 0 in the published analysis.
    """
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    if finite.size <= ddof:
        return float("nan")
    return float(finite.std(ddof=ddof) / np.sqrt(finite.size))


def student(degrees: int, cases: int) -> float:
    """Return the value that Student's t exceeds with probability 1 / `cases` (8 or 10)."""
    points = STUDENT[cases]
    return points[min(degrees, len(points)) - 1]  # degrees of freedom from 1 on
