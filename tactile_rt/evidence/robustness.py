"""A model with a sensor that is not what it was trained on: noisy, drifting, wrong, half dead."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.evidence.records import Record
from tactile_rt.models import evaluation
from tactile_rt.models.datasets import RATED_NOISE, SweepSet
from tactile_rt.models.evaluation import OFFSET, Disturbance

__all__ = ["CONDITIONS", "RATED", "Robustness", "measure_robustness", "robustness_records"]


def _amount(table: Mapping[str, float], factor: float = 1.0) -> str:
    return " and ".join(f"{1e6 * factor * v:g} u{u}" for u, v in table.items())


RATED = _amount(RATED_NOISE)

REST = 80  # samples: 0.7 s, which a tare can be taken from

CONDITIONS = {
    "noise at a quarter of the rated": Disturbance(noise=0.25),
    "noise at half the rated": Disturbance(noise=0.5),
    f"rated noise, {RATED}": Disturbance(noise=1.0),
    f"rated noise, after {REST} samples of rest": Disturbance(noise=1.0, rest=REST),
    "noise at twice the rated": Disturbance(noise=2.0),
    f"offset of {_amount(OFFSET, 0.25)} after the tare": Disturbance(offset=0.25),
    f"offset of {_amount(OFFSET)} after the tare": Disturbance(offset=1.0),
    "gain error of 20 % per whisker": Disturbance(gain=0.2),
    "6 dead whiskers": Disturbance(dead=6),
}


@dataclass(frozen=True)
class Robustness:
    """Accuracy under one condition, and the points that it costs on the same sweeps."""

    name: str
    accuracy: evaluation.Interval
    lost: evaluation.Interval


def measure_robustness(
    test: SweepSet, run: evaluation.Step, clean: NDArray[np.float32]
) -> list[Robustness]:
    """Accuracy under every condition, the first without any.

    Args:
        test: the sweeps.
        run: as `evaluation.predict` takes it.
        clean: (sweep, class) final posteriors of the same sweeps, undisturbed.
    """
    labels, objects = test.sweeps.labels, test.sweeps.objects
    base = evaluation.hits(clean, labels)
    nothing = evaluation.Interval(0.0, 0.0, 0.0)
    found = [Robustness("an ideal sensor", evaluation.accuracy(base, objects), nothing)]
    for name, disturbance in CONDITIONS.items():
        there = evaluation.predict(test, run, disturbance=disturbance)[:, -1]
        right = evaluation.hits(there, labels)
        lost = evaluation.accuracy(base.astype(np.float64) - right, objects)
        found.append(Robustness(name, evaluation.accuracy(right, objects), lost))
    return found


def robustness_records(found: list[Robustness], how: str) -> list[Record]:
    """One figure per condition.

    Args:
        found: as `measure_robustness` gives it.
        how: which sweeps.
    """
    return [
        Record(
            f"models.top-1, {r.name}",
            100 * r.accuracy.value,
            "%",
            "",
            f"95 % interval {100 * r.accuracy.low:.1f} to {100 * r.accuracy.high:.1f}, by object",
            f"{100 * r.lost.value:.1f} points lost ({100 * r.lost.low:.1f} to "
            f"{100 * r.lost.high:.1f}); {how}",
        )
        for r in found[1:]
    ]
