"""RBF support vector machines, as baselines for networks and for the card of a sweep set.

`fit_svm` fits a machine to compare a network with on the same windows: with the same onsets,
baseline and compression, and a penalty chosen on the validation split.
The card of a sweep set reports whether the set can be learnt at all, with features and a penalty
of its own (`tactile_rt.sim_backend.datasets.card_survey`); the command passes `fit` to it, since
simulation and networks do not import each other.

Features are not standardised, since that lowers the accuracy.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from sklearn.metrics.pairwise import rbf_kernel
from sklearn.svm import SVC

from tactile_rt.core.errors import ConfigError

if TYPE_CHECKING:
    from tactile_rt.models.datasets import SweepSet
    from tactile_rt.models.disturbances import Disturbance

MOST_PAIRED = 8000  # most sweeps with a precomputed kernel, 8 bytes a pair: half a gigabyte
PENALTIES = (1.0, 10.0, 100.0, 300.0)  # C

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class FittedSVM:
    """A fitted support vector machine; a call maps features (sweep, feature) to labels (sweep,)."""

    machine: SVC
    kernel: Callable[[Floats], Floats]
    how: str = ""

    def __call__(self, features: Floats) -> NDArray[Any]:
        return np.asarray(self.machine.predict(self.kernel(features)))

    def margins(self, features: Floats, classes: int) -> NDArray[np.float64]:
        """Return the decision value (sweep, class) of each class against all others.

        It is -inf for a class without training sweeps.
        """
        found = np.full((len(features), classes), -np.inf)
        distance = self.machine.decision_function(self.kernel(features))
        if distance.ndim == 1:  # with two classes, only the second's value
            distance = np.column_stack([-distance, distance])
        found[:, self.machine.classes_] = distance
        return found

    def hits(self, data: "SweepSet") -> NDArray[np.bool_]:
        """Return a mask (sweep,) of right decisions; a sweep without onset counts as wrong."""
        x, usable = window_features(data)
        return np.asarray((self(x) == data.sweeps.labels) & usable)


def fit(features: Floats, labels: NDArray[Any], penalty: float, how: str = "") -> FittedSVM:
    """Fit a machine to features (sweep, feature) and labels (sweep,), with penalty C."""
    # gamma is scikit-learn's "scale". The kernel is computed here as a matrix product: libsvm
    # computes it pair by pair, dozens of times slower with thousands of features.
    gamma = 1.0 / (features.shape[1] * float(features.var()) or 1.0)
    if len(features) > MOST_PAIRED:
        machine = SVC(C=penalty, gamma=gamma).fit(features, labels)
        return FittedSVM(machine, lambda others: others, how)
    machine = SVC(C=penalty, kernel="precomputed")
    machine.fit(rbf_kernel(features, gamma=gamma), labels)
    return FittedSVM(machine, lambda others: rbf_kernel(others, features, gamma), how)


def fit_svm(train: "SweepSet", validation: "SweepSet") -> FittedSVM:
    """Fit a machine for each penalty and return the most accurate on the validation sweeps."""
    x, usable = window_features(train)
    if len(set(train.sweeps.labels[usable].tolist())) < 2:
        raise ConfigError("a support vector machine needs touches of two categories to learn from")
    how = f"same onsets, baseline, clipping and signed log; {train.timing.steps} steps of mean load"
    among = ", ".join(f"{p:g}" for p in PENALTIES)
    tried = [
        fit(x[usable], train.sweeps.labels[usable], c, f"{how}; C = {c:g} of {among} by validation")
        for c in PENALTIES
    ]
    return max(tried, key=lambda one: one.hits(validation).mean())


def window_features(
    data: "SweepSet", disturbance: "Disturbance | None" = None
) -> tuple[Floats, NDArray[np.bool_]]:
    """Return compressed loads (sweep, step * element * channel) and a mask of detected onsets."""
    # Imported here, since writing a set's card does not need these.
    from tactile_rt.models.disturbances import CLEAN
    from tactile_rt.models.evaluation.measures import cut_windows, run_over

    limits = data.manifest.limits

    def run(samples: Floats, offset: Floats, sigma: Floats) -> Floats:
        cut = np.clip(samples - offset[:, None, None], -limits.clip, limits.clip)
        cut = np.sign(cut) * np.log1p(np.abs(cut) / limits.scale)
        return np.asarray(cut.mean(axis=2).reshape(len(cut), -1))

    return run_over(cut_windows(data, disturbance=disturbance or CLEAN), run)
