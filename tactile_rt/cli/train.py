"""`tactile-rt train`, `grid`, `recipes`, `probe`, `export`: from a sweep set to a model file."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.console import Console

from tactile_rt.cli.app import app, check_folder, check_output, needing
from tactile_rt.cli.options import Accelerator, Json, Seed, argument, option, set_option
from tactile_rt.cli.tables import progress_bar, show_table, told_as_json
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.locks import alone_in
from tactile_rt.core.settings import take_sets

if TYPE_CHECKING:
    from tactile_rt.models.training.config import Progress

WAITING = 0.1  # share of an epoch spent waiting for data: less is not worth reporting


@app.command(epilog="tactile-rt train sweeps run --epochs 5 --set width=0.25")
def train(
    data: Annotated[Path, argument("A sweep set.")],
    folder: Annotated[Path, argument("Run folder; an interrupted run continues.")],
    also: Annotated[
        list[Path] | None, option("Another set to learn from; may be repeated.")
    ] = None,
    begin: Annotated[
        Path | None, option("Checkpoint to start from; classes may differ.", "--from")
    ] = None,
    recipe: Annotated[
        str, option("Name (see `recipes`) or TOML file; options override it.")
    ] = "default",
    encoder: Annotated[
        str | None, option("zhuang-CELL, resnet18, s4, ..., or a TOML file of a graph.")
    ] = None,
    epochs: Annotated[int | None, option("Passes over the training split.", min=1)] = None,
    seed: Annotated[int | None, option("Seed of weights, windows and noise.")] = None,
    sets: Annotated[
        list[str] | None,
        set_option("Any key of the recipe: width=0.25, attender=none, decoder=linear, batch=8"),
    ] = None,
    accelerator: Accelerator = "auto",
    threads: Annotated[int, option("Number of CPU threads.", min=1, max=1024)] = 1,
    json: Json = None,
) -> None:
    """Train an encoder-attender-decoder network on a sweep set."""
    from tactile_rt.models.checkpoints import describe_checkpoint, read_network_options
    from tactile_rt.models.training.recipes import read_recipe

    asked = {"encoder": encoder, "epochs": epochs, "seed": seed}
    if encoder is not None and encoder.endswith(".toml"):
        asked |= {"encoder": "graph", "graph": _read_text(Path(encoder))}
    given: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    if also:
        given["also"] = tuple(map(str, also))
    if begin is not None:
        given = {**read_network_options(begin), **given, "begin": str(begin)}
    config = read_recipe(recipe, str(data), sets or (), **given)
    first = os.environ.get("RANK", "0") == "0"  # the first of torchrun's processes, or the only one
    # Refuse what cannot be trained before torch is imported, which takes seconds.
    config.check_sets()
    if config.begin:
        describe_checkpoint(Path(config.begin))
    check_folder(folder)
    if first:
        with alone_in(folder):  # only a check: the training locks it again
            pass
    with needing("train"):
        import torch

        from tactile_rt.models.training.loop import train as train_network
    torch.set_num_threads(threads)
    # Under torchrun every process would print the same.
    console = Console(stderr=True, quiet=not first)
    history: list[dict[str, Any]] = []
    with progress_bar("finding onsets", console=console) as update:

        def show(at: "Progress") -> None:
            update(
                total=at.updates,
                completed=at.update,
                description=f"epoch {at.epoch}/{at.epochs} loss {at.loss:.3f}",
            )
            if at.metrics:
                history.append({"epoch": at.epoch, "update": at.update, **at.metrics})
                console.print(_describe_epoch(at))

        with needing("train"):
            best = train_network(config, folder, show, device=accelerator)
    if not console.quiet:
        told_as_json({"best": best, "epochs": history}, json)
    console.print(f"best network: {best}")


def _describe_epoch(at: "Progress") -> str:
    m = at.metrics
    if "validation_top1" in m:
        found = _describe_top1(m)
    else:
        found = f"validation loss {m['validation_loss']:.3f}"
    waited = f" ({100 * m['waiting']:.0f} % of the time waiting for data)"
    return f"epoch {at.epoch}: loss {m['loss']:.3f}, {found}" + waited * (m["waiting"] >= WAITING)


def _describe_top1(m: dict[str, float]) -> str:
    noisy = f"{100 * m['validation_top1_noisy']:.1f} % at rated noise"
    return f"validation top-1 {100 * m['validation_top1']:.1f} % clean, {noisy}"


def _read_text(path: Path) -> str:
    try:
        return path.read_text()
    except UnicodeDecodeError:
        raise ConfigError(f"{path} is not a text file") from None


@app.command(epilog="tactile-rt recipes")
def recipes(
    plot: Annotated[Path | None, option("Picture of every augmentation, .png.")] = None,
    json: Json = None,
) -> None:
    """List the shipped training recipes and the values tried."""
    from tactile_rt.models.training.recipes import load_recipe, shipped_recipes

    if plot:
        _draw_augmentations(plot)

    found: list[dict[str, Any]] = []
    for name in shipped_recipes():
        recipe = load_recipe(name)
        tried = (f"{key} {', '.join(map(str, v))}" for key, v in recipe.search.items())
        found.append({"recipe": name, "about": recipe.about, "tried": "; ".join(tried)})
    show_table(found, {"recipe": "recipe", "about": "what", "tried": "tried"}, json)


def _draw_augmentations(path: Path) -> None:
    """Draw a whisked object of the shipped stimuli, as each augmentation changes it."""
    from tactile_rt.alignment.stimuli_input import read_stimuli
    from tactile_rt.classifier.model_file import SHIPPED, read_model

    check_output(path)
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: the picture must be a .png")
    with needing("train"):
        from tactile_rt.models.evaluation.pictures import draw_augmentations
        from tactile_rt.models.training.config import AUGMENTATIONS
    array, touch = read_model(SHIPPED)[0].array, read_stimuli().samples[0]
    draw_augmentations(array, touch, AUGMENTATIONS, path)


@app.command(epilog="tactile-rt probe run/best.pt probed --data sweeps")
def probe(
    checkpoint: Annotated[Path, argument("Checkpoint of a run, best.pt.")],
    folder: Annotated[Path, argument("Folder of the probed network.")],
    data: Annotated[Path | None, option("Sweep set. Default: the one it was trained on.")] = None,
    epochs: Annotated[int, option("Passes over the features.", min=1)] = 100,
    seed: Seed = 0,
    sets: Annotated[
        list[str] | None,
        set_option("An option of the fit: readout=mean, standardise=false, learning_rate=0.01"),
    ] = None,
    json: Json = None,
) -> None:
    """Fit a linear classifier on a frozen network's features."""
    from tactile_rt.models.checkpoints import describe_checkpoint, probed_on
    from tactile_rt.models.training.config import ProbeConfig

    usual = {"data": str(data or ""), "epochs": epochs, "seed": seed}
    (config,) = take_sets("probe", sets or (), ProbeConfig, usual=usual)
    probed_on(checkpoint, describe_checkpoint(checkpoint), folder, config.data)
    with needing("train"):
        from tactile_rt.models.training.probing import probe as fit
    shown: list[Progress] = []
    with progress_bar("probing") as update:

        def show(at: "Progress") -> None:
            shown.append(at)
            update(total=at.updates, completed=at.update)

        best = fit(checkpoint, folder, config, show)
    m = shown[-1].metrics
    told_as_json({"best": best, **m}, json)
    typer.echo(f"{best}: {_describe_top1(m)}", err=True)


