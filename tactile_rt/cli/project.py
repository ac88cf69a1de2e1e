"""`tactile-rt new` and `make`: make a model from the description of an array."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactile_rt.cli.app import app, needing
from tactile_rt.cli.options import Json, argument, option
from tactile_rt.cli.tables import progress_bar, show_table, told_as_json

if TYPE_CHECKING:
    from tactile_rt.project.making import MakeProgress

ABOUT = ("top-1", "top-1 at rated noise", "RBF SVM top-1", "points above the SVM")


@app.command(epilog="tactile-rt new my-robot --array mouse --classes mug,bottle")
def new(
    folder: Annotated[Path, argument("New folder of the project.")],
    array: Annotated[
        str, option("TOML file, or a name of `array list`. Default: an example.")
    ] = "",
    classes: Annotated[str, option("Object categories to distinguish, comma-separated.")] = "",
) -> None:
    """Begin a project: a model for your own array, by simulation."""
    with needing("sim"):
        from tactile_rt.project.folder import KINDS, new_project
    chosen = tuple(k.strip() for k in classes.split(",") if k.strip()) or KINDS
    new_project(folder, array, chosen)
    again = shlex.join(["tactile-rt", "make", str(folder)])
    typer.echo(f"{folder}: edit array.toml and sweeps.toml, then `{again}`")


@app.command(epilog="tactile-rt make my-robot --minutes 60")
def make(
    folder: Annotated[Path, argument("Folder of `tactile-rt new`.")],
    minutes: Annotated[
        float, option("Time for all steps; less time makes a smaller model.")
    ] = 60.0,
    preview: Annotated[
        bool,
        option("Only simulate a few sweeps of each kind; draw FOLDER/preview.png.", "--preview"),
    ] = False,
    json: Json = None,
) -> None:
    """Make a project's model: simulate, train, export, evaluate.

    Finished steps are not repeated; an interrupted step continues.
    """
    with needing("sim,train"):
        from tactile_rt.models.evaluation.records import as_dicts
        from tactile_rt.project.folder import Project
        from tactile_rt.project.making import make as make_project
        from tactile_rt.project.making import preview_sweeps
    project = Project(folder)
    if preview:
        with progress_bar("sweeping", timed=False):
            counts = preview_sweeps(project, picture := folder / "preview.png")
        headings = {
            "kind": "kind", "sweeps": "sweeps", "touch": "touch, %", "beyond": "beyond range, %",
            "change": "what to change",
        }  # fmt: skip
        rows = []
        for kind, count in counts.items():
            touch, beyond = count.shares
            row = (kind, count.sweeps, 100 * touch, 100 * beyond, count.shortcomings)
            rows.append(dict(zip(headings, row, strict=True)))
        show_table(rows, headings, json)
        typer.echo(f"{picture} shows an object of each kind where it first touches", err=True)
        return
    with progress_bar("reading", timed=False) as update:
        seen = ""

        def tell(stage: "MakeProgress") -> None:
            nonlocal seen
            left = f"about {max(stage.left_s, 0) / 60:.0f} min left of all"
            update(description=f"{stage.name}, {left}", total=stage.of, completed=stage.done)
            if stage.name != seen:
                seen = stage.name
                typer.echo(f"{stage.name} ({left})", err=True)

        records = make_project(project, minutes, tell)
    told_as_json(as_dicts(records), json)
    for record in records:
        if (what := record.name.removeprefix("models.")) in ABOUT:
            typer.echo(f"{what}: {record.value:.1f} {record.unit} ({record.anchor})", err=True)
    decides = shlex.join(["tactile-rt", "run", str(folder / "robot.toml")])
    report = project.report / "report.html"
    typer.echo(f"{report} tells the rest; `{decides}` decides", err=True)
