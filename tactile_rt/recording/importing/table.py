"""Conversion of rows of numbers to a recording: columns in words, times or a rate, lost samples.

    time=time:s,(x{0..3}=T{0..3}.fx:mN,y{0..3}=T{0..3}.fy:mN)

`ascii_mapping` describes the kinds of columns. Here a time may have decimals in every unit, does
not wrap, and may be split into two columns: seconds and the rest in us or ns, or a date and a time
of day, both time:iso. Columns are found by their names or, without names, by their places.

Times. Rows that share one time (of a coarse clock) are spread evenly up to the next time. Rows that
are out of order are sorted, and a single time that is too early or too late among correct ones is
interpolated. A time that goes back for good begins another stretch, one period after the row
before; a time of day that falls by more than half a day is of the next day.
"""

import re
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.settings import nearest
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk
from tactile_rt.drivers.codecs.ascii_mapping import (
    Column,
    LineMapping,
    array_of,
    order_columns,
    parse_columns,
    read_mapping,
)
from tactile_rt.drivers.codecs.ascii_text import in_seconds, number
from tactile_rt.drivers.codecs.column_guess import FASTEST_HZ
from tactile_rt.drivers.codecs.column_words import compress_columns
from tactile_rt.recording.description import Description
from tactile_rt.recording.importing.report import Import, clock_of, write_chunks

NS: Final = {"s": NS_PER_S, "iso": NS_PER_S, "ms": 10**6, "us": 1000, "ns": 1}
GAP: Final = 10  # typical steps: a longer step is a pause, not a period
BLOCK: Final = 1024  # rows that are kept as Python numbers
BESIDE: Final = ("header.", "layout.", "field.header.")  # fields of a message that are no data
NEAR: Final = 64  # rows within which a step forward may undo a step back of time
MADE_GOOD: Final = 0.4  # least part of a step back that it must undo
EVEN: Final = (0.6, 1.5)  # periods between rows that only needed sorting
FAR: Final = 2  # rows that sorting moves per outlier; more: the outliers' times are wrong
MOST_LOOSE: Final = 1 / 3  # largest share of rows with wrong times
DAY_NS: Final = 86_400 * NS_PER_S
EXACT: Final = 2.0**53  # whole numbers up to here are exact in float64
_ZONE: Final = re.compile(r"(?i)utc|gmt|:\d\d.*(?:z|[+-]\d\d:?\d\d)\s*$")
SHOWN: Final = 600  # characters of names in a message


@dataclass
class Table:
    """Table of text or numbers, whose rows are read one after another."""

    path: Path
    names: tuple[str, ...]
    # rows, each with one cell per column: texts or numbers
    rows: Iterable[Sequence[Any]]
    # times of the rows read so far, ns, if the table has times beside its columns; else None
    times_ns: list[int] | None = None
    # sentences on what could not be read; complete once all rows were read
    notes: list[str] = field(default_factory=list)
    line: int = 0  # number of the text line that was read last
    width: int = 0  # number of cells of every complete row; 0 for any number


def shown_names(names: Sequence[str]) -> str:
    """Return a shortened list of column names, for a message."""
    text = compress_columns([f'"{n}"' if "," in n else n for n in names])
    return text if len(text) <= SHOWN else f"{text[:SHOWN]} ..."


def mapping_of(columns: str, name: str) -> LineMapping:
    """Return a mapping of columns from words, or a TOML file as docs/codecs/ascii_line.toml."""
    if columns.endswith(".toml"):
        return read_mapping(columns, LineMapping)
    return LineMapping(columns=(columns,), name=name)


