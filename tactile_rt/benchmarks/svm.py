"""What a network is compared with: an RBF support vector machine on the windows that it sees."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sklearn.svm import SVC

from tactile_rt.benchmarks.records import Record
from tactile_rt.models.datasets import SweepSet, channel_values, find_onsets, windows
from tactile_rt.models.training import CLIP, SCALE

__all__ = ["compare_svm"]

PENALTIES = (1.0, 10.0, 100.0, 300.0)  # C; standardising the features only makes it worse


def compare_svm(data: Path, test: SweepSet, network: float) -> list[Record]:
    """Fit, choose on the validation split, and set beside a network's top-1 (%).

    Raises:
        RecordingError: the set's training or validation split cannot be read.
    """
    train, validation = SweepSet.read(data, "train"), SweepSet.read(data, "validation")
    x, usable = _features(train)
    machines = [SVC(C=c).fit(x[usable], train.sweeps.labels[usable]) for c in PENALTIES]
    best = max(machines, key=lambda machine: _accuracy(machine, validation))
    svm = 100 * _accuracy(best, test)
    how = (
        "same onsets, tare, clipping and signed log; 22 steps of mean load; "
        f"C = {best.C:g} of {', '.join(f'{c:g}' for c in PENALTIES)} by validation"
    )
    return [
        Record("models.RBF SVM top-1", svm, "%", "", "the same test sweeps", how),
        Record("models.points above the SVM", network - svm, "points", ">= 3", "", how),
    ]


def _features(data: SweepSet) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(sweep, step * element * channel) compressed loads, and whether there was an onset."""
    spec = data.manifest.spec
    clip, scale = channel_values(spec, CLIP), channel_values(spec, SCALE)
    found = find_onsets(data.sweeps.values, data.floor)
    cut = windows(data.sweeps.values, found.start) - found.offset[:, None, None]
    cut = np.clip(cut, -clip, clip)
    cut = np.sign(cut) * np.log1p(np.abs(cut) / scale)
    return cut.mean(axis=2).reshape(len(cut), -1), found.start >= 0


def _accuracy(machine: SVC, data: SweepSet) -> float:
    """Top-1; sweeps without an onset are wrong."""
    x, usable = _features(data)
    right = (machine.predict(x) == data.sweeps.labels) & usable
    return float(right.mean())
