"""A frozen benchmark: what scoring a model needs, without any animal's raw data.

A deterministic model's score against an animal is r_xy times a factor that depends on the animal
alone, so an RDM (15 numbers of six stimuli) and that factor per animal are enough. Its file is
JSON with a hash of the content: one of another version, or changed by hand, is refused.
"""

import hashlib
import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np

from tactile_rt.alignment.json_file import Number, encode, read_json, write_json
from tactile_rt.alignment.rdm import Floats, upper
from tactile_rt.alignment.statistics import standard_error
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import STIMULI

PROTOCOLS = ("strict", "paper-code")
FEWEST, MOST = 3, 50  # stimuli


class Frozen(msgspec.Struct, frozen=True, eq=False, forbid_unknown_fields=True):
    """An RDM and how far it can be relied on.

    Attributes:
        rdm: (pair,) The dissimilarities of the pairs of stimuli: for paper-code, from the mean
            over trials; for strict, the mean over divisions of the trials.
        reliability: The mean split-half correlation of the RDM, corrected by Spearman-Brown; for
            strict, that of the RDM of one half of a division.
        factor: The factor K by which a model's r_xy is multiplied to give its score; NaN if the RDM
            is too noisy to score on.
    """

    rdm: Floats
    reliability: Number
    factor: Number
    units: int


class Target(msgspec.Struct, frozen=True, eq=False, forbid_unknown_fields=True):
    """What models are compared to: an animal, or all of them pooled.

    Attributes:
        chosen: The RDM that the protocol scores on; for strict, it is made of reliable units only.
        trials: The number of trials that were used; for paper-code, the rows of the padded array.
    """

    name: str
    chosen: Frozen
    unfiltered: Frozen
    reliable: bool
    trials: int
    sha256: str


class Consistency(msgspec.Struct, frozen=True, eq=False, forbid_unknown_fields=True):
    """How well animals predict each other.

    Attributes:
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
        return self._reduce(np.mean)

    @property
    def sem(self) -> float:
        """Standard error of that mean."""
        return standard_error(self.pooled, self.ddof)

    @property
    def highest(self) -> float:
        """Highest pooled score."""
        return self._reduce(np.max)

    def _reduce(self, reduce: Callable[[Floats], np.floating]) -> float:
        finite = self.pooled[np.isfinite(self.pooled)]
        return float(reduce(finite)) if finite.size else math.nan


class Benchmark(msgspec.Struct, frozen=True, eq=False, forbid_unknown_fields=True):
    """A frozen benchmark.

    Attributes:
        pooled: All animals as one target, which paper-code scores on as well; None under strict.
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


# 3: the benchmark stands beside its hash.
class _File(
    msgspec.Struct, tag_field="kind", tag="tactile_rt benchmark 3", forbid_unknown_fields=True
):
    benchmark: Benchmark
    sha256: str


def benchmark_sha256(benchmark: Benchmark) -> str:
    """Hash of a benchmark's content, as its file carries it."""
    return hashlib.sha256(encode(benchmark)).hexdigest()


def save_benchmark(benchmark: Benchmark, path: Path) -> None:
    """Write a benchmark as JSON, whole or not at all."""
    write_json(_File(benchmark, benchmark_sha256(benchmark)), path)


def load_benchmark(path: Path) -> Benchmark:
    """Read a benchmark.

    Raises:
        ConfigError: no such file, another version, a field that is wrong, or changed content.
    """
    file = read_json(path, _File, "tactile-rt align build")
    if file.sha256 != benchmark_sha256(file.benchmark):
        raise ConfigError(f"{path}: changed since it was built: build it again")
    check_benchmark(file.benchmark, path)
    return file.benchmark


def load_strict(path: Path) -> Benchmark:
    """Read a benchmark of the protocol whose stimuli have names, as gate and decoder need."""
    benchmark = load_benchmark(path)
    if benchmark.protocol != "strict":
        raise ConfigError(
            f"{path} is of protocol {benchmark.protocol}, whose stimuli stand in the order of "
            "their first appearance, another in each session: build with protocol strict"
        )
    return benchmark


def check_benchmark(benchmark: Benchmark, path: Path) -> None:
    """Check what the types of a benchmark's fields cannot.

    Raises:
        ConfigError: no such protocol, other stimuli, or tables that do not fit.
    """
    if benchmark.protocol not in PROTOCOLS:
        raise ConfigError(f"{path}: no protocol {benchmark.protocol!r}: {', '.join(PROTOCOLS)}")
    number = len(benchmark.stimuli)
    if not FEWEST <= number == len(set(benchmark.stimuli)) <= MOST:
        raise ConfigError(f"{path}: stimuli need {FEWEST} to {MOST} names, each another")
    if {*benchmark.stimuli} == {*STIMULI} and benchmark.stimuli != STIMULI:
        raise ConfigError(f"{path}: the six stimuli are in another order than {STIMULI}")
    pairs = len(upper(number)[0])
    for target in benchmark.all_targets:
        if not target.chosen.rdm.shape == target.unfiltered.rdm.shape == (pairs,):
            raise ConfigError(f"{path}: target {target.name}: an RDM has {pairs} entries")
    a2a = benchmark.a2a
    animals = len(a2a.animals)
    if a2a.animals != tuple(t.name for t in benchmark.targets) or not (
        a2a.pooled.shape == (animals,) and a2a.pairwise.shape == (animals, animals)
    ):
        raise ConfigError(f"{path}: a2a and the targets are not of the same animals")
