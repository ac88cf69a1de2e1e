"""The rule that matches touches to enrolled objects, fitted on validation sweeps.

Half of the objects give the Gaussians of objects and touches, the other half the score below which
few touches of an enrolled object fall, and vice versa; a file has the Gaussians of all objects.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier import enrolment
from tactile_rt.classifier.enrolment import IdentityRule
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import Disturbance
from tactile_rt.models.evaluation.measures import Floats, Names, Step, cut_windows, run_over

REFUSED = 0.05  # of touches of enrolled objects
AMONG = (1, 5, 20, 100)  # numbers of enrolled objects
FEWEST = 20  # objects below which that share is not measured
DRAWS = 20  # random draws of the touches that enrol an object and of those to judge
SHARED = 0.2  # share of the touches' covariance that is taken as isotropic
DIRECTIONS, LEAST = 32, 0.05  # most directions; least variance of objects in each
TINY = 1e-6  # least variance of embeddings of length 1
PER_DIRECTION = 4  # least objects per direction: fewer do not show how objects differ in it

Doubles = NDArray[np.float64]
NONE_YET = np.zeros((len(AMONG), enrolment.ENROLLED, enrolment.JUDGED))


def fit_identity(sets: Sequence[SweepSet], run: Step) -> IdentityRule | None:
    """Fit the rule that matches touches to enrolled objects; None with few objects.

    Args:
        sets: sweeps of objects that the network was not trained on.
        run: maps (samples, offset, sigma) of windows to embeddings, (batch, step, unit).
    """
    embeddings, objects = [], []
    for k, one in enumerate(sets):
        found, touched = run_over(cut_windows(one, disturbance=Disturbance(noise=1.0)), run)
        embeddings.append(found[touched, -1])
        objects += [f"{k} {name}" for name in one.sweeps.objects[touched]]
    touches, names = np.concatenate(embeddings), np.array(objects, dtype=str)
    table = identity_thresholds(touches, names)
    return None if np.isnan(table).any() else fit_gaussians(touches, names, table)


def identity_thresholds(embeddings: Floats, objects: Names) -> Doubles:
    """Return the log-odds below which few touches of enrolled objects fall.

    Args:
        embeddings: (touch, unit) embeddings of touches at their last step.
        objects: (touch,) name of the object that each touch is of.

    Returns:
        Thresholds, (among, enrolled, judged), by the numbers of objects and touches; with too few
        objects for a number, the threshold of a smaller number; NaN without any.
    """
    rng = np.random.default_rng(0)
    table = np.full((len(AMONG), enrolment.ENROLLED, enrolment.JUDGED), np.nan)
    names, count = np.unique(objects, return_counts=True)
    if (count > 1).sum() < FEWEST:
        return table
    halves = [np.isin(objects, names[k::2]) for k in range(2)]
    rules = [fit_gaussians(embeddings[half], objects[half]) for half in halves]
    for n, m in product(range(1, enrolment.ENROLLED + 1), range(1, enrolment.JUDGED + 1)):
        best: list[list[float]] = [[] for _ in AMONG]
        for k, rule in enumerate(rules[::-1]):
            places = enrolment.project(rule, embeddings)
            known = [np.flatnonzero(objects == name) for name in names[k::2]]
            known = [own for own in known if len(own) >= n + m]
            for _ in range(DRAWS if known else 0):
                drawn = np.stack([places[rng.permutation(own)[: n + m]] for own in known])
                enrolled, judged = drawn[:, :n].mean(axis=1), drawn[:, n:].mean(axis=1)
                odds = enrolment.log_odds(np.array(rule.between), enrolled, n, judged[:, None], m)
                order = rng.permutation(len(known))
                for many, scores in zip(AMONG, best, strict=True):
                    groups = order[: len(order) // many * many].reshape(-1, many)
                    scores += odds[groups[:, :, None], groups[:, None]].max(axis=2).ravel().tolist()
        found = table[:, n - 1, m - 1]
        found[:] = table[:, n - 2, m - 1] if n > 1 else table[:, 0, m - 2]
        for j, scores in enumerate(best):
            if len(scores) >= FEWEST * DRAWS:
                found[j] = np.quantile(scores, REFUSED, method="lower")
            elif j and np.isnan(found[j]):
                found[j] = found[j - 1]
    return table


def fit_gaussians(
    embeddings: Floats, objects: Names, thresholds: Doubles = NONE_YET
) -> IdentityRule:
    """Fit the Gaussians of objects and touches; return them as a rule with thresholds."""
    names, own, count = np.unique(objects, return_inverse=True, return_counts=True)
    means = np.stack([embeddings[own == k].mean(axis=0) for k in range(len(names))]).astype(float)
    apart = embeddings - means[own]
    within = apart.T @ apart / max(1, len(own) - len(names))
    alike = np.trace(within) / len(within) * np.eye(len(within))
    values, vectors = np.linalg.eigh((1 - SHARED) * within + SHARED * alike)
    whitening = vectors / np.sqrt(np.maximum(values, TINY))
    origin = means.mean(axis=0)
    spread = (means - origin) @ whitening
    # a mean of few touches also varies by the touches: subtract that part
    values, vectors = np.linalg.eigh(spread.T @ spread / (len(names) - 1))
    between = (values - (1 / count).mean())[::-1]
    known = min(DIRECTIONS, len(names) // PER_DIRECTION, int((between > LEAST).sum()))
    most = max(1, known)
    directions = whitening @ vectors[:, ::-1][:, :most]
    return IdentityRule(
        enrolment.LOG_ODDS,
        REFUSED,
        AMONG,
        tuple(thresholds.ravel().tolist()),
        len(names),
        origin.astype("<f2").tobytes(),
        directions.astype("<f2").tobytes(),
        tuple(float(value) for value in np.maximum(between[:most], LEAST)),
    )
