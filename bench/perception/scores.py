"""The figures of one method on one test: all from its posteriors, all with intervals by object."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.perception.methods import Method, of_kinds
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation import measures
from tactile_rt.models.evaluation.measures import Interval

COVERAGES = (50, 80, 95)  # percent of the sweeps that are decided, the surest first
Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Figures:
    """What a method reaches on a test.

    Attributes:
        top1: The share of the sweeps whose kind is the most probable one.
        macro: The mean over kinds of the share that is right.
        two, four: The shares of pairs and of fours of sweeps of one object that are right when
            their posteriors are fused.
        calibration: The expected calibration error, 15 bins.
        at: The accuracy of the surest sweeps, by the percentage that is decided.
    """

    top1: Interval
    macro: Interval
    two: Interval
    four: Interval
    calibration: Interval
    at: dict[int, Interval]


def score(method: Method, test: SweepSet) -> Figures:
    """A method's figures on the sweeps of the kinds that it knows."""
    known = of_kinds(test, method.kinds)
    labels, objects = known.sweeps.labels, known.sweeps.objects
    posteriors = method.posteriors(known, CLEAN)

    def over(statistic: Callable[[NDArray[np.int64]], float]) -> Interval:
        return measures.bootstrap(statistic, objects)

    right = measures.hits(posteriors, labels)
    sure = np.nan_to_num(posteriors.max(axis=1), nan=0.0)

    return Figures(
        top1=measures.accuracy(right, objects),
        macro=over(lambda at: _macro(right[at], labels[at])),
        two=measures.fused_accuracy(posteriors, labels, objects, 2),
        four=measures.fused_accuracy(posteriors, labels, objects, 4),
        calibration=over(
            lambda at: measures.expected_calibration_error(posteriors[at], labels[at])
        ),
        at={c: over(lambda at, c=c: _surest(right[at], sure[at], c)) for c in COVERAGES},  # type: ignore[misc]
    )


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
