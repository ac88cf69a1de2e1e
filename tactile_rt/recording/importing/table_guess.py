"""Proposals of columns for a table or a board's printed lines, which a user may correct."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.drivers.codecs.ascii_text import in_seconds, number
from tactile_rt.drivers.codecs.column_guess import (
    LOOKED_AT,
    guess_columns,
    guess_line_columns,
    list_unread_units,
)
from tactile_rt.drivers.codecs.column_words import compress_columns
from tactile_rt.drivers.opening import make_codec
from tactile_rt.recording.importing.table import read_samples, shown_names
from tactile_rt.recording.importing.table_form import CsvForm, csv_form, read_table

_DELTA = re.compile(r"Delta_X\W+([\d.,]+(?:E[+-]\d+)?)")  # LabVIEW's step, s
_CLOCK = re.compile(r"\d:\d")
LEAST = 3  # rows
DAY_S = 86_400
DATED = 0.9  # share of dates among the cells of a column of dates
ORDERS = {"": "year", "mdy": "month", "dmy": "day"}


@dataclass(frozen=True)
class ProposedColumns:
    """Proposed columns of a file, with an explanation for the user."""

    columns: str  # columns in words; empty where the file cannot be read with any that were found
    table: bool  # whether the file is to be read as a table; else as what a board prints
    timed: bool
    said: str
    samples: int = 0
    rate_hz: float = 0.0  # rate in the header, Hz; 0 if it has none


def propose_line_columns(data: bytes) -> ProposedColumns | None:
    """Propose the columns of a board's printed lines; None if they hold no samples."""
    data = b"\n" + data  # the data begin with a whole line
    guess = guess_line_columns(data) or guess_line_columns(data[len(data) // 2 :])
    if guess is None:
        return None
    columns = compress_columns(guess)
    try:
        codec = make_codec("serial", "ascii_line", {"columns": columns})
    except ConfigError:
        return None
    codec.feed(data, 0)
    whole, lines = codec.stats.intact, len(data.splitlines()) - 1
    if whole < max(LEAST, codec.stats.corrupt):
        return None
    summary = f"{whole} samples in the first {lines} lines"
    return ProposedColumns(columns, False, "time" in columns, summary, whole)


def propose_columns(path: Path, data: bytes) -> ProposedColumns | None:
    """Propose the columns of a text file; None if it has none."""
    try:
        form = csv_form(path)
    except RecordingError:
        form = None
    printed = propose_line_columns(data)
    labelled = printed is not None and "=" in printed.columns
    if form is None or (labelled and not form.names):
        return printed
    if form.names or form.delimiter != " ":
        proposed = _propose_table_columns(path, form)
        if proposed is not None and proposed.columns:
            return proposed
    if printed is None or labelled:
        return printed or _propose_table_columns(path, form)
    tried = _try_import(path, form, replace(printed, table=True))
    return tried if tried.columns else _propose_table_columns(path, form) or tried


def _propose_table_columns(path: Path, form: CsvForm) -> ProposedColumns | None:
    rows = [r for r in islice(read_table(path, form).rows, LOOKED_AT) if len(r) == form.width]
    clocks = {k: order for k in range(form.width) if (order := _find_order([r[k] for r in rows]))}
    cells = [
        [number(in_seconds(c.strip(), clocks.get(k, "")) or "nan") for k, c in enumerate(row)]
        for row in rows
    ]
    numbers = sum(c is not None for row in cells for c in row)
    if len(rows) < LEAST or 2 * numbers < len(rows) * form.width:
        return None
    names = form.names
    if form.units:  # written as units in names are
        names = tuple(f"{n} [{u}]" if u else n for n, u in zip(names, form.units, strict=True))
    words, timed = guess_columns(names, cells, clocks)
    if clocks and max(row[min(clocks)] or 0 for row in cells) < DAY_S:  # another column has dates
        for k in sorted(set(range(form.width)) - clocks.keys()):
            if order := _find_order([f"{r[k].strip() or '-'} {r[min(clocks)]}" for r in rows]):
                clocks[k], words[k] = order, "time:iso"
                break
    summary = f"{path} is a table of {form.width} columns"
    left = [n for n, word in zip(form.names, words, strict=False) if word == "-"]
    summary += f" (left out: {shown_names(left)})" if left else ""
    summary += f"; {form.note}" if form.note else ""
    unread = list_unread_units(names, words)
    summary += f"; units that are not read: {shown_names(unread)}" if unread else ""
    if not any("." in word for word in words if not word.startswith("time")):
        none = f"no measured number in {shown_names(left)}"
        return ProposedColumns("", True, timed, none) if left and timed else None
    for k, order in clocks.items():
        if words[k] == "time:iso" and order != "iso":
            words[k] = f"time:{order}"
            summary += f", {rows[0][k].strip()} with the {ORDERS[order]} first"
    for k in sorted(set(range(form.width)) - clocks.keys()):
        if rows and sum(bool(_CLOCK.search(row[k])) for row in rows) >= len(rows) * DATED:
            summary += f"; {rows[0][k].strip()!r:.40} in column {k + 1} is no time that is read"
    if form.names:
        words = [f"{n}={w}" for n, w in zip(form.names, words, strict=True) if w != "-"]
    found = ProposedColumns(compress_columns(words), True, timed, summary, rate_hz=_find_rate(form))
    return _try_import(path, form, found)


def _find_rate(form: CsvForm) -> float:
    steps = {m[1].replace(",", ".") for head in form.heads if (m := _DELTA.match(head))}
    of_time = all("Time" in x for x in form.heads if x.startswith("X_Dimension"))
    step_s = number(steps.pop()) if of_time and len(steps) == 1 else None
    return float(f"{1 / step_s:.6g}") if step_s else 0.0


def _find_order(cells: Sequence[str]) -> str:
    """Return the order of numbers in dates, ``iso``, ``mdy`` or ``dmy``; empty without dates."""
    cells = [c.strip() for c in cells if c.strip()] or ["no date"]
    read = {
        o: sum(":" in c and number(in_seconds(c, o)) is not None for c in cells) for o in ORDERS
    }
    half_days = cells[0].rstrip(".")[-1:] in "mM"
    best = max(read, key=lambda o: (read[o], not o, (o == "mdy") == half_days))
    return (best or "iso") if read[best] >= len(cells) * DATED else ""


def _try_import(path: Path, form: CsvForm, proposed: ProposedColumns) -> ProposedColumns:
    """Try a proposal on the first rows; return it, without columns if that fails."""
    table = read_table(path, form)
    table.rows = islice(table.rows, LOOKED_AT)
    try:
        _, _, read, _ = read_samples(table, proposed.columns, 0.0 if proposed.timed else 1.0)
    except (ConfigError, RecordingError) as error:
        return replace(proposed, columns="", said=str(error))
    if len(read.values) > read.corrupt and np.isfinite(read.values).any():
        return proposed
    return replace(proposed, columns="", said=f"{path}: most lines are no rows: {read.complaint}")


def propose_fields(paths: Sequence[str]) -> str:
    """Propose columns for the largest array in a message, or for its fields, in words.

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
        *places, last = [s for s in path.split(".") if s.isdecimal()] or [""]
        whole = f"T{last}.value" if last else f"S.{path.replace('.', '_')}"
        words.append(f"{path}=" + (f"T{'_'.join(places)}.c{last}" if places else whole))
    return compress_columns(words)