@app.command(epilog="tactile-rt export run/best.pt model.onnx")
def export(
    checkpoint: Annotated[Path, argument("Checkpoint of a run, best.pt.")],
    model: Annotated[Path, argument("Model file to write, .onnx.")],
    name: Annotated[str, option("Name of the model. Default: the file's name.")] = "",
    precision: Annotated[
        str, option("fp32, fp16 or bf16 (smaller files), int8 (also faster).")
    ] = "fp32",
    kind: Annotated[
        str, option("step: one step of a stream; window: a whole episode at once.")
    ] = "step",
    data: Annotated[
        list[Path] | None, option("Sweep set it was trained on, if moved; repeat for each set.")
    ] = None,
    license: Annotated[str, option("Licence to store in the file, e.g. Apache-2.0.")] = "",
    json: Json = None,
) -> None:
    """Export a trained network as a self-contained ONNX model."""
    from tactile_rt.models.checkpoints import describe_checkpoint, trained_on

    check_output(model)
    trained_on(checkpoint, describe_checkpoint(checkpoint), data or ())
    with needing("train"):
        from tactile_rt.export.graph_forms import PRECISIONS
    if precision not in PRECISIONS:
        raise ConfigError(f"--precision is {precision!r}, not one of {', '.join(PRECISIONS)}")
    if kind not in ("step", "window"):
        raise ConfigError(f"--kind is {kind!r}, not one of step, window")
    with needing("train"):
        from tactile_rt.export.release import release
    form: Literal["step", "window"] = "window" if kind == "window" else "step"
    with progress_bar("calibrating, exporting and checking parity"):
        card = release(checkpoint, model, name or model.stem, precision, form, data or (), license)
    size, found = model.stat().st_size / 1e6, card.figures
    results = {"model": model, "megabytes": size, "temperature": card.temperature, **found}
    told_as_json(results, json)
    parity = f"parity {found['parity']:.1e}, temperature {card.temperature:.2f}"
    typer.echo(f"{model}: {size:.1f} MB, {parity}", err=True)
    if precision != "fp32":
        line = "{quantisation_agreement:.1f} % of {quantisation_sweeps} validation decisions as in "
        line += "fp32, top-1 {quantisation_top1_drop:.1f} points lower"
        typer.echo(line.format(**found), err=True)


