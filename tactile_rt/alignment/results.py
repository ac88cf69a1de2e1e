"""Scores of models stored in a JSON file, for the report and as a baseline for the gate."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.benchmark import Benchmark, benchmark_sha256, check_benchmark
from tactile_rt.alignment.gate import neural_checks
from tactile_rt.alignment.json_file import Number, read_json
from tactile_rt.alignment.layers import Layers
from tactile_rt.alignment.rdm import Floats, normalise_vectors, upper_indices
from tactile_rt.alignment.scoring import Score, score
from tactile_rt.alignment.stimuli_input import StimuliInput
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import STIMULI


class ModelResult(Score, frozen=True, eq=False, kw_only=True):
    """All stored results of a model: its score, and fields as in `layers.Layers`."""

    name: str
    sha256: str
    precision: str
    parameters: int
    first: tuple[int, ...]
    units: tuple[int, ...]
    performance: Number = math.nan  # accuracy on the task, 0 to 1; NaN if no accuracy is known
    performance_of: str = ""
    untrained: Score | None = None
    notes: tuple[str, ...] = ()
    # the model's encoder, attender, objective, augmentation and masking, as far as they are known;
    # the report groups models by them
    groups: dict[str, str] = msgspec.field(default_factory=dict)
    # verdict of the gate's NeuroAI Turing test: pass, fail or inconclusive; empty under paper-code
    turing: str = ""
    turing_why: str = ""


class Results(
    msgspec.Struct, frozen=True, eq=False, tag_field="kind", tag="tactile_rt alignment scores 2"
):
    """The content of a file of scores: a benchmark, and models' results on it."""

    benchmark: Benchmark
    models: tuple[ModelResult, ...]
    raw: Score | None  # score of the loads; None if the stimuli are not the six whisked ones
    input: dict[str, str]


def results_of(
    benchmark: Benchmark, stimuli: StimuliInput, models: Sequence[ModelResult]
) -> Results:
    """Combine models' results on a benchmark, and score the raw sensor input."""
    if benchmark.stimuli != STIMULI:
        return Results(benchmark, tuple(models), None, {})
    raw = score(benchmark, {"raw": stimuli.raw()})
    return Results(benchmark, tuple(models), raw, {"file": stimuli.name, "sha256": stimuli.sha256})


def score_model(
    benchmark: Benchmark,
    layers: Layers,
    untrained: Layers | None = None,
    performance: tuple[float, str] | None = None,
) -> ModelResult:
    """Score a model and its untrained network.

    Protocol strict adds the test against real animals ("Turing test").
    """
    patterns = layers.patterns
    made = score(benchmark, patterns)
    # The test needs the stimuli's names, which paper-code does not have.
    checks = neural_checks(made, benchmark) if benchmark.protocol == "strict" else ()
    test = next((check for check in checks if check.name == "turing"), None)
    accuracy, measured_on = performance or (math.nan, "")
    return ModelResult(
        **{name: getattr(made, name) for name in Score.__struct_fields__},
        name=layers.name,
        sha256=layers.sha256,
        precision=layers.precision,
        parameters=layers.parameters,
        first=tuple(int(layers.first[n]) for n in patterns),
        units=tuple(p.shape[1] for p in patterns.values()),
        performance=accuracy,
        performance_of=measured_on,
        untrained=score(benchmark, untrained.patterns) if untrained else None,
        notes=(*layers.notes, *_note_missing_rdms(patterns, benchmark.stimuli)),
        groups=_read_groups(layers),
        turing=test.verdict if test else "",
        turing_why=test.why if test else "",
    )


def _note_missing_rdms(
    patterns: Mapping[str, NDArray[np.float64]], names: Sequence[str]
) -> Iterator[str]:
    """Yield a note for each group of layers without an RDM for the same stimuli."""
    found: dict[tuple[str, ...], list[str]] = {}
    for layer, responses in patterns.items():
        varies = np.asarray(np.isfinite(normalise_vectors(responses)).all(axis=1))
        if not varies.all():
            alike = tuple(s for s, good in zip(names, varies, strict=True) if not good)
            found.setdefault(alike, []).append(layer)
    for alike, layers in found.items():
        stimuli = "every stimulus" if len(alike) == len(names) else ", ".join(alike)
        yield (
            f"{len(layers)} of {len(patterns)} layers have no RDM and take no part, for all units "
            f"of each answer {stimuli} alike: {', '.join(layers)}"
        )


def read_results(path: Path) -> Results:
    """Read and check scores from a JSON file of `tactile-rt align score`."""
    results = read_json(path, Results, "tactile-rt align score --json")
    check_benchmark(results.benchmark, path)
    targets = tuple(t.name for t in results.benchmark.all_targets)
    pairs = len(upper_indices(len(results.benchmark.stimuli))[0])
    if results.raw is not None:
        _check_score(results.raw, targets, ("raw",), pairs, f"{path} is damaged: raw sensor input")
    for model in results.models:
        where = f"{path} is damaged: {model.name}"
        _check_score(model, targets, model.layers, pairs, where)
        if not len(model.units) == len(model.first) == len(model.layers):
            raise ConfigError(f"{where}: units and layers do not fit")
        if model.untrained is not None:
            _check_score(model.untrained, targets, model.untrained.layers, pairs, where)
    return results


def _check_score(
    made: Score, targets: tuple[str, ...], layers: tuple[str, ...], pairs: int, where: str
) -> None:
    shape = (len(layers), len(targets))
    if not (
        made.layers == layers
        and made.targets == targets
        and made.rdms.shape == (len(layers), pairs)
        and made.r.shape == made.corrected.shape == made.unfiltered.shape == shape
        and made.per_target.shape == (len(targets),)
        and len(made.chosen) == len(made.reliable) == len(targets)
    ):
        raise ConfigError(f"{where}: the tables do not fit")


def baseline_of(path: Path, benchmark: Benchmark, stimuli: StimuliInput) -> Floats:
    """Read the RDMs (layer, pair) of the only model in a file of scores.

    Raises:
        ConfigError: the file is unreadable, has several models, or another benchmark or stimuli.
    """
    results = read_results(path)
    if len(results.models) != 1:
        raise ConfigError(f"{path} has {len(results.models)} models; a baseline must have one")
    if benchmark_sha256(results.benchmark) != benchmark_sha256(benchmark):
        raise ConfigError(f"{path} was scored on another benchmark: score the baseline on this one")
    if results.raw and results.input.get("sha256") != stimuli.sha256:
        raise ConfigError(
            f"{path} was scored on other stimuli ({results.input.get('file', 'not named')}) than "
            f"{stimuli.name}: score the baseline on these"
        )
    return results.models[0].rdms


def _read_groups(layers: Layers) -> dict[str, str]:
    known = {key: layers.network.get(key) for key in ("encoder", "attender")}
    known |= {key: layers.training.get(key) for key in ("objective", "augmentation", "masking")}
    return {
        key: f"{value:g}" if isinstance(value, float) else str(value)
        for key, value in known.items()
        if value is not None
    }
