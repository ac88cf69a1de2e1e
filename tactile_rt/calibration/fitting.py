"""The calibration matrix of an element, by least squares from known loads.

The model is load = M (raw - tare): an affine map, fitted as load = M raw + b, so that neither the
loads nor the readings need a common zero. The tare is the raw reading of no load, -M^+ b. Raw
channels and loads are scaled to unit standard deviation for the solution, so that newtons and
newton metres, volts and counts weigh alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.errors import ConfigError

__all__ = ["Fit", "calibrate"]

WORST = 5
WEAK = 0.01  # least share of load that an axis must have of its own; conditions go with 1 / WEAK


@dataclass(frozen=True, eq=False)
class Fit:
    """A matrix and how well it does.

    Attributes:
        matrix: (axis, channel) load per raw unit.
        tare: (channel,) raw reading at no load.
        residuals: (row, axis) known load minus fitted load, N and N m.
        rms: (axis,) root mean square of the residuals, N and N m.
        full_scale: (axis,) largest known load on each axis, N and N m.
        r_squared: (axis,) share of the known loads' variance that the matrix explains.
        condition: Condition number of the scaled readings: how much errors in them can be
            magnified.
        load_condition: Condition number of the scaled loads: 1 if every axis is loaded apart from
            the others.
        worst: Rows with the largest residuals for their full scale, the worst first.
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
    """Fit the matrix of one element.

    Args:
        raw: (row, channel) readings.
        loads: (row, axis) known loads, N and N m.
        channels: names of the readings, for messages; empty: numbers from 0.

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
    x_scale, y_scale = _spread(x), _spread(y)
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
    load_condition, warnings = _span(y, tuple(axes))
    if condition > 1 / WEAK:
        warnings.append(
            f"readings are nearly dependent (condition {condition:.3g}): errors in them are "
            "magnified; the loads may not span all axes, or channels may measure the same"
        )
    if len(axes) > inputs:
        warnings.append(
            f"{len(axes)} axes cannot be told apart by {inputs} channels: leave some out"
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


def _spread(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation per column; exactly 0 of a constant one, whatever rounding says."""
    return np.where(np.ptp(values, axis=0) > 0, values.std(axis=0), 0.0)


def _span(loads: NDArray[np.float64], axes: tuple[str, ...]) -> tuple[float, list[str]]:
    """Condition of the scaled loads, and what is wrong with the directions they span."""
    scale = _spread(loads)
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
