"""`tactile-rt train`, `export` and `eval`: from a sweep set to a model file with its figures."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from tactile_rt.cli import app, check_output, needs
from tactile_rt.cli.progress import progress_bar
from tactile_rt.stream import ConfigError


@app.command()
def train(
    data: Annotated[Path, typer.Argument(help="A sweep set.")],
    folder: Annotated[Path, typer.Argument(help="The run; an interrupted one goes on.")],
    attender: Annotated[str, typer.Option(help="gpt or none.")] = "none",
    decoder: Annotated[str, typer.Option(help="linear or mlp.")] = "mlp",
    width: Annotated[
        float, typer.Option(help="Scales every channel count; a multiple of 1/32.")
    ] = 0.125,
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the training split.")] = 14,
    batch: Annotated[int, typer.Option(min=1, help="Sweeps per update.")] = 32,
    learning_rate: Annotated[float, typer.Option(help="Peak, after a warm-up.")] = 5e-3,
    seed: Annotated[int, typer.Option(help="Of weights, windows and noise.")] = 0,
    threads: Annotated[int, typer.Option(min=1, help="CPU threads.")] = 1,
) -> None:
    """Train an Encoder-Attender-Decoder network on a sweep set."""
    try:
        import torch

        from tactile_rt.models import training
    except ModuleNotFoundError as error:
        raise needs("train", error) from None
    torch.set_num_threads(threads)
    config = training.TrainingConfig(
        data=str(data),
        attender=attender,
        decoder=decoder,
        width=width,
        epochs=epochs,
        batch=batch,
        learning_rate=learning_rate,
        seed=seed,
    )
    console = Console(stderr=True)
    with progress_bar(console, "finding onsets") as update:

        def show(at: training.Progress) -> None:
            update(
                total=at.updates,
                completed=at.update,
                description=f"epoch {at.epoch}/{at.epochs} loss {at.loss:.3f}",
            )
            if at.metrics:
                m = at.metrics
                console.print(
                    f"epoch {at.epoch}: loss {m['loss']:.3f}, validation top-1 "
                    f"{100 * m['validation_top1']:.1f} % clean, "
                    f"{100 * m['validation_top1_noisy']:.1f} % at rated noise"
                )

        best = training.train(config, folder, show)
    console.print(f"best network: {best}")


@app.command()
def export(
    checkpoint: Annotated[Path, typer.Argument(help="best.pt of a training run.")],
    model: Annotated[Path, typer.Argument(help="The .onnx file to write.")],
    name: Annotated[str, typer.Option(help="Of the model; default: the file's name.")] = "",
) -> None:
    """Export a trained network as a streaming ONNX step, with everything needed to run it."""
    try:
        from tactile_rt.export.release import release
    except ModuleNotFoundError as error:
        raise needs("train", error) from None
    if model.is_dir():
        raise ConfigError(f"{model} is a folder: name a file to write")
    console = Console(stderr=True)
    with console.status("calibrating, exporting and checking parity"):
        card = release(checkpoint, model, name or model.stem)
    console.print(
        f"{model}: {model.stat().st_size / 1e6:.1f} MB, parity {card.figures['parity']:.1e}, "
        f"temperature {card.temperature:.2f}"
    )


@app.command(name="eval")
def evaluate(
    model: Annotated[Path, typer.Argument(help="An .onnx model.")],
    data: Annotated[Path, typer.Argument(help="A sweep set.")],
    accurate: Annotated[
        Path | None, typer.Option(help="The same sweeps at another profile, to compare with.")
    ] = None,
    svm: Annotated[bool, typer.Option(help="Fit an RBF SVM on the same windows too.")] = False,
    pictures: Annotated[
        Path | None, typer.Option(help="Folder for confusion.png, accuracy_over_time.png.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures here too.")] = None,
) -> None:
    """Measure a model on the test objects of a sweep set: accuracy, noise, fusion, calibration."""
    try:
        from tactile_rt.benchmarks.classification import evaluate_model
    except ModuleNotFoundError as error:
        raise needs("train", error) from None
    from tactile_rt.benchmarks.records import show, write

    check_output(json)
    console = Console(stderr=True)
    with console.status("evaluating"):
        records = evaluate_model(model, data, accurate, svm, pictures)
    show(records, Console())
    if json:
        write(records, json)
