"""`tactile-rt objects get`, `check`: what is swept past the whiskers, from elsewhere."""

from pathlib import Path
from typing import Annotated

import typer

from tactile_rt.cli.app import add_group, check_output, needing
from tactile_rt.cli.options import Json, argument, option
from tactile_rt.cli.tables import progress_bar, show_table, told_as_json
from tactile_rt.core.errors import ConfigError

objects = add_group("objects", "Download objects to simulate, and check meshes of your own.")


@objects.command(epilog="tactile-rt objects get real objects")
def get(
    wanted: Annotated[str, argument("The list: real, real2, or a CSV file.", metavar="LIST")],
    folder: Annotated[Path, argument("Folder to write: FOLDER/CATEGORY/NAME.ply.")],
    clones: Annotated[
        Path | None,
        option("Folder of cloned repositories and unpacked packages to use instead of GitHub."),
    ] = None,
    json: Json = None,
) -> None:
    """Download the objects of a list and check every file's hash.

    A second call fetches what is missing. Exit code 1 if anything still is.
    """
    from tactile_rt.sim_backend.objects.object_lists import get_objects, read_list

    listed = read_list(wanted)
    with needing("sim"), progress_bar("getting", len(listed), counted=True) as update:
        missing = get_objects(listed, folder, clones, lambda name: update(advance=1))
    for name, why in missing.items():
        typer.echo(f"{typer.style(name, fg='red')}: {why}", err=True)
    licences = sorted({thing.files[0].licence for thing in listed})
    kinds = len({thing.files[0].category for thing in listed})
    told = {
        "folder": folder, "objects": len(listed), "kinds": kinds, "missing": missing,
        "licences": licences,
    }  # fmt: skip
    if not told_as_json(told, json):
        typer.echo(
            f"{len(listed) - len(missing)} of {len(listed)} objects of {kinds} kinds are in "
            f"{folder}; licences: {', '.join(licences)}, see objects.csv"
        )
    raise typer.Exit(1 if missing else 0)


@objects.command(epilog="tactile-rt objects check objects")
def check(
    folder: Annotated[Path, argument("Folder: CATEGORY/OBJECT.stl, or ShapeNetCore.")],
    plot: Annotated[
        Path | None, option("Picture (.png) to write of all objects, to see them.")
    ] = None,
    json: Json = None,
) -> None:
    """Load every object of a folder and report which can be used.

    Also reports how near the simulated surfaces are. Exit code 1 if some cannot be used.
    """
    if not folder.is_dir():
        raise ConfigError(f"no folder {folder}")
    check_output(plot)
    if plot and plot.suffix.lower() != ".png":
        raise ConfigError(f"{plot}: the picture is a .png")
    with needing("sim"):
        from tactile_rt.sim_backend.objects.mesh_detail import SIZE_MM
        from tactile_rt.sim_backend.objects.object_sets import open_objects
    opened = open_objects(folder)
    with progress_bar("loading", total=len(opened.names), counted=True) as update:
        usable = opened.check(lambda name: update(advance=1))
    if plot:
        with needing("view"):
            from tactile_rt.sim_backend.views.contact_sheet import write_contact_sheet
        things = {n: opened.load(n).pieces if n in usable else None for n in opened.names}
        write_contact_sheet(plot, things)
    found = []
    for kind in dict.fromkeys(opened.categories.values()):
        names = [name for name in opened.names if opened.categories[name] == kind]
        mm = {n: SIZE_MM * usable[n].surface_error for n in names if n in usable}
        worst = max(mm, key=mm.__getitem__, default="")
        found.append(
            {"kind": kind, "objects": len(names), "usable": len(mm), "worst_mm": mm.get(worst),
             "worst": worst}
        )  # fmt: skip
    headings = {
        "kind": "kind", "objects": "objects", "usable": "usable", "worst_mm": "worst, mm of 40",
        "worst": "which",
    }  # fmt: skip
    show_table(found, headings, json)
    if plates := [thing for thing in usable.values() if thing.made_by == "plates"]:
        of = len(opened.names)
        typer.echo(f"{len(plates)} of {of} are not closed, taken as plates", err=True)
    for why in opened.skipped.values():
        typer.echo(why, err=True)
    raise typer.Exit(1 if opened.skipped else 0)
