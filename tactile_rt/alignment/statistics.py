"""Choosing a layer without looking at the animal it is scored on, and what chance would give.

Six stimuli can be relabelled in 720 ways, so the null distribution is exact; of more than seven
it is drawn (`rdm.relabellings`). Every step that looks at the neural data, the choice of a layer
included, is done again for each.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.rdm import Floats, count_stimuli, normalised, relabellings

# Points of Student's t that it exceeds in one of so many cases, for 1, 2, ... degrees of freedom;
# and the normal's beyond.
STUDENT = {
    8: (2.414, 1.604, 1.423, 1.344, 1.301, 1.273, 1.254, 1.240, 1.230, 1.221, 1.214, 1.209, 1.204,
        1.200, 1.197, 1.194, 1.191, 1.189, 1.187, 1.185, 1.183, 1.182, 1.180, 1.179, 1.178, 1.177,
        1.176, 1.175, 1.174, 1.173, 1.150),
    10: (3.078, 1.886, 1.638, 1.533, 1.476, 1.440, 1.415, 1.397, 1.383, 1.372, 1.363, 1.356, 1.350,
         1.345, 1.341, 1.337, 1.333, 1.330, 1.328, 1.325, 1.323, 1.321, 1.319, 1.318, 1.316, 1.315,
         1.314, 1.313, 1.311, 1.310, 1.282),
}  # fmt: skip
Statistic = Callable[[Floats], Floats]

# Relabellings that leave an RDM as it is give its statistic again, but for rounding.
TIE = 1e-12
AT_ONCE = 1 << 24  # numbers: of fifty stimuli and many layers, all relabellings take gigabytes


@dataclass(frozen=True, eq=False)
class Permutations:
    """A statistic among those of all relabelled stimuli."""

    statistic: float  # statistic of the stimuli as they are; NaN if there is none
    null: Floats  # (way,) statistics of all relabellings, the identity first: 720 of six stimuli
    p: float  # share of relabellings that reach the statistic, at least one of them
    percentile_95: float


def held_out(values: ArrayLike) -> tuple[Floats, NDArray[np.intp]]:
    """For each animal the layer that is best on the mean of all others, and its score there.

    Args:
        values: (..., layer, animal), finite.

    Returns:
        Scores (..., animal) and chosen layers (..., animal), the first of equals. With fewer than
        two animals or no layer there is no choice: NaN and -1.
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
    """Mean over animals of `held_out` scores: (..., layer, animal) -> (...)."""
    return np.asarray(held_out(values)[0].mean(axis=-1))


def highest(values: Floats) -> Floats:
    """The highest of all layers and targets, as published: (..., layer, target) -> (...)."""
    if values.shape[-1] * values.shape[-2] == 0:
        return np.full(values.shape[:-2], np.nan)
    return np.asarray(values.max(axis=(-2, -1)))


def max_statistic(
    rdms: ArrayLike, targets: ArrayLike, factors: ArrayLike, statistic: Statistic = mean_held_out
) -> Permutations:
    """Test a statistic that chooses among layers by relabelling the stimuli.

    Args:
        rdms: (layer, pair) of a model; a layer with a NaN takes no part.
        targets: (target, pair), finite.
        factors: (target,) that correct a target's correlations for its noise, finite.
        statistic: of corrected correlations (..., layer, target).
    """
    unit = normalised(rdms)  # (layer, pair): relabelling keeps mean and length
    unit = unit[np.isfinite(unit).all(axis=-1)]
    goal = normalised(targets) * np.asarray(factors, dtype=np.float64)[:, None]
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
    """s.e.m. over animals that have a value; NaN with too few of them.

    Args:
        ddof: degrees of freedom that are left to the mean: 0 in the published analysis.
    """
    there = np.asarray(values, dtype=np.float64)
    there = there[np.isfinite(there)]
    if there.size <= ddof:
        return float("nan")
    return float(there.std(ddof=ddof) / np.sqrt(there.size))


def student(degrees: int, cases: int) -> float:
    """What Student's t of one or more degrees of freedom exceeds in one of 8 or of 10 cases."""
    points = STUDENT[cases]
    return points[min(degrees, len(points)) - 1]
