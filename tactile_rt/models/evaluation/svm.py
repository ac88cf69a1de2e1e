"""RBF support vector machines: the one place where one is fitted.

Two questions want one. Does a network beat it on the very windows that it sees? `fit_svm` answers
that: the machine takes the same onsets, baseline and compression, and validation chooses its
penalty.
And can a set be learnt from at all? The card of a sweep set asks that with features and a penalty
of its own (`tactile_rt.sim_backend.datasets.card_survey`), and is handed `fit` by the command:
simulation and networks do not know of each other.

Standardising the features only makes the machine worse, so nothing here does.
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

MOST_PAIRED = 8000  # sweeps whose kernel, 8 bytes a pair, is kept: half a gigabyte
PENALTIES = (1.0, 10.0, 100.0, 300.0)  # C

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class FittedSVM:
    """A fitted machine; called with (sweep, feature) values, it decides their (sweep,) labels."""

    machine: SVC
    kernel: Callable[[Floats], Floats]
    how: str = ""

    def __call__(self, features: Floats) -> NDArray[Any]:
        return np.asarray(self.machine.predict(self.kernel(features)))

    def margins(self, features: Floats, classes: int) -> NDArray[np.float64]:
        """Distances from the decision for each of `classes` numbers, against all others.

        Returns:
            (sweep, class); -inf of a class that no sweep was of.
        """
        found = np.full((len(features), classes), -np.inf)
        distance = self.machine.decision_function(self.kernel(features))
        if distance.ndim == 1:  # of two classes: from the second
            distance = np.column_stack([-distance, distance])
        found[:, self.machine.classes_] = distance
        return found

    def hits(self, data: "SweepSet") -> NDArray[np.bool_]:
        """(sweep,) whether each is right; one without an onset is not."""
        x, usable = window_features(data)
        return np.asarray((self(x) == data.sweeps.labels) & usable)


def fit(features: Floats, labels: NDArray[Any], penalty: float, how: str = "") -> FittedSVM:
    """Fit one machine to (sweep, feature) values and (sweep,) labels, at penalty C."""
    # Of its own gamma, "scale". The kernel is a product of matrices, which libsvm by itself works
    # out pair by pair: dozens of times slower where there are thousands of features.
    gamma = 1.0 / (features.shape[1] * float(features.var()) or 1.0)
    if len(features) > MOST_PAIRED:
        machine = SVC(C=penalty, gamma=gamma).fit(features, labels)
        return FittedSVM(machine, lambda others: others, how)
    machine = SVC(C=penalty, kernel="precomputed")
    machine.fit(rbf_kernel(features, gamma=gamma), labels)
    return FittedSVM(machine, lambda others: rbf_kernel(others, features, gamma), how)


def fit_svm(train: "SweepSet", validation: "SweepSet") -> FittedSVM:
    """Fit one machine per penalty and keep the best on the validation sweeps."""
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
    """(sweep, step * element * channel) compressed loads, and whether there was an onset."""
    # Imported here: it brings torch, which whoever only writes a set's card does without.
    from tactile_rt.models.disturbances import CLEAN
    from tactile_rt.models.evaluation.measures import cut_windows, run_over

    limits = data.manifest.limits

    def run(samples: Floats, offset: Floats, sigma: Floats) -> Floats:
        cut = np.clip(samples - offset[:, None, None], -limits.clip, limits.clip)
        cut = np.sign(cut) * np.log1p(np.abs(cut) / limits.scale)
        return np.asarray(cut.mean(axis=2).reshape(len(cut), -1))

    return run_over(cut_windows(data, disturbance=disturbance or CLEAN), run)
