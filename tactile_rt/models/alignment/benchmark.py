"""A frozen benchmark: what scoring a model needs, without any animal's raw data.

A deterministic model's score against an animal is r_xy times a factor that depends on the animal
alone, so 15 numbers and that factor per animal are enough.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.alignment.rdm import STIMULI

__all__ = ["PROTOCOLS", "Benchmark", "Consistency", "Frozen", "Target"]

Floats = NDArray[np.float64]

PROTOCOLS = ("strict", "paper-code")


@dataclass(frozen=True, eq=False)
class Frozen:
    """An RDM and how far it can be relied on.

    Attributes:
        rdm: (15,) The dissimilarities of the 15 pairs of stimuli: for paper-code, from the mean
            over trials; for strict, the mean over divisions of the trials.
        reliability: The mean split-half correlation of the RDM, corrected by Spearman-Brown; for
            strict, that of the RDM of one half of a division.
        factor: The factor K by which a model's r_xy is multiplied to give its score; NaN if the RDM
            is too noisy to score on.
        units: The number of units that the RDM was made from; for strict, on average.
    """

    rdm: Floats
    reliability: float
    factor: float
    units: int


@dataclass(frozen=True, eq=False)
class Target:
    """What models are compared to: an animal, or all of them pooled.

    Attributes:
        name: The name of the animal, or of the pool of all animals.
        chosen: The RDM that the protocol scores on; for strict, it is made of reliable units only.
        unfiltered: The RDM of all units, without the protocol's filter.
        reliable: Whether the target is reliable enough to count in a mean over animals.
        trials: The number of trials that were used; for paper-code, the rows of the padded array.
        sha256: The SHA-256 sum of the rates that the target was made from, hex.
    """

    name: str
    chosen: Frozen
    unfiltered: Frozen
    reliable: bool
    trials: int
    sha256: str


@dataclass(frozen=True, eq=False)
class Consistency:
    """How well animals predict each other.

    Attributes:
        animals: The names of the animals, in the order of the axes.
        pooled: (animal,) The score of all other animals' units pooled against each animal; NaN
            where there is none.
        pairwise: (animal, animal) The score of a row's animal against a column's; NaN on the
            diagonal.
        ddof: The degrees of freedom that the standard error leaves to the mean: 1, and 0 in the
            published analysis.
    """

    animals: tuple[str, ...]
    pooled: Floats
    pairwise: Floats
    ddof: int = 1

    @property
    def mean(self) -> float:
        """Mean of the pooled scores; NaN without any."""
        return _or_nan(self.pooled, np.mean)

    @property
    def sem(self) -> float:
        """Standard error of that mean."""
        there = self.pooled[np.isfinite(self.pooled)]
        if there.size <= self.ddof:
            return math.nan
        return float(there.std(ddof=self.ddof) / math.sqrt(there.size))

    @property
    def highest(self) -> float:
        """Highest pooled score."""
        return _or_nan(self.pooled, np.max)


@dataclass(frozen=True, eq=False)
class Benchmark:
    """A frozen benchmark.

    Attributes:
        protocol: The name of the protocol, ``strict`` or ``paper-code``.
        targets: The animals that models are compared to.
        pooled: All animals as one target, which paper-code scores on as well; None under strict.
        a2a: The animal-to-animal consistency, which a model cannot be expected to exceed.
        bootstraps, seed: Number and seed of the random divisions of the trials.
        sources: The names of the files that were read.
        notes: Remarks on what was left out and why, a line each.
        stimuli: The names of the stimuli along the stimulus axis.
    """

    protocol: str
    targets: tuple[Target, ...]
    pooled: Target | None
    a2a: Consistency
    bootstraps: int
    seed: int
    sources: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    stimuli: tuple[str, ...] = STIMULI

    @property
    def all_targets(self) -> tuple[Target, ...]:
        """Animals, and the pooled target where there is one."""
        return self.targets + ((self.pooled,) if self.pooled else ())

    @property
    def reliable(self) -> tuple[Target, ...]:
        """Animals that count in a mean."""
        return tuple(target for target in self.targets if target.reliable)


def _or_nan(values: Floats, reduce: Callable[[Floats], np.floating]) -> float:
    finite = values[np.isfinite(values)]
    return float(reduce(finite)) if finite.size else math.nan
