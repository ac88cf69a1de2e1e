"""Temperature, prediction sets and refusals of a model, fitted on validation sweeps.

Prediction sets are conformal: the truth is in that of every step for as many touches of new objects
as the coverage says, whatever the network makes of them, as long as these are drawn as those were
that the rule was fitted on (Vovk, Gammerman & Shafer 2005). Sweeps of one object are alike, so that
an object counts once, however often it was swept (Lee, Barber & Willett 2023, hierarchical
conformal prediction). A robot may stop at any step, so that the coverage is that of all of them at
once: a sweep's score is that of its worst step. What is usual at a step, which steps are compared
by, is told by half of the objects; the other half, for which that is given, tells how far a sweep
may be from it.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tactile_rt.classifier.decision_rules import (
    MASS_ABOVE,
    POSTERIOR,
    UNKNOWN,
    OpenSetRule,
    PredictionSetRule,
    mass_above,
)
from tactile_rt.core.errors import RecordingError
from tactile_rt.export.identity import Doubles
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import Disturbance
from tactile_rt.models.evaluation.measures import (
    Floats,
    Labels,
    Names,
    Step,
    at_temperature,
    cut_windows,
    predict,
    run_over,
    split_by_class,
)

TEMPERATURES = np.geomspace(0.25, 4.0, 81)
COVERAGE = 0.9
REFUSED = 0.08  # of the sweeps of known kinds, at most, at each step
LEAST = 0.05  # a smaller posterior of `unknown` refuses nothing
ENOUGH = 20  # objects of a class, of which half set a quantile of 90 %
FEWEST = 50  # objects below which there is no rule: nearly all classes would be in each set
USUAL = 0.9  # the share of sweeps that are no worse than what is usual at a step
SMALLEST = 0.05  # what is usual, at least: where nearly all sweeps are right, it would be nothing
# A rule holds up to a noise, in units of the rated, and is fitted at the ends of its range.
NOISE = {0.3: (0.0, 0.3), 1.2: (1.2,), 2.2: (2.2,)}
REFUSED_AT = (0.0, 1.0)  # the noise at which so few are refused, each


def fit_temperature(posteriors: Floats, labels: Labels) -> float:
    """The temperature that minimises the negative log-likelihood (Guo et al. 2017).

    Args:
        posteriors: (sweep, class) at temperature 1; undecided sweeps (NaN) are left out.
        labels: (sweep,).

    Returns:
        One of `TEMPERATURES`; 1 if no sweep is decided.
    """
    decided = ~np.isnan(posteriors[:, 0])
    if not decided.any():
        return 1.0
    logits = np.log(np.clip(posteriors[decided], 1e-12, None))
    right = labels[decided]

    def loss(temperature: float) -> float:
        scaled = logits / temperature
        scaled = scaled - scaled.max(axis=1, keepdims=True)
        chosen = scaled[np.arange(len(right)), right]
        return float((np.log(np.exp(scaled).sum(axis=1)) - chosen).mean())

    return float(min(TEMPERATURES, key=loss))


def fit_rules(
    sets: Sequence[SweepSet], run: Step, temperature: float, labels: Sequence[str], classes: int
) -> tuple[OpenSetRule | None, tuple[PredictionSetRule, ...]]:
    """Fit the rules of a model.

    Args:
        sets: labelled sweeps that it has not learnt from, as groups of which each is to have
            the coverage.
        run: (samples, offset, sigma) of windows to (batch, step, label) logits.
        classes: how many of the labels are classes; the others are refusals.
    """
    levels = {*REFUSED_AT, *(level for ends in NOISE.values() for level in ends)}
    posteriors = {
        level: [at_temperature(predict(one, run, level), temperature) for one in sets]
        for level in sorted(levels)
    }
    names = [one.sweeps.objects for one in sets]
    unknown = None
    if UNKNOWN in labels[classes:]:
        at = list(labels).index(UNKNOWN)
        groups = [
            (posteriors[level][k][..., at], names[k])
            for level in REFUSED_AT
            for k in range(len(sets))
        ]
        unknown = fit_open_set(groups)
    rules = []
    for bound, ends in NOISE.items():
        drawn = [
            (
                np.concatenate([posteriors[level][k][..., :classes] for level in ends]),
                np.tile(one.sweeps.labels, len(ends)),
                np.tile(names[k], len(ends)),
            )
            for k, one in enumerate(sets)
        ]
        if (rule := fit_prediction_sets(drawn, bound)) is not None:
            rules.append(rule)
    return unknown, tuple(rules)


def fit_names(
    sets: Sequence[SweepSet], run: Step, kinds: Mapping[str, Sequence[str]]
) -> dict[str, tuple[PredictionSetRule, ...]]:
    """Fit the prediction sets of kinds within each class, of which each has the coverage.

    With few objects of a class, all of its kinds are in the set.

    Args:
        sets: labelled sweeps that the model has not learnt from. Each that has `ENOUGH` objects of
            a class is to have the coverage there; the others have it together.
        run: (samples, offset, sigma) of windows to (batch, step, name) logits.
        kinds: those that it tells apart, by class.
    """
    rules: dict[str, tuple[PredictionSetRule, ...]] = {}
    for bound, ends in NOISE.items():
        groups: dict[str, dict[int, list[Any]]] = {}  # by class and set; 0: those of few objects
        for number, one in enumerate(sets, start=1):
            drawn: dict[str, list[Any]] = {}
            for level in ends:
                windows = cut_windows(one, disturbance=Disturbance(noise=level))
                logits, found = run_over(windows, run)
                split = split_by_class(logits, found, one.kinds(kinds), kinds)
                for name, at, posteriors, labels in split:
                    if found[at].any():
                        part = posteriors, labels, one.sweeps.objects[at]
                        drawn.setdefault(name, []).append(part)
            for name, parts in drawn.items():
                objects = {one for *_, names in parts for one in names.tolist()}
                group = number if len(objects) >= ENOUGH else 0
                groups.setdefault(name, {}).setdefault(group, []).extend(parts)
        for name, several in groups.items():
            joint: list[Any] = [
                tuple(map(np.concatenate, zip(*parts, strict=True))) for parts in several.values()
            ]
            rule = fit_prediction_sets(joint, bound, fewest=1)
            assert rule is not None
            rules[name] = (*rules.get(name, ()), rule)
    return rules


def fit_open_set(groups: Sequence[tuple[Floats, Names]], refused: float = REFUSED) -> OpenSetRule:
    """Fit thresholds that refuse few sweeps of known kinds at each step.

    Args:
        groups: posteriors (sweep, step) of the label `unknown`, NaN where no contact was found, and
            objects (sweep,); each of the groups is refused no more.
        refused: the share of sweeps of new objects.

    Raises:
        RecordingError: no contact in any sweep.
    """
    each = []
    for posteriors, names in _touched(groups):
        order = np.argsort(posteriors, axis=0)
        share = np.cumsum(_weights(names)[order], axis=0)
        rank = (share < 1 - refused - 1e-12).sum(axis=0)  # (step,) of the threshold
        ranked = np.vstack([np.take_along_axis(posteriors, order, axis=0), np.ones(rank.shape)])
        each.append(ranked[rank, np.arange(len(rank))])
    thresholds = np.maximum(np.max(each, axis=0), LEAST)
    return OpenSetRule(POSTERIOR, "logits", tuple(float(t) for t in thresholds))


def fit_prediction_sets(
    groups: Sequence[tuple[Floats, Labels, Names]],
    noise: float,
    coverage: float = COVERAGE,
    fewest: int = FEWEST,
) -> PredictionSetRule | None:
    """Fit the quantiles of a coverage in each group; None with too few objects.

    Args:
        groups: posteriors (sweep, step, class), NaN where no contact was found, labels (sweep,)
            and objects (sweep,).
        noise: the largest in units of the rated at which they hold.
        fewest: the number of objects in a group below which there are too few.

    Raises:
        RecordingError: no contact in any sweep.
    """
    fitted, objects = [], set()
    for posteriors, labels, names in _touched(groups):
        own = sorted(set(names.tolist()))
        if len(own) < fewest:
            return None
        objects |= set(own)
        scores = mass_above(posteriors)[np.arange(len(labels)), :, labels]
        usual = np.isin(names, own[::2])
        level = _usual(scores[usual], _weights(names[usual]))
        fitted.append(_envelope(scores[~usual], _weights(names[~usual]), level, coverage))
    quantiles = np.max(fitted, axis=0)
    return PredictionSetRule(
        MASS_ABOVE, coverage, tuple(float(q) for q in quantiles), len(objects), noise=noise
    )


def _touched(groups: Sequence[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """Of each group the sweeps in which a contact was found, posteriors first; of none: left out.

    Raises:
        RecordingError: there is none in any.
    """
    found = [
        (group, ~np.isnan(group[0]).reshape(len(group[0]), -1).any(axis=1)) for group in groups
    ]
    kept = [tuple(part[there] for part in group) for group, there in found if there.any()]
    if not kept:
        raise RecordingError(
            "in no validation sweep a contact was found and answered by numbers, so that nothing "
            "can be fitted: are the loads of the sweep set in SI units? did training converge?"
        )
    return kept


def _weights(names: Names) -> Doubles:
    """(sweep,) Each object's weight is one of all objects and one yet to come."""
    _, which, count = np.unique(names, return_inverse=True, return_counts=True)
    weights: Doubles = 1 / (count[which] * (len(count) + 1))
    return weights


