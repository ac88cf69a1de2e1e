"""Scores at rest: one JSON file that a report is drawn from and a gate compares with."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.files import write_whole
from tactile_rt.models.alignment.benchmark import Benchmark
from tactile_rt.models.alignment.benchmark_file import benchmark_sha256
from tactile_rt.models.alignment.gate import neural_checks
from tactile_rt.models.alignment.layers import Layers
from tactile_rt.models.alignment.rdm import PAIRS, STIMULI, normalised, rdm
from tactile_rt.models.alignment.scoring import Score, score
from tactile_rt.models.alignment.stimuli_input import StimuliInput

__all__ = [
    "AlignmentControl",
    "BenchmarkResult",
    "ModelResult",
    "Results",
    "baseline_of",
    "model_result",
    "read_results",
    "results_of",
    "write_results",
]

VERSION = 1
# None in the file where there is no value; what is larger cannot be drawn.
Number = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)] | None


class AlignmentControl(msgspec.Struct, frozen=True):
    """What a score is compared with: raw sensor input, or an untrained network.

    Attributes:
        name: The name of the control, as a report prints it.
        layers: The names of the layers that were scored.
        corrected: (layer, target) Correlations corrected for noise.
        score, sem, p: Score, standard error and p value of the control, as `scoring.Score` has a
            model's.
    """

    name: str
    layers: tuple[str, ...]
    corrected: tuple[tuple[Number, ...], ...]
    score: Number
    sem: Number
    p: Number


class ModelResult(msgspec.Struct, frozen=True):
    """Everything that is shown of a model; fields as in `scoring.Score` and `layers.Layers`.

    Attributes:
        rdms: (layer, 15) The dissimilarities of the 15 pairs of stimuli in each layer.
        units: (layer,) The number of units in each layer.
        performance: The accuracy on the task, 0 to 1; None if no accuracy is known.
        performance_of: The words that say what that accuracy was measured on.
        untrained: The network before its training as a control, where there is one.
        groups: The groups that the model belongs to, by what they divide models by: encoder,
            attender, objective, augmentation, masking; without those that are not known.
        turing: The verdict of the gate's NeuroAI Turing test: pass, fail or inconclusive; empty
            under paper-code, and in files that were written without it.
        turing_why: The reason for that verdict, and what the test would find in this benchmark.
    """

    name: str
    sha256: str
    precision: str
    parameters: int
    layers: tuple[str, ...]
    first: tuple[int, ...]
    units: tuple[int, ...]
    rdms: tuple[tuple[Number, ...], ...]
    corrected: tuple[tuple[Number, ...], ...]
    unfiltered: tuple[tuple[Number, ...], ...]
    chosen: tuple[str, ...]
    per_target: tuple[Number, ...]
    score: Number
    sem: Number
    p: Number
    null_95: Number
    performance: Number = None
    performance_of: str = ""
    untrained: AlignmentControl | None = None
    notes: tuple[str, ...] = ()
    groups: dict[str, str] = {}
    turing: str = ""
    turing_why: str = ""


class BenchmarkResult(msgspec.Struct, frozen=True):
    """What is shown of the benchmark; (target, 15) RDMs and a factor and a reliability each."""

    protocol: str
    sha256: str
    targets: tuple[str, ...]
    reliable: tuple[bool, ...]
    factors: tuple[Number, ...]
    reliabilities: tuple[Number, ...]
    rdms: tuple[tuple[Number, ...], ...]
    a2a_mean: Number
    a2a_sem: Number
    a2a_highest: Number
    a2a: dict[str, Number]
    notes: tuple[str, ...] = ()


class Results(msgspec.Struct, frozen=True):
    """One file of scores.

    Attributes:
        stimuli, pairs: Names along the axes of the RDMs: six stimuli, fifteen pairs.
        input: The file name and the SHA-256 sum of the stimuli's loads.
        raw: The control that no model is needed for: the readings of the sensors themselves.
    """

    benchmark: BenchmarkResult
    models: tuple[ModelResult, ...]
    raw: AlignmentControl
    raw_rdm: tuple[Number, ...]
    input: dict[str, str]
    stimuli: tuple[str, ...] = STIMULI
    kind: str = "tactile_rt alignment scores"
    version: int = VERSION


def results_of(
    benchmark: Benchmark, stimuli: StimuliInput, models: Sequence[ModelResult]
) -> Results:
    """Scores of models on one benchmark, the sensors themselves beside them."""
    targets = benchmark.all_targets
    raw = stimuli.raw()
    a2a = benchmark.a2a
    return Results(
        benchmark=BenchmarkResult(
            protocol=benchmark.protocol,
            sha256=benchmark_sha256(benchmark),
            targets=tuple(t.name for t in targets),
            reliable=tuple(bool(t.reliable) for t in targets),
            factors=_numbers([t.chosen.factor for t in targets]),
            reliabilities=_numbers([t.chosen.reliability for t in targets]),
            rdms=_table([t.chosen.rdm for t in targets]),
            a2a_mean=_number(a2a.mean),
            a2a_sem=_number(a2a.sem),
            a2a_highest=_number(a2a.highest),
            a2a=dict(zip(a2a.animals, _numbers(a2a.pooled), strict=True)),
            notes=benchmark.notes,
        ),
        models=tuple(models),
        raw=_control("raw sensor input", score(benchmark, {"raw": raw})),
        raw_rdm=_numbers(rdm(raw)),
        input={"file": stimuli.name, "sha256": stimuli.sha256},
    )


def model_result(
    benchmark: Benchmark,
    layers: Layers,
    untrained: Layers | None = None,
    performance: tuple[float, str] | None = None,
) -> tuple[ModelResult, Score]:
    """Score a model."""
    patterns = layers.patterns
    made = score(benchmark, patterns)
    # The test takes stimuli by their names, which paper-code has lost.
    checks = neural_checks(made, benchmark) if benchmark.protocol == "strict" else ()
    test = next((check for check in checks if check.name == "turing"), None)
    return ModelResult(
        name=layers.name,
        sha256=layers.sha256,
        precision=layers.precision,
        parameters=layers.parameters,
        layers=made.layers,
        first=tuple(int(layers.first[n]) for n in patterns),
        units=tuple(p.shape[1] for p in patterns.values()),
        rdms=_table([rdm(p) for p in patterns.values()]),
        corrected=_table(made.corrected),
        unfiltered=_table(made.unfiltered),
        chosen=made.chosen,
        per_target=_numbers(made.per_target),
        score=_number(made.score),
        sem=_number(made.sem),
        p=_number(made.p),
        null_95=_number(made.null_95),
        performance=performance[0] if performance else None,
        performance_of=performance[1] if performance else "",
        untrained=(
            _control(untrained.name, score(benchmark, untrained.patterns)) if untrained else None
        ),
        notes=(*layers.notes, *_without_rdm(patterns)),
        groups=_groups(layers),
        turing=test.verdict if test else "",
        turing_why=test.why if test else "",
    ), made


def _without_rdm(patterns: Mapping[str, NDArray[np.float64]]) -> Iterator[str]:
    """What takes no part in a score, and why: a line for all layers of one reason."""
    found: dict[tuple[str, ...], list[str]] = {}
    for layer, responses in patterns.items():
        there = np.asarray(np.isfinite(normalised(responses)).all(axis=1))
        if not there.all():
            alike = tuple(s for s, one in zip(STIMULI, there, strict=True) if not one)
            found.setdefault(alike, []).append(layer)
    for alike, layers in found.items():
        stimuli = "every stimulus" if len(alike) == len(STIMULI) else ", ".join(alike)
        yield (
            f"{len(layers)} of {len(patterns)} layers have no RDM and take no part, for all units "
            f"of each answer {stimuli} alike: {', '.join(layers)}"
        )


def write_results(results: Results, path: Path) -> None:
    """Write them whole or not at all, as JSON."""
    text = msgspec.json.format(msgspec.json.encode(results), indent=1)
    write_whole(path, lambda file: file.write(text + b"\n"))


def read_results(path: Path) -> Results:
    """Read what `write_results` wrote.

    Raises:
        ConfigError: not there, damaged, or of another version.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from None
    try:
        head = msgspec.json.decode(raw)
        if not isinstance(head, dict) or head.get("kind") != "tactile_rt alignment scores":
            raise ConfigError(f"{path} has no scores: write some with `tactile-rt align score`")
        if head.get("version") != VERSION:
            raise ConfigError(
                f"{path} has scores of version {head.get('version')!r}, not {VERSION}"
            )
        results = msgspec.json.decode(raw, type=Results)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(
            f"{path} is damaged, or not what `tactile-rt align score --json` wrote: {error}"
        ) from None
    for what, fits in _fitting(results):
        if not fits:
            raise ConfigError(f"{path} is damaged: the tables of {what} do not fit")
    return results


