"""Rules that a model file may carry beside its network: when it does not know, what it may be.

They are fitted on sweeps of objects that the network was not trained on, and stored in the
`ModelCard`. A score is a number that is larger the less a step looks like what was learnt; it is
stored by name, and whoever finds a name that they do not know cannot apply the rule.
"""

from collections.abc import Sequence
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

__all__ = [
    "MASS_ABOVE",
    "POSTERIOR",
    "UNKNOWN",
    "CandidateRule",
    "UnknownRule",
    "fitting",
    "mass_above",
    "named",
]

MAX_NAME = 200  # characters
UNKNOWN = "unknown"  # what is decided of an object of no class that the model knows
POSTERIOR = "posterior of unknown"  # the score of an `UnknownRule`: of the label `unknown`
# The score of a `CandidateRule`: how much of the posterior the more probable classes have.
MASS_ABOVE = "mass above"


class UnknownRule(msgspec.Struct, frozen=True):
    """When a step's decision is that the object is of no class that the model knows.

    Attributes:
        score: The name of the score: `POSTERIOR`.
        output: The output of the graph that the score is computed from.
        thresholds: (step,) or (1,) The score above which the object is unknown, by step or for all.
    """

    score: str
    output: Literal["logits", "embedding"]
    thresholds: tuple[float, ...]

    def fault(self, steps: int) -> str:
        """What makes the rule unusable for episodes of so many steps; "" if nothing does."""
        if not named(self.score):
            return f"score must be 1 to {MAX_NAME} printable characters"
        if len(self.thresholds) not in (1, steps):
            return f"thresholds: {len(self.thresholds)} values, neither 1 nor one for {steps} steps"
        if not np.isfinite(self.thresholds).all():
            return "thresholds must be finite"
        return ""

    def threshold(self, step: int) -> float:
        """That of a step, counted from 1."""
        return self.thresholds[step - 1 if len(self.thresholds) > 1 else 0]


class CandidateRule(msgspec.Struct, frozen=True):
    """Which classes a step leaves possible, so that the true one is seldom left out.

    A class is a candidate at a step if its score there is not above the step's quantile.

    Attributes:
        score: The name of the score that every class gets at a step: `MASS_ABOVE`.
        coverage: The promise: the share of sweeps of unseen objects of which the true class is a
            candidate at every step, in (0, 1).
        quantiles: (step,) The largest score of a candidate, by step.
        objects: The number of objects that the quantiles were fitted on; the sweeps of an object
            count as one.
        noise: The largest noise for which the promise holds, in multiples of the rated noise;
            None if for any.
    """

    score: str
    coverage: float
    quantiles: tuple[float, ...]
    objects: int
    noise: float | None = None

    def fault(self, steps: int) -> str:
        """What makes the rule unusable for episodes of so many steps; "" if nothing does."""
        if not named(self.score):
            return f"score must be 1 to {MAX_NAME} printable characters"
        if not 0 < self.coverage < 1:
            return f"coverage is {self.coverage:g}, not between 0 and 1"
        if len(self.quantiles) != steps:
            return f"quantiles: {len(self.quantiles)} values for {steps} steps"
        if not np.isfinite(self.quantiles).all():
            return "quantiles must be finite"
        if self.objects < 1:
            return f"objects is {self.objects}, must be at least 1"
        if self.noise is not None and not 0 <= self.noise < np.inf:
            return f"noise is {self.noise:g}, must be 0 or more"
        return ""

    def candidates(self, probabilities: NDArray[np.float32], step: int) -> list[int]:
        """The classes (indices of `probabilities` (class,)) that a step, from 1, leaves possible.

        The most probable one is first, and always among them.
        """
        order = np.argsort(-probabilities, kind="stable")
        allowed = mass_above(probabilities)[order] <= self.quantiles[step - 1]
        return [int(k) for k in order[: max(1, int(allowed.sum()))]]


def fitting(rules: Sequence[CandidateRule], noise: float) -> CandidateRule | None:
    """The rule that holds at a noise, in multiples of the rated: the narrowest; None if none is."""
    known = [r for r in rules if r.score == MASS_ABOVE and (r.noise is None or noise <= r.noise)]
    return min(known, key=lambda r: np.inf if r.noise is None else r.noise, default=None)


def mass_above(probabilities: NDArray[np.float32]) -> NDArray[np.float64]:
    """(..., class) The share of the posterior that the classes have which are more probable.

    It is 0 for the most probable class, and next to 1 for the least. Where the posterior leaves
    nothing to any class (all of it is a refusal's), all are alike.
    """
    p = probabilities.astype(np.float64)
    p = np.where(p.sum(axis=-1, keepdims=True) > 0, p, 1.0)
    p = p / p.sum(axis=-1, keepdims=True)
    order = np.argsort(-p, axis=-1, kind="stable")
    ranked = np.take_along_axis(p, order, axis=-1)
    above = np.cumsum(ranked, axis=-1) - ranked
    out: NDArray[np.float64] = np.empty_like(above)
    np.put_along_axis(out, order, above, axis=-1)
    return out


def named(text: str) -> bool:
    """Whether a text may stand for something on terminals, pages and in logs."""
    return 0 < len(text) <= MAX_NAME and text.isprintable()
