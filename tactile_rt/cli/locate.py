"""`tactile-rt locate`: which whiskers touch, and where along them, from their base loads."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from tactile_rt.cli.app import app, check_output, needs
from tactile_rt.cli.options import Json, Seed, set_option
from tactile_rt.cli.progress import progress_bar, working
from tactile_rt.cli.tables import show_records, told_as_json
from tactile_rt.settings import take_sets

if TYPE_CHECKING:
    from tactile_rt.classifier.contact_point import WhiskerShapes
    from tactile_rt.sweep_set import SweepManifest

locate = typer.Typer(help="Find out where along each whisker it touches.", no_args_is_help=True)
app.add_typer(locate, name="locate")


@locate.command()
def train(
    data: Annotated[Path, typer.Argument(help="A sweep set made with --contacts.")],
    checkpoint: Annotated[Path, typer.Argument(help="The file to write.")],
    epochs: Annotated[int, typer.Option(min=1, help="Passes over the training split.")] = 12,
    seed: Seed = 0,
    sets: Annotated[
        list[str] | None, set_option("Of the training: hidden=64, batch=256, learning_rate=0.002")
    ] = None,
    threads: Annotated[int, typer.Option(min=1, max=1024, help="CPU threads.")] = 1,
    json: Json = None,
) -> None:
    """Train the contact network on the simulator's own contacts."""
    from tactile_rt.sweep_set import SweepManifest

    for file in (checkpoint, json):
        check_output(file)
    SweepManifest.read(data)
    try:
        import torch

        from tactile_rt.models import contact_regression as regression
        from tactile_rt.models.datasets import SweepSet
    except ModuleNotFoundError as error:
        raise needs("train", error) from None
    usual = {"epochs": epochs, "seed": seed}
    (config,) = take_sets("locate train", sets or (), regression.ContactConfig, usual=usual)
    torch.set_num_threads(threads)
    console = Console(stderr=True)
    known, held = (SweepSet.read(data, split) for split in ("train", "validation"))
    history: list[dict[str, float]] = []
    with progress_bar(console, "training", config.epochs) as update:

        def show(epoch: int, loss: float, error: float) -> None:
            history.append({"epoch": epoch, "loss": loss, "validation": error})
            update(advance=1)
            console.print(f"epoch {epoch}/{config.epochs}: loss {loss:.4f}, validation {error:.4f}")

        regression.train_contacts(
            known,
            held,
            _shapes(known.manifest),
            config,
            checkpoint,
            show,
        )
    told_as_json(history, json)
    console.print(f"best network: {checkpoint}")


@locate.command(name="eval")
def evaluate(
    checkpoint: Annotated[Path, typer.Argument(help="What `locate train` wrote.")],
    data: Annotated[Path, typer.Argument(help="A sweep set made with --contacts.")],
    json: Json = None,
) -> None:
    """Measure it on the test objects, beside the classical estimates from moment and force."""
    try:
        from tactile_rt.evidence.locating import contact_records
    except ModuleNotFoundError as error:
        raise needs("train", error) from None
    check_output(json)
    with working(Console(stderr=True), "evaluating"):
        records = contact_records(checkpoint, data)
    show_records(records, json)


def _shapes(manifest: "SweepManifest") -> "WhiskerShapes":
    """Of the whiskers that a set was made with, from mm to SI."""
    import numpy as np

    from tactile_rt.classifier.contact_point import WhiskerShapes
    from tactile_rt.sim_backend.arrays.files import load_animals

    animals = load_animals(str(manifest.recipe.get("array", "mouse")))
    whiskers = [whisker for animal in animals for whisker in animal.whiskers]
    return WhiskerShapes(
        length=np.array([w.length for w in whiskers]) * 1e-3,
        curvature=np.array([w.curvature for w in whiskers]) * 1e3,
        base_radius=np.array([w.base_radius for w in whiskers]) * 1e-3,
        tip_radius=np.array([w.tip_radius for w in whiskers]) * 1e-3,
        young_modulus=np.array([w.young_modulus for w in whiskers]),
    )
