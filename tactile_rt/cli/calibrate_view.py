"""What `tactile-rt tare` and `calibrate` show of what they measured."""

from typing import TYPE_CHECKING

import numpy as np
import typer

if TYPE_CHECKING:
    from rich.console import Console

    from tactile_rt.calibration import Calibration, Fit, LoadTable, Tare

__all__ = ["show_fit", "show_tare", "show_uncalibrated"]


def show_tare(measured: "Tare", console: "Console") -> None:
    """Offsets and noise, channel by channel."""
    from rich.markup import escape
    from rich.table import Table

    spec = measured.spec
    counted = np.array([e not in measured.untared for e in spec.elements])
    offset, noise = measured.offset[counted], measured.noise[counted]
    names = [e for e, there in zip(spec.elements, counted, strict=True) if there]
    table = Table("channel", "unit", "offset", "noise (median)", "noisiest", box=None)
    for c, (channel, unit) in enumerate(zip(spec.channels, spec.units, strict=True)):
        low, high = offset[:, c].min(), offset[:, c].max()
        span = f"{low:.4g}" if len(names) == 1 else f"{low:.4g} to {high:.4g}"
        most = int(noise[:, c].argmax())
        table.add_row(
            *map(escape, (channel, unit, span, f"{np.median(noise[:, c]):.2g}")),
            escape(f"{names[most]} {noise[most, c]:.2g}"),
        )
    console.print(table)


def show_fit(fit: "Fit", loads: "LoadTable", console: "Console") -> None:
    """Residuals per axis, conditions, worst lines and warnings."""
    from rich.markup import escape
    from rich.table import Table

    table = Table("axis", "unit", "full scale", "residual RMS", "of full scale", "R²", box=None)
    rows = zip(fit.axes, loads.units, fit.full_scale, fit.rms, fit.r_squared, strict=True)
    for axis, unit, full, rms, explained in rows:
        share = f"{100 * rms / full:.2g} %" if full else "-"
        table.add_row(
            axis, unit, f"{full:.4g}", f"{rms:.2g}", share, f"{explained:.6f}" if full else "-"
        )
    console.print(table)
    console.print(
        f"{len(loads.lines)} loads; condition number {fit.condition:.3g} of the readings, "
        f"{fit.load_condition:.3g} of the loads",
        soft_wrap=True,
    )
    for row in fit.worst[:3]:
        left = ", ".join(
            f"{a} {r:+.2g} {u}"
            for a, r, u in zip(fit.axes, fit.residuals[row], loads.units, strict=True)
        )
        console.print(f"worst: line {loads.lines[row]}, off by {left}", soft_wrap=True)
    for warning in fit.warnings:
        console.print(f"[yellow]warning[/]: {escape(warning)}", soft_wrap=True)


def show_uncalibrated(calibration: "Calibration") -> None:
    """Name the elements that cannot be used yet, if there are any."""
    if calibration.uncalibrated:
        typer.echo(
            f"without a matrix, and so never valid: {', '.join(calibration.uncalibrated)}", err=True
        )
