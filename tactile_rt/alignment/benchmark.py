"""A frozen benchmark: the data that scoring a model needs, without any animal's raw recordings.

A deterministic model's score against an animal is r_xy times a factor that depends on the animal
alone, so an RDM (15 numbers for six stimuli) and that factor per animal are enough. The file is
JSON with a hash of the content: a file of another version, or changed by hand, is rejected.
"""

import hashlib
import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from tactile_rt.alignment.json_file import Number, encode, read_json, write_json
from tactile_rt.alignment.rdm import Floats, upper_indices
from tactile_rt.alignment.statistics import standard_error
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import STIMULI

PROTOCOLS = ("strict", "paper-code")
FEWEST, MOST = 3, 50  # stimuli


class Frozen(msgspec.Struct, frozen=True, eq=False, forbid_unknown_fields=True):
    """The RDM of a target, with its reliability and noise correction.

    Attributes:
        rdm: (pair,) The dissimilarities of the pairs of stimuli: for paper-code, from the mean
            over trials; for strict, the mean over divisions of the trials.
        reliability: The mean split-half correlation of the RDM, corrected by Spearman-Brown; for
            strict, that of the RDM of one half of a division.
        factor: The factor by which a model's r_xy is multiplied to give its score; NaN if the RDM
            is too noisy to score on.
    """

    rdm: Floats
    reliability: Number
    factor: Number
    units: int


class Target(msgspec.Struct, frozen=True, eq=False, forbid_unknown_fields=True):
    """A target that models are compared with: an animal, or all animals pooled.

    Attributes:
        chosen: The RDM that the protocol scores on; for strict, from reliable units only.
        unfiltered: The RDM of all units, reported as well.
        reliable: True if the target counts in mean scores.
        trials: The number of trials used; for paper-code, the rows of the padded array.
    """

    name: str
    chosen: Frozen
    unfiltered: Frozen
    reliable: bool
    trials: int
    sha256: str


class Consistency(msgspec.Struct, frozen=True, eq=False, forbid_unknown_fields=True):
    """Consistency between animals: scores of animals as models of each other.

    Attributes:
        pooled: (animal,) The score of all other animals' units pooled against each animal; NaN
            without a score.
        pairwise: (animal, animal) The score between each row's and column's animal; NaN on the
            diagonal.
        ddof: The degrees of freedom deducted in the standard error: 1, or 0 as published.
    """

    animals: tuple[str, ...]
    pooled: Floats
    pairwise: Floats
    ddof: int = 1

    @property
    def mean(self) -> float:
        """Mean of the pooled scores; NaN if none is finite."""
        return self._reduce(np.mean)

    @property
    def sem(self) -> float:
        """Standard error of `mean`."""
        return standard_error(self.pooled, self.ddof)

    @property
    def highest(self) -> float:
        """Highest pooled score."""
        return self._reduce(np.max)

    def _reduce(self, reduce: Callable[[Floats], np.floating]) -> float:
        finite = self.pooled[np.isfinite(self.pooled)]
        return float(reduce(finite)) if finite.size else math.nan


class Benchmark(msgspec.Struct, frozen=True, eq=False, forbid_unknown_fields=True):
    """A frozen benchmark: the targets that models are scored against, and their consistency.

    Attributes:
        pooled: All animals as one further target for paper-code; None for strict.
        a2a: The consistency between animals.
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
        """Animals, followed by the pooled target if there is one."""
        return self.targets + ((self.pooled,) if self.pooled else ())

    @property
    def reliable(self) -> tuple[Target, ...]:
        """Animals that count in mean scores."""
        return tuple(target for target in self.targets if target.reliable)


# Version 3: the file holds the benchmark and its hash.
class _File(
    msgspec.Struct, tag_field="kind", tag="tactile_rt benchmark 3", forbid_unknown_fields=True
):
    benchmark: Benchmark
    sha256: str


def benchmark_sha256(benchmark: Benchmark) -> str:
    """Return the SHA-256 of a benchmark's content, as stored in its file."""
    return hashlib.sha256(encode(benchmark)).hexdigest()


def save_benchmark(benchmark: Benchmark, path: Path) -> None:
    """Write a benchmark to a JSON file, atomically."""
    write_json(_File(benchmark, benchmark_sha256(benchmark)), path)


def load_benchmark(path: Path) -> Benchmark:
    """Read and check a benchmark from its JSON file.

    Raises:
        ConfigError: the file is missing, of another version, invalid, or changed since the build.
    """
    file = read_json(path, _File, "tactile-rt align build")
    if file.sha256 != benchmark_sha256(file.benchmark):
        raise ConfigError(f"{path}: changed since it was built: build it again")
    check_benchmark(file.benchmark, path)
    return file.benchmark


def load_strict(path: Path) -> Benchmark:
    """Read a benchmark; check that its protocol is strict, whose stimuli have names."""
    benchmark = load_benchmark(path)
    if benchmark.protocol != "strict":
        raise ConfigError(
            f"{path} was built with protocol {benchmark.protocol}, which orders the stimuli of "
            "each session by first appearance: build it with protocol strict"
        )
    return benchmark


def check_benchmark(benchmark: Benchmark, path: Path) -> None:
    """Check the values and shapes of a benchmark's fields.

    Raises:
        ConfigError: the protocol is unknown, stimuli are invalid, or shapes do not match.
    """
    if benchmark.protocol not in PROTOCOLS:
        raise ConfigError(f"{path}: no protocol {benchmark.protocol!r}: {', '.join(PROTOCOLS)}")
    number = len(benchmark.stimuli)
    if not FEWEST <= number == len(set(benchmark.stimuli)) <= MOST:
        raise ConfigError(f"{path}: stimuli need {FEWEST} to {MOST} different names")
    if {*benchmark.stimuli} == {*STIMULI} and benchmark.stimuli != STIMULI:
        raise ConfigError(f"{path}: the six stimuli must be in the order {STIMULI}")
    pairs = len(upper_indices(number)[0])
    for target in benchmark.all_targets:
        if not target.chosen.rdm.shape == target.unfiltered.rdm.shape == (pairs,):
            raise ConfigError(f"{path}: target {target.name}: an RDM has {pairs} entries")
    a2a = benchmark.a2a
    animals = len(a2a.animals)
    if a2a.animals != tuple(t.name for t in benchmark.targets) or not (
        a2a.pooled.shape == (animals,) and a2a.pairwise.shape == (animals, animals)
    ):
        raise ConfigError(f"{path}: a2a and targets must have the same animals")
