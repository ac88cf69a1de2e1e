"""Columns for a table, or for what a board printed, for a user to look at and change."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.drivers.codecs.ascii_text import in_seconds, number
from tactile_rt.drivers.codecs.column_guess import LOOKED_AT, guess_columns, guess_line_columns
from tactile_rt.drivers.codecs.column_words import compress_columns
from tactile_rt.drivers.opening import make_codec
from tactile_rt.recording.importing.csv import CsvForm, csv_form, read_table

__all__ = [
    "ProposedColumns",
    "line_columns",
    "propose_columns",
    "propose_fields",
    "propose_line_columns",
]

LEAST = 3  # rows
DATED = 20  # rows that are looked at for dates


@dataclass(frozen=True)
class ProposedColumns:
    """What may be in the columns of a file.

    Attributes:
        table: Whether the file is to be read as a table; else as what a board prints.
    """

    columns: str
    table: bool
    timed: bool
    said: str


def line_columns(data: bytes) -> tuple[str, int] | None:
    """The columns of lines that a board prints, in words, and how many lines are samples by them;
    None: there are none."""
    guess = guess_line_columns(data) or guess_line_columns(data[len(data) // 2 :])
    if guess is None:
        return None
    columns = compress_columns(guess)
    try:
        codec = make_codec("serial", "ascii_line", {"columns": columns})
    except ConfigError:
        return None
    codec.feed(data, 0)
    whole, corrupt = codec.stats.intact, codec.stats.corrupt
    return (columns, whole) if whole >= max(LEAST, corrupt) else None


def propose_columns(path: Path, data: bytes) -> ProposedColumns | None:
    """The columns of a file of text; None where it has none."""
    try:
        form = csv_form(path)
    except RecordingError:
        form = None
    if form is not None and (form.names or form.delimiter != " "):
        proposed = _of_table(path, form)
        if proposed is not None:
            return proposed
    told = propose_line_columns(data)
    if form is None or (told is not None and "=" in told.columns):
        return told
    return _of_table(path, form) if told is None else replace(told, table=True)


def propose_line_columns(data: bytes) -> ProposedColumns | None:
    """The columns of what a board printed; None where it printed no samples."""
    told = line_columns(data)
    if told is None:
        return None
    columns, n = told
    return ProposedColumns(columns, False, "time" in columns, f"{n} lines are samples")


def _of_table(path: Path, form: CsvForm) -> ProposedColumns | None:
    rows = [r for r in islice(read_table(path, form).rows, LOOKED_AT) if len(r) == form.width]
    cells = [[number(in_seconds(c.strip()) or "nan") for c in row] for row in rows]
    numbers = sum(c is not None for row in cells for c in row)
    if len(rows) < LEAST or 2 * numbers < len(rows) * form.width:
        return None
    dated = {
        k
        for k in range(form.width)
        if all(":" in row[k] and in_seconds(row[k]) != row[k] for row in rows[:DATED])
    }
    names = form.names
    if form.units:  # said as names say them
        names = tuple(f"{n} [{u}]" if u else n for n, u in zip(names, form.units, strict=True))
    words, timed = guess_columns(names, cells, dated)
    if not any("." in word for word in words if not word.startswith("time")):
        return None
    if form.names:
        words = [f"{n}={w}" for n, w in zip(form.names, words, strict=True) if w != "-"]
    said = f"{path} is a table of {form.width} columns"
    return ProposedColumns(compress_columns(words), True, timed, said)


def propose_fields(paths: Sequence[str]) -> str:
    """Propose columns for the largest array of a message, or for its fields.

    Args:
        paths: Path of each number, as ``sensors.0.values.3``.
    """
    groups: dict[tuple[str, ...], list[str]] = {}
    for path in paths:
        steps = path.split(".")
        array = [s for s in steps if not s.isdecimal()] if any(map(str.isdecimal, steps)) else []
        groups.setdefault(tuple(array), []).append(path)
    words = []
    for path in max(groups.values(), key=len, default=[]):
        places = [s for s in path.split(".") if s.isdecimal()]
        if not places:
            words.append(f"{path}=S.{path.replace('.', '_')}")
        elif len(places) == 1:
            words.append(f"{path}=T{places[0]}.value")
        else:
            words.append(f"{path}=T{'_'.join(places[:-1])}.c{places[-1]}")
    return compress_columns(words)
