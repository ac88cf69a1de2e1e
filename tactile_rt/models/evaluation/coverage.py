"""What a model file says of its own decisions, held against what it does: coverage, refusals."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.decision_rules import UNKNOWN, fitting
from tactile_rt.classifier.model_card import ModelCard, decided
from tactile_rt.classifier.model_file import file_outputs, load_model
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import Floats, Interval
from tactile_rt.models.evaluation.windows import stepped
from tactile_rt.models.implausible import IMPLAUSIBLE

__all__ = [
    "Coverage",
    "NameCoverage",
    "measure_coverage",
    "measure_names",
    "named_faults",
    "score_known",
]

NOTHING = Interval(float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True)
class Coverage:
    """The coverage and the refusals of a model on a test.

    Attributes:
        nominal: The coverage that the model file tells, 0 to 1; NaN without prediction sets.
        covered: The share of the sweeps of kinds that it knows, and in which it found a contact, of
            which the true kind was in the prediction set of every step.
        size: The mean number of classes in the prediction set at the last step of these.
        unknown: The share of the sweeps that it calls unknown.
        faulty: The share that it refuses for what is wrong with the loads.
    """

    nominal: float
    covered: Interval
    size: Interval
    unknown: Interval
    faulty: Interval


@dataclass(frozen=True)
class NameCoverage:
    """Prediction sets of kinds on a test, of things of known kinds.

    Attributes:
        nominal: The coverage that the model file tells, 0 to 1.
        covered: The share of the sweeps of which the true kind was in the set of its class at every
            step.
        of_class: The same of each class, by its name.
        where_right: The same of the sweeps of which the class is right at the last step.
        top1: The share of which the true kind is the most probable of its class at the last step.
        size: The mean number of kinds in the set of the last step.
        kinds: The mean number of kinds of the classes.
    """

    nominal: float
    covered: Interval
    of_class: dict[str, Interval]
    where_right: Interval
    top1: Interval
    size: Interval
    kinds: float


def measure_names(
    path: Path, test: SweepSet, disturbance: Disturbance = CLEAN
) -> NameCoverage | None:
    """Measure prediction sets of kinds; None of a model, or a test, without.

    Args:
        test: the sweeps, labelled by the model's classes; sweeps without a contact are left out.
    """
    session, card = load_model(path)
    fitted = {name: fitting(own, disturbance.noise) for name, own in card.names.items()}
    rules = {name: rule for name, rule in fitted.items() if rule}

    def run(samples: Floats, offset: Floats, sigma: Floats) -> Floats:
        out = file_outputs(session, card, samples, offset, sigma)
        return np.concatenate([out["logits"][..., : len(card.classes)], out["names"]], axis=-1)

    if not rules or (test.kinds(card.kinds) < 0).all():
        return None
    cut = measures.cut_windows(test, disturbance=disturbance)
    answers, found = measures.run_over(cut, run)
    names = answers[..., len(card.classes) :]
    right = answers[:, -1, : len(card.classes)].argmax(axis=1) == test.sweeps.labels
    taken, rows = [], []
    for name, at, posteriors, kinds in measures.split_by_class(
        names, found, test.kinds(card.kinds), card.kinds
    ):
        for k in np.flatnonzero(found[at]) if name in rules else ():
            steps = enumerate(posteriors[k], start=1)
            sets = [rules[name].prediction_set(p, step) for step, p in steps]
            inside = all(kinds[k] in one for one in sets)
            taken.append(at[k])
            rows.append((inside, sets[-1][0] == kinds[k], len(sets[-1]), len(card.kinds[name])))
    if not taken:
        return None
    (inside, first, size, of), at = np.array(rows, dtype=float).T, np.array(taken)
    objects, labels, sure = test.sweeps.objects[at], test.sweeps.labels[at], right[at]
    return NameCoverage(
        max(rule.coverage for rule in rules.values()),
        measures.accuracy(inside, objects),
        {
            card.classes[k]: measures.accuracy(inside[labels == k], objects[labels == k])
            for k in np.unique(labels).tolist()
        },
        measures.accuracy(inside[sure], objects[sure]) if sure.any() else NOTHING,
        measures.accuracy(first, objects),
        measures.bootstrap(lambda at: float(size[at].mean()), objects),
        float(of.mean()),
    )


def measure_coverage(
    path: Path, test: SweepSet, disturbance: Disturbance = CLEAN
) -> Coverage | None:
    """Measure coverage and refusals on a test; None of a model without either.

    Args:
        test: the sweeps, labelled by the model's classes; those of none (-1) are only refused or
            not.
    """
    _, card = load_model(path)
    if not card.refusals and not card.candidates:
        return None
    posteriors = _posteriors(path, test, disturbance)
    labels, objects = test.sweeps.labels, test.sweeps.objects
    said = _decisions(card, posteriors[:, -1])
    faults = [name for name in card.refusals if name in IMPLAUSIBLE]
    unknown = measures.accuracy(said == UNKNOWN, objects)
    faulty = measures.accuracy(np.isin(said, faults), objects)
    rule = fitting(card.candidates, disturbance.noise)
    if rule is None or (labels < 0).any():
        return Coverage(float("nan"), NOTHING, NOTHING, unknown, faulty)
    found = np.flatnonzero(~np.isnan(posteriors[:, 0, 0]))
    labels, objects = labels[found], objects[found]
    inside, sizes = np.zeros(len(labels), dtype=np.bool_), np.zeros(len(labels))
    for k, at in enumerate(found):
        own = posteriors[at][:, : len(card.classes)]
        left = [rule.prediction_set(p, step) for step, p in enumerate(own, start=1)]
        inside[k] = all(labels[k] in names for names in left)
        sizes[k] = len(left[-1])
    return Coverage(
        rule.coverage,
        measures.accuracy(inside, objects),
        measures.bootstrap(lambda at: float(sizes[at].mean()), objects),
        unknown,
        faulty,
    )


def score_known(path: Path, test: SweepSet) -> Floats:
    """Score (sweep,), open set, how sure a model is that things are of known kinds.

    That is the posterior of all labels but `unknown`; of a model that has no such label, that of
    the most probable class. 0 where no contact was found.
    """
    _, card = load_model(path)
    last = _posteriors(path, test, CLEAN)[:, -1]
    if UNKNOWN in card.refusals:
        sure = 1 - last[:, card.labels.index(UNKNOWN)]
    else:
        sure = last[:, : len(card.classes)].max(axis=1)
    return np.nan_to_num(sure, nan=0.0)


def named_faults(path: Path, test: SweepSet) -> Iterator[tuple[str, Interval]]:
    """Of each kind of loads that no touch makes: the share that a model refuses for its loads.

    Only of those that it has a label for.
    """
    _, card = load_model(path)
    faults = [name for name in card.refusals if name in IMPLAUSIBLE]
    rng = np.random.default_rng(0)
    for name in faults:
        values = IMPLAUSIBLE[name](test.sweeps.values, test.manifest.spec, rng)
        spoilt = replace(test, sweeps=replace(test.sweeps, values=values))
        said = _decisions(card, _posteriors(path, spoilt, CLEAN)[:, -1])
        yield name, measures.accuracy(np.isin(said, faults), test.sweeps.objects)


def _posteriors(path: Path, test: SweepSet, disturbance: Disturbance) -> Floats:
    """(sweep, step, label) of all labels, refusals last."""
    run = stepped(*load_model(path), refusals=True)
    return measures.predict(test, run, disturbance=disturbance)


def _decisions(card: ModelCard, posteriors: Floats) -> NDArray[np.str_]:
    """(sweep,) What is decided at the last step; "" where no contact was found."""
    found = [None if np.isnan(p).any() else decided(card, p, card.steps) for p in posteriors]
    return np.array(["" if k is None else card.labels[k] for k in found])
