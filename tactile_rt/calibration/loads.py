"""Tables of known loads: a .csv whose lines each say a load and what the sensor read under it.

Loads are columns fx, fy, fz (N), mx, my, mz (N m), as many of them as were applied. The readings
are columns ``raw_CHANNEL``, one per raw channel, or are taken from a recording between the seconds
``start_s`` and ``end_s`` of its own time. Lines that begin with # are remarks.
"""

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.calibration.correction import nearest
from tactile_rt.stream import ArraySpec, Chunk, ConfigError

__all__ = ["AXES", "LoadTable", "raw_readings", "read_loads"]

AXES = {"fx": "N", "fy": "N", "fz": "N", "mx": "N m", "my": "N m", "mz": "N m"}
RAW = "raw_"
TIMES = ("start_s", "end_s")


@dataclass(frozen=True, eq=False)
class LoadTable:
    """Known loads, one a row.

    Attributes:
        axes: of the loads, in the order of `AXES`.
        loads: (row, axis) N and N m.
        channels: of the readings; empty if the table has times instead.
        raw: (row, channel) readings, raw units.
        times: (row, 2) start and end, s; no rows if the table has readings.
        lines: (row,) in the file, from 1.
    """

    axes: tuple[str, ...]
    loads: NDArray[np.float64]
    channels: tuple[str, ...]
    raw: NDArray[np.float64]
    times: NDArray[np.float64]
    lines: tuple[int, ...]

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the axes."""
        return tuple(AXES[a] for a in self.axes)


def read_loads(path: Path) -> LoadTable:
    """Read a table of loads.

    Raises:
        ConfigError: one line that names the file, the line, the column, and what to do.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise ConfigError(f"{path}: is not UTF-8 text; save it as UTF-8") from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    rows = [
        (number, [cell.strip() for cell in next(csv.reader([line]))])
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip(" ,") and not line.startswith("#")  # spreadsheets keep empty rows as commas
    ]
    if len(rows) < 2:
        raise ConfigError(f"{path}: needs a line of column names, and lines of loads")
    (number, header), *rows = rows
    _check_header(f"{path}, line {number}", header)
    values = np.empty((len(rows), len(header)))
    for at, (number, cells) in enumerate(rows):
        where = f"{path}, line {number}"
        if len(cells) != len(header):
            raise ConfigError(f"{where}: {len(cells)} values for {len(header)} columns")
        for column, (name, cell) in enumerate(zip(header, cells, strict=True)):
            values[at, column] = _number(f"{where}, column {name}", cell)
    lines = tuple(number for number, _ in rows)
    axes = tuple(a for a in AXES if a in header)
    channels = tuple(c for c in header if c.startswith(RAW))
    times = values[:, [header.index(t) for t in TIMES if t in header]]
    for line, row in zip(lines, times, strict=True):
        if len(row) and not 0 <= row[0] < row[1]:
            raise ConfigError(f"{path}, line {line}: start_s must be 0 or more and before end_s")
    return LoadTable(
        axes,
        values[:, [header.index(a) for a in axes]],
        tuple(c.removeprefix(RAW) for c in channels),
        values[:, [header.index(c) for c in channels]],
        times if times.shape[1] else np.empty((0, 2)),
        lines,
    )


def raw_readings(
    table: LoadTable, recorded: Chunk, spec: ArraySpec, element: str
) -> NDArray[np.float64]:
    """What an element read under each load of a table with times: (row, channel) medians.

    Args:
        table: with times.
        recorded: of raw samples; the table's second 0 is its first sample's.
        spec: what they are samples of.
        element: of it.

    Raises:
        ConfigError: no such element, or no valid sample in one of the ranges (which line).
    """
    if element not in spec.elements:
        raise ConfigError(f"no element {element!r}; {nearest(element, spec.elements)}")
    at = spec.elements.index(element)
    t_s = (recorded.t_ns - recorded.t_ns[0]) * 1e-9
    readings = []
    for line, (start, end) in zip(table.lines, table.times, strict=True):
        inside = (t_s >= start) & (t_s < end) & recorded.valid[:, at]
        if not inside.any():
            raise ConfigError(
                f"line {line}: no valid sample of {element} from {start:g} to {end:g} s; the "
                f"recording is {t_s[-1]:.4g} s long"
            )
        readings.append(np.median(recorded.values[inside, at].astype(np.float64), axis=0))
    return np.stack(readings)


def _check_header(where: str, header: list[str]) -> None:
    if len(header) == 1 and ";" in header[0]:
        raise ConfigError(f"{where}: columns are separated by semicolons; use commas")
    for column in header:
        if column not in (*AXES, *TIMES) and not (column.startswith(RAW) and column != RAW):
            known = (*AXES, *TIMES, *(RAW + a for a in AXES))
            hint = nearest(column, known).split("there are")[0]
            raise ConfigError(
                f"{where}: no column {column!r} is known; "
                + (hint or f"there are {', '.join((*AXES, *TIMES))} and {RAW}CHANNEL")
            )
    if len(set(header)) < len(header):
        twice = next(c for i, c in enumerate(header) if c in header[:i])
        raise ConfigError(f"{where}: column {twice} is there twice; remove one")
    if not set(header) & set(AXES):
        raise ConfigError(f"{where}: no load; add columns of {', '.join(AXES)}")
    timed, read = set(header) & set(TIMES), any(c.startswith(RAW) for c in header)
    if len(timed) == 1:
        raise ConfigError(f"{where}: start_s and end_s go together; add the other")
    if bool(timed) == read:
        raise ConfigError(
            f"{where}: needs readings ({RAW}CHANNEL) or times in a recording (start_s, end_s), "
            "one of the two"
        )


def _number(where: str, cell: str) -> float:
    try:
        number = float(cell)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{where}: {cell!r} is not a number")
    return number
