"""Settings that are text only: ``--set key=value``, a URL's options, the rows of a CSV file."""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings.structs import (
    convert,
    format_value,
    hint,
    is_list,
    is_text,
    nearest,
    types_of,
)
from tactile_rt.core.settings.tree import (
    SettingNode,
    format_path,
    make_node,
    plain_value,
    read_text,
)

LONGEST_URL = 4096  # characters
NAMES = ("name", "kind")  # keys whose value identifies an item of a list


# --set


def set_key(nodes: SettingNode, text: str, kind: Any) -> SettingNode:
    """Set one key of a settings tree in place, and return the tree.

    Args:
        text: ``a.b=value``; ``source.NAME.url=...`` or ``source.0.url=...`` selects an item of a
            list. The value is TOML, or text that need not be quoted.

    Raises:
        ConfigError: the text has another form, or no such item exists.
    """
    key, equals, written = text.partition("=")
    origin = f"--set {text}"
    steps = key.split(".")
    if not equals or not all(steps):
        raise ConfigError(f"{origin}: a setting must be KEY=VALUE")
    at: Any = nodes
    path: list[str | int] = []
    for i, step in enumerate(steps):
        last = i == len(steps) - 1
        if isinstance(at.value, list):
            place = _find_item(at, step, origin, format_path(path))
            path.append(place)
            if last:
                raise ConfigError(f"{origin}: {format_path(path)} is a table: name one of its keys")
            at = at.value[place]
            continue
        if not isinstance(at.value, dict):
            raise ConfigError(f"{origin}: {format_path(path)} has a value, not keys")
        path.append(step)
        if last:
            value = written if is_text(kind, path) else plain_value(written)
            at.value[step] = make_node(value, origin, 0, Path.cwd())
        else:
            if step not in at.value:
                listed = is_list(kind, path)
                at.value[step] = make_node([] if listed else {}, origin, 0, Path.cwd())
            at = at.value[step]
    return nodes


def set_keys(
    nodes: SettingNode, sets: Sequence[str], kind: Any, known: Sequence[str] | None = None
) -> SettingNode:
    """Set several keys of a settings tree in place, as `set_key`, and return the tree.

    Args:
        sets: ``a.b=value`` each; the last value of a repeated key is used.
        known: the keys that may be set; None for all.
    """
    known = list(types_of(kind)) if known is None else known
    for text in sets:
        key, equals, _ = text.partition("=")
        key = key.partition(".")[0]
        if not equals:
            raise ConfigError(f"--set {text}: a setting must be KEY=VALUE; {nearest('', known)}")
        if key not in known:
            raise ConfigError(f"--set {text}: no key {key!r}; {hint(key, known)}")
        set_key(nodes, text, kind)
    return nodes


def take_sets(
    what: str, sets: Sequence[str], *kinds: type[Any], usual: Mapping[str, Any] | None = None
) -> tuple[Any, ...]:
    """Make dataclasses from ``--set`` texts; each key goes to the class that has it.

    Args:
        what: name of the command, for messages.
        usual: default values, which take precedence over those of the dataclasses.
    """
    known = {name: kind for kind in kinds for name in types_of(kind)}
    made = []
    for kind in kinds:
        values = {k: v for k, v in (usual or {}).items() if k in types_of(kind)}
        nodes = make_node(values, what, 0, Path.cwd())
        mine = [s for s in sets if known.get(re.split("[=.]", s)[0], kinds[0]) is kind]
        made.append(convert(set_keys(nodes, mine, kind, list(known)), kind))
    return tuple(made)


def _find_item(node: SettingNode, step: str, origin: str, where: str) -> int:
    """Find the index of an item in a list, by its name or index."""
    tables = [n.value if isinstance(n.value, dict) else {} for n in node.value]
    names = [[t[key].value for key in NAMES if key in t] for t in tables]
    for i, known in enumerate(names):
        if step in known:
            return i
    if step.isdecimal() and len(step) < 6 and int(step) < len(node.value):
        return int(step)
    texts = dict.fromkeys(n for known in names for n in known if isinstance(n, str))
    raise ConfigError(f"{origin}: no {where} {step!r}; {nearest(step, texts)}")


# URLs


