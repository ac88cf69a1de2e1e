"""`tactile-rt sweep`: make a sweep set in simulation."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tactile_rt.cli.app import app, needing
from tactile_rt.cli.options import Json, argument, option, set_option
from tactile_rt.cli.tables import progress_bar, told_as_json
from tactile_rt.core.errors import ConfigError

if TYPE_CHECKING:
    from tactile_rt.sim_backend.datasets.recipes import SweepRecipe


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
    chosen = _recipe(folder, recipe, [*given, *(sets or ())])
    splits = tuple(dict.fromkeys(s.strip() for s in split.split(","))) if split else ()
    names = dataset.describe_set(chosen).names(splits)
    if line := ringing(load_animals(chosen.array), PROFILES[chosen.profile]):
        typer.echo(line, err=True)
    there = len(dataset.finished_objects(folder, names))
    engine, address = "processes" if ray is None else "ray", None if ray == "auto" else ray
    made = dataset.make_sweeps(chosen, folder, processes or None, splits, engine, address)
    with progress_bar("objects", len(names), there, counted=True) as update:
        for k, name in enumerate(made):  # those that were there first
            update(advance=int(k >= there), description=name)
    found = tally(folder, names, len(chosen.sweeps))
    told = {"set": folder, "sweeps": found.sweeps, "profile": chosen.profile}
    told_as_json(told | {"shortcomings": found.shortcomings}, json)
    but = f"; {found.shortcomings}" if found.shortcomings else ""
    typer.echo(f"{folder}: {found.sweeps} sweeps at profile {chosen.profile}{but}", err=True)
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


def _recipe(folder: Path, name: str | None, sets: list[str]) -> "SweepRecipe":
    """The recipe of a set that is there or to be made, with what is set otherwise."""
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
