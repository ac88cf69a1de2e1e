"""Rules that a model file may carry beside its network: when it does not know, what it may be.

They are fitted on sweeps of objects that the network was not trained on, and stored in the
`ModelCard`. A score is a number that is larger the less a step looks like what was learnt; it is
stored by name, and whoever finds a name that they do not know cannot apply the rule.
"""

from typing import Literal

import msgspec
import numpy as np

__all__ = ["CandidateRule", "UnknownRule", "named"]

MAX_NAME = 200  # characters


class UnknownRule(msgspec.Struct, frozen=True):
    """When a step's decision is that the object is of no class that the model knows.

    Attributes:
        score: The name of the score, such as "entropy".
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


class CandidateRule(msgspec.Struct, frozen=True):
    """Which classes a step leaves possible, so that the true one is seldom left out.

    A class is a candidate at a step if its score there is not above the step's quantile.

    Attributes:
        score: The name of the score that every class gets at a step.
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


def named(text: str) -> bool:
    """Whether a text may stand for something on terminals, pages and in logs."""
    return 0 < len(text) <= MAX_NAME and text.isprintable()
