"""`tactile-rt model` and `tactile-rt eval`: show, verify, time and evaluate a model file."""

import math
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from tactile_rt.cli.app import add_group, app, needing
from tactile_rt.cli.options import STDOUT, Json, Quick, argument, option
from tactile_rt.cli.tables import print_table, progress_bar, show_records, told_as_json
from tactile_rt.core.errors import ModelError, name_some

model = add_group("model", "Inspect, verify and time a model file.")

File = Annotated[Path, argument("Model file, .onnx.")]
MANY = 8  # classes named before "..."


@model.command(epilog="tactile-rt model show model.onnx")
def show(file: File, json: Json = None) -> None:
    """Show what a model file contains, without running it."""
    from tactile_rt.classifier.model_card import one_line
    from tactile_rt.classifier.model_file import read_model
    from tactile_rt.core.stream import NS_PER_S

    card, contents, data = read_model(file)
    if told_as_json(card, json):
        return
    spec = card.array
    period_ms = card.period_ns / NS_PER_S * 1e3
    rest = f", ... {card.classes[-1]}" if len(card.classes) > MANY else ""
    state = sum(math.prod(s.shape) for s in card.state)
    opset = contents.opset.get("", contents.opset.get("ai.onnx", 0))
    rows = {
        "name": card.name,
        "file": f"{len(data) / 1e6:.2f} MB, {card.precision}, metadata version {card.version}",
        "graph": f"{sum(contents.operators.values())} operators, opset {opset}, "
        f"{contents.weights / 1e6:.2f} MB of weights, by {contents.producer or 'unknown'}",
        "kind": "one step of a stream" if card.kind == "step" else "a whole window",
        "array": f"{spec.name}: {spec.shape[0]} elements x {', '.join(spec.channels)} "
        f"at {spec.rate_hz:g} Hz, frame {spec.frame}",
        "input": f"resampled to {NS_PER_S / card.period_ns:.4g} Hz; a step is {card.substeps} x "
        f"{period_ms:g} ms, an episode {card.steps} steps "
        f"({card.steps * card.substeps * period_ms / 1e3:.3g} s)",
        "classes": f"{len(card.classes)}: {', '.join(card.classes[:MANY])}{rest}",
        "refusals": ", ".join(card.refusals),
        "embedding": f"{card.embedding} units",
        "state": f"{len(card.state)} tensors, {state} values" if card.state else "none",
        "sensor": _format_pairs(card.sensor),
        "clip": _format_channels(spec, card.clip),
        "scale": _format_channels(spec, card.scale),
        "noise floor": _format_channels(spec, card.floor),
        "temperature": f"{card.temperature:.4g}",
        "unknown": _describe_unknown(card.unknown),
        "prediction sets": "\n".join(map(_describe_set, card.candidates)),
        "kinds": "\n".join(f"{c}: {', '.join(kinds)}" for c, kinds in card.kinds.items()),
        "names": "\n".join(f"{c}: {_describe_set(of[0])}" for c, of in card.names.items() if of),
        "identity": f"enrols objects, measured on {card.identity.objects}; enrolled: "
        f"{name_some((one.name for one in card.enrolled), MANY) or 'none'}"
        if card.identity
        else "",
        "figures": _format_pairs(card.figures),
        "licence": card.license,
        "probe": "stored" if card.probe else "none stored",
        "hashes": _format_pairs(card.hashes),
        "made by": _format_pairs({k: v for k, v in card.provenance.items() if isinstance(v, str)}),
    }
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold", no_wrap=True)
    table.add_column(overflow="fold")
    for what, text in rows.items():
        if text:
            # The file may come from anywhere: its text must not control the terminal.
            lines = "\n".join(one_line(line) for line in text.splitlines())
            table.add_row(what, escape(lines))
    print_table(table)


