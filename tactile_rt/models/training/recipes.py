"""Recipes: training configurations in TOML, from this package or the user.

about = "SimCLR of a recurrent encoder (Chung et al. 2025, Tables A4 and A5)"

[train]                     # fields of `TrainingConfig`; missing fields have their defaults
encoder = "zhuang-intersection-ln"
objective = "simclr"

[search]                    # other values that the paper tried; a note, not used by a training
learning_rate = [0.1, 0.01, 0.001, 0.0001]
"""

from collections.abc import Sequence
from dataclasses import fields as fields_of
from dataclasses import replace
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.core import settings
from tactile_rt.core.errors import ConfigError
from tactile_rt.models.training.config import TrainingConfig

KEYS = tuple(f.name for f in fields_of(TrainingConfig) if f.name != "data")


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The content of a recipe file: values of a training's options, and values to search.

    Attributes:
        train: Values of fields of `TrainingConfig`, by name.
        search: Lists of values to try, by the field's name.
    """

    about: str = ""
    train: dict[str, Any] = {}
    search: dict[str, list[Any]] = {}

    def config(self, data: str, sets: Sequence[str] = (), **overrides: Any) -> TrainingConfig:
        """Return the recipe's configuration for the sweep set `data`, with some values replaced.

        Args:
            sets: ``key=value`` texts, as on a command line; they replace `overrides` too.
            overrides: values of fields of `TrainingConfig`.

        Raises:
            ConfigError: an unknown key, or an invalid value.
        """
        nodes = settings.make_node({**self.train, **overrides, "data": data}, "training", 0, Path())
        settings.set_keys(nodes, sets, TrainingConfig, KEYS)
        made: TrainingConfig = settings.convert(nodes, TrainingConfig)
        return made


def shipped_recipes() -> tuple[str, ...]:
    """Return the names of the recipes in this package."""
    files = resources.files("tactile_rt.models").joinpath("recipes").iterdir()
    return tuple(sorted(f.name[: -len(".toml")] for f in files if f.name.endswith(".toml")))


def load_recipe(name: str) -> Recipe:
    """Read and check a recipe, by a path ending in ".toml" or a shipped name.

    Raises:
        ConfigError: the recipe is missing or invalid; the message names the key.
    """
    if name.endswith(".toml"):
        nodes = settings.read_toml(Path(name))
    elif name in (known := shipped_recipes()):
        shipped = resources.files("tactile_rt.models") / "recipes" / f"{name}.toml"
        nodes = settings.parse_toml(shipped.read_text(), name)
    else:
        raise ConfigError(settings.no_such("recipe", name, known))
    recipe: Recipe = settings.convert(nodes, Recipe)
    empty = replace(nodes, value={})
    train, search = (nodes.value.get(table, empty) for table in ("train", "search"))
    for what, table in (("train", train), ("search", search)):
        for key, node in table.value.items():
            if key not in KEYS:
                raise ConfigError(
                    f"{node.where}: {what} has no key {key!r}; {settings.hint(key, KEYS)}"
                )
    _check_fields(nodes, train)
    # All combinations of values to try must be valid, not only the first.
    for values in product(*(node.value for node in search.value.values())) if search.value else ():
        fields = {**train.value, **dict(zip(search.value, values, strict=True))}
        _check_fields(nodes, replace(search, value=fields))
    return recipe


def _check_fields(nodes: settings.SettingNode, fields: settings.SettingNode) -> None:
    """Check the fields of a training; an error names the place in the file."""
    data = settings.make_node("", nodes.file, 0, nodes.folder)
    tree = replace(nodes, value={"train": replace(fields, value={**fields.value, "data": data})})
    config: TrainingConfig = settings.convert(tree, TrainingConfig, ["train"])
    if config.encoder == "graph":  # its frame is the array's, which is not known here
        return
    try:
        config.network(2)
    except ConfigError as error:
        raise ConfigError(f"{fields.where}: {error}") from None


def read_recipe(name: str, data: str, sets: Sequence[str] = (), **overrides: Any) -> TrainingConfig:
    """Read a recipe and return its configuration for the sweep set `data`.

    Args:
        sets: ``key=value`` texts that replace values.

    Raises:
        ConfigError: the recipe is missing, or a value is invalid.
    """
    return load_recipe(name).config(data, sets, **overrides)
