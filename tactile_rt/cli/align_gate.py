"""`tactile-rt align gate`: test whether a model may be released."""

import sys
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from typer.core import TyperCommand

from tactile_rt.cli.align import Stimuli, align
from tactile_rt.cli.app import needing
from tactile_rt.cli.options import Json, argument, option
from tactile_rt.cli.tables import told_as_json
from tactile_rt.core.errors import ConfigError, TactileError

USAGE = 2  # click's exit code
INPUT_ERROR = 3  # exit code of the gate, whose 1 and 2 mean fail and inconclusive


class GateCommand(TyperCommand):
    """Command that exits with `INPUT_ERROR` on a usage error, as 2 means inconclusive."""

    def make_context(self, *arguments: Any, **more: Any) -> Any:
        try:
            return super().make_context(*arguments, **more)
        except Exception as error:
            # click's UsageError, of which typer has its own copy.
            if getattr(error, "exit_code", None) == USAGE:
                error.exit_code = INPUT_ERROR  # type: ignore[attr-defined]
            raise


@align.command(
    "gate", cls=GateCommand, epilog="tactile-rt align gate model.onnx --reference run/best.pt"
)
def gate_model(
    model: Annotated[Path, argument("Model to release: .onnx, best.pt or .npz.")],
    benchmark: Annotated[Path | None, option("Tests 1 and 2: benchmark of `align build`.")] = None,
    baseline: Annotated[Path | None, option("Test 3: scores of the previous model on it.")] = None,
    reference: Annotated[
        Path | None, option("Test 4: checkpoint (or .onnx) that it was exported from.")
    ] = None,
    stimuli: Stimuli = None,
    json: Json = None,
) -> None:
    """Test whether a model may be released.

    Exit code: 0 pass, 1 fail, 2 inconclusive, 3 input error.
    """
    try:
        code = _gate(model, benchmark, baseline, reference, stimuli, json)
    except (TactileError, OSError) as error:
        typer.secho(f"tactile-rt: {' '.join(str(error).splitlines())}", err=True, fg="red")
        code = INPUT_ERROR
    except Exception:  # a bug of ours: Python would exit with 1, which is a verdict
        traceback.print_exc()
        code = INPUT_ERROR
    sys.exit(code)


def _gate(
    model: Path,
    benchmark: Path | None,
    baseline: Path | None,
    reference: Path | None,
    stimuli: Path | None,
    json: Path | None,
) -> int:
    if benchmark is None and reference is None:
        raise ConfigError("name a --benchmark to score on, or the --reference it was exported from")
    if baseline is not None and benchmark is None:
        raise ConfigError("--baseline needs the --benchmark that it was scored on")
    with needing("train"):
        from tactile_rt.alignment.benchmark import load_strict
        from tactile_rt.alignment.fidelity import check_fidelity, export_layers
        from tactile_rt.alignment.gate import Check, exit_code, neural_checks
        from tactile_rt.alignment.loading import check_models, load_layers
        from tactile_rt.alignment.results import baseline_of
        from tactile_rt.alignment.scoring import score
        from tactile_rt.alignment.stimuli_input import read_stimuli

        felt = read_stimuli(stimuli)
        frozen = load_strict(benchmark) if benchmark else None
        before = baseline_of(baseline, frozen, felt) if baseline and frozen else None
        check_models([model, *([reference] if reference else [])])
        checks: list[Check] = []
        rows: list[Any] = []
        if reference is not None:
            original, _ = load_layers(reference, felt)
            is_onnx = model.suffix == ".onnx"
            made = export_layers(model, felt, original) if is_onnx else load_layers(model, felt)[0]
            check, found = check_fidelity(original, made)
            checks.append(check)
            rows += found
        if frozen is not None:
            patterns = load_layers(model, felt, names=frozen.stimuli)[0].patterns
            checks = [*neural_checks(score(frozen, patterns), frozen, before), *checks]
    code = exit_code(checks)
    colours = {"pass": "green", "fail": "bold red", "inconclusive": "yellow"}
    verdicts = [{"name": c.name, "verdict": c.verdict, "why": c.why} for c in checks]
    taps = [asdict(row) for row in rows]
    if told_as_json({"exit_code": code, "checks": verdicts, "taps": taps}, json):
        return code
    console = Console(soft_wrap=True)
    for check in checks:
        word = f"[{colours[check.verdict]}]{check.verdict}[/]"
        console.print(f"{check.name}: {word}: {escape(check.why)}", highlight=False)
    return code
