"""Fit of an element's calibration matrix to known loads by least squares.

A table is a .csv with a known load and the sensor's reading in each line. Loads are columns fx, fy,
fz (N), mx, my, mz (N m), only those that were applied. The readings are columns ``raw_CHANNEL``,
one per raw channel, or are taken from a recording between the seconds ``start_s`` and ``end_s``.

The model is load = M (raw - tare): an affine map, fitted as load = M raw + b, so that neither the
loads nor the readings need a common zero. The tare is the raw reading at no load, -M^+ b. Raw
channels and loads are scaled to unit standard deviation for the solution, so that newtons and
newton metres, volts and counts have equal weight.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import convert, nearest, read_csv
from tactile_rt.core.stream import ArraySpec, Chunk

AXES = {"fx": "N", "fy": "N", "fz": "N", "mx": "N m", "my": "N m", "mz": "N m"}
RAW = "raw_"
TIMES = ("start_s", "end_s")
WORST = 5  # rows that `Fit.worst` lists
WEAK = 0.01  # least singular value of loads, relative to the largest; 1 / the largest condition


@dataclass(frozen=True, eq=False)
class LoadTable:
    """Table of known loads and of a sensor's readings under them, one load per row.

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
        """Unit of each loaded axis, N or N m."""
        return tuple(AXES[a] for a in self.axes)


def read_loads(path: Path) -> LoadTable:
    """Read a table of known loads from a .csv file."""
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


def median_readings(
    table: LoadTable, recorded: Chunk, spec: ArraySpec, element: str
) -> NDArray[np.float64]:
    """Return the median reading of an element under each load of a table, (row, channel).

    Args:
        recorded: raw samples; the table's times count from the first sample.

    Raises:
        ConfigError: no such element, or no valid sample in one of the ranges; names the line.
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


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted calibration matrix, with its quality.

    Attributes:
        matrix: (axis, channel) load per raw unit.
        tare: (channel,) raw reading at no load.
        residuals: (row, axis) known load minus fitted load, N and N m.
        rms: (axis,) root mean square of the residuals, N and N m.
        full_scale: (axis,) largest known load on each axis, N and N m.
        r_squared: (axis,) share of the known loads' variance that the matrix explains.
        condition: Condition number of the scaled readings: the largest factor by which errors in
            them are magnified.
        load_condition: Condition number of the scaled loads: 1 if every axis is loaded
            independently of the others.
        worst: Indices of the rows with the largest residuals relative to full scale, largest first.
        warnings: Reasons to doubt the matrix, a sentence each.
    """

    axes: tuple[str, ...]
    matrix: NDArray[np.float64]
    tare: NDArray[np.float64]
    residuals: NDArray[np.float64]
    rms: NDArray[np.float64]
    full_scale: NDArray[np.float64]
    r_squared: NDArray[np.float64]
    condition: float
    load_condition: float
    worst: tuple[int, ...]
    warnings: tuple[str, ...]


def calibrate(
    raw: ArrayLike,
    loads: ArrayLike,
    axes: Sequence[str] = ("fx", "fy", "fz", "mx", "my", "mz"),
    channels: Sequence[str] = (),
) -> Fit:
    """Fit the calibration matrix of one element to known loads.

    Args:
        raw: (row, channel) readings.
        loads: (row, axis) known loads, N and N m.
        channels: names of the readings, for messages; empty for numbers from 0.

    Raises:
        ConfigError: fewer rows than the fit has unknowns per axis, sizes that disagree, values that
            are not finite, or a reading that never changes.
    """
    x, y = np.asarray(raw, np.float64), np.asarray(loads, np.float64)
    if x.ndim != 2 or y.ndim != 2 or len(x) != len(y) or y.shape[1] != len(axes):
        raise ConfigError(f"readings {x.shape} and loads {y.shape} of {len(axes)} axes disagree")
    rows, inputs = x.shape
    names = list(channels) or [str(i) for i in range(inputs)]
    if rows < inputs + 1:
        raise ConfigError(
            f"{rows} loads for {inputs} channels and an offset: at least {inputs + 1}, better "
            f"{3 * inputs} are needed"
        )
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ConfigError("readings and loads must be finite")
    x0, y0 = x.mean(axis=0), y.mean(axis=0)
    x_scale, y_scale = _column_std(x), _column_std(y)
    for name, scale in zip(names, x_scale, strict=True):
        if scale == 0:
            raise ConfigError(f"channel {name} never changes: is it connected?")
    y_scale = np.where(y_scale > 0, y_scale, 1.0)
    design, targets = (x - x0) / x_scale, (y - y0) / y_scale
    solution, _, _, singular = np.linalg.lstsq(design, targets, rcond=None)
    matrix = solution.T * y_scale[:, None] / x_scale
    tare = x0 - np.linalg.pinv(matrix) @ y0
    residuals = y - (y0 + (x - x0) @ matrix.T)
    rms = np.sqrt(np.mean(residuals**2, axis=0))
    full_scale = np.abs(y).max(axis=0)
    shares = np.abs(residuals) / np.where(full_scale > 0, full_scale, 1.0)
    worst = np.argsort(-shares.max(axis=1), kind="stable")[:WORST]
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 else np.inf
    load_condition, warnings = _check_span(y, tuple(axes))
    if condition > 1 / WEAK:
        warnings.append(
            f"readings are nearly dependent (condition {condition:.3g}): errors in them are "
            "magnified; the loads may not span all axes, or channels may measure the same"
        )
    if len(axes) > inputs:
        warnings.append(
            f"{len(axes)} axes cannot be separated by {inputs} channels: leave some out"
        )
    if rows < 2 * (inputs + 1):
        warnings.append(
            f"{rows} loads are few for {inputs + 1} unknowns per axis: residuals look smaller than "
            "the errors of new loads are"
        )
    return Fit(
        tuple(axes),
        matrix,
        tare,
        residuals,
        rms,
        full_scale,
        1 - np.var(residuals, axis=0) / y_scale**2,
        condition,
        load_condition,
        tuple(worst.tolist()),
        tuple(warnings),
    )


def _column_std(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the standard deviation of each column, exactly 0 if the column is constant."""
    return np.where(np.ptp(values, axis=0) > 0, values.std(axis=0), 0.0)


def _check_span(loads: NDArray[np.float64], axes: tuple[str, ...]) -> tuple[float, list[str]]:
    """Return the condition number of the scaled loads, and warnings on missing directions."""
    scale = _column_std(loads)
    still = [a for a, s in zip(axes, scale, strict=True) if s == 0]
    warnings = [f"{a} is never loaded: it will read 0 whatever comes" for a in still]
    moving = scale > 0
    if not moving.any():
        raise ConfigError("all loads are the same; a table needs different ones")
    scaled = (loads[:, moving] - loads[:, moving].mean(axis=0)) / scale[moving]
    _, singular, directions = np.linalg.svd(scaled, full_matrices=False)
    names = [a for a, m in zip(axes, moving, strict=True) if m]
    for size, direction in zip(singular, directions, strict=True):
        if size < WEAK * singular[0]:
            together = [n for n, d in zip(names, direction, strict=True) if abs(d) > 0.2]
            warnings.append(
                f"{' and '.join(together)} were always loaded together: the matrix cannot tell "
                "them apart; add loads of one without the other"
            )
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0 and not still else np.inf
    return condition, warnings
