"""Decoding of shape and distance from responses to the six stimuli, and chance levels.

Shape is decoded with one distance held out, distance with one shape held out, so that all classes
have equally many training stimuli: on noise, the nearest class mean is right as often as a guess.
The paper holds out one stimulus at a time, which leaves the right class one training stimulus less:
on noise in many dimensions the decoder is almost never right, and chance is not 1/2 or 1/3.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.rdm import Floats, rdm, to_matrices
from tactile_rt.core.stream.stimuli import DISTANCES, SHAPES, STIMULI

Labels = tuple[int, ...]

SHAPE: Labels = tuple(SHAPES.index(name.split("-")[0]) for name in STIMULI)
DISTANCE: Labels = tuple(DISTANCES.index(name.split("-")[1]) for name in STIMULI)
TIE = 1e-9


@dataclass(frozen=True)
class Decoded:
    """Accuracies of decoding held-out stimuli, 0 to 1; NaN for responses without an RDM.

    For each accuracy, `chance` is the mean accuracy over all relabellings of the stimuli, and `p`
    the share of relabellings that are at least as accurate as the true labels.
    """

    shape: float
    shape_chance: float
    shape_p: float
    distance: float
    distance_chance: float
    distance_p: float


def decode(patterns: ArrayLike) -> Decoded:
    """Decode shape and distance by the nearest class mean of normalised responses (6, unit)."""
    return decode_rdm(rdm(patterns))


def decode_rdm(entries: ArrayLike) -> Decoded:
    """Decode shape and distance by the nearest class mean, from an RDM (15,).

    The null distribution is exact: all 720 relabellings, the true labels included.
    """
    squares = 2 * to_matrices(entries)  # squared Euclidean distances of vectors of length one
    if not np.isfinite(squares).all():
        return Decoded(*[float("nan")] * 6)
    orders = np.array(list(permutations(range(len(STIMULI)))))
    relabelled = squares[orders[:, :, None], orders[:, None, :]]  # (720, 6, 6)
    found = []
    for labels, folds in ((SHAPE, DISTANCE), (DISTANCE, SHAPE)):
        right = _score_nearest(relabelled, np.array(labels), np.array(folds))
        found += [float(right[0]), float(right.mean()), float((right >= right[0] - TIE).mean())]
    return Decoded(*found)


def decode_paper(patterns: ArrayLike) -> Decoded:
    """Decode responses (6, unit) by the paper's method: leave-one-out logistic regression.

    Chance is the mean over all divisions of the stimuli into classes of the same sizes.
    """
    values = np.asarray(patterns, dtype=np.float64)
    values = values - values.mean(axis=0)
    if not np.isfinite(values).all():
        return Decoded(*[float("nan")] * 6)
    u, s, _ = np.linalg.svd(values, full_matrices=False)
    reduced = u * s  # the penalty is the same in any orthonormal basis
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    found = []
    # One thread: with five points, threads only wait for each other, for minutes if busy.
    with threadpool_limits(1):
        for labels in (SHAPE, DISTANCE):
            right = np.array([_leave_one_out(reduced, other) for other in _list_divisions(labels)])
            found += [float(right[0]), float(right.mean()), float((right >= right[0] - TIE).mean())]
    return Decoded(*found)


def mean_decoded(several: Sequence[Decoded]) -> Decoded:
    """Average accuracies and chance levels over animals, as in the paper's table.

    Animals without accuracies are left out; p is NaN, and without any animal so are all values.
    """
    finite = [one for one in several if math.isfinite(one.shape)]
    nan = math.nan
    if not finite:
        return Decoded(*[nan] * 6)
    shape, shape_chance, distance, distance_chance = (
        float(np.mean([getattr(one, name) for one in finite]))
        for name in ("shape", "shape_chance", "distance", "distance_chance")
    )
    return Decoded(shape, shape_chance, nan, distance, distance_chance, nan)


def _score_nearest(squares: Floats, labels: NDArray[np.intp], folds: NDArray[np.intp]) -> Floats:
    """Compute nearest-mean accuracies (...) from squared distances; ties count as guesses."""
    right: Floats = np.zeros(squares.shape[:-2])
    for fold in np.unique(folds):
        tested = np.flatnonzero(folds == fold)
        away = []
        for label in np.unique(labels):
            members = np.flatnonzero((folds != fold) & (labels == label))
            within = squares[..., members[:, None], members[None, :]].mean(axis=(-2, -1))
            to = squares[..., tested[:, None], members[None, :]].mean(axis=-1)
            away.append(to - within[..., None] / 2)  # squared distance to the members' mean
        distances = np.stack(away, axis=-1)  # (..., tested, label)
        least = distances <= distances.min(axis=-1, keepdims=True) + TIE
        hit = np.take_along_axis(
            least, np.broadcast_to(labels[tested][:, None], (*least.shape[:-1], 1)), axis=-1
        )[..., 0]
        right += (hit / least.sum(axis=-1)).sum(axis=-1)
    return right / len(labels)


def _leave_one_out(values: Floats, labels: Labels) -> float:
    """Return the leave-one-out accuracy of logistic regression on values (stimulus, feature)."""
    from sklearn.linear_model import LogisticRegression

    goal = np.array(labels)
    right = 0
    for i in range(len(goal)):
        others = np.arange(len(goal)) != i
        machine = LogisticRegression(max_iter=1000).fit(values[others], goal[others])
        right += int(machine.predict(values[i : i + 1])[0] == goal[i])
    return right / len(goal)


@cache
def _list_divisions(labels: Labels) -> tuple[Labels, ...]:
    """List all partitions of the stimuli into classes of the sizes in `labels`, `labels` first."""

    def renumber(order: Labels) -> Labels:
        names: dict[int, int] = {}
        return tuple(names.setdefault(label, len(names)) for label in order)

    divisions = {renumber(labels): None}
    divisions.update(dict.fromkeys(sorted({renumber(p) for p in permutations(labels)})))
    return tuple(divisions)
