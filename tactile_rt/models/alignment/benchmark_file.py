"""Files of frozen benchmarks: JSON with a version and a hash of the content.

A file of another version, or changed by hand, is refused.
"""

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.files import write_whole
from tactile_rt.models.alignment.benchmark import (
    PROTOCOLS,
    Benchmark,
    Consistency,
    Frozen,
    Target,
)
from tactile_rt.models.alignment.rdm import PAIRS, STIMULI

__all__ = ["benchmark_sha256", "load_benchmark", "load_strict", "save_benchmark"]

Floats = NDArray[np.float64]

# 2: RDMs of `strict` are means over many divisions of the trials, in both directions.
SCHEMA = 2


# NaN has no JSON: null stands for it.
class _Frozen(msgspec.Struct, forbid_unknown_fields=True):
    rdm: tuple[float, ...]
    reliability: float | None
    factor: float | None
    units: int


class _Target(msgspec.Struct, forbid_unknown_fields=True):
    name: str
    chosen: _Frozen
    unfiltered: _Frozen
    reliable: bool
    trials: int
    sha256: str


class _Consistency(msgspec.Struct, forbid_unknown_fields=True):
    animals: tuple[str, ...]
    pooled: tuple[float | None, ...]
    pairwise: tuple[tuple[float | None, ...], ...]


class _File(msgspec.Struct, forbid_unknown_fields=True):
    schema: int
    protocol: str
    stimuli: tuple[str, ...]
    bootstraps: int
    seed: int
    targets: tuple[_Target, ...]
    pooled: _Target | None
    a2a: _Consistency
    sources: tuple[str, ...]
    notes: tuple[str, ...]
    sha256: str = ""


class _Version(msgspec.Struct):
    schema: int


def benchmark_sha256(benchmark: Benchmark) -> str:
    """Hash of a benchmark's content, as its file carries it."""
    return _sha256(_file(benchmark))


def save_benchmark(benchmark: Benchmark, path: Path) -> None:
    """Write a benchmark as JSON, whole or not at all."""
    file = _file(benchmark)
    file.sha256 = _sha256(file)
    text = msgspec.json.format(msgspec.json.encode(file), indent=1)
    write_whole(path, lambda out: out.write(text + b"\n"))


def load_benchmark(path: Path) -> Benchmark:
    """Read a benchmark.

    Raises:
        ConfigError: no such file, another schema, a field that is wrong, or changed content.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    try:
        version = msgspec.json.decode(text, type=_Version).schema
        if version != SCHEMA:
            raise ConfigError(
                f"{path}: schema {version}, and this release reads {SCHEMA}: "
                "build the benchmark again"
            )
        file = msgspec.json.decode(text, type=_File)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not an alignment benchmark ({error})") from None
    if file.sha256 != _sha256(file):
        raise ConfigError(f"{path}: changed since it was built: build it again")
    _check(file, path)
    return Benchmark(
        protocol=file.protocol,
        targets=tuple(_target(t) for t in file.targets),
        pooled=_target(file.pooled) if file.pooled else None,
        a2a=Consistency(
            animals=file.a2a.animals,
            pooled=_array(file.a2a.pooled),
            pairwise=np.array([_array(row) for row in file.a2a.pairwise]).reshape(
                len(file.a2a.animals), len(file.a2a.animals)
            ),
            ddof=0 if file.protocol == "paper-code" else 1,
        ),
        bootstraps=file.bootstraps,
        seed=file.seed,
        sources=file.sources,
        notes=file.notes,
        stimuli=file.stimuli,
    )


def load_strict(path: Path) -> Benchmark:
    """Read a benchmark whose stimuli have names, as tests need that ask what each stimulus is.

    Raises:
        ConfigError: as `load_benchmark`; or the benchmark is of the other protocol.
    """
    benchmark = load_benchmark(path)
    if benchmark.protocol != "strict":
        raise ConfigError(
            f"{path} is of protocol {benchmark.protocol}, whose stimuli stand in the order of "
            "their first appearance, another in each session: build with protocol strict"
        )
    return benchmark


def _check(file: _File, path: Path) -> None:
    """What the types cannot say."""
    if file.protocol not in PROTOCOLS:
        raise ConfigError(f"{path}: no protocol {file.protocol!r}: {', '.join(PROTOCOLS)}")
    if file.stimuli != STIMULI:
        raise ConfigError(f"{path}: stimuli {file.stimuli}, not {STIMULI}")
    for target in (*file.targets, *([file.pooled] if file.pooled else [])):
        if not len(target.chosen.rdm) == len(target.unfiltered.rdm) == len(PAIRS):
            raise ConfigError(f"{path}: target {target.name}: an RDM has {len(PAIRS)} entries")
    animals = file.a2a.animals
    if animals != tuple(t.name for t in file.targets) or not (
        len(file.a2a.pooled) == len(file.a2a.pairwise) == len(animals)
        and all(len(row) == len(animals) for row in file.a2a.pairwise)
    ):
        raise ConfigError(f"{path}: a2a and the targets are not of the same animals")


def _file(benchmark: Benchmark) -> _File:
    a2a = benchmark.a2a
    return _File(
        schema=SCHEMA,
        protocol=benchmark.protocol,
        stimuli=benchmark.stimuli,
        bootstraps=benchmark.bootstraps,
        seed=benchmark.seed,
        targets=tuple(_plain_target(t) for t in benchmark.targets),
        pooled=_plain_target(benchmark.pooled) if benchmark.pooled else None,
        a2a=_Consistency(a2a.animals, _nulls(a2a.pooled), tuple(_nulls(r) for r in a2a.pairwise)),
        sources=benchmark.sources,
        notes=benchmark.notes,
    )


def _sha256(file: _File) -> str:
    bare = msgspec.structs.replace(file, sha256="")
    return hashlib.sha256(msgspec.json.encode(bare)).hexdigest()


def _plain_target(target: Target) -> _Target:
    return _Target(
        name=target.name,
        chosen=_plain(target.chosen),
        unfiltered=_plain(target.unfiltered),
        reliable=target.reliable,
        trials=target.trials,
        sha256=target.sha256,
    )


def _plain(frozen: Frozen) -> _Frozen:
    reliability, factor = _nulls([frozen.reliability, frozen.factor])
    return _Frozen(tuple(map(float, frozen.rdm)), reliability, factor, frozen.units)


def _target(target: _Target) -> Target:
    return Target(
        name=target.name,
        chosen=_frozen(target.chosen),
        unfiltered=_frozen(target.unfiltered),
        reliable=target.reliable,
        trials=target.trials,
        sha256=target.sha256,
    )


def _frozen(frozen: _Frozen) -> Frozen:
    reliability, factor = _array((frozen.reliability, frozen.factor))
    return Frozen(np.array(frozen.rdm), float(reliability), float(factor), frozen.units)


def _nulls(values: Sequence[float] | Floats) -> tuple[float | None, ...]:
    return tuple(float(v) if math.isfinite(v) else None for v in values)


def _array(values: Sequence[float | None]) -> Floats:
    return np.array([math.nan if v is None else v for v in values], dtype=np.float64)
