"""`tactile-rt eval`: what a model can do, measured on objects that it never saw."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from tactile_rt.cli.app import app, needing
from tactile_rt.cli.options import Json, Quick
from tactile_rt.cli.progress import progress_bar
from tactile_rt.cli.tables import show_records


@app.command(name="eval")
def evaluate(
    model: Annotated[Path, typer.Argument(help="An .onnx model.")],
    data: Annotated[Path, typer.Argument(help="A sweep set.")],
    svm: Annotated[
        bool, typer.Option("--svm", help="Fit an RBF SVM on the same windows too.")
    ] = False,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for confusion and accuracy over time.")
    ] = None,
    quick: Quick = False,
    json: Json = None,
) -> None:
    """Measure a model on the test objects of a sweep set: accuracy, fusion, calibration, noise
    and what else goes wrong with a sensor."""
    from tactile_rt.sets.manifest import SweepManifest

    SweepManifest.read(data)
    with needing("train"):
        from tactile_rt.models.evaluation.model_file import evaluate_model
    with progress_bar(Console(stderr=True), "evaluating"):
        records = evaluate_model(model, data, svm, pictures, quick)
    show_records(records, json)
