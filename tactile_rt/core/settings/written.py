"""Settings that are text alone: ``--set key=value``, a URL's options, the rows of a CSV file."""

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
    hint,
    is_list,
    is_text,
    nearest,
    shown,
    types_of,
)
from tactile_rt.core.settings.tree import SettingNode, make_node, named, plain_value, read_text

LONGEST_URL = 4096  # characters
NAMES = ("name", "kind")  # keys that an item of a list goes by


# --set


def set_key(nodes: SettingNode, text: str, kind: Any) -> SettingNode:
    """A tree in which one key is otherwise.

    Args:
        nodes: the tree; it is changed.
        text: ``a.b=value``, of which ``source.NAME.url=...`` or ``source.0.url=...`` names an item
            of a list. The value is TOML, or text that need not be quoted.

    Raises:
        ConfigError: not of that form, or no such item.
    """
    key, equals, written = text.partition("=")
    origin = f"--set {text}"
    steps = key.split(".")
    if not equals or not all(steps):
        raise ConfigError(f"{origin}: a setting is KEY=VALUE")
    at: Any = nodes
    path: list[str | int] = []
    for i, step in enumerate(steps):
        last = i == len(steps) - 1
        if isinstance(at.value, list):
            place = _item(at, step, origin, named(path))
            path.append(place)
            if last:
                raise ConfigError(f"{origin}: {named(path)} is a table: say which key of it")
            at = at.value[place]
            continue
        if not isinstance(at.value, dict):
            raise ConfigError(f"{origin}: {named(path)} has a value, not keys")
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
    """A tree in which some keys are otherwise, each as `set_key` has it.

    Args:
        nodes: the tree; it is changed.
        sets: ``a.b=value`` each; of the same key twice the last holds.
        known: its keys that may be set; None: all.
    """
    known = list(types_of(kind)) if known is None else known
    for text in sets:
        key, equals, _ = text.partition("=")
        key = key.partition(".")[0]
        if not equals:
            raise ConfigError(f"--set {text}: a setting is KEY=VALUE; {nearest('', known)}")
        if key not in known:
            raise ConfigError(f"--set {text}: no key {key!r}; {hint(key, known)}")
        set_key(nodes, text, kind)
    return nodes


def take_sets(
    what: str, sets: Sequence[str], *kinds: type[Any], usual: Mapping[str, Any] | None = None
) -> tuple[Any, ...]:
    """Settings of a command shared out among dataclasses: each takes those that it knows.

    Args:
        usual: values where nothing is set, beside the dataclasses' own.
    """
    known = {name: kind for kind in kinds for name in types_of(kind)}
    made = []
    for kind in kinds:
        values = {k: v for k, v in (usual or {}).items() if k in types_of(kind)}
        nodes = make_node(values, what, 0, Path.cwd())
        mine = [s for s in sets if known.get(re.split("[=.]", s)[0], kinds[0]) is kind]
        made.append(convert(set_keys(nodes, mine, kind, list(known)), kind))
    return tuple(made)


def _item(node: SettingNode, step: str, origin: str, where: str) -> int:
    """Which item of a list is meant: by its name, or by its number from 0."""
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
    """Take ``scheme:target?option=value&option=value`` apart.

    Returns:
        Scheme (empty: there is none), target, and the options as written.

    Raises:
        ConfigError: it holds what cannot be printed, is too long, is no URL, or gives an option
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
    # A + is a +, as in a file's name, not the space that web forms make of it.
    pairs = parse_qsl(parts.query.replace("+", "%2B"), keep_blank_values=True)
    fields: dict[str, str] = {}
    for name, value in pairs:
        if name in fields:
            raise ConfigError(f"option {name!r} is given twice")
        fields[name] = value
    return parts.scheme, unquote(parts.netloc + parts.path), fields


def take_options(what: str, fields: Mapping[str, str], *kinds: type[Any]) -> tuple[Any, ...]:
    """The options shared out among dataclasses: each takes those that it knows.

    Args:
        fields: as written; numbers may be hexadecimal, as CAN identifiers are.

    Raises:
        ConfigError: an option that none knows, or ill-typed.
    """
    known = list(dict.fromkeys(name for kind in kinds for name in types_of(kind)))
    for name in fields:
        if name not in known:
            raise ConfigError(f"{what} has no option {name!r}; {hint(name, known)}")
    made = []
    for kind in kinds:
        mine = {k: _decimal(v) for k, v in fields.items() if k in types_of(kind)}
        made.append(convert(make_node(mine, what, 0, Path()), kind, lax=True))
    return tuple(made)


def _decimal(value: str) -> str:
    """A hexadecimal number in decimal; of more than 64 bits there is none."""
    return str(int(value, 16)) if re.fullmatch(r"0[xX][0-9a-fA-F]{1,16}", value) else value


# CSV


@dataclass(frozen=True)
class CsvTable:
    """A CSV file as read."""

    where: str
    columns: tuple[str, ...]
    rows: tuple[SettingNode, ...]


def read_csv(path: Path) -> CsvTable:
    """Read a CSV file whose first line names the columns; lines that begin with # are remarks.

    Raises:
        ConfigError: it cannot be read, has no line, a column twice, or a row of another length;
            names file and line.
    """
    lines = [
        (number, _cells(line, f"{path}:{number}"))
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
        raise ConfigError(f"{where}: column {twice!r} is there twice; remove one")
    rows = []
    for number, cells in below:
        if len(cells) != len(columns):
            raise ConfigError(f"{path}:{number}: {len(cells)} values for {len(columns)} columns")
        row = dict(zip(columns, cells, strict=True))
        rows.append(make_node(row, str(path), number, path.parent))
    return CsvTable(where, tuple(columns), tuple(rows))


def _cells(line: str, where: str) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([line]))]
    except csv.Error as error:  # a cell that is too long for one
        raise ConfigError(f"{where}: {error}") from None


def check_columns(table: CsvTable, known: Sequence[str], needed: Sequence[str] = ()) -> None:
    """Refuse a column that is not known, and the lack of one that is needed."""
    for column in table.columns:
        if column not in known:
            raise ConfigError(f"{table.where}: no column {shown(column)}; {hint(column, known)}")
    for column in needed:
        if column not in table.columns:
            raise ConfigError(f"{table.where}: no column {column}; add it")