@model.command(epilog="tactile-rt model verify model.onnx")
def verify(file: File, json: Json = None) -> None:
    """Check that a model file is whole and computes the same here.

    Reads it within size limits, checks its metadata against its graph, loads it in a separate
    process as the daemon does, runs an episode of built-in input, and compares the logits with
    those in the file.
    """
    import hashlib

    from tactile_rt.classifier.model_file import load_model, read_model, verify_model
    from tactile_rt.classifier.trial import try_model

    card, contents, data = read_model(file)
    results: dict[str, str] = {}

    def report(what: str, says: str) -> None:
        results[what] = says
        if json != STDOUT:
            typer.echo(f"{what}: {says}")

    report("sha256", hashlib.sha256(data).hexdigest())
    operators = sum(contents.operators.values())
    report("structure", f"{operators} operators, nothing outside the file")
    if card.kind == "step":
        found = try_model(file)
        report(
            "trial",
            f"warm after {found.load_s:.2f} s, {found.memory_mb:.0f} MB, "
            f"{1e3 * found.step_s:.2f} ms a step",
        )
    _, card = load_model(file, kind=None)
    report("metadata", f"version {card.version}, agrees with the graph")
    for line in verify_model(file):
        what, _, says = line.partition(": ")
        report(what, says)
    told_as_json(results, json)


@model.command(epilog="tactile-rt model bench model.onnx --steps 500")
def bench(
    file: File,
    steps: Annotated[int, option("Steps to time.", min=10, max=1_000_000)] = 2000,
    json: Json = None,
) -> None:
    """Measure a model's size, loading, memory and time per step."""
    from tactile_rt.classifier.model_file import read_model
    from tactile_rt.export.model_steps import Subject, measure_model

    card, _, _ = read_model(file)
    if card.kind != "step":
        raise ModelError(f"{file} is a {card.kind} model: only step models are timed")
    with progress_bar("measuring"):
        records = measure_model(Subject("model", file), steps)
    show_records(records, json)


def _format_channels(spec: Any, values: tuple[float, ...]) -> str:
    named = zip(spec.channels, values, spec.units, strict=True)
    return ", ".join(f"{channel} {value:.3g} {unit}" for channel, value, unit in named)


def _describe_unknown(rule: Any) -> str:
    if rule is None:
        return ""
    least, most = min(rule.thresholds), max(rule.thresholds)
    above = f"{least:.4g}" if least == most else f"{least:.4g} to {most:.4g}, by step"
    return f"{rule.score} of the {rule.output} above {above}"


def _describe_set(rule: Any) -> str:
    noise = "" if rule.noise is None else f" up to {rule.noise:.3g} x the rated noise"
    return f"{100 * rule.coverage:.3g} % by {rule.score}, of {rule.objects} objects{noise}"


def _format_pairs(values: dict[str, Any]) -> str:
    def format_value(value: Any) -> str:
        return f"{value:.4g}" if isinstance(value, float) else str(value)

    return "\n".join(f"{key}: {format_value(value)}" for key, value in values.items())


@app.command("eval", epilog="tactile-rt eval model.onnx sweeps --pictures pictures")
def evaluate(
    model: File,
    data: Annotated[Path, argument("Sweep set; its test objects are used.")],
    svm: Annotated[bool, option("Also fit an RBF SVM on the same windows.", "--svm")] = False,
    pictures: Annotated[
        Path | None, option("Folder for pictures of confusion and accuracy over time.")
    ] = None,
    quick: Quick = False,
    json: Json = None,
) -> None:
    """Measure a model on the test objects of a sweep set.

    Reports accuracy, fusion of touches, calibration, noise and faults of the sensor.
    """
    from tactile_rt.sets.manifest import SweepManifest

    SweepManifest.read(data)
    with needing("train"):
        from tactile_rt.models.evaluation.model_file import evaluate_model
    with progress_bar("evaluating"):
        records = evaluate_model(model, data, svm, pictures, quick)
    show_records(records, json)