def _fitting(results: Results) -> Iterator[tuple[str, bool]]:
    """Whose tables they are, and whether they are of the sizes that the types cannot say."""
    benchmark, raw = results.benchmark, results.raw
    targets = len(benchmark.targets)
    told = (benchmark.reliable, benchmark.factors, benchmark.reliabilities)
    yield (
        "the benchmark",
        {len(values) for values in told} <= {targets}
        and _is_table(benchmark.rdms, targets, len(PAIRS))
        and set(benchmark.a2a) == set(benchmark.targets[: len(benchmark.a2a)])
        and results.stimuli == STIMULI,
    )
    yield (
        raw.name,
        raw.layers == ("raw",)
        and _is_table(raw.corrected, 1, targets)
        and len(results.raw_rdm) == len(PAIRS),
    )
    for model in results.models:
        layers, before = len(model.layers), model.untrained
        yield (
            model.name,
            len(model.units) == len(model.first) == layers
            and len(model.per_target) == len(model.chosen) == targets
            and _is_table(model.rdms, layers, len(PAIRS))
            and _is_table(model.corrected, layers, targets)
            and _is_table(model.unfiltered, layers, targets)
            and (before is None or _is_table(before.corrected, len(before.layers), targets)),
        )


def _is_table(rows: Sequence[Sequence[Number]], number: int, width: int) -> bool:
    return len(rows) == number and all(len(row) == width for row in rows)


