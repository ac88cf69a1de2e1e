"""From a few touches of each class to what tells them apart, and from everything else.

At every step, a class is the mean of its touches' features, and all classes share how touches of
one class differ: a covariance of few directions, and of the same small variance in all others
(probabilistic principal components: Tipping & Bishop 1999, doi:10.1111/1467-9868.00196). A
decision is the nearest mean by that measure; what is far from all of them is unknown. How far a
touch of a class may be from its mean is learnt leave-one-out, and where there are touches of
anything else, from these, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError

FEWEST = 2  # touches of a class
AXES = 16  # directions in which touches of a class differ
SHARE = 0.1  # of the mean variance, added to the shared covariance in every direction
FOLDS = 10
REFUSED = 0.06  # of the touches, leave-one-out, at most, are taken for unknown
# Where touches of anything else are known, the reach leaves out so many of them, as long as it
# refuses no more than this share of the classes' and is no wider than so many times the usual one.
OTHERS_LET_IN, REFUSED_FOR_OTHERS, WIDER = 0.1, 0.12, 1.2
ENOUGH = 5  # touches of a class, below which they do not tell how far others may be
MAD, FARTHEST = 1.4826, 2.5  # standard deviations of the logarithm of the distance, at most
LIMIT = 5.0  # standardised features are limited to, either way: one outlier is not the decision
# A feature's scale is no less than so many times the median one of its kind, and than this share
# of its whole spread: what never varied in ten touches may still vary in the eleventh.
LEAST_OF_KIND, LEAST_OF_SPREAD = 4.0, 0.15
TEMPERATURES = np.geomspace(1.0, 1e4, 81)
TINY = 1e-9

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TouchClasses:
    """What tells classes apart, step by step.

    Standardised features are (f - mean) / scale, limited to 5.
    """

    labels: tuple[str, ...]
    mean: Floats  # (step, feature)
    scale: Floats  # (step, feature)
    centres: Floats  # (step, class, feature) means of the classes, standardised
    # (step, feature, axis) directions in which touches of a class differ, each as long as a unit
    # along it weighs less than a unit across all
    axes: Floats
    rest: Floats  # (step,) variance in all other directions
    # (class,) of a squared distance: what is left when the part from a mean of few touches is off
    share: Floats
    reach: Floats  # (step,) squared distance from the nearest class beyond which all is unknown
    temperature: float  # divides half of the squared distances: posteriors mean what they say

    def distances(self, features: Floats) -> Floats:
        """(touch, step, class) squared distances of touches (touch, step, feature)."""
        found = np.clip((features - self.mean) / self.scale, -LIMIT, LIMIT)
        away = found[:, :, None] - self.centres
        along = np.einsum("tscf,sfa->tsca", away, self.axes)
        whole = np.square(away).sum(-1) / self.rest[:, None] - np.square(along).sum(-1)
        return np.asarray(self.share * whole)


@dataclass(frozen=True)
class LeaveOneOut:
    """What was made of every touch, leave-one-out: by the others alone."""

    distances: Floats  # (touch, step, class) squared distances from the classes of the others
    right: NDArray[np.bool_]  # (touch,) whether the nearest class at the last step was its own


def fit_classes(
    features: Floats,
    labels: Sequence[str],
    kinds: Sequence[slice],
    told: LeaveOneOut | None = None,
    others: Floats | None = None,
) -> TouchClasses:
    """Learn classes.

    Args:
        features: (touch, step, feature) of all touches.
        labels: (touch,) the class of each.
        kinds: which features are of one kind, and so of one scale.
        told: what `leave_one_out` said of these touches; None: it is asked.
        others: (touch, step, feature) of touches of anything else; None: there are none.
    """
    _check_enough(labels)
    told = told or leave_one_out(features, labels, kinds)
    nearest = told.distances.min(axis=2)  # (touch, step)
    classes, own = np.unique(np.asarray(labels), return_inverse=True)
    many = np.bincount(own)[own] >= ENOUGH
    nearest = nearest[many] if many.any() else nearest
    rank = min(len(nearest) - 1, int(np.ceil((1 - REFUSED) * (len(nearest) + 1))) - 1)
    # A touch under a wrong name is far from its class; it is not to let everything through.
    logs = np.log(nearest + TINY)
    middle = np.median(logs, axis=0)
    spread = MAD * np.median(np.abs(logs - middle), axis=0)
    reach = np.minimum(np.sort(nearest, axis=0)[rank], np.exp(middle + FARTHEST * spread))
    temperature = _temperature(told.distances[:, -1], own)
    names = tuple(str(name) for name in classes)
    found = TouchClasses(names, *_shared(features, own, kinds), reach, temperature)
    if others is None or not len(others):
        return found
    far = np.quantile(found.distances(others).min(axis=2), OTHERS_LET_IN, axis=0)
    least = np.minimum(reach, np.quantile(nearest, 1 - REFUSED_FOR_OTHERS, axis=0))
    return replace(found, reach=np.clip(far, least, WIDER * reach))


def count_refused(
    features: Floats, labels: Sequence[str], kinds: Sequence[slice], others: Floats
) -> int:
    """Count the touches of anything else that are refused at the last step.

    Each of `others` (touch, step, feature) is judged by what is learnt without it.
    """
    told, refused = leave_one_out(features, labels, kinds), 0
    for k in range(len(others)):
        found = fit_classes(features, labels, kinds, told, np.delete(others, k, axis=0))
        refused += bool(found.distances(others[k : k + 1])[0, -1].min() > found.reach[-1])
    return refused


def leave_one_out(features: Floats, labels: Sequence[str], kinds: Sequence[slice]) -> LeaveOneOut:
    """Judge every touch by what is learnt from others: of many, a tenth of each class at a time.

    Takes what `fit_classes` takes; at least two touches of each class.
    """
    _check_enough(labels)
    classes, own = np.unique(np.asarray(labels), return_inverse=True)
    turn = np.empty(len(own), dtype=int)
    for k in range(len(classes)):
        count = int((own == k).sum())
        turn[own == k] = np.arange(count) % min(FOLDS, count)
    distances = np.empty((*features.shape[:2], len(classes)))
    for fold in range(turn.max() + 1):
        out = turn == fold
        learnt = TouchClasses(
            tuple(classes), *_shared(features[~out], own[~out], kinds), np.zeros(0), 1.0
        )
        distances[out] = learnt.distances(features[out])
    return LeaveOneOut(distances, distances[:, -1].argmin(axis=1) == own)


def _check_enough(labels: Sequence[str]) -> None:
    """Refuse labels of which one has fewer than two touches."""
    for name in dict.fromkeys(labels):
        if list(labels).count(name) < FEWEST:
            raise ConfigError(f"there is one touch of {name!r}; a class needs {FEWEST} at least")


def _shared(
    features: Floats, own: NDArray[np.intp], kinds: Sequence[slice]
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """mean, scale, centres, axes, rest and share, as `TouchClasses` has them."""
    count = int(own.max()) + 1
    share = 1 - 1 / (np.bincount(own) + 1.0)
    freedom = max(1, len(own) - count)
    mean = features.mean(axis=0)
    scale = np.sqrt(np.square(features - _means(features, own)[own]).sum(axis=0) / freedom)
    spread = features.std(axis=0)
    for kind in kinds:
        usual = LEAST_OF_KIND * np.median(scale[:, kind], axis=1, keepdims=True)
        least = np.hypot(usual, LEAST_OF_SPREAD * spread[:, kind])
        scale[:, kind] = np.hypot(scale[:, kind], least) + TINY
    found = np.clip((features - mean) / scale, -LIMIT, LIMIT)
    centres = _means(found, own)
    apart = np.swapaxes(found - centres[own], 0, 1)  # (step, touch, feature)
    # The covariance has no more directions than touches: they are found among these.
    values, vectors = np.linalg.eigh(apart @ np.swapaxes(apart, 1, 2) / freedom)
    values, vectors = values[:, ::-1][:, :AXES], vectors[:, :, ::-1][:, :, :AXES]
    average = np.square(apart).sum(axis=(1, 2)) / (freedom * apart.shape[2])  # variance
    rest = SHARE * average + TINY
    along = np.swapaxes(apart, 1, 2) @ vectors  # (step, feature, axis)
    along /= np.linalg.norm(along, axis=1, keepdims=True) + TINY
    kept = (1 - SHARE) * np.maximum(values, 0) + rest[:, None]
    less = np.sqrt(np.maximum(0, 1 / rest[:, None] - 1 / kept))
    return mean, scale, np.swapaxes(centres, 0, 1), along * less[:, None], rest, share


def _means(features: Floats, own: NDArray[np.intp]) -> Floats:
    """(class, step, feature)."""
    return np.stack([features[own == k].mean(axis=0) for k in range(int(own.max()) + 1)])


def _temperature(distances: Floats, own: NDArray[np.intp]) -> float:
    """That with the likeliest posteriors of the touches' own classes."""
    if distances.shape[1] == 1:
        return float(max(1.0, np.median(distances)))
    least = distances - distances.min(axis=1, keepdims=True)
    rows = np.arange(len(own))
    scored = least / 2 / TEMPERATURES[:, None, None]
    losses = scored[:, rows, own] + np.log(np.exp(-scored).sum(axis=2))
    return float(TEMPERATURES[losses.mean(axis=1).argmin()])
