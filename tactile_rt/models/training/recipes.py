"""Recipes: training configurations in TOML, the paper's and one's own.

about = "SimCLR of a recurrent encoder (Chung et al. 2025, Tables A4 and A5)"

[train]                     # the fields of `TrainingConfig`; what is left out has its default
encoder = "zhuang-intersection-ln"
objective = "simclr"

[search]                    # what else the paper tried; a note, unless somebody runs it
learning_rate = [0.1, 0.01, 0.001, 0.0001]
"""

import difflib
import tomllib
from collections.abc import Iterator
from dataclasses import fields
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.stream import ConfigError

__all__ = ["Recipe", "load_recipe", "read_recipe", "shipped_recipes"]

KEYS = tuple(f.name for f in fields(TrainingConfig) if f.name != "data")


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A recipe file.

    Attributes:
        about: A line that says what the recipe is.
        train: Fields of `TrainingConfig`, by name.
        search: All values that are to be tried, for some of the fields.
    """

    about: str = ""
    train: dict[str, Any] = {}
    search: dict[str, list[Any]] = {}

    def config(self, data: str, **overrides: Any) -> TrainingConfig:
        """The configuration, with what is asked for otherwise.

        Raises:
            ConfigError: a value that cannot be.
        """
        try:
            return msgspec.convert({**self.train, **overrides, "data": data}, TrainingConfig)
        except msgspec.ValidationError as error:
            raise ConfigError(_told(error)) from None

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
        try:
            text = Path(name).read_text()
        except OSError as error:
            raise ConfigError(f"{name}: {error.strerror}") from None
        except UnicodeDecodeError:
            raise ConfigError(f"{name} is not TOML: it is no text") from None
    elif name in (known := shipped_recipes()):
        text = (resources.files("tactile_rt.models") / "recipes" / f"{name}.toml").read_text()
    else:
        raise ConfigError(f"no recipe {name!r}; {_nearest(name, known)}")
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{name} is not TOML: {error}") from None
    _check_keys(name, "", raw, Recipe.__struct_fields__)
    try:
        recipe = msgspec.convert(raw, Recipe)
        for table, keys in (("train", recipe.train), ("search", recipe.search)):
            _check_keys(name, f"{table}.", keys, KEYS)
        for values in recipe.searched():  # the first is not the only one that must be possible
            recipe.config("", **values)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{name}: {_told(error)}") from None
    except ConfigError as error:
        raise ConfigError(
            str(error) if str(error).startswith(name) else f"{name}: {error}"
        ) from None
    return recipe


def read_recipe(name: str, data: str, **overrides: Any) -> TrainingConfig:
    """The training configuration of a recipe.

    Args:
        name: of one that ships, or of a TOML file.
        data: the sweep set's folder.
        overrides: fields that are to be otherwise.

    Raises:
        ConfigError: there is none, it is damaged, or a value cannot be.
    """
    return load_recipe(name).config(data, **overrides)


def _check_keys(name: str, table: str, given: Any, known: tuple[str, ...]) -> None:
    for key in given:
        if key not in known:
            raise ConfigError(f"{name} has no key {table}{key}; {_nearest(key, known)}")


def _nearest(name: str, known: tuple[str, ...]) -> str:
    near = difflib.get_close_matches(name, known, 1)
    return f"did you mean {near[0]}?" if near else f"there are {', '.join(known)}"


def _told(error: msgspec.ValidationError) -> str:
    # "Expected `int`, got `str` - at `$.batch`" -> the key first, as everywhere else
    what, _, where = str(error).partition(" - at `$.")
    return f"{where.rstrip('`')}: {what.lower()}" if where else what
