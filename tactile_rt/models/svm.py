"""What a network is compared with: an RBF support vector machine on the windows that it sees."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from sklearn.svm import SVC

from tactile_rt.models.datasets import SweepSet, channel_values, windows
from tactile_rt.models.onsets import find_onsets
from tactile_rt.models.training import CLIP, SCALE

__all__ = ["FittedSVM", "fit_svm"]

PENALTIES = (1.0, 10.0, 100.0, 300.0)  # C; standardising the features only makes it worse


@dataclass(frozen=True)
class FittedSVM:
    """The machine of the penalty that validation chose.

    Attributes:
        machine: the machine.
        how: it was made, in words.
    """

    machine: SVC
    how: str

    def hits(self, data: SweepSet) -> NDArray[np.bool_]:
        """(sweep,) whether each is right; one without an onset is not."""
        x, usable = _features(data)
        right: NDArray[np.bool_] = (self.machine.predict(x) == data.sweeps.labels) & usable
        return right


def fit_svm(train: SweepSet, validation: SweepSet) -> FittedSVM:
    """Fit one machine per penalty and keep the best on the validation sweeps."""
    x, usable = _features(train)
    tried = [
        FittedSVM(
            SVC(C=c).fit(x[usable], train.sweeps.labels[usable]),
            "same onsets, tare, clipping and signed log; 22 steps of mean load; "
            f"C = {c:g} of {', '.join(f'{p:g}' for p in PENALTIES)} by validation",
        )
        for c in PENALTIES
    ]
    return max(tried, key=lambda one: one.hits(validation).mean())


def _features(data: SweepSet) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """(sweep, step * element * channel) compressed loads, and whether there was an onset."""
    spec = data.manifest.spec
    clip, scale = channel_values(spec, CLIP), channel_values(spec, SCALE)
    found = find_onsets(data.sweeps.values, data.floor)
    cut = windows(data.sweeps.values, found.start) - found.offset[:, None, None]
    cut = np.clip(cut, -clip, clip)
    cut = np.sign(cut) * np.log1p(np.abs(cut) / scale)
    return cut.mean(axis=2).reshape(len(cut), -1), found.start >= 0