@app.command(epilog="tactile-rt grid wide24 grid --processes 2")
def grid(
    plan: Annotated[
        str, argument("TOML file, or a shipped plan: paper, paper-claims, wide24, wide24-full.")
    ],
    folder: Annotated[Path, argument("Output folder; finished tasks are kept.")],
    processes: Annotated[int, option("Networks to train in parallel.", min=1)] = 2,
    accelerator: Accelerator = "cpu",
    json: Json = None,
) -> None:
    """Train and compare many networks, each tuned alike.

    A plan combines encoders, attenders and objectives. An interrupted grid continues. FOLDER gets
    results.json, results.md and task_performance.png.
    """
    from tactile_rt.models.grid.outcomes import Outcome, waiting_tasks
    from tactile_rt.models.grid.plan import read_grid
    from tactile_rt.sets.manifest import SweepManifest

    check_folder(folder)
    planned = read_grid(plan)
    if waiting_tasks(planned, folder):
        SweepManifest.read(Path(planned.data))
    with needing("train"):
        from tactile_rt.models.grid.picture import draw_grid
        from tactile_rt.models.grid.pool import run_grid
        from tactile_rt.models.grid.results import GridResults, gather, write_results

    def conclude() -> GridResults:
        results = gather(planned, folder)
        write_results(results, folder)
        draw_grid(results, folder / "task_performance.png")
        return results

    def show(found: Outcome, done: int, total: int) -> None:
        update(completed=done, total=total)
        right = found.right()
        result = found.failed or f"top-1 {100 * right.mean():.1f} %"
        took = f", {found.seconds:.0f} CPU s" if found.seconds else ""
        typer.echo(f"{done}/{total} {found.name}, seed {found.seed}: {result}{took}", err=True)
        if done % per_seed == 0:
            conclude()

    per_seed = -(-len(planned.tasks()) // planned.seeds)
    done = len(planned.tasks()) - len(waiting_tasks(planned, folder))
    with progress_bar("tasks", len(planned.tasks()), done, counted=True) as update:
        run_grid(planned, folder, processes, show, accelerator)
    told_as_json(conclude(), json)
    typer.echo(f"{folder}: its tables and pictures", err=True)
