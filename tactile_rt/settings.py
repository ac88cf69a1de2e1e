"""Options out of a URL: strings into dataclasses, with a clear error for each mistake."""

import difflib
import re
from typing import Any, TypeVar

import msgspec

from tactile_rt.stream import ConfigError

__all__ = ["parse_options", "take_options"]

T = TypeVar("T")


def parse_options(what: str, fields: dict[str, str], kind: type[T]) -> T:
    """All fields as one dataclass.

    Args:
        what: whose options they are, for the message.
        fields: as written.
        kind: dataclass of the options.

    Raises:
        ConfigError: unknown or ill-typed option.
    """
    (made,) = take_options(what, fields, kind)
    return made  # type: ignore[no-any-return]


def take_options(what: str, fields: dict[str, str], *kinds: type[Any]) -> tuple[Any, ...]:
    """The fields shared out among dataclasses: each takes those that it knows.

    Raises:
        ConfigError: a field that none knows, or ill-typed.
    """
    known = [name for kind in kinds for name in kind.__dataclass_fields__]
    for name in fields:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"it takes {', '.join(known) or 'none'}"
            raise ConfigError(f"{what} has no option {name!r}; {hint}")
    made = []
    for kind in kinds:
        mine = {k: _plain(v) for k, v in fields.items() if k in kind.__dataclass_fields__}
        try:
            made.append(msgspec.convert(mine, kind, strict=False))
        except msgspec.ValidationError as error:
            raise ConfigError(f"{what}: {error}") from None
    return tuple(made)


def _plain(value: str) -> str:
    """Hexadecimal numbers, as CAN identifiers are written, in decimal."""
    return str(int(value, 16)) if re.fullmatch(r"0[xX][0-9a-fA-F]+", value) else value
