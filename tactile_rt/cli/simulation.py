"""`tactile-rt sweep`: make a sweep set in simulation."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tactile_rt.cli import app, needs, starting


@app.command()
def sweep(
    folder: Annotated[Path, typer.Argument(help="Where the set goes; an unfinished one goes on.")],
    objects: Annotated[int, typer.Option(min=3, help="Objects of every category.")] = 60,
    validation: Annotated[int, typer.Option(min=1, help="Of these, held out to tune on.")] = 4,
    test: Annotated[int, typer.Option(min=1, help="Of these, held out to test on.")] = 10,
    sweeps: Annotated[int, typer.Option(min=1, help="Sweeps of every object.")] = 8,
    profile: Annotated[
        str, typer.Option(help="How finely: realtime, dataset (finer), accurate.")
    ] = "realtime",
    split: Annotated[str, typer.Option(help="Only these splits, comma-separated.")] = (
        "train,validation,test"
    ),
    seed: Annotated[int, typer.Option(help="Of the drawn sweep parameters.")] = 0,
    processes: Annotated[int, typer.Option(min=0, help="0: one per core.")] = 0,
) -> None:
    """Sweep simulated objects past the whisker array and store what it feels."""
    try:
        with starting():
            from tactile_rt.sim_backend.dataset import SweepRecipe, make_sweeps
    except ModuleNotFoundError as error:
        raise needs("sim", error) from None
    recipe = SweepRecipe(
        objects=objects,
        validation=validation,
        test=test,
        sweeps=sweeps,
        profile=profile,
        seed=seed,
    )
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    splits = tuple(dict.fromkeys(s.strip() for s in split.split(",")))
    total = recipe.count(splits)
    console = Console(stderr=True)
    # Gone when it is done or fails, and nothing in a log file: an error is one line alone.
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as progress:
        task = progress.add_task("objects", total=total)
        for name in make_sweeps(recipe, folder, processes or None, splits):
            progress.update(task, advance=1, description=name)
    console.print(f"{folder}: {total * sweeps} sweeps at profile {profile}")
