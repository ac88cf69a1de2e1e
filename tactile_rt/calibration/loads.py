"""Tables of known loads: a .csv whose lines each say a load and what the sensor read under it.

Loads are columns fx, fy, fz (N), mx, my, mz (N m), as many of them as were applied. The readings
are columns ``raw_CHANNEL``, one per raw channel, or are taken from a recording between the seconds
``start_s`` and ``end_s`` of its own time. Lines that begin with # are remarks.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.settings import convert, nearest, read_csv
from tactile_rt.stream import ArraySpec, Chunk

__all__ = ["AXES", "LoadTable", "raw_readings", "read_loads"]

AXES = {"fx": "N", "fy": "N", "fz": "N", "mx": "N m", "my": "N m", "mz": "N m"}
RAW = "raw_"
TIMES = ("start_s", "end_s")


@dataclass(frozen=True, eq=False)
class LoadTable:
    """Known loads, one a row.

    Attributes:
        axes: Names of the axes that were loaded, in the order of `AXES`.
        loads: Known loads, (row, axis), N and N m.
        channels: Names of the raw channels that were read; empty if the table has times instead.
        raw: Readings under each load, (row, channel), raw units.
        times: Start and end of each load in the recording, (row, 2), s; no rows if the table has
            readings.
        lines: Number of each row's line in the file, (row,), counted from 1.
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
    """Read a table of loads."""
    table = read_csv(path)
    if not table.rows:
        raise ConfigError(f"{path}: needs a line of column names, and lines of loads")
    header = table.columns
    _check_header(table.where, header)
    rows = [list(convert(row, dict[str, float], lax=True).values()) for row in table.rows]
    values = np.array(rows, dtype=np.float64)
    lines = tuple(row.line for row in table.rows)
    axes = tuple(a for a in AXES if a in header)
    channels = tuple(c for c in header if c.startswith(RAW))
    times = values[:, [header.index(t) for t in TIMES if t in header]]
    for line, row in zip(lines, times, strict=True):
        if len(row) and not 0 <= row[0] < row[1]:
            raise ConfigError(f"{path}:{line}: start_s must be 0 or more and before end_s")
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


def _check_header(where: str, header: Sequence[str]) -> None:
    for column in header:
        if column not in (*AXES, *TIMES) and not (column.startswith(RAW) and column != RAW):
            known = (*AXES, *TIMES, *(RAW + a for a in AXES))
            near = nearest(column, known)
            if not near.startswith("did you mean"):
                near = f"there are {', '.join((*AXES, *TIMES))} and {RAW}CHANNEL"
            raise ConfigError(f"{where}: no column {column!r}; {near}")
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
