"""The figures of one method on one test: all from its posteriors, all with intervals by object."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.perception.data import Data
from bench.perception.methods import Method, of_kinds
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import Interval

NOTHING = Interval(float("nan"), float("nan"), float("nan"))
COVERAGES = (50, 80, 95)  # percent of the sweeps that are decided, the surest first
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Figures:
    """What a method reaches on a test.

    Attributes:
        top1, top5: The shares of the sweeps whose kind is the most probable one, or of the five.
        macro: The mean over kinds of the share that is right.
        two, four: The shares of pairs and of fours of sweeps of one object that are right when
            their posteriors are fused.
        calibration: The expected calibration error, 15 bins.
        at: The accuracy of the surest sweeps, by the percentage that is decided.
        auroc: Open set: how well its scores tell known kinds from the withheld ones; NaN where
            there are none.
    """

    top1: Interval
    top5: Interval
    macro: Interval
    two: Interval
    four: Interval
    calibration: Interval
    at: dict[int, Interval]
    auroc: Interval


def score(
    method: Method, test: SweepSet, strange: tuple[Floats, NDArray[np.str_]] | None = None
) -> Figures:
    """A method's figures on the sweeps of the kinds that it knows.

    Args:
        method: which.
        test: the sweeps.
        strange: its scores (sweep,) of things of unknown kinds, and the objects (sweep,);
            None: there are none in this test's world.
    """
    known = of_kinds(test, method.kinds)
    labels, objects = known.sweeps.labels, known.sweeps.objects
    posteriors = method.posteriors(known, CLEAN)

    def over(statistic: Callable[[NDArray[np.int64]], float]) -> Interval:
        return measures.bootstrap(statistic, objects)

    right = measures.hits(posteriors, labels)
    sure = np.nan_to_num(posteriors.max(axis=1), nan=0.0)
    area = NOTHING
    if strange is not None:
        area = measures.open_set(method.score_known(known), objects, *strange)

    return Figures(
        top1=measures.accuracy(right, objects),
        top5=measures.accuracy(measures.hits(posteriors, labels, 5), objects),
        macro=over(lambda at: _macro(right[at], labels[at])),
        two=measures.fused_accuracy(posteriors, labels, objects, 2),
        four=measures.fused_accuracy(posteriors, labels, objects, 4),
        calibration=over(
            lambda at: measures.expected_calibration_error(posteriors[at], labels[at])
        ),
        at={c: over(lambda at, c=c: _surest(right[at], sure[at], c)) for c in COVERAGES},  # type: ignore[misc]
        auroc=area,
    )


def accuracy_by_source(method: Method, test: SweepSet, data: Data) -> dict[str, Interval]:
    """Top-1 on the objects of every source."""
    known = of_kinds(test, method.kinds)
    right = measures.hits(method.posteriors(known, CLEAN), known.sweeps.labels)
    source = np.array([data.origins[name].source for name in known.sweeps.objects.tolist()])
    return {
        name: measures.accuracy(right[source == name], known.sweeps.objects[source == name])
        for name in sorted(set(source.tolist()))
    }


def robustness(
    method: Method, test: SweepSet, conditions: dict[str, Disturbance]
) -> dict[str, Interval]:
    """Top-1 under every condition."""
    known = of_kinds(test, method.kinds)
    return {
        name: measures.accuracy(
            measures.hits(method.posteriors(known, disturbance), known.sweeps.labels),
            known.sweeps.objects,
        )
        for name, disturbance in conditions.items()
    }


def _macro(right: NDArray[np.bool_], labels: NDArray[np.int64]) -> float:
    return float(np.mean([right[labels == label].mean() for label in np.unique(labels)]))


def _surest(right: NDArray[np.bool_], sure: Floats, coverage: int) -> float:
    decided = np.argsort(-sure, kind="stable")[: max(1, round(coverage / 100 * len(sure)))]
    return float(right[decided].mean())
