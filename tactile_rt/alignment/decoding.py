"""What can be decoded from the six stimuli, and what would be decoded by chance.

Shape is decoded with one distance held out, distance with one shape held out, so that every class
has as many stimuli to learn from as any other: of noise, the nearest class mean is then right as
often as a guess. The paper holds out one stimulus at a time instead, which leaves the right class
short of one: of noise in many dimensions that is right almost never, and chance is not 1/2 or 1/3.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.rdm import Floats, rdm, square
from tactile_rt.core.stream.stimuli import DISTANCES, SHAPES, STIMULI

Labels = tuple[int, ...]

SHAPE: Labels = tuple(SHAPES.index(name.split("-")[0]) for name in STIMULI)
DISTANCE: Labels = tuple(DISTANCES.index(name.split("-")[1]) for name in STIMULI)
TIE = 1e-9


@dataclass(frozen=True)
class Decoded:
    """Shares of held-out stimuli that are decoded rightly, NaN where nothing is decoded.

    Beside each: the mean over all relabellings of the stimuli, and the share of these that are
    right at least as often as the true labels.
    """

    shape: float
    shape_chance: float
    shape_p: float
    distance: float
    distance_chance: float
    distance_p: float


def decode(patterns: ArrayLike) -> Decoded:
    """Nearest class mean of responses (6, unit), each centred over units and of length one."""
    return decode_rdm(rdm(patterns))


def decode_rdm(entries: ArrayLike) -> Decoded:
    """The same from an RDM (15,), which has all that it needs: the distances between stimuli.

    The null is exact: all 720 relabellings, the stimuli as they are among them.
    """
    squares = 2 * square(entries)  # of Euclidean distances between vectors of length one
    if not np.isfinite(squares).all():
        return Decoded(*[float("nan")] * 6)
    orders = np.array(list(permutations(range(len(STIMULI)))))
    relabelled = squares[orders[:, :, None], orders[:, None, :]]  # (720, 6, 6)
    found = []
    for labels, folds in ((SHAPE, DISTANCE), (DISTANCE, SHAPE)):
        right = _nearest(relabelled, np.array(labels), np.array(folds))
        found += [float(right[0]), float(right.mean()), float((right >= right[0] - TIE).mean())]
    return Decoded(*found)


def decode_paper(patterns: ArrayLike) -> Decoded:
    """The paper's variant (Table "Stimuli decoding"): logistic regression, one stimulus held out.

    Its chance is that of every way to divide the stimuli into classes of the same sizes.
    """
    values = np.asarray(patterns, dtype=np.float64)
    values = values - values.mean(axis=0)
    if not np.isfinite(values).all():
        return Decoded(*[float("nan")] * 6)
    u, s, _ = np.linalg.svd(values, full_matrices=False)
    reduced = u * s  # the penalty is the same in any orthonormal basis
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    found = []
    # Of five points, threads only wait for each other: minutes where others use the processor.
    with threadpool_limits(1):
        for labels in (SHAPE, DISTANCE):
            right = np.array([_one_out(reduced, other) for other in _divisions(labels)])
            found += [float(right[0]), float(right.mean()), float((right >= right[0] - TIE).mean())]
    return Decoded(*found)


def mean_decoded(several: Sequence[Decoded]) -> Decoded:
    """The mean over animals, as the paper's row of them; p is of no mean, and so NaN.

    Animals that nothing can be decoded of are left out; without any other all is NaN.
    """
    there = [one for one in several if math.isfinite(one.shape)]
    nan = math.nan
    if not there:
        return Decoded(*[nan] * 6)
    shape, shape_chance, distance, distance_chance = (
        float(np.mean([getattr(one, name) for one in there]))
        for name in ("shape", "shape_chance", "distance", "distance_chance")
    )
    return Decoded(shape, shape_chance, nan, distance, distance_chance, nan)


def _nearest(squares: Floats, labels: NDArray[np.intp], folds: NDArray[np.intp]) -> Floats:
    """Accuracies (...) from squared distances (..., 6, 6); equals count as a guess among them."""
    right: Floats = np.zeros(squares.shape[:-2])
    for fold in np.unique(folds):
        tested = np.flatnonzero(folds == fold)
        away = []
        for label in np.unique(labels):
            members = np.flatnonzero((folds != fold) & (labels == label))
            within = squares[..., members[:, None], members[None, :]].mean(axis=(-2, -1))
            to = squares[..., tested[:, None], members[None, :]].mean(axis=-1)
            away.append(to - within[..., None] / 2)  # to the members' mean
        distances = np.stack(away, axis=-1)  # (..., tested, label)
        least = distances <= distances.min(axis=-1, keepdims=True) + TIE
        hit = np.take_along_axis(
            least, np.broadcast_to(labels[tested][:, None], (*least.shape[:-1], 1)), axis=-1
        )[..., 0]
        right += (hit / least.sum(axis=-1)).sum(axis=-1)
    return right / len(labels)


def _one_out(values: Floats, labels: Labels) -> float:
    from sklearn.linear_model import LogisticRegression

    goal = np.array(labels)
    right = 0
    for i in range(len(goal)):
        others = np.arange(len(goal)) != i
        machine = LogisticRegression(max_iter=1000).fit(values[others], goal[others])
        right += int(machine.predict(values[i : i + 1])[0] == goal[i])
    return right / len(goal)


@cache
def _divisions(labels: Labels) -> tuple[Labels, ...]:
    """Every division into classes of the same sizes, whatever their names; the given first."""

    def renamed(order: Labels) -> Labels:
        names: dict[int, int] = {}
        return tuple(names.setdefault(label, len(names)) for label in order)

    divisions = {renamed(labels): None}
    divisions.update(dict.fromkeys(sorted({renamed(p) for p in permutations(labels)})))
    return tuple(divisions)
