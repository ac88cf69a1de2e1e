"""Recipes from files: a user's own in TOML, those that ship, and those that a set was made by."""

import math
import tomllib
from collections.abc import Sequence
from contextlib import suppress
from importlib import resources
from pathlib import Path
from typing import Any

from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.datasets.recipe_tables import Table, misnamed
from tactile_rt.sim_backend.datasets.recipes import (
    PARAMETERS,
    SHAPES,
    Between,
    Choice,
    Each,
    ObjectChoice,
    SweepChoice,
    SweepRecipe,
)
from tactile_rt.sim_backend.randomisation import Randomisation
from tactile_rt.sim_backend.sensor import SensorModel
from tactile_rt.sim_backend.sweep import usual_distance
from tactile_rt.stream import ConfigError

__all__ = [
    "DEFAULT_RECIPE",
    "read_recipe",
    "recipe_from_dict",
    "recipe_of_set",
    "shipped_recipes",
]

DEFAULT_RECIPE = "default24"


def shipped_recipes() -> tuple[str, ...]:
    """Names of the recipes that ship with the package."""
    folder = resources.files(__package__) / "recipes"
    return tuple(sorted(p.name[:-5] for p in folder.iterdir() if p.name.endswith(".toml")))


def read_recipe(name: str) -> SweepRecipe:
    """The recipe of this name that ships with the package, or the one in a TOML file.

    Folders and files in it are found from the working directory, as they are on a command line.

    Raises:
        ConfigError: no such recipe, or something in it is wrong.
    """
    if Path(name).suffix == ".toml":
        path = Path(name)
        try:
            text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"cannot read recipe {path}: {error.strerror}") from None
        except UnicodeDecodeError:
            raise ConfigError(f"{path} is not a recipe: not UTF-8 text") from None
    elif name in shipped_recipes():
        shipped = resources.files(__package__) / "recipes" / f"{name}.toml"
        text = shipped.read_text(encoding="utf-8")
    else:
        raise ConfigError(
            misnamed("recipe", name, shipped_recipes()) + ", and files that end in .toml"
        )
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name} is not TOML: {error}") from None
    return recipe_from_dict(raw, name)


def recipe_of_set(recipe: dict[str, Any], categories: Sequence[str]) -> SweepRecipe:
    """The recipe that a set's manifest or a model's card holds.

    One of version 1, which knew fewer settings, comes to the same objects, split and ranges; its
    sweeps were drawn otherwise.

    Args:
        recipe: as stored.
        categories: class names of the set.

    Raises:
        ConfigError: it is not one that this release knows.
    """
    if isinstance(recipe.get("objects"), int):
        old = read_recipe("mouse12").to_dict()
        counts: dict[str, Any] = {
            "categories": tuple(categories),
            "per_category": recipe["objects"],
            **{name: recipe[name] for name in ("validation", "test") if name in recipe},
        }
        recipe = {
            **old,
            **{name: recipe[name] for name in ("profile", "seed") if name in recipe},
            "objects": {**old["objects"], **counts},
            "sweeps": {**old["sweeps"], "draws": recipe.get("sweeps", 8)},
        }
    return recipe_from_dict(recipe, "the set's recipe")


def recipe_from_dict(raw: dict[str, Any], where: str = "recipe") -> SweepRecipe:
    """Read what a recipe file holds.

    Args:
        raw: the file's tables.
        where: the file, for complaints.

    Raises:
        ConfigError: a key is unknown or of the wrong kind, or a value out of range: one line
            that says which, where.
    """
    top = Table(where, raw)
    objects, sweeps = top.table("objects"), top.table("sweeps")
    source, array = objects.text("from", SHAPES), top.text("array", SweepRecipe.array)
    array = _absolute(array) if Path(array).suffix else array
    usual = {name: getattr(SweepChoice, name) for name in PARAMETERS}
    if "distance_mm" not in sweeps:
        with suppress(ConfigError):  # of an array that is not there: told when it is needed
            usual["distance_mm"] = usual_distance(load_animals(array))
    all_of_it = source != SHAPES  # a folder's own counts; the published split is 8 : 1 : 1
    recipe: dict[str, Any] = {
        "name": top.text("name", SweepRecipe.name),
        "array": array,
        "profile": top.text("profile", SweepRecipe.profile),
        "seed": top.whole("seed", SweepRecipe.seed),
        "period_ms": top.number("period_ms", SweepRecipe.period_ms),
        "lead_ms": top.number("lead_ms", SweepRecipe.lead_ms),
        "length_ms": top.number("length_ms", SweepRecipe.length_ms),
        "contacts": top.flag("contacts"),
        "objects": ObjectChoice(
            source=_absolute(source) if source != SHAPES else source,
            categories=objects.names("categories"),
            withheld=objects.names("withheld"),
            per_category=objects.whole("per_category", 0 if all_of_it else 60),
            validation=objects.number("validation", 0.1 if all_of_it else 4),
            test=objects.number("test", 0.1 if all_of_it else 12),
            per_withheld=objects.whole("per_withheld", 0),
        ),
        "sweeps": SweepChoice(
            **{n: _choice(sweeps, n, usual[n]) for n in PARAMETERS},
            draws=sweeps.whole("draws", 1),
            held_out_draws=sweeps.whole("held_out_draws", 0),
        ),
        "sensor": top.table("sensor").filled(SensorModel),
        "randomisation": top.table("randomisation").filled(Randomisation),
    }
    for table in (objects, sweeps, top):
        table.refuse_others()
    try:
        return SweepRecipe(**recipe)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def _absolute(path: str) -> str:
    """Whoever makes a part of the set may do so from another folder."""
    return str(Path(path).expanduser().absolute())


def _choice(table: Table, name: str, default: Choice) -> Choice:
    raw = table.take(name)
    if raw is None:
        return default
    if isinstance(raw, dict):
        inner = Table(table.where, raw, f"{table.prefix}{name}.")
        between, each = inner.numbers("between"), inner.numbers("each")
        inner.refuse_others()
        if len(between or ()) == 2 and each is None:
            assert between is not None
            return Between(*between)
        if each and between is None:
            return Each(each)
    elif not isinstance(raw, bool) and isinstance(raw, int | float) and math.isfinite(raw):
        return float(raw)
    raise table.wrong(
        name, raw, "a number, { between = [low, high] } or { each = [a number, ...] }"
    )
