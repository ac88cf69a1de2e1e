"""What a classifier says, and what it counts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Classification", "ClassifierStats", "fuse"]


@dataclass(frozen=True)
class Classification:
    """A decision during an episode.

    Attributes:
        onset_ns: stream time at which contact began, ns.
        t_ns: stream time of the last resampled sample used, ns.
        step: steps used, counted from 1; those before them, of a longer contact, are not in it.
        final: nothing more will be said of this window; an episode that a silence of the stream
            cuts short has no such decision.
        label: the most probable class.
        labels: all class names.
        probabilities: (class,) float32 posterior.
        latency_s: time the model step took, s.
        late: more work had gathered than the deadline allows.
    """

    onset_ns: int
    t_ns: int
    step: int
    final: bool
    label: str
    labels: tuple[str, ...]
    probabilities: NDArray[np.float32]
    latency_s: float
    late: bool = False

    def top(self, k: int = 5) -> list[tuple[str, float]]:
        """The k most probable classes with their probabilities."""
        order = np.argsort(-self.probabilities, kind="stable")[:k]
        return [(self.labels[i], float(self.probabilities[i])) for i in order]


@dataclass
class ClassifierStats:
    """Counted since the classifier was made.

    Attributes:
        steps: that the network took.
        late: steps that missed the deadline.
        withheld: decisions that were not returned because they were late.
        bad_samples: samples of one element that were no number, infinite or absurd, though marked
            valid; they were taken for invalid.
        bad_steps: steps at which the network said no numbers; they gave no decision.
    """

    steps: int = 0
    late: int = 0
    withheld: int = 0
    bad_samples: int = 0
    bad_steps: int = 0


def fuse(posteriors: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Combine posteriors (class,) of independent sweeps of one object: their normalised product.

    Assumes equal priors, as the training sets have.

    Raises:
        ValueError: no posteriors.
    """
    evidence = np.log(np.clip(np.stack(posteriors), 1e-12, None)).sum(axis=0)
    fused = np.exp(evidence - evidence.max())
    normalised: NDArray[np.float32] = (fused / fused.sum()).astype(np.float32)
    return normalised
