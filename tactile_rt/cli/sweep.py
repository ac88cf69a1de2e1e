"""`tactile-rt sweep`: make a sweep set in simulation."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from tactile_rt.cli.app import app, check_output, needs, starting
from tactile_rt.cli.progress import progress_bar
from tactile_rt.cli.tables import Json, told_as_json
from tactile_rt.stream import ConfigError

if TYPE_CHECKING:
    from tactile_rt.sim_backend.datasets.recipes import SweepRecipe


@app.command()
def sweep(
    folder: Annotated[Path, typer.Argument(help="Where the set goes; an unfinished one goes on.")],
    recipe: Annotated[
        str | None,
        typer.Option(
            help="What to make: wide24, default24, mouse12, paper-lowvar-highfi, "
            "paper-highvar-lowfi, or a TOML file. Without it the folder's own, or else wide24. The "
            "paper's come to 16 and 312 sweeps of an object, as its code does; its table's totals "
            "are other numbers."
        ),
    ] = None,
    objects: Annotated[int | None, typer.Option(help="Objects of every category.")] = None,
    validation: Annotated[float | None, typer.Option(help="Of these, held out to tune on.")] = None,
    test: Annotated[float | None, typer.Option(help="Of these, held out to test on.")] = None,
    sweeps: Annotated[int | None, typer.Option(help="Sweeps drawn of every object.")] = None,
    profile: Annotated[
        str | None, typer.Option(help="How finely: realtime, dataset (finer), accurate.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the drawn sweep parameters.")] = None,
    contacts: Annotated[
        bool, typer.Option("--contacts", help="Store where along each whisker it touches, too.")
    ] = False,
    split: Annotated[
        str | None, typer.Option(help="Only these splits, comma-separated: test,withheld.")
    ] = None,
    processes: Annotated[int, typer.Option(min=0, help="At a time; 0: one per core.")] = 0,
    engine: Annotated[str, typer.Option(help="processes, or ray for a cluster.")] = "processes",
    address: Annotated[
        str | None, typer.Option(help="Of the Ray cluster; without it this machine's, or a new one")
    ] = None,
    card: Annotated[
        bool,
        typer.Option("--card", help="When all is made, describe the set: README.md with pictures."),
    ] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Make nothing: check the set's checksums.")
    ] = False,
    json: Json = None,
) -> None:
    """Sweep simulated objects past the whisker array and store what it feels."""
    check_output(json)
    console = Console(stderr=True, soft_wrap=True)
    if verify:
        from tactile_rt.sim_backend.datasets.inventory import check_sums

        files = check_sums(folder)
        told_as_json({"set": folder, "files": files}, json)
        console.print(f"{folder}: {files} files are as they were written")
        return
    try:
        with starting():
            from tactile_rt.sim_backend.arrays.files import load_animals
            from tactile_rt.sim_backend.datasets.dataset import (
                describe_set,
                finished_objects,
                make_sweeps,
            )
            from tactile_rt.sim_backend.datasets.inventory import tally
            from tactile_rt.sim_backend.remarks import ringing
            from tactile_rt.sim_backend.world import PROFILES
    except ModuleNotFoundError as error:
        raise needs("sim", error) from None
    chosen = _override(
        _recipe(folder, recipe),
        {"per_category": objects, "validation": validation, "test": test},
        {"draws": sweeps},
        {"profile": profile, "seed": seed, "contacts": contacts or None},
    )
    splits = tuple(dict.fromkeys(s.strip() for s in split.split(","))) if split else ()
    if address is not None and engine != "ray":
        raise ConfigError("--address is that of a Ray cluster: give --engine ray, too")
    names = describe_set(chosen).names(splits)
    if line := ringing(load_animals(chosen.array), PROFILES[chosen.profile]):
        console.print(line)
    there = len(finished_objects(folder, names))
    made = make_sweeps(chosen, folder, processes or None, splits, engine, address)
    with progress_bar(console, "objects", len(names), there, counted=True) as update:
        for k, name in enumerate(made):  # those that were there first
            update(advance=int(k >= there), description=name)
    found = tally(folder, names, len(chosen.sweeps))
    told_as_json(
        {
            "set": folder, "sweeps": found.sweeps, "profile": chosen.profile,
            "shortcomings": found.shortcomings,
        },
        json,
    )  # fmt: skip
    but = f"; {found.shortcomings}" if found.shortcomings else ""
    console.print(f"{folder}: {found.sweeps} sweeps at profile {chosen.profile}{but}")
    if card:
        _write_card(folder)
        console.print(f"{folder / 'README.md'} describes them")


def _write_card(folder: Path) -> None:
    try:
        import matplotlib  # noqa: F401
        import sklearn  # noqa: F401
    except ModuleNotFoundError as error:
        raise needs("train", error) from None
    from tactile_rt.models.svm import fit
    from tactile_rt.sim_backend.datasets.card import write_card

    write_card(folder, fit)


def _recipe(folder: Path, name: str | None) -> "SweepRecipe":
    from tactile_rt.sim_backend.datasets.recipe_files import (
        DEFAULT_RECIPE,
        read_recipe,
        recipe_of_set,
    )
    from tactile_rt.sweep_set import SweepManifest

    if name is None and (folder / "manifest.json").exists():
        manifest = SweepManifest.read(folder)
        if manifest.recorded:
            raise ConfigError(f"{folder} is made of recordings, by `tactile-rt label`")
        return recipe_of_set(manifest.recipe, manifest.categories)
    return read_recipe(name or DEFAULT_RECIPE)


def _override(
    recipe: "SweepRecipe",
    objects: dict[str, object],
    sweeps: dict[str, object],
    top: dict[str, object],
) -> "SweepRecipe":
    """The recipe with the options that were given."""

    def given(options: dict[str, object]) -> dict[str, Any]:
        return {name: value for name, value in options.items() if value is not None}

    return replace(
        recipe,
        objects=replace(recipe.objects, **given(objects)),
        sweeps=replace(recipe.sweeps, **given(sweeps)),
        **given(top),
    )
