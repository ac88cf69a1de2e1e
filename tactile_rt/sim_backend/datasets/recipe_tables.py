"""Reading the tables of a TOML file with complaints that name file, key and nearest valid name."""

import difflib
import math
from collections.abc import Sequence
from dataclasses import fields
from typing import Any, TypeVar

from tactile_rt.stream import ConfigError

__all__ = ["Table", "misnamed"]

Settings = TypeVar("Settings")


def misnamed(what: str, name: str, known: Sequence[str]) -> str:
    """One phrase: there is no such thing, what may have been meant, and what there is."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return f"no {what} {name!r}{hint}: there are {', '.join(known)}"


class Table:
    """One table of a file, taken apart key by key; what is left over at the end is unknown.

    Args:
        where: the file.
        raw: the table.
        prefix: of its keys in complaints, such as "sweeps.".
    """

    def __init__(self, where: str, raw: dict[str, Any], prefix: str = "") -> None:
        self.where, self.prefix = where, prefix
        self._raw, self._asked = raw, dict[str, None]()

    def __contains__(self, key: str) -> bool:
        return key in self._raw

    def take(self, key: str) -> Any:
        """The value of a key, or None."""
        self._asked[key] = None
        return self._raw.get(key)

    def table(self, key: str) -> "Table":
        """The table under a key; an empty one if there is none."""
        return Table(self.where, self.free(key), f"{self.prefix}{key}.")

    def free(self, key: str) -> dict[str, Any]:
        """The table under a key as it is."""
        value = self.take(key)
        if not isinstance(value, dict | None):
            raise self.wrong(key, value, "a table")
        return value or {}

    def text(self, key: str, default: str) -> str:
        """A string."""
        value = self.take(key)
        if not isinstance(value, str | None) or value == "":
            raise self.wrong(key, value, "a text in quotes")
        return default if value is None else value

    def whole(self, key: str, default: int) -> int:
        """A whole number."""
        value = self.take(key)
        if value is None:
            return default
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.wrong(key, value, "a whole number")
        return value

    def flag(self, key: str) -> bool:
        """Whether a key is true; false if it is not there."""
        value = self.take(key)
        if not isinstance(value, bool | None):
            raise self.wrong(key, value, "true or false")
        return bool(value)

    def number(self, key: str, default: float) -> float:
        """A finite number."""
        value = self.take(key)
        if value is None:
            return default
        if not _is_number(value):
            raise self.wrong(key, value, "a number")
        return float(value)

    def numbers(self, key: str) -> tuple[float, ...] | None:
        """A list of finite numbers, or None."""
        value = self.take(key)
        if value is None:
            return None
        if not isinstance(value, list | tuple) or not all(_is_number(v) for v in value):
            raise self.wrong(key, value, "a list of numbers")
        return tuple(float(v) for v in value)

    def names(self, key: str) -> tuple[str, ...]:
        """A list of different strings; empty if there is none."""
        value = self.take(key) or []
        if not isinstance(value, list | tuple) or not all(isinstance(v, str) for v in value):
            raise self.wrong(key, value, "a list of texts in quotes")
        if len(set(value)) != len(value):
            raise self.wrong(key, value, "a list without repetition")
        return tuple(value)

    def filled(self, kind: type[Settings]) -> Settings:
        """A dataclass of numbers from the keys of its fields; the others stay at their default."""
        values = {
            f.name: self.number(f.name, getattr(kind, f.name))
            for f in fields(kind)  # type: ignore[arg-type]
        }
        self.refuse_others()
        try:
            return kind(**values)
        except ConfigError as error:
            raise ConfigError(f"{self.where}: {self.prefix}{error}") from None

    def wrong(self, key: str, value: object, wanted: str) -> ConfigError:
        """The complaint about a value of the wrong kind."""
        return ConfigError(f"{self.where}: {self.prefix}{key} must be {wanted}, not {value!r}")

    def refuse_others(self) -> None:
        """Complain of the first key that was never asked for.

        Raises:
            ConfigError: there is one.
        """
        known = tuple(self._asked)
        for key in self._raw:
            if key not in self._asked:
                inside = f" in [{self.prefix[:-1]}]" if self.prefix else ""
                raise ConfigError(f"{self.where}: {misnamed('key', key, known)}{inside}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