def place_columns(
    columns: Sequence[Column], names: Sequence[str], where: str
) -> tuple[list[int], list[str]]:
    """Return the cell index of each column in a row, and notes on unused cells.

    Raises:
        ConfigError: no column has that name or place.
    """
    labelled = [c.label for c in columns if c.label]
    if labelled and len(labelled) < len(columns):
        raise ConfigError(f"{where}: give all columns a name, NAME=COLUMN, or none")
    if labelled and not names:
        raise ConfigError(f"{where}: the file does not name its columns: give them by position")
    if not labelled and len(columns) > len(names) > 0:
        raise ConfigError(f"{where}: {len(columns)} columns for {len(names)} of the file")
    places = [] if labelled else list(range(len(columns)))
    from_last = list(enumerate(names))[::-1]
    known = {n.strip().lower(): k for k, n in from_last} | {n: k for k, n in from_last}
    for label in labelled:
        found = known.get(label, known.get(label.strip().lower()))
        if found is None:
            raise ConfigError(f"{where}: no column {label!r}; {nearest(label, names)}")
        places.append(found)
    left = [n for k, n in enumerate(names) if k not in places and not n.startswith(BESIDE)]
    return places, [f"left out: {shown_names(left)}"] if left else []


def import_table(table: Table, output: Path, columns: str, rate_hz: float = 0.0) -> Import:
    """Convert a table of numbers to a recording.

    Args:
        output: the recording to write, whole or not at all.
        columns: the meaning of the columns: words, or the path of a TOML file.
        rate_hz: rate of the samples, Hz; 0 to estimate it from their times.

    Raises:
        ConfigError: the columns are invalid, or neither times nor a rate are given.
    """
    parsed, spec, read, notes = read_samples(table, columns, rate_hz)
    account = Import(intact=len(read.values), corrupt=read.corrupt, notes=[*table.notes, *notes])
    values, times, count = read.values, read.times, read.count
    if times is not None:
        if any(c.kind == "iso" for c in parsed) and times.max() < DAY_NS:
            # medians, so that a single wrong time does not count as midnight
            around = np.lib.stride_tricks.sliding_window_view(np.pad(times, 2, mode="edge"), 5)
            middle = np.median(around, axis=1).astype(np.int64)
            steps = np.diff(middle, prepend=middle[0])
            days = np.cumsum((steps < -DAY_NS // 2).astype(int) - (steps > 23 * DAY_NS // 24))
            late = middle + DAY_NS * np.maximum(0, days) - times
            times = times + DAY_NS * np.round(late / DAY_NS).astype(np.int64)
        order, times = _sort_rows(times, account)
        values, count = values[order], None if count is None else count[order]
    seq, keep = _number_rows(count, parsed, len(values), account)
    values, times = values[keep], None if times is None else times[keep]
    if read.complaint and read.corrupt:
        account.notes.append(f"the first line that is no sample: {read.complaint}")
    if times is None:
        t_ns, zero = np.round(seq * (NS_PER_S / rate_hz)).astype(np.int64), 0
    else:
        zero = clock_of(int(times[0]))
        t_ns, own = _make_increasing(times - zero, rate_hz, account)
        if rate_hz and not 0.8 < own / rate_hz < 1.2:
            account.notes.append(f"its times tell {own:.4g} Hz, not the {rate_hz:g} Hz of --rate")
        if own > FASTEST_HZ:
            account.notes.append(f"{own:.4g} Hz by its times is too fast: another unit of time?")
        spec = replace(spec, rate_hz=rate_hz or own)
    valid = np.logical_and.reduce(np.isfinite(values), axis=2)
    session = {"imported": table.path.name, "columns": columns}
    about = Description(spec, zero, table.path.name, session=session)
    write_chunks(output, about, Chunk(seq, t_ns, values, valid), account, str(table.path))
    if read.local:
        account.first = account.first.removesuffix(" UTC")
        account.last = account.last.replace(" UTC", " (local time, taken as UTC)")
    return account


def read_samples(
    table: Table, columns: str, rate_hz: float = 0.0
) -> tuple[tuple[Column, ...], ArraySpec, "ReadRows", list[str]]:
    """Read the rows of a table; return its columns, the array, the rows, and notes."""
    mapping = mapping_of(columns, table.path.stem)
    where = columns if columns.endswith(".toml") else "--columns"
    parsed = parse_columns(mapping.columns, where)
    places, notes = place_columns(parsed, table.names, where)
    if rate_hz:
        mapping = msgspec.structs.replace(mapping, rate_hz=rate_hz)
    parts = ("us", "ns") if any(c.kind == "s" for c in parsed) else ()  # fractions of seconds
    dated = [c for c in parsed if c.kind == "iso"]
    second = dated[1] if len(dated) == 2 else None  # a time of day whose date is another column
    rest = tuple(c for c in parsed if c.kind not in parts and c is not second)
    spec = array_of(mapping, rest, where)
    if not rate_hz and table.times_ns is None and not any(c.kind in NS for c in parsed):
        raise ConfigError(f"{table.path}: no column is a time: give --rate, in Hz")
    read = _read(table, parsed, places, spec)
    if not len(read.values):
        why = f", all {read.corrupt} lines are otherwise" if read.corrupt else ""
        raise RecordingError(
            f"{table.path}: no line has the {len(parsed)} columns that are described{why}"
            + (f" ({read.complaint})" if read.complaint else "")
        )
    return parsed, spec, read, notes


@dataclass
class ReadRows:
    """Values, times and counts read from the rows of a table."""

    values: NDArray[np.float32]
    times: NDArray[np.int64] | None
    count: NDArray[np.int64] | None
    corrupt: int
    complaint: str
    local: bool  # whether the times are dates without a time zone


def _read(
    table: Table, columns: Sequence[Column], places: Sequence[int], spec: ArraySpec
) -> ReadRows:
    order = order_columns(columns, spec)
    scale = np.array([columns[k].scale for k in order])
    offset = np.array([columns[k].offset for k in order])
    measured = [places[k] for k in order]
    clocks = [(places[k], c) for k, c in enumerate(columns) if c.kind in NS]
    dated = [c.kind for _, c in clocks] == ["iso", "iso"]
    counter = next((places[k] for k, c in enumerate(columns) if c.kind == "count"), None)
    need = max(places) + 1
    width = max(need, table.width or len(table.names))
    least = width if table.width else need
    blocks: list[NDArray[np.float32]] = []
    rows: list[list[float]] = []
    times: list[int] = []
    counts: list[int] = []
    corrupt, complaint, local = 0, "", False

    def finish_block() -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            block = np.array(rows, np.float64).reshape(len(rows), len(order)) * scale + offset
            blocks.append(block.astype(np.float32).reshape(len(rows), *spec.shape))
        rows.clear()

    for cells in table.rows:
        try:
            if len(cells) < least or (len(cells) > width and (table.width or table.names)):
                raise ValueError(f"{len(cells)} columns, not {width}")
            row = [_parse_number(cells[k]) for k in measured]
            each = [_parse_time(cells[place], column, dated) for place, column in clocks]
            if dated and sum(ns >= DAY_NS for ns in each) != 1:
                raise ValueError(
                    f"{[cells[p] for p, _ in clocks]!r:.60} is no date and time of day"
                )
            t_ns = sum(each)
            if not clocks and table.times_ns is not None:
                t_ns = table.times_ns[-1]
            if counter is not None:
                count = _parse_number(cells[counter])
                if not count.is_integer() or abs(count) >= EXACT:
                    raise ValueError(f"{cells[counter]!r:.40} is no count")
                counts.append(int(count))
        except (ValueError, OverflowError) as error:
            corrupt += 1
            complaint = complaint or (f"line {table.line}: " if table.line else "") + str(error)
            continue
        if not times:
            dates = " ".join(
                f"{c.label} {cells[place]}" for place, c in clocks if c.kind == "iso" or c.offset
            )
            local = bool(dates) and not _ZONE.search(dates)
        rows.append(row)
        times.append(t_ns)
        if len(rows) == BLOCK:
            finish_block()
    finish_block()
    timed = bool(clocks) or table.times_ns is not None
    return ReadRows(
        np.concatenate(blocks), np.array(times, np.int64) if timed else None,
        np.array(counts, np.int64) if counter is not None else None, corrupt, complaint,
        local,
    )  # fmt: skip


def _parse_number(cell: Any) -> float:
    """Parse the number of a cell; NaN if it is empty."""
    if not isinstance(cell, str):
        return float(cell)
    found = number(cell.strip() or "nan")
    if found is None:
        raise ValueError(f"{cell[:40]!r} is no number")
    return found


def _parse_time(cell: Any, column: Column, dated: bool) -> int:
    """Parse a time in ns; decimals are converted exactly.

    Args:
        dated: whether the cell may be a date without a time of day.
    """
    text = str(cell).strip()
    if column.kind == "iso":
        midnight = " 00:00" if dated and ":" not in text else ""
        text = in_seconds(text + midnight, column.unit).removesuffix(midnight)
    try:
        ns = (Decimal(text) * Decimal(column.scale) + Decimal(column.offset)) * NS[column.kind]
        if abs(ns) < 1 << 62:
            return round(ns)
        hint = f": too large for time:{column.kind}"
    except InvalidOperation:  # not a number
        hint = "; time:mdy or time:dmy?" if "/" in text and not column.unit else ""
    raise ValueError(f"{cell!r:.40} is no time{hint}")


def _number_rows(
    count: NDArray[np.int64] | None, columns: Sequence[Column], n: int, account: Import
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return sequence numbers and a mask of the rows to keep; count missing samples."""
    if count is None:
        return np.arange(n, dtype=np.int64), np.ones(n, np.bool_)
    wrap = 1 << next(c.bits for c in columns if c.kind == "count")
    steps = np.diff(count) % wrap
    keep = np.concatenate([[True], steps != 0])
    forward = (steps > 0) & (steps <= wrap // 2)
    account.missing = int((steps[forward] - 1).sum())
    if again := int((~keep).sum()):
        account.notes.append(f"{again} lines repeat the count of the one before: left out")
    if resets := int((steps > wrap // 2).sum()):
        account.notes.append(f"the count goes back {resets} times")
    advance = np.where(forward, steps, 1)[keep[1:]]
    return np.concatenate([[0], np.cumsum(advance)]).astype(np.int64), keep


def _sort_rows(
    times: NDArray[np.int64], account: Import
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Sort rows by time; return (order, times, which decrease only between stretches)."""
    order, steps = np.arange(len(times)), np.diff(times)
    back = np.flatnonzero(steps < 0)
    if not len(back):
        return order, times
    if (steps <= 0).all():
        account.notes.append("its first line is its newest: read from its end")
        return order[::-1], times[::-1]
    ends = np.flatnonzero(steps)
    paces = steps[ends] / np.diff(ends, prepend=-1)
    period = float(np.median(paces[paces > 0]))
    over = steps - period
    lasting = [k for k in back if over[max(0, k - NEAR) : k + NEAR].max() < -MADE_GOOD * over[k]]
    times, moved, dated = times.copy(), 0, 0
    for a, b in pairwise([0, *(k + 1 for k in lasting), len(times)]):
        part, of_part = times[a:b], order[a:b]
        low = np.minimum.accumulate(part[::-1])[::-1]
        mixed = np.flatnonzero((low < part) | (np.maximum.accumulate(part) > part))
        wrong: list[int] = []
        for run in np.split(mixed, np.flatnonzero(np.diff(mixed) > 1) + 1) if len(mixed) else ():
            i, j = int(run[0]), int(run[-1]) + 1
            rank = np.argsort(part[i:j], kind="stable")
            between = np.diff(np.sort(part[max(0, i - 1) : j + 1]))
            out, places = _find_outliers(part[i:j].tolist()), int((rank != np.arange(j - i)).sum())
            squeezed = between.min() < EVEN[0] * period or places > FAR * len(out)
            if squeezed and between.max() > EVEN[1] * period:
                wrong += [i + k for k in out]
            else:
                part[i:j], of_part[i:j] = part[i:j][rank], of_part[i:j][rank]
                moved += places
        if wrong and len(wrong) <= MOST_LOOSE * len(part):
            right = np.delete(np.arange(len(part)), wrong)
            part[wrong] = np.interp(wrong, right, part[right] - part[0]).astype(np.int64) + part[0]
            dated += len(wrong)
    if moved:
        account.notes.append(f"{moved} lines stand in another order than their times: sorted")
    if dated:
        account.notes.append(f"{dated} times do not fit those beside them: put between these")
    return order, times


def _find_outliers(times: Sequence[int]) -> list[int]:
    """Return the fewest indices to remove so that times never decrease; prefer later ones."""
    ends: list[int] = []
    last: list[int] = []
    after = [-1] * len(times)
    for k in reversed(range(len(times))):
        n = bisect_right(ends, -times[k])
        after[k] = last[n - 1] if n else -1
        ends[n : n + 1], last[n : n + 1] = [-times[k]], [k]
    kept, k = set(), last[-1]
    while k >= 0:
        kept.add(k)
        k = after[k]
    return [k for k in range(len(times)) if k not in kept]


def _make_increasing(
    times: NDArray[np.int64], rate_hz: float, account: Import
) -> tuple[NDArray[np.int64], float]:
    """Return strictly increasing times, and their rate in Hz."""
    if len(times) == 1:
        return times, rate_hz or 1.0
    steps = np.diff(times)
    ends = np.flatnonzero(steps)  # with a coarse clock several rows share a time
    forward = steps[ends] > 0
    if not forward.any():
        raise ConfigError("all lines have the same time: leave its column out, and give --rate")
    stretches, repeats = int((steps < 0).sum()), int((steps == 0).sum())
    pause = GAP * np.median(steps[ends][forward])
    usual = forward & (steps[ends] <= pause)
    rows = np.diff(ends, prepend=-1)
    long = steps[ends] > EVEN[1] * np.median((steps[ends] / rows)[usual]) * rows
    if (long & usual).sum() <= account.corrupt:
        usual &= ~long  # rows are missing in long steps
    period = float(steps[ends][usual].sum() / rows[usual].sum())
    if stretches:
        account.notes.append(f"times go back {stretches} times: there they go on a period later")
        jump = np.where(steps < 0, round(period) - steps, 0)
        times = times + np.concatenate([[0], np.cumsum(jump)])
    gaps = np.flatnonzero(steps > max(pause, account.corrupt * period, NS_PER_S / 10))
    if len(gaps) and not account.missing:
        at = int(gaps[steps[gaps].argmax()])
        more = f", the longest of {len(gaps)} gaps" if len(gaps) > 1 else ""
        account.notes.append(f"no rows for {steps[at] / NS_PER_S:.4g} s after row {at + 1}{more}")
    if repeats:
        account.notes.append(f"{repeats} lines have the time of the one before: spread evenly")
        times = _spread_evenly(times, period)
    return times, float(f"{NS_PER_S / period:.6g}")


def _spread_evenly(times: NDArray[np.int64], period: float) -> NDArray[np.int64]:
    """Spread rows of equal time up to the next time, at most a period apart."""
    first = np.flatnonzero(np.concatenate([[True], np.diff(times) > 0]))
    lengths = np.diff(np.append(first, len(times)))
    room = np.diff(np.append(times[first], times[-1] + round(period * lengths[-1])))
    step = np.maximum(1.0, np.minimum(room / lengths, period))
    within = np.arange(len(times)) - np.repeat(first, lengths)
    spread: NDArray[np.int64] = np.floor(within * np.repeat(step, lengths)).astype(np.int64)
    return times + spread
