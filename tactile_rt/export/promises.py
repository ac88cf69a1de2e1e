"""What a model file promises, fitted on sweeps that its network has not learnt from.

Candidates are conformal: the truth is among them at every step for as many touches of new objects
as was promised, whatever the network makes of them, as long as these are drawn as those were that
the rule was fitted on (Vovk, Gammerman & Shafer 2005). Sweeps of one object are alike, so that an
object counts once, however often it was swept (Lee, Barber & Willett 2023, hierarchical conformal
prediction). A robot may stop at any step, so that the promise is about all of them at once: a
sweep's score is that of its worst step, steps being compared by how rare their scores are.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.decision_rules import (
    MASS_ABOVE,
    POSTERIOR,
    UNKNOWN,
    CandidateRule,
    UnknownRule,
    mass_above,
)
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.evaluation import Step, at_temperature, predict

__all__ = ["COVERAGE", "fit_candidates", "fit_unknown", "fitted_rules"]

COVERAGE = 0.96
REFUSED = 0.08  # of the sweeps of known kinds, at most, at the threshold
FEWEST = 50  # objects below which no promise is made: it would leave nearly all classes possible
# A rule holds up to a noise, and is fitted at these, in units of the rated.
NOISE = {0.3: (0.0, 0.25), 1.2: (1.0,), 2.2: (2.0,)}

Floats = NDArray[np.float64]


def fitted_rules(
    sets: Sequence[SweepSet], run: Step, temperature: float, labels: Sequence[str], classes: int
) -> tuple[UnknownRule | None, tuple[CandidateRule, ...]]:
    """The rules of a model.

    Args:
        sets: labelled sweeps that it has not learnt from, as groups of which each is to be kept
            the promise.
        run: (samples, offset, sigma) of windows to (batch, step, label) logits.
        temperature: of the model.
        labels: what it tells apart.
        classes: how many of the labels are classes; the others are refusals.
    """
    posteriors = {
        level: [at_temperature(predict(one, run, level), temperature) for one in sets]
        for level in sorted({level for levels in NOISE.values() for level in levels})
    }
    unknown = None
    if UNKNOWN in labels[classes:]:
        at = list(labels).index(UNKNOWN)
        groups = [
            np.concatenate([posteriors[level][k][..., at] for level in (0.0, 1.0)])
            for k in range(len(sets))
        ]
        unknown = fit_unknown(groups)
    rules = []
    for bound, levels in NOISE.items():
        drawn = [
            (
                np.concatenate([posteriors[level][k][..., :classes] for level in levels]),
                np.tile(one.sweeps.labels, len(levels)),
                np.tile(one.sweeps.objects, len(levels)),
            )
            for k, one in enumerate(sets)
        ]
        if (rule := fit_candidates(drawn, bound)) is not None:
            rules.append(rule)
    return unknown, tuple(rules)


def fit_unknown(groups: Sequence[NDArray[np.float32]], refused: float = REFUSED) -> UnknownRule:
    """The threshold of each step by which at most so many sweeps of known kinds are refused.

    Args:
        groups: posteriors (sweep, step) of the label `unknown`, NaN where no contact was found;
            each of the groups is refused no more.
        refused: the share.
    """
    each = [np.nanquantile(group, 1 - refused, axis=0) for group in groups]
    thresholds = np.max(each, axis=0)
    return UnknownRule(POSTERIOR, "logits", tuple(float(round(t, 6)) for t in thresholds))


def fit_candidates(
    groups: Sequence[tuple[NDArray[np.float32], NDArray[np.int64], NDArray[np.str_]]],
    noise: float,
    coverage: float = COVERAGE,
) -> CandidateRule | None:
    """The quantiles that keep the promise to each of the groups; None of too few objects.

    Args:
        groups: posteriors (sweep, step, class), NaN where no contact was found, labels (sweep,)
            and objects (sweep,).
        noise: the largest in units of the rated at which they hold.
        coverage: the promise.
    """
    fitted, objects = [], 0
    for posteriors, labels, names in groups:
        found = ~np.isnan(posteriors[:, 0, 0])
        names = names[found]
        scores = mass_above(posteriors[found])[np.arange(int(found.sum())), :, labels[found]]
        objects += len(set(names.tolist()))
        fitted.append(_envelope(scores, _weights(names), coverage))
    if objects < FEWEST:
        return None
    quantiles = np.max(fitted, axis=0)
    return CandidateRule(
        MASS_ABOVE, coverage, tuple(float(q) for q in quantiles), objects, noise=noise
    )


def _weights(names: NDArray[np.str_]) -> Floats:
    """(sweep,) Each object's weight is one of all objects and one yet to come."""
    _, which, count = np.unique(names, return_inverse=True, return_counts=True)
    weights: Floats = 1 / (count[which] * (len(count) + 1))
    return weights


def _envelope(scores: Floats, weights: Floats, coverage: float) -> Floats:
    """(step,) The scores that no step of so large a share of the sweeps exceeds.

    Args:
        scores: (sweep, step), in [0, 1).
        weights: (sweep,), of which the sum is less than 1.
        coverage: the share.
    """
    sweeps, steps = scores.shape
    order = np.argsort(scores, axis=0)
    ranked = np.take_along_axis(scores, order, axis=0)
    share = np.cumsum(weights[order], axis=0)  # (sweep, step) of all that are no larger
    rarity = np.empty_like(scores)  # (sweep, step) how large a share is no larger
    for step in range(steps):
        last = np.searchsorted(ranked[:, step], scores[:, step], side="right") - 1
        rarity[:, step] = share[last, step]
    worst = rarity.max(axis=1)
    at = np.argsort(worst)
    enough = np.searchsorted(np.cumsum(weights[at]), coverage)
    if enough == sweeps:
        return np.ones(steps)  # too few objects for any set but that of all classes
    level = worst[at[enough]]
    which = [np.searchsorted(share[:, step], level - 1e-12) for step in range(steps)]
    found: Floats = ranked[np.minimum(which, sweeps - 1), np.arange(steps)]
    return found
