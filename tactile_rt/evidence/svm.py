"""A network beside an RBF support vector machine on the same sweeps."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.evidence.records import Record
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.intervals import Interval, accuracy
from tactile_rt.models.svm import fit_svm

__all__ = ["compare_svm"]


def compare_svm(data: Path, test: SweepSet, network: NDArray[np.bool_]) -> list[Record]:
    """Fit, choose on the validation split, and set beside a network on the test sweeps.

    Args:
        data: the sweep set.
        test: its test sweeps.
        network: (sweep,) whether the network is right.

    Raises:
        RecordingError: the set's training or validation split cannot be read.
    """
    svm = fit_svm(SweepSet.read(data, "train"), SweepSet.read(data, "validation"))
    right, objects = svm.hits(test), test.sweeps.objects
    own = accuracy(right, objects)
    above = accuracy(network.astype(np.float64) - right, objects)
    return [
        Record("models.RBF SVM top-1", 100 * own.value, "%", "", _interval(own), svm.how),
        Record(
            "models.points above the SVM",
            100 * above.value,
            "points",
            ">= 3",
            _interval(above),
            svm.how,
        ),
    ]


def _interval(estimate: Interval) -> str:
    return (
        f"95 % interval {100 * estimate.low:.1f} to {100 * estimate.high:.1f}, by object; "
        "the same test sweeps"
    )