def baseline_of(path: Path, benchmark: Benchmark, stimuli: StimuliInput) -> NDArray[np.float64]:
    """RDMs (layer, 15) of the one model in a file of scores on this benchmark and these stimuli.

    Raises:
        ConfigError: unreadable, of several models, or of another benchmark or other stimuli.
    """
    results = read_results(path)
    if len(results.models) != 1:
        raise ConfigError(f"{path} has {len(results.models)} models; a baseline is one")
    if results.benchmark.sha256 != benchmark_sha256(benchmark):
        raise ConfigError(f"{path} was scored on another benchmark: score the baseline on this one")
    if results.input.get("sha256") != stimuli.sha256:
        raise ConfigError(
            f"{path} was scored on other stimuli ({results.input.get('file', 'not named')}) than "
            f"{stimuli.name}: score the baseline on these"
        )
    return np.array(results.models[0].rdms, dtype=np.float64)


def _control(name: str, made: Score) -> AlignmentControl:
    return AlignmentControl(
        name=name,
        layers=made.layers,
        corrected=_table(made.corrected),
        score=_number(made.score),
        sem=_number(made.sem),
        p=_number(made.p),
    )


def _groups(layers: Layers) -> dict[str, str]:
    told = {key: layers.network.get(key) for key in ("encoder", "attender")}
    told |= {key: layers.training.get(key) for key in ("objective", "augmentation", "masking")}
    return {
        key: f"{value:g}" if isinstance(value, float) else str(value)
        for key, value in told.items()
        if value is not None
    }


def _number(value: float) -> Number:
    return float(value) if math.isfinite(value) else None


def _numbers(values: ArrayLike) -> tuple[Number, ...]:
    array: NDArray[np.float64] = np.asarray(values, dtype=np.float64)
    return tuple(_number(v) for v in array.tolist())


def _table(rows: ArrayLike) -> tuple[tuple[Number, ...], ...]:
    return tuple(_numbers(row) for row in np.asarray(rows, dtype=np.float64))
