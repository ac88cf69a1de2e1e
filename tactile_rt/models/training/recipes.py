"""Recipes: training configurations in TOML, the paper's and one's own.

about = "SimCLR of a recurrent encoder (Chung et al. 2025, Tables A4 and A5)"

[train]                     # the fields of `TrainingConfig`; what is left out has its default
encoder = "zhuang-intersection-ln"
objective = "simclr"

[search]                    # what else the paper tried; a note, unless somebody runs it
learning_rate = [0.1, 0.01, 0.001, 0.0001]
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from dataclasses import fields as fields_of
from importlib import resources
from itertools import product
from pathlib import Path
from shlex import quote
from typing import Any

import msgspec

from tactile_rt.errors import ConfigError
from tactile_rt.models.checkpoint_files import NETWORK
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.sensor_faults import SensorFaults
from tactile_rt.settings import (
    SettingNode,
    convert,
    hint,
    make_node,
    no_such,
    parse_toml,
    read_toml,
    set_keys,
)

__all__ = [
    "Recipe",
    "as_options",
    "load_recipe",
    "read_recipe",
    "shipped_recipes",
    "training_command",
]

KEYS = tuple(f.name for f in fields_of(TrainingConfig) if f.name != "data")


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A recipe file.

    Attributes:
        about: Description of the recipe, in a line.
        train: Fields of `TrainingConfig`, by their names.
        search: Lists of all values that are to be tried, by the names of their fields.
    """

    about: str = ""
    train: dict[str, Any] = {}
    search: dict[str, list[Any]] = {}

    def config(self, data: str, sets: Sequence[str] = (), **overrides: Any) -> TrainingConfig:
        """The configuration, with what is asked for otherwise.

        Args:
            data: the sweep set's folder.
            sets: ``key=value`` each, as on a command line.
            overrides: fields of `TrainingConfig`.

        Raises:
            ConfigError: a key that there is not, or a value that cannot be.
        """
        nodes = make_node({**self.train, **overrides, "data": data}, "training", 0, Path())
        set_keys(nodes, sets, TrainingConfig, KEYS)
        made: TrainingConfig = convert(nodes, TrainingConfig)
        return made

    def searched(self) -> Iterator[dict[str, Any]]:
        """Every combination of the values to be tried."""
        for values in product(*self.search.values()):
            yield dict(zip(self.search, values, strict=True))


def shipped_recipes() -> tuple[str, ...]:
    """Names of the recipes that ship."""
    files = resources.files("tactile_rt.models").joinpath("recipes").iterdir()
    return tuple(sorted(f.name[: -len(".toml")] for f in files if f.name.endswith(".toml")))


def load_recipe(name: str) -> Recipe:
    """Read a recipe.

    Args:
        name: of one that ships, or of a TOML file.

    Raises:
        ConfigError: there is none, or it is damaged; the message names the key.
    """
    if name.endswith(".toml"):
        nodes = read_toml(Path(name))
    elif name in (known := shipped_recipes()):
        shipped = resources.files("tactile_rt.models") / "recipes" / f"{name}.toml"
        nodes = parse_toml(shipped.read_text(), name)
    else:
        raise ConfigError(no_such("recipe", name, known))
    recipe: Recipe = convert(nodes, Recipe)
    empty = replace(nodes, value={})
    train, search = (nodes.value.get(table, empty) for table in ("train", "search"))
    for what, table in (("train", train), ("search", search)):
        for key, node in table.value.items():
            if key not in KEYS:
                raise ConfigError(f"{node.where}: {what} has no key {key!r}; {hint(key, KEYS)}")
    _check(nodes, train)
    # The first of the values to be tried is not the only one that must be possible.
    for values in product(*(node.value for node in search.value.values())) if search.value else ():
        fields = {**train.value, **dict(zip(search.value, values, strict=True))}
        _check(nodes, replace(search, value=fields))
    return recipe


def _check(nodes: SettingNode, fields: SettingNode) -> None:
    """Refuse fields of a training that cannot be, with where they stand."""
    data = make_node("", nodes.file, 0, nodes.folder)
    tree = replace(nodes, value={"train": replace(fields, value={**fields.value, "data": data})})
    config: TrainingConfig = convert(tree, TrainingConfig, ["train"])
    if config.encoder == "graph":  # whose frame is that of an array, which is not known here
        return
    try:
        config.network(2)
    except ConfigError as error:
        raise ConfigError(f"{fields.where}: {error}") from None


def read_recipe(name: str, data: str, sets: Sequence[str] = (), **overrides: Any) -> TrainingConfig:
    """The training configuration of a recipe.

    Args:
        name: of one that ships, or of a TOML file.
        data: the sweep set's folder.
        sets: ``key=value`` each, which are to be otherwise.
        overrides: fields that are to be otherwise.

    Raises:
        ConfigError: there is none, it is damaged, or a value cannot be.
    """
    return load_recipe(name).config(data, sets, **overrides)


def training_command(trained: Mapping[str, Any], folder: Path) -> str:
    """The command that trains so again: with the recipe that says most of it, and what else.

    Args:
        trained: a run's configuration, as its `config.json` and its checkpoints have it.
        folder: of the run.
    """
    known = {key: trained[key] for key in (*KEYS, "data") if key in trained}
    asked = TrainingConfig(**{**known, "also": tuple(known.get("also", ()))})
    given: dict[str, Any] = {"also": asked.also, "begin": asked.begin, "seed": asked.seed}
    if asked.begin:  # whose network it is
        given |= {key: getattr(asked, key) for key in NETWORK}

    def changed(recipe: str) -> dict[str, Any]:
        usual = read_recipe(recipe, asked.data, **given)
        return {k: v for k in KEYS if (v := getattr(asked, k)) != getattr(usual, k)}

    recipe = min(("default", *shipped_recipes()), key=lambda name: len(changed(name)))
    options = [f"--recipe {recipe}", *as_options(changed(recipe))]
    options += [f"--also {quote(other)}" for other in asked.also]
    options += [f"--from {quote(asked.begin)}"] if asked.begin else []
    where = f"{quote(asked.data)} {quote(str(folder))}"
    return f"tactile-rt train {where} {' '.join(options)} --seed {asked.seed}"


def as_options(values: Mapping[str, Any]) -> list[str]:
    """Settings as they are written on a command line, ``--set key=value`` each."""
    options = []
    for key, value in values.items():
        if isinstance(value, SensorFaults):
            faults = asdict(value).items()
            options += as_options({f"{key}.{name}": number for name, number in faults})
        else:
            text = str(value).lower() if isinstance(value, bool) else str(value)
            options.append(f"--set {quote(f'{key}={text}')}")
    return options
