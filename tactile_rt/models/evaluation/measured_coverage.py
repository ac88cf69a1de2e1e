"""Measurement of a model file's coverage and refusals, to compare with the stated coverage."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.decision_rules import UNKNOWN, PredictionSetRule, fitting
from tactile_rt.classifier.model_card import ModelCard, choose_label
from tactile_rt.classifier.model_file import file_outputs, load_model
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import Floats, Interval, Labels, run_steps
from tactile_rt.models.implausible import IMPLAUSIBLE

NAMES_LEFT = "names at the last step"  # a mean number of names; the other results are shares
Doubles = NDArray[np.float64]
NOTHING = Interval(float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True)
class Coverage:
    """Measured coverage and rates of refusal of a model on test sweeps.

    Attributes:
        nominal: The coverage that the model file states, 0 to 1; NaN without prediction sets.
        covered: The share of sweeps whose true class is in the prediction set at every step, among
            sweeps with a detected contact.
        size: The mean number of classes in the prediction set at the last step of these sweeps.
        unknown: The share of all sweeps that the model decides are unknown.
        faulty: The share of all sweeps that the model refuses because of faulty loads.
    """

    nominal: float
    covered: Interval
    size: Interval
    unknown: Interval
    faulty: Interval


def measure_names(
    path: Path, test: SweepSet, disturbance: Disturbance = CLEAN
) -> Iterator[tuple[str, Interval]]:
    """Measure the prediction sets of kinds within the true class of each test sweep.

    The coverage of a class is the share of its sweeps whose kind is in the class's prediction set
    at every step. Sweeps of kinds unknown to the model, and classes of one kind, are left out.

    Args:
        test: the sweeps, labelled by the model's classes; sweeps without a contact are left out.

    Yields:
        The name of a result and its value; nothing if the model or the test has no kinds.
    """
    session, card = load_model(path)
    rules = {name: fitting(own, disturbance.noise) for name, own in card.names.items()}
    numbers, classes = test.kinds(card.kinds), len(card.classes)

    def run(*loads: Floats) -> Floats:
        out = file_outputs(session, card, *loads)
        return np.concatenate([out["logits"][..., :classes], out["names"]], axis=-1)

    if not any(rules.values()) or (numbers < 0).all():
        return
    answers, found = measures.run_over(measures.cut_windows(test, disturbance=disturbance), run)
    right = answers[:, -1, :classes].argmax(axis=1) == test.sweeps.labels
    split = measures.split_by_class(answers[..., classes:], found, numbers, card.kinds)
    taken, rows = [], []
    for name, at, posteriors, kinds in split:
        if (rule := rules.get(name)) is None or len(card.kinds[name]) < 2:
            continue
        touched = found[at]
        taken.append(at[touched])
        rows.append(_measure_sets(rule, posteriors[touched], kinds[touched]))
    if not sum(map(len, taken)):
        return
    at, (inside, first, size) = np.concatenate(taken), np.concatenate(rows, axis=1)
    objects, of = test.sweeps.objects[at], test.sweeps.labels[at]
    yield "kind, top-1 within the true class", measures.accuracy(first, objects)
    yield "coverage of the names", measures.accuracy(inside, objects)
    for label in np.unique(of).tolist():
        own = of == label
        name = f"coverage of the names of {card.classes[label]}"
        yield name, measures.accuracy(inside[own], objects[own])
    if (own := right[at]).any():
        name = "coverage of the names where the class is right"
        yield name, measures.accuracy(inside[own], objects[own])
    yield NAMES_LEFT, measures.bootstrap(lambda at: float(size[at].mean()), objects)


def measure_coverage(
    path: Path, test: SweepSet, disturbance: Disturbance = CLEAN
) -> Coverage | None:
    """Measure coverage and refusals on test sweeps; return None for a model without either.

    Args:
        test: the sweeps, labelled by the model's classes; if any sweep is of no class (-1), only
            refusals are measured.
    """
    _, card = load_model(path)
    if not card.refusals and not card.candidates:
        return None
    posteriors = _predict_all(path, test, disturbance)
    labels, objects = test.sweeps.labels, test.sweeps.objects
    answers = _decide(card, posteriors[:, -1])
    faults = [name for name in card.refusals if name in IMPLAUSIBLE]
    unknown = measures.accuracy(answers == UNKNOWN, objects)
    faulty = measures.accuracy(np.isin(answers, faults), objects)
    rule = fitting(card.candidates, disturbance.noise)
    if rule is None or (labels < 0).any():
        return Coverage(float("nan"), NOTHING, NOTHING, unknown, faulty)
    found = np.flatnonzero(~np.isnan(posteriors[:, 0, 0]))
    labels, objects = labels[found], objects[found]
    inside, _, sizes = _measure_sets(rule, posteriors[found][..., : len(card.classes)], labels)
    return Coverage(
        rule.coverage,
        measures.accuracy(inside, objects),
        measures.bootstrap(lambda at: float(sizes[at].mean()), objects),
        unknown,
        faulty,
    )


def _measure_sets(rule: PredictionSetRule, posteriors: Floats, labels: Labels) -> Doubles:
    """Form the prediction sets of sweeps at every step and compare them with the labels.

    Args:
        posteriors, labels: (sweep, step, class) and (sweep,).

    Returns:
        (3, sweep): 1 if the label is in the set at every step, 1 if the label is first in the last
        set, and the size of the last set.
    """
    rows = []
    for p, label in zip(posteriors, labels.tolist(), strict=True):
        sets = [rule.prediction_set(one, step) for step, one in enumerate(p, start=1)]
        rows.append((all(label in one for one in sets), sets[-1][0] == label, len(sets[-1])))
    return np.array(rows, dtype=float).reshape(-1, 3).T


def score_known(path: Path, test: SweepSet) -> Floats:
    """Return open-set scores (sweep,): a model's probability that the object is known.

    The score is the posterior of all labels but "unknown"; for a model without that label, the
    posterior of the most probable class. It is 0 where no contact was detected.
    """
    _, card = load_model(path)
    last = _predict_all(path, test, CLEAN)[:, -1]
    if UNKNOWN in card.refusals:
        sure = 1 - last[:, card.labels.index(UNKNOWN)]
    else:
        sure = last[:, : len(card.classes)].max(axis=1)
    return np.nan_to_num(sure, nan=0.0)


def named_faults(path: Path, test: SweepSet) -> Iterator[tuple[str, Interval]]:
    """Measure how often a model refuses sweeps as faulty, for each implausible fault.

    Only faults that the model has a label for are measured. Yields the fault and the share.
    """
    _, card = load_model(path)
    faults = [name for name in card.refusals if name in IMPLAUSIBLE]
    rng = np.random.default_rng(0)
    for name in faults:
        values = IMPLAUSIBLE[name](test.sweeps.values, test.manifest.spec, rng)
        spoilt = replace(test, sweeps=replace(test.sweeps, values=values))
        answers = _decide(card, _predict_all(path, spoilt, CLEAN)[:, -1])
        yield name, measures.accuracy(np.isin(answers, faults), test.sweeps.objects)


def _predict_all(path: Path, test: SweepSet, disturbance: Disturbance) -> Floats:
    """Run a model file on test sweeps; return posteriors (sweep, step, label), refusals last."""
    run = run_steps(*load_model(path), refusals=True)
    return measures.predict(test, run, disturbance=disturbance)


def _decide(card: ModelCard, posteriors: Floats) -> NDArray[np.str_]:
    """Return the label (sweep,) decided from each posterior; "" where no contact was detected."""
    found = [None if np.isnan(p).any() else choose_label(card, p, card.steps) for p in posteriors]
    return np.array(["" if k is None else card.labels[k] for k in found])