def split_url(url: str) -> tuple[str, str, dict[str, str]]:
    """Split a URL, ``scheme:target?option=value&option=value``, into three parts.

    Returns:
        Scheme (empty if absent), target, and options as text.

    Raises:
        ConfigError: the text has unprintable characters, is too long, is no URL, or gives an option
            twice.
    """
    if not url.isprintable():
        raise ConfigError(f"{url!r:.80} holds what cannot be printed")
    if len(url) > LONGEST_URL:
        raise ConfigError(f"{url!r:.80} is too long: {len(url)} characters, {LONGEST_URL} at most")
    try:
        parts = urlsplit(url, allow_fragments=False)  # a file's name may hold a #
    except ValueError as error:
        raise ConfigError(f"{url!r}: {error}") from None
    # A + stays a +, as in a file's name, unlike in web forms, where it is a space.
    pairs = parse_qsl(parts.query.replace("+", "%2B"), keep_blank_values=True)
    fields: dict[str, str] = {}
    for name, value in pairs:
        if name in fields:
            raise ConfigError(f"option {name!r} is given twice")
        fields[name] = value
    return parts.scheme, unquote(parts.netloc + parts.path), fields


def take_options(what: str, fields: Mapping[str, str], *kinds: type[Any]) -> tuple[Any, ...]:
    """Make dataclasses from a URL's options; each key goes to the classes that have it.

    Args:
        what: the URL without options, for messages.
        fields: the options as text; numbers may be hexadecimal, as CAN identifiers are.

    Raises:
        ConfigError: an option is unknown, or has the wrong type.
    """
    known = list(dict.fromkeys(name for kind in kinds for name in types_of(kind)))
    for name in fields:
        if name not in known:
            raise ConfigError(f"{what} has no option {name!r}; {hint(name, known)}")
    made = []
    for kind in kinds:
        mine = {k: _convert_hexadecimal(v) for k, v in fields.items() if k in types_of(kind)}
        made.append(convert(make_node(mine, what, 0, Path()), kind, lax=True))
    return tuple(made)


def _convert_hexadecimal(value: str) -> str:
    """Convert a hexadecimal number of at most 64 bits to decimal text; keep other text."""
    return str(int(value, 16)) if re.fullmatch(r"0[xX][0-9a-fA-F]{1,16}", value) else value


# CSV


@dataclass(frozen=True)
class CsvTable:
    """Columns and rows of a CSV file. `where` is the file and line of the header."""

    where: str
    columns: tuple[str, ...]
    rows: tuple[SettingNode, ...]


def read_csv(path: Path) -> CsvTable:
    """Read a CSV file whose first line names the columns. Lines that begin with # are skipped.

    Raises:
        ConfigError: the file cannot be read, is empty, or has a column twice or a row of another
            length; names file and line.
    """
    lines = [
        (number, _split_cells(line, f"{path}:{number}"))
        for number, line in enumerate(read_text(path).splitlines(), start=1)
        if line.strip(" ,") and not line.startswith("#")  # spreadsheets keep empty rows as commas
    ]
    if not lines:
        raise ConfigError(f"{path}: is empty; its first line names the columns")
    (number, columns), *below = lines
    where = f"{path}:{number}"
    if len(columns) == 1 and ";" in columns[0]:
        raise ConfigError(f"{where}: columns are separated by semicolons; use commas")
    if len(set(columns)) < len(columns):
        twice = next(c for i, c in enumerate(columns) if c in columns[:i])
        raise ConfigError(f"{where}: column {twice!r} appears twice; remove one")
    rows = []
    for number, cells in below:
        if len(cells) != len(columns):
            raise ConfigError(f"{path}:{number}: {len(cells)} values for {len(columns)} columns")
        row = dict(zip(columns, cells, strict=True))
        rows.append(make_node(row, str(path), number, path.parent))
    return CsvTable(where, tuple(columns), tuple(rows))


def _split_cells(line: str, where: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:  # a cell is too long
        raise ConfigError(f"{where}: {error}") from None


def check_columns(table: CsvTable, known: Sequence[str], needed: Sequence[str] = ()) -> None:
    """Refuse a table that has an unknown column or lacks a needed one."""
    for column in table.columns:
        if column not in known:
            raise ConfigError(
                f"{table.where}: no column {format_value(column)}; {hint(column, known)}"
            )
    for column in needed:
        if column not in table.columns:
            raise ConfigError(f"{table.where}: no column {column}; add it")
