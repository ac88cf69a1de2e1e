"""Classes learnt from a few touches each, to distinguish them and to refuse anything else.

At every step, a class is the mean of its touches' features, and all classes share one covariance of
touches within a class: a few main directions, and the same small variance in all others
(probabilistic principal components: Tipping & Bishop 1999, doi:10.1111/1467-9868.00196). A
decision is the nearest mean by that metric; a touch that is far from all means is unknown. The
reach, how far a touch may be from the mean of its class, is learnt leave-one-out and, if there are
touches of anything else, also from these.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError

FEWEST = 2  # touches of a class
AXES = 16  # main directions of the covariance
SHARE = 0.1  # of the mean variance, added to the shared covariance in every direction
FOLDS = 10
REFUSED = 0.06  # of the touches, leave-one-out, at most, are taken for unknown
# If touches of anything else are known, the reach lets in this share of them, as long as it refuses
# no more than that share of the classes' touches and is at most so many times the usual reach.
OTHERS_LET_IN, REFUSED_FOR_OTHERS, WIDER = 0.1, 0.12, 1.2
ENOUGH = 5  # touches of a class that suffice to estimate the reach
MAD, FARTHEST = 1.4826, 2.5  # MAD to standard deviation; of the log distance, at most
LIMIT = 5.0  # of standardised features, either way, so that one outlier does not decide
# A feature's scale is at least so many times the median scale of its kind, and this share of its
# whole spread: a feature that never varied in ten touches may still vary in the eleventh.
LEAST_OF_KIND, LEAST_OF_SPREAD = 4.0, 0.15
TEMPERATURES = np.geomspace(1.0, 1e4, 81)
TINY = 1e-9

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TouchClasses:
    """Classes learnt from touches: their means, shared covariance and reach in every step.

    Standardised features are (f - mean) / scale, limited to 5.
    """

    labels: tuple[str, ...]
    mean: Floats  # (step, feature)
    scale: Floats  # (step, feature)
    centres: Floats  # (step, class, feature) means of the classes, standardised
    # (step, feature, axis) main directions of the covariance; the squared length of each is
    # 1 / rest minus the inverse variance along it
    axes: Floats
    rest: Floats  # (step,) variance in all other directions
    # (class,) factor of squared distances that corrects for the error of a mean of few touches
    share: Floats
    reach: Floats  # (step,) squared distance from the nearest class beyond which all is unknown
    temperature: float  # divides half of the squared distances, so that posteriors are calibrated

    def distances(self, features: Floats) -> Floats:
        """Return squared distances (touch, step, class) of features (touch, step, feature)."""
        found = np.clip((features - self.mean) / self.scale, -LIMIT, LIMIT)
        away = found[:, :, None] - self.centres
        along = np.einsum("tscf,sfa->tsca", away, self.axes)
        whole = np.square(away).sum(-1) / self.rest[:, None] - np.square(along).sum(-1)
        return np.asarray(self.share * whole)


@dataclass(frozen=True)
class LeaveOneOut:
    """Leave-one-out results: each touch is classified by what is learnt from the others."""

    distances: Floats  # (touch, step, class) squared distances from the classes of the others
    right: NDArray[np.bool_]  # (touch,) whether the nearest class at the last step was its own


def fit_classes(
    features: Floats,
    labels: Sequence[str],
    kinds: Sequence[slice],
    judged: LeaveOneOut | None = None,
    others: Floats | None = None,
) -> TouchClasses:
    """Learn classes from labelled touches, and their reach and temperature leave-one-out.

    Args:
        features: (touch, step, feature) The features of all touches.
        labels: (touch,) The class of each touch.
        kinds: The slices of features of one kind, which have similar scales.
        judged: The result of `leave_one_out` for these touches, or None to compute it.
        others: (touch, step, feature) The features of touches of anything else, or None.
    """
    _check_enough(labels)
    judged = judged or leave_one_out(features, labels, kinds)
    nearest = judged.distances.min(axis=2)  # (touch, step)
    classes, own = np.unique(np.asarray(labels), return_inverse=True)
    many = np.bincount(own)[own] >= ENOUGH
    nearest = nearest[many] if many.any() else nearest
    rank = min(len(nearest) - 1, int(np.ceil((1 - REFUSED) * (len(nearest) + 1))) - 1)
    # A touch with a wrong label is far from its class; it must not make the reach too wide.
    logs = np.log(nearest + TINY)
    middle = np.median(logs, axis=0)
    spread = MAD * np.median(np.abs(logs - middle), axis=0)
    reach = np.minimum(np.sort(nearest, axis=0)[rank], np.exp(middle + FARTHEST * spread))
    temperature = _fit_temperature(judged.distances[:, -1], own)
    names = tuple(str(name) for name in classes)
    found = TouchClasses(names, *_fit_shared(features, own, kinds), reach, temperature)
    if others is None or not len(others):
        return found
    far = np.quantile(found.distances(others).min(axis=2), OTHERS_LET_IN, axis=0)
    least = np.minimum(reach, np.quantile(nearest, 1 - REFUSED_FOR_OTHERS, axis=0))
    return replace(found, reach=np.clip(far, least, WIDER * reach))


def count_refused(
    features: Floats, labels: Sequence[str], kinds: Sequence[slice], others: Floats
) -> int:
    """Return how many touches of no class (`others`) are refused at the last step.

    Each of `others` (touch, step, feature) is judged by what is learnt without it.
    """
    judged, refused = leave_one_out(features, labels, kinds), 0
    for k in range(len(others)):
        found = fit_classes(features, labels, kinds, judged, np.delete(others, k, axis=0))
        refused += bool(found.distances(others[k : k + 1])[0, -1].min() > found.reach[-1])
    return refused


def leave_one_out(features: Floats, labels: Sequence[str], kinds: Sequence[slice]) -> LeaveOneOut:
    """Classify each touch by what is learnt from the other touches.

    Of more than ten touches of a class, a tenth is left out at a time. A class needs two or more.
    """
    _check_enough(labels)
    classes, own = np.unique(np.asarray(labels), return_inverse=True)
    fold_of = np.empty(len(own), dtype=int)
    for k in range(len(classes)):
        count = int((own == k).sum())
        fold_of[own == k] = np.arange(count) % min(FOLDS, count)
    distances = np.empty((*features.shape[:2], len(classes)))
    for fold in range(fold_of.max() + 1):
        out = fold_of == fold
        learnt = TouchClasses(
            tuple(classes), *_fit_shared(features[~out], own[~out], kinds), np.zeros(0), 1.0
        )
        distances[out] = learnt.distances(features[out])
    return LeaveOneOut(distances, distances[:, -1].argmin(axis=1) == own)


def _check_enough(labels: Sequence[str]) -> None:
    """Raise `ConfigError` if a class has fewer than two touches."""
    for name in dict.fromkeys(labels):
        if list(labels).count(name) < FEWEST:
            raise ConfigError(f"there is one touch of {name!r}; a class needs {FEWEST} at least")


def _fit_shared(
    features: Floats, own: NDArray[np.intp], kinds: Sequence[slice]
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Return the fields mean, scale, centres, axes, rest and share of `TouchClasses`."""
    count = int(own.max()) + 1
    share = 1 - 1 / (np.bincount(own) + 1.0)
    freedom = max(1, len(own) - count)
    mean = features.mean(axis=0)
    scale = np.sqrt(np.square(features - _compute_means(features, own)[own]).sum(axis=0) / freedom)
    spread = features.std(axis=0)
    for kind in kinds:
        usual = LEAST_OF_KIND * np.median(scale[:, kind], axis=1, keepdims=True)
        least = np.hypot(usual, LEAST_OF_SPREAD * spread[:, kind])
        scale[:, kind] = np.hypot(scale[:, kind], least) + TINY
    found = np.clip((features - mean) / scale, -LIMIT, LIMIT)
    centres = _compute_means(found, own)
    apart = np.swapaxes(found - centres[own], 0, 1)  # (step, touch, feature)
    # The covariance has at most as many directions as touches: compute them from inner products.
    values, vectors = np.linalg.eigh(apart @ np.swapaxes(apart, 1, 2) / freedom)
    values, vectors = values[:, ::-1][:, :AXES], vectors[:, :, ::-1][:, :, :AXES]
    average = np.square(apart).sum(axis=(1, 2)) / (freedom * apart.shape[2])  # variance
    rest = SHARE * average + TINY
    along = np.swapaxes(apart, 1, 2) @ vectors  # (step, feature, axis)
    along /= np.linalg.norm(along, axis=1, keepdims=True) + TINY
    kept = (1 - SHARE) * np.maximum(values, 0) + rest[:, None]
    less = np.sqrt(np.maximum(0, 1 / rest[:, None] - 1 / kept))
    return mean, scale, np.swapaxes(centres, 0, 1), along * less[:, None], rest, share


def _compute_means(features: Floats, own: NDArray[np.intp]) -> Floats:
    """Compute the mean features of each class (class, step, feature)."""
    return np.stack([features[own == k].mean(axis=0) for k in range(int(own.max()) + 1)])


def _fit_temperature(distances: Floats, own: NDArray[np.intp]) -> float:
    """Return the temperature that makes the touches' own classes most likely."""
    if distances.shape[1] == 1:
        return float(max(1.0, np.median(distances)))
    least = distances - distances.min(axis=1, keepdims=True)
    rows = np.arange(len(own))
    scored = least / 2 / TEMPERATURES[:, None, None]
    losses = scored[:, rows, own] + np.log(np.exp(-scored).sum(axis=2))
    return float(TEMPERATURES[losses.mean(axis=1).argmin()])
