"""`tactile-rt objects get`, `check`: what is swept past the whiskers, from elsewhere."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from tactile_rt.cli.app import app, needing
from tactile_rt.cli.options import Json
from tactile_rt.cli.progress import progress_bar
from tactile_rt.cli.tables import show_table, told_as_json
from tactile_rt.core.errors import ConfigError

objects = typer.Typer(help="Objects that others made.", no_args_is_help=True)
app.add_typer(objects, name="objects")


@objects.callback()
def _objects() -> None:
    """Objects that others made: get those of a list, and see how well they can be used."""


@objects.command()
def get(
    wanted: Annotated[str, typer.Argument(metavar="LIST", help="real, or a .csv file.")],
    folder: Annotated[Path, typer.Argument(help="Where they are put: FOLDER/CATEGORY/NAME.ply.")],
    clones: Annotated[
        Path | None,
        typer.Option(help="A folder of clones of the repositories, instead of GitHub."),
    ] = None,
    json: Json = None,
) -> None:
    """Get the objects of a list into a folder, every file checked by its hash.

    Called again it goes on with what is missing. Exit code 1 if anything is.
    """
    from tactile_rt.sim_backend.objects.object_lists import get_objects, read_list

    listed = read_list(wanted)
    console = Console(stderr=True)
    with needing("sim"), progress_bar(console, "getting", len(listed), counted=True) as update:
        missing = get_objects(listed, folder, clones, lambda name: update(advance=1))
    for name, why in missing.items():
        console.print(f"[red]{escape(name)}[/]: {escape(why)}", soft_wrap=True, highlight=False)
    licences = sorted({thing.files[0].licence for thing in listed})
    kinds = len({thing.files[0].category for thing in listed})
    told = {
        "folder": folder, "objects": len(listed), "kinds": kinds, "missing": missing,
        "licences": licences,
    }  # fmt: skip
    if told_as_json(told, json):
        raise typer.Exit(1 if missing else 0)
    typer.echo(
        f"{len(listed) - len(missing)} of {len(listed)} objects of {kinds} kinds are in {folder}; "
        f"licences: {', '.join(licences)}, see objects.csv"
    )
    raise typer.Exit(1 if missing else 0)


@objects.command()
def check(
    folder: Annotated[Path, typer.Argument(help="CATEGORY/OBJECT.stl, or ShapeNetCore's layout.")],
    json: Json = None,
) -> None:
    """Load every object of a folder once: how many can be used, how near, and why others cannot.

    Exit code 1 if some cannot.
    """
    if not folder.is_dir():
        raise ConfigError(f"no folder {folder}")
    with needing("sim"):
        from tactile_rt.sim_backend.objects.mesh_detail import SIZE_MM
        from tactile_rt.sim_backend.objects.object_sets import open_objects
    opened = open_objects(folder)
    console = Console(stderr=True)
    with progress_bar(console, "loading", total=len(opened.names), counted=True) as update:
        report = opened.check(lambda name: update(advance=1))
    found = []
    for kind in dict.fromkeys(opened.categories.values()):
        names = [name for name in opened.names if opened.categories[name] == kind]
        errors = [report.surface_error[n] for n in names if n in report.surface_error]
        worst = SIZE_MM * max(errors) if errors else None
        found.append(
            {"kind": kind, "objects": len(names), "usable": len(errors), "worst_mm": worst}
        )
    headings = {
        "kind": "kind", "objects": "objects", "usable": "usable", "worst_mm": "worst, mm of 40",
    }  # fmt: skip
    show_table(found, headings, json)
    for why in report.skipped.values():
        console.print(escape(why), soft_wrap=True, highlight=False)
    raise typer.Exit(1 if report.skipped else 0)
