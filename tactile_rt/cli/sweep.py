"""`tactile-rt sweep`: make a sweep set in simulation; `objects`: get and check objects."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactile_rt.cli.app import add_group, app, check_output, needing
from tactile_rt.cli.options import Json, argument, option, set_option
from tactile_rt.cli.tables import progress_bar, show_table, told_as_json
from tactile_rt.core.errors import ConfigError

if TYPE_CHECKING:
    from tactile_rt.sim_backend.datasets.recipes import SweepRecipe

objects = add_group("objects", "Download objects to simulate, and check meshes of your own.")


@app.command(epilog="tactile-rt sweep sweeps --set objects.per_category=10")
def sweep(
    folder: Annotated[Path, argument("Folder of the set; an unfinished one continues.")],
    recipe: Annotated[
        str | None,
        option(
            "Recipe: wide24, default24, mouse12, paper-lowvar-highfi, "
            "paper-highvar-lowfi, or a TOML file. Default: the folder's own, else wide24."
        ),
    ] = None,
    profile: Annotated[str | None, option("Accuracy: realtime, dataset (finer), accurate.")] = None,
    seed: Annotated[int | None, option("Seed of the sweep parameters.")] = None,
    sets: Annotated[
        list[str] | None,
        set_option("Any key of the recipe: objects.per_category=10, sweeps.draws=2, contacts=true"),
    ] = None,
    split: Annotated[
        str | None, option("Only these splits, comma-separated: test,withheld.")
    ] = None,
    processes: Annotated[int, option("Processes to run; 0: one per core.", min=0)] = 0,
    ray: Annotated[
        str | None, option("Ray cluster: HOST:PORT, local, or auto (a running one, else local).")
    ] = None,
    card: Annotated[
        bool, option("Also describe the set in a README.md with pictures.", "--card")
    ] = False,
    verify: Annotated[bool, option("Only check the set's checksums.", "--verify")] = False,
    json: Json = None,
) -> None:
    """Simulate sweeps of objects past an array as a training set."""
    if verify:
        from tactile_rt.sim_backend.datasets.inventory import check_sums

        files = check_sums(folder)
        told_as_json({"set": folder, "files": files}, json)
        typer.echo(f"{folder}: {files} files are as they were written", err=True)
        return
    with needing("sim"):
        from tactile_rt.sim_backend.arrays.files import load_animals
        from tactile_rt.sim_backend.datasets import dataset
        from tactile_rt.sim_backend.datasets.inventory import tally
        from tactile_rt.sim_backend.sweep_simulation import ringing
        from tactile_rt.sim_backend.world import PROFILES
    asked = {"profile": profile, "seed": seed}
    given = [f"{key}={value}" for key, value in asked.items() if value is not None]
    chosen = _choose_recipe(folder, recipe, [*given, *(sets or ())])
    splits = tuple(dict.fromkeys(s.strip() for s in split.split(","))) if split else ()
    names = dataset.describe_set(chosen).names(splits)
    if line := ringing(load_animals(chosen.array), PROFILES[chosen.profile]):
        typer.echo(line, err=True)
    finished = len(dataset.finished_objects(folder, names))
    engine, address = "processes" if ray is None else "ray", None if ray == "auto" else ray
    made = dataset.make_sweeps(chosen, folder, processes or None, splits, engine, address)
    with progress_bar("objects", len(names), finished, counted=True) as update:
        for k, name in enumerate(made):  # finished objects come first
            update(advance=int(k >= finished), description=name)
    found = tally(folder, names, len(chosen.sweeps))
    results = {"set": folder, "sweeps": found.sweeps, "profile": chosen.profile}
    told_as_json(results | {"shortcomings": found.shortcomings}, json)
    note = f"; {found.shortcomings}" if found.shortcomings else ""
    typer.echo(f"{folder}: {found.sweeps} sweeps at profile {chosen.profile}{note}", err=True)
    if card:
        _write_card(folder)
        typer.echo(f"{folder / 'README.md'} describes them", err=True)


def _write_card(folder: Path) -> None:
    with needing("train"):
        import matplotlib  # noqa: F401
        import sklearn  # noqa: F401
    from tactile_rt.models.evaluation.svm import fit
    from tactile_rt.sim_backend.datasets.card import write_card

    write_card(folder, fit)


def _choose_recipe(folder: Path, name: str | None, sets: list[str]) -> "SweepRecipe":
    """Return an existing set's recipe, or the named recipe, with the values of ``sets``."""
    from tactile_rt.sets.manifest import SweepManifest
    from tactile_rt.sim_backend.datasets.recipe_files import (
        DEFAULT_RECIPE,
        read_recipe,
        recipe_of_set,
    )

    if name is None and (folder / "manifest.json").exists():
        manifest = SweepManifest.read(folder)
        if manifest.recorded:
            raise ConfigError(f"{folder} is made of recordings, by `tactile-rt label`")
        return recipe_of_set(manifest.recipe, sets)
    return read_recipe(name or DEFAULT_RECIPE, sets=sets)


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
    results = {
        "folder": folder, "objects": len(listed), "kinds": kinds, "missing": missing,
        "licences": licences,
    }  # fmt: skip
    if not told_as_json(results, json):
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
        raise ConfigError(f"{plot}: the picture must be a .png")
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
