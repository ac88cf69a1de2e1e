"""What a model file says of its own decisions, held against what it does: coverage, refusals."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.decision_rules import UNKNOWN, fitting
from tactile_rt.classifier.model_card import ModelCard, decided
from tactile_rt.classifier.model_file import load_model
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import Floats, Interval
from tactile_rt.models.evaluation.windows import stepped
from tactile_rt.models.implausible import IMPLAUSIBLE

__all__ = ["Coverage", "measure_coverage", "named_faults", "score_known"]

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
