"""Temperature, prediction sets and refusals of a model, fitted on validation sweeps.

Prediction sets are conformal: the coverage is the share of touches of new objects for which the set
of every step contains the true class. It holds for any network, as long as these touches are drawn
like those of the fit (Vovk, Gammerman & Shafer 2005). Sweeps of one object are alike, so an object
counts once, however often it was swept (Lee, Barber & Willett 2023, hierarchical conformal
prediction). A robot may stop at any step, so the coverage holds for all steps at once: a sweep's
score is that of its worst step. Half of the objects give the usual score of each step, which makes
steps comparable; the other half show by how much a sweep may exceed it.
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
REFUSED = 0.08  # largest share of the sweeps of known kinds that is refused at a step
LEAST = 0.05  # a smaller posterior of `unknown` refuses nothing
ENOUGH = 20  # objects of a class, of which half set a quantile of 90 %
FEWEST = 50  # objects below which there is no rule: nearly all classes would be in each set
USUAL = 0.9  # share of sweeps whose score at a step is at most the usual one
SMALLEST = 0.05  # least usual score: it would be 0 where nearly all sweeps are right
# A rule holds up to a noise level, in units of the rated noise, and is fitted at these levels.
NOISE = {0.3: (0.0, 0.3), 1.2: (1.2,), 2.2: (2.2,)}
REFUSED_AT = (0.0, 1.0)  # noise levels at each of which at most `REFUSED` are refused


def fit_temperature(posteriors: Floats, labels: Labels) -> float:
    """Return the temperature that minimises the negative log-likelihood (Guo et al. 2017).

    Args:
        posteriors: (sweep, class) at temperature 1; undecided sweeps (NaN) are left out.
        labels: (sweep,) index of the true class.

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
    """Fit the open-set rule and the prediction sets of a model on labelled sweeps.

    Args:
        sets: labelled sweeps that the model was not trained on, in groups; the coverage holds in
            each group.
        run: maps (samples, offset, sigma) of windows to logits, (batch, step, label).
        classes: number of labels that are classes, the first ones; the others are refusals.
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
    """Fit, for each class, the prediction sets of its kinds, with the coverage.

    The set of a class with few objects contains all its kinds.

    Args:
        sets: labelled sweeps that the model was not trained on. For each class, the coverage holds
            in every set with `ENOUGH` objects, and over the other sets together.
        run: maps (samples, offset, sigma) of windows to logits, (batch, step, name).
        kinds: the kinds that the model distinguishes, by class.
    """
    rules: dict[str, tuple[PredictionSetRule, ...]] = {}
    for bound, ends in NOISE.items():
        groups: dict[str, dict[int, list[Any]]] = {}  # by class and set; 0: sets of few objects
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
    """Fit thresholds, one per step, that refuse few sweeps of known kinds.

    Args:
        groups: posteriors (sweep, step) of the label `unknown`, NaN where no contact was found, and
            objects (sweep,); `refused` holds in each group.
        refused: largest share of refused sweeps, of new objects of known kinds.

    Raises:
        RecordingError: no contact in any sweep.
    """
    each = []
    for posteriors, names in _drop_untouched(groups):
        order = np.argsort(posteriors, axis=0)
        share = np.cumsum(_make_weights(names)[order], axis=0)
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
    """Fit the quantiles that reach a coverage in each group; None with too few objects.

    Args:
        groups: posteriors (sweep, step, class), NaN where no contact was found, labels (sweep,)
            and objects (sweep,).
        noise: largest noise at which the quantiles hold, in units of the rated noise.
        fewest: least number of objects in each group.

    Raises:
        RecordingError: no contact in any sweep.
    """
    fitted, objects = [], set()
    for posteriors, labels, names in _drop_untouched(groups):
        own = sorted(set(names.tolist()))
        if len(own) < fewest:
            return None
        objects |= set(own)
        scores = mass_above(posteriors)[np.arange(len(labels)), :, labels]
        usual = np.isin(names, own[::2])
        level = _fit_usual(scores[usual], _make_weights(names[usual]))
        fitted.append(_fit_envelope(scores[~usual], _make_weights(names[~usual]), level, coverage))
    quantiles = np.max(fitted, axis=0)
    return PredictionSetRule(
        MASS_ABOVE, coverage, tuple(float(q) for q in quantiles), len(objects), noise=noise
    )


def _drop_untouched(groups: Sequence[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """Drop sweeps without contact from each group, and groups without any contact.

    Raises:
        RecordingError: no contact in any sweep.
    """
    found = [
        (group, ~np.isnan(group[0]).reshape(len(group[0]), -1).any(axis=1)) for group in groups
    ]
    kept = [tuple(part[touch] for part in group) for group, touch in found if touch.any()]
    if not kept:
        raise RecordingError(
            "no validation sweep has both a contact and finite logits, so nothing can be fitted: "
            "are the loads of the sweep set in SI units? did training converge?"
        )
    return kept


def _make_weights(names: Names) -> Doubles:
    """Return weights of sweeps, (sweep,), that sum to 1 / (objects + 1) per object."""
    _, which, count = np.unique(names, return_inverse=True, return_counts=True)
    weights: Doubles = 1 / (count[which] * (len(count) + 1))
    return weights


def _fit_usual(scores: Doubles, weights: Doubles) -> Doubles:
    """Return the `USUAL` quantile at each step of scores, (sweep, step), in [0, 1)."""
    order = np.argsort(scores, axis=0)
    share = np.cumsum(weights[order], axis=0) / weights.sum()
    rank = np.minimum((share < USUAL).sum(axis=0), len(scores) - 1)
    usual = np.take_along_axis(scores, order, axis=0)[rank, np.arange(len(rank))]
    clipped: Doubles = np.clip(usual, SMALLEST, 1 - SMALLEST * 1e-4)
    return clipped


def _fit_envelope(scores: Doubles, weights: Doubles, usual: Doubles, coverage: float) -> Doubles:
    """Return bounds of the scores, (step,), that a share of sweeps keeps at every step.

    Args:
        scores: (sweep, step), in [0, 1).
        weights: (sweep,), with a sum below 1.
        usual: usual score of each step, (step,), in (0, 1); sets the form of the result.
        coverage: share of sweeps.
    """
    # posterior at and below the true class, as a power of its usual value, at the worst step
    worst = (np.log1p(-np.minimum(scores, 1 - 1e-12)) / np.log1p(-usual)).max(axis=1)
    order = np.argsort(worst)
    enough = np.searchsorted(np.cumsum(weights[order]), coverage - 1e-12)
    if enough == len(worst):
        return np.ones(len(usual))  # too few objects for any set but that of all classes
    found: Doubles = 1 - (1 - usual) ** (worst[order[enough]] * (1 + 1e-9))
    return found
