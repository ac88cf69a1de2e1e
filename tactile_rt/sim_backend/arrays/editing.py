"""Numbers of an array's file changed in its text, so that comments and layout stay.

A line is changed by its look, which TOML allows to mislead. So what has been written is read again,
and refused unless it is the file with just these numbers changed.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from tactile_rt.errors import ConfigError
from tactile_rt.settings import find_lines, parse_toml

__all__ = ["Edit", "edited", "rounded"]

LINE = re.compile(r"(\s*[\w-]+\s*=\s*)(?:\{[^}]*\}|[^#{]*?)(\s*)(#.*)?")
MEASURED = re.compile(r"(;\s*|#\s*)measured: .*")


class Edit(NamedTuple):
    """A value that is to stand in an array's file.

    Attributes:
        path: The place of the value in the file: tables by name, one of several by its number
            from 0, and the key, e.g. ``("sensor", "channel", 0, "drift")``.
        value: The number, or numbers by name.
        why: What was measured, for a comment.
    """

    path: tuple[str | int, ...]
    value: float | dict[str, float]
    why: str


def rounded(value: float) -> float:
    """A value with as many digits as are worth writing: four."""
    return float(f"{value:.4g}")


def edited(path: Path, text: str, edits: Sequence[Edit]) -> str:
    """The text of an array's file with values changed, or added to their tables.

    Args:
        path: of the file, for messages.
        text: what is in it.
        edits: the values, each with a comment that says what was measured.

    Raises:
        ConfigError: a value stands in the file in a way that this cannot change.
    """
    ending = "\r\n" if "\r\n" in text else "\n"
    text = text.replace("\r\n", "\n")
    wanted = parse_toml(text, str(path)).plain()
    for edit in edits:
        at: Any = wanted
        for part in edit.path[:-1]:
            at = at[part] if isinstance(part, int) else at.setdefault(part, {})
        at[edit.path[-1]] = edit.value
        text = _with(text, edit)
        try:
            same = parse_toml(text, str(path)).plain() == wanted
        except ConfigError:
            same = False
        if not same:
            raise ConfigError(
                f"{path}: cannot change {edit.path[-1]} as it is written there; put "
                f"{edit.path[-1]} = {_toml(edit.value)} into its table by hand"
            )
    return text.replace("\n", ending)


def _with(text: str, edit: Edit) -> str:
    lines, numbers = text.split("\n"), find_lines(text)
    table, said = edit.path[:-1], f"measured: {edit.why}"
    new = f"{edit.path[-1]} = {_toml(edit.value)} # {said}"
    if edit.path in numbers:
        at = numbers[edit.path] - 1
        if found := LINE.fullmatch(lines[at]):
            key, gap, comment = found.groups()
            kept = MEASURED.sub("", comment or "").rstrip()
            comment = f"{kept}; {said}" if kept else f"# {said}"
            lines[at] = f"{key}{_toml(edit.value)}{gap or ' '}{comment}"
    elif table in numbers:
        keys = [n for p, n in numbers.items() if p[:-1] == table and lines[n - 1].strip()[0] != "["]
        lines.insert(max([numbers[table], *keys]), new)
    else:
        lines += [f"[{'.'.join(map(str, table))}]", new, ""]
    return "\n".join(lines)


def _toml(value: float | dict[str, float]) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{name} = {_toml(v)}" for name, v in value.items()) + " }"
    return f"{value:g}"
