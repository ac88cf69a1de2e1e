"""Recipes from files: a user's own in TOML, shipped ones, and those stored with a set."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace
from difflib import get_close_matches
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.core import settings
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import STEP_MS, Timing
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.datasets.recipes import GENERATED, SweepRecipe
from tactile_rt.sim_backend.sweep import usual_distance
from tactile_rt.sim_backend.transducer import device_spec
from tactile_rt.sim_backend.world import SAMPLE_MS

DEFAULT_RECIPE = "wide24"


def shipped_recipes() -> tuple[str, ...]:
    """Return the names of the recipes that ship with the package."""
    folder = resources.files(__package__) / "recipes"
    return tuple(sorted(p.name[:-5] for p in folder.iterdir() if p.name.endswith(".toml")))


def read_recipe(name: str, folder: Path | None = None, sets: Sequence[str] = ()) -> SweepRecipe:
    """Read a shipped recipe by its name, or the recipe in a TOML file.

    Args:
        folder: the base of relative paths in a TOML file; if None, the working directory, as on a
            command line.
        sets: settings ``key=value`` to override; ``objects.test=3`` sets a key of a table.
    """
    if Path(name).suffix == ".toml":
        return _parse(settings.set_keys(settings.read_toml(Path(name)), sets, SweepRecipe), folder)
    if name not in shipped_recipes():
        known = settings.no_such("recipe", name, shipped_recipes())
        raise ConfigError(f"{known} (or give a file that ends in .toml)")
    shipped = resources.files(__package__) / "recipes" / f"{name}.toml"
    nodes = settings.parse_toml(shipped.read_text(encoding="utf-8"), name)
    return _parse(settings.set_keys(nodes, sets, SweepRecipe))


def recipe_of_set(recipe: dict[str, Any], sets: Sequence[str] = ()) -> SweepRecipe:
    """Make a recipe from the dictionary stored in a set's manifest or a model's card.

    Raises:
        ConfigError: this release does not understand the recipe.
    """
    nodes = settings.make_node(recipe, "the set's recipe", 0, Path())
    return _parse(settings.set_keys(nodes, sets, SweepRecipe))


def _parse(nodes: settings.SettingNode, folder: Path | None = None) -> SweepRecipe:
    _add_usual_values(nodes, folder)
    recipe: SweepRecipe = settings.convert(nodes, SweepRecipe)
    objects = recipe.objects
    if Path(recipe.array).suffix:
        recipe = replace(recipe, array=_make_absolute(recipe.array, folder))
    if objects.generated:
        return recipe
    source = _make_absolute(objects.source, folder)
    slip = get_close_matches(objects.source, GENERATED, 1, 0.8)
    if slip and not Path(source).exists():
        why = f"no such folder {objects.source!r}; did you mean {slip[0]}?"
        raise settings.refusal(nodes, ["objects", "from"], why)
    labels = objects.labels and _make_absolute(objects.labels, folder)
    return replace(recipe, objects=msgspec.structs.replace(objects, source=source, labels=labels))


def _add_usual_values(nodes: settings.SettingNode, folder: Path | None) -> None:
    """Fill in a recipe's missing distance, period and lengths from its array."""
    written = nodes.plain()
    array, period_ms = written.get("array", SweepRecipe.array), SweepRecipe.period_ms
    sweeps = nodes.value.setdefault("sweeps", _make_node(nodes, {})).value
    with suppress(ConfigError, TypeError):  # a missing array is reported when it is needed
        animals = load_animals(_make_absolute(array, folder) if Path(array).suffix else array)
        period_ms = max(period_ms, 1e3 / device_spec(animals).rate_hz)
        if isinstance(sweeps, dict):
            sweeps.setdefault("distance_mm", _make_node(nodes, usual_distance(animals)))
    period_ms = written.get("period_ms", period_ms)
    usual = {"period_ms": period_ms}
    if isinstance(period_ms, int | float) and period_ms >= SAMPLE_MS:
        usual["lead_ms"], usual["length_ms"] = _find_usual_lengths(period_ms)
    for name, value in usual.items():
        nodes.value.setdefault(name, _make_node(nodes, value))


def _make_node(nodes: settings.SettingNode, value: Any) -> settings.SettingNode:
    return settings.make_node(value, nodes.file, nodes.line, nodes.folder)


def _find_usual_lengths(period_ms: float) -> tuple[float, float]:
    """Return the usual lead and length (ms) of a sweep, enough for baseline and window."""
    # A baseline takes a fixed number of samples; a window a fixed number of steps, and spare.
    lead_ms = max(SweepRecipe.lead_ms, SweepRecipe.lead_ms / SweepRecipe.period_ms * period_ms)
    after_ms = SweepRecipe.length_ms - SweepRecipe.lead_ms
    step_ms = Timing.of(round(period_ms * 1e6)).substeps * period_ms
    return lead_ms, lead_ms + after_ms * max(1.0, step_ms / STEP_MS)


def _make_absolute(path: str, folder: Path | None) -> str:
    """Return the absolute path, since parts of a set may be made from other folders."""
    try:
        return str(((folder or Path()) / Path(path).expanduser()).absolute())
    except RuntimeError:  # no such user, or one without a home
        raise ConfigError(f"{path} names no user of this computer") from None