def _usual(scores: Doubles, weights: Doubles) -> Doubles:
    """(step,) What few sweeps (sweep, step) of scores in [0, 1) exceed at a step."""
    order = np.argsort(scores, axis=0)
    share = np.cumsum(weights[order], axis=0) / weights.sum()
    rank = np.minimum((share < USUAL).sum(axis=0), len(scores) - 1)
    usual = np.take_along_axis(scores, order, axis=0)[rank, np.arange(len(rank))]
    clipped: Doubles = np.clip(usual, SMALLEST, 1 - SMALLEST * 1e-4)
    return clipped


def _envelope(scores: Doubles, weights: Doubles, usual: Doubles, coverage: float) -> Doubles:
    """(step,) The scores that no step of so large a share of the sweeps exceeds.

    Args:
        scores: (sweep, step), in [0, 1).
        weights: (sweep,), of which the sum is less than 1.
        usual: (step,), in (0, 1); the more, the larger a score is let through.
        coverage: the share.
    """
    # what is left of the posterior at and below a class, as a power of what usually is
    worst = (np.log1p(-np.minimum(scores, 1 - 1e-12)) / np.log1p(-usual)).max(axis=1)
    order = np.argsort(worst)
    enough = np.searchsorted(np.cumsum(weights[order]), coverage - 1e-12)
    if enough == len(worst):
        return np.ones(len(usual))  # too few objects for any set but that of all classes
    found: Doubles = 1 - (1 - usual) ** (worst[order[enough]] * (1 + 1e-9))
    return found
