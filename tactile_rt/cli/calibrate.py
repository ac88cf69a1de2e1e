"""`tactile-rt tare` and `calibrate`: measure a device's calibration and store it by its id."""

import re
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from tactile_rt.cli.app import app, check_output, open_url
from tactile_rt.cli.options import STDOUT, Json, Url, argument, option
from tactile_rt.cli.tables import print_table, progress_bar, told_as_json
from tactile_rt.core.errors import ConfigError, name_some

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tactile_rt.calibration import Calibration, Fit, LoadTable, Tare
    from tactile_rt.core.stream import ArraySpec, Chunk, Source

LOUDER = 3.0  # times the noise of the last tare: more prints a warning


@app.command(epilog="tactile-rt tare 'serial:///dev/ttyUSB0?codec=bota'")
def tare(
    source: Url,
    seconds: Annotated[float, option("How long to read, s.", min=0.01, max=3600)] = 2.0,
    device: Annotated[str, option("Id of the device. Default: the id that it reports.")] = "",
    out: Annotated[
        Path | None, option("TOML file to write or update. Default: the device's own.")
    ] = None,
    json: Json = None,
) -> None:
    """Measure the zero of an untouched sensor and store it.

    Refused if an element is touched or drifts meanwhile. Matrices, mapping and mirror in the
    device's file are kept.
    """
    from tactile_rt.calibration import Calibration, calibration_path, save_calibration
    from tactile_rt.calibration import tare as measure

    check_output(out)
    with open_url(source) as opened:
        raw, before = _find_raw(opened, source)
        name = device or (before.device if before else _find_id(raw))
        path = out or calibration_path(name)
        known = _load_existing(path, device) or before or Calibration.of(name, raw.spec)
        known.output_spec(raw.spec)  # refuses another array before samples are read
        with progress_bar(f"do not touch {raw.spec.name}"):
            measured = measure(raw, seconds)
    untared = set(measured.untared)
    tared = [i for i, e in enumerate(raw.spec.elements) if e not in untared]
    new = {raw.spec.elements[i]: _round_row(measured.offset[i]) for i in tared}
    noise = {raw.spec.elements[i]: _round_row(measured.noise[i]) for i in tared}
    louder = [e for e in noise if _is_louder(noise[e], known.noise.get(e, ()))]
    known = known.with_note(
        f"{_now()} tare: {measured.seconds:.3g} s, {measured.samples.max()} samples",
        tare={**known.tare, **new},
        noise={**known.noise, **noise},
        changes=round(measured.changes, 4),
    )
    save_calibration(known, path if out else None)
    results = {
        "device": known.device, "file": path, "seconds": measured.seconds,
        "channels": raw.spec.channels, "units": raw.spec.units, "offset": new, "noise": noise,
        "untared": measured.untared, "louder": louder,
    }  # fmt: skip
    if not told_as_json(results, json):
        _show_tare(measured)
    if untared:
        typer.echo(f"not tared, too few valid samples: {', '.join(measured.untared)}", err=True)
    if louder:
        typer.echo(
            f"more than {LOUDER:g} times as noisy as when last tared: {', '.join(louder)}; did "
            "the array shake? then tare again",
            err=True,
        )
    _show_uncalibrated(known)
    typer.echo(f"tare of {known.device} written to {path}", err=json == STDOUT)


@app.command(epilog="tactile-rt calibrate loads.csv --device my-sensor")
def calibrate(
    table: Annotated[Path, argument("CSV file: loads fx..mz, and raw_... or start_s,end_s.")],
    element: Annotated[str, option("Element that was loaded. Default: the only one.")] = "",
    source: Annotated[str, option("URL of the recording that start_s and end_s refer to.")] = "",
    device: Annotated[str, option("Id of the device whose file to update.")] = "",
    out: Annotated[
        Path | None, option("TOML file to write or update. Default: the file of --device.")
    ] = None,
    json: Json = None,
) -> None:
    """Fit an element's calibration matrix to known loads.

    Fits by least squares and prints the residuals. Without --device and --out nothing is written.
    """
    from tactile_rt.calibration import (
        Calibration,
        calibration_path,
        median_readings,
        read_loads,
        save_calibration,
    )
    from tactile_rt.calibration import calibrate as fit_loads

    check_output(out)
    loads = read_loads(table)
    path = out or (calibration_path(device) if device else None)
    known = _load_existing(path, device) if path else None
    if len(loads.times):
        recorded, spec = _read_samples(table, loads, source)
        fresh = Calibration.of(device or (path.stem if path else "unnamed"), spec)
    elif source:
        raise ConfigError(f"{table} has readings: leave out --source")
    else:
        fresh = Calibration(
            device or (path.stem if path else "unnamed"),
            (element or "A0",),
            loads.channels,
            ("1",) * len(loads.channels),
        )
    target = known or fresh
    if not element and len(target.elements) > 1:
        raise ConfigError(f"--element: name the loaded one of {name_some(target.elements)}")
    element = element or target.elements[0]
    try:
        if len(loads.times):
            raw = median_readings(loads, recorded, spec, element)
        else:
            raw = loads.raw
        raw = raw[:, _match_channels(fresh.channels, target)]
        fit = fit_loads(raw, loads.loads, loads.axes, target.channels)
    except ConfigError as error:
        raise ConfigError(f"{table}: {error}") from None
    made = None
    if path:
        made = _add_fit(target, element, fit, loads, table)
        save_calibration(made, path if out else None)
    results = {
        "device": target.device, "element": element, "file": path, "units": loads.units,
        "lines": loads.lines, **vars(fit),
    }  # fmt: skip
    if not told_as_json(results, json):
        _show_fit(fit, loads)
    if made:
        _show_uncalibrated(made)
        message = f"matrix of {made.device}, element {element}, written to {path}"
    else:
        message = "not written: name a --device or a file (--out)"
    typer.echo(message, err=json == STDOUT)


def _find_id(source: "Source") -> str:
    """Return a device's id, or else its array's name, as a valid file name."""
    own = str(getattr(source, "device_id", "") or source.spec.name)
    return re.sub(r"[^\w.:+-]+", "-", own).lstrip(".")


def _load_existing(path: Path, device: str) -> "Calibration | None":
    from tactile_rt.calibration import load_calibration

    if not path.exists():
        return None
    known = load_calibration(path)
    if device not in ("", known.device):
        raise ConfigError(f"{path} is of device {known.device}, not {device}: name another --out")
    return known


def _read_samples(table: Path, loads: "LoadTable", url: str) -> "tuple[Chunk, ArraySpec]":
    """Read a recording's raw samples up to a table's last time; return its spec, too."""
    from tactile_rt.calibration.tare_measurement import record
    from tactile_rt.core.stream import concatenate

    if not url:
        raise ConfigError(f"{table} has times: name the recording they are in with --source")
    with open_url(url) as opened:
        raw, _ = _find_raw(opened, url)
        return concatenate(record(raw, float(loads.times.max()))), raw.spec


def _find_raw(source: "Source", url: str) -> "tuple[Source, Calibration | None]":
    """Return the raw source inside a calibrated source, and its calibration or None."""
    from tactile_rt.calibration import CalibratedSource

    known = None
    while isinstance(source, CalibratedSource):
        known, source = source.calibration, source.source
    if getattr(source, "calibrated", False):
        raise ConfigError(f"{url}: its samples are calibrated: from=wire gives the raw ones")
    return source, known


def _match_channels(channels: tuple[str, ...], known: "Calibration") -> list[int]:
    """Return the table's column of each raw channel that the calibration has."""
    for channel in (*known.channels, *channels):
        if channel in channels and channel in known.channels:
            continue
        what = f"no reading raw_{channel}" if channel in known.channels else f"raw_{channel}"
        raise ConfigError(f"{what}; {known.device} has channels {', '.join(known.channels)}")
    return [channels.index(c) for c in known.channels]


def _add_fit(
    known: "Calibration", element: str, fit: "Fit", loads: "LoadTable", table: Path
) -> "Calibration":
    if element not in known.elements:
        raise ConfigError(
            f"--element: {known.device} has no {element!r}; there are {name_some(known.elements)}"
        )
    if known.matrices.keys() - {element} and known.output != (loads.axes, loads.units):
        raise ConfigError(
            f"{table} has loads {', '.join(loads.axes)}; the other elements of {known.device} are "
            f"calibrated for {', '.join(known.output[0])}: give the same columns"
        )
    return known.with_note(
        f"{_now()} matrix of {element}: {len(loads.loads)} loads, condition {fit.condition:.3g}",
        output_channels=loads.axes,
        output_units=loads.units,
        gain=known.gain if len(known.channels) == len(loads.axes) else (),
        tare={**known.tare, element: _round_row(fit.tare)},
        matrices={**known.matrices, element: tuple(map(_round_row, fit.matrix))},
    )


def _round_row(row: "NDArray[np.float64]") -> tuple[float, ...]:
    # two digits more than float32 holds: people read the file
    return tuple(float(f"{v:.9g}") for v in row)


def _is_louder(noise: tuple[float, ...], before: tuple[float, ...]) -> bool:
    return any(now > LOUDER * then > 0 for now, then in zip(noise, before, strict=False))


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


def _show_tare(measured: "Tare") -> None:
    import numpy as np

    spec = measured.spec
    tared = np.array([e not in measured.untared for e in spec.elements])
    offset, noise = measured.offset[tared], measured.noise[tared]
    names = [e for e, use in zip(spec.elements, tared, strict=True) if use]
    table = Table("channel", "unit", "offset", "noise (median)", "noisiest", box=None)
    for c, (channel, unit) in enumerate(zip(spec.channels, spec.units, strict=True)):
        low, high = offset[:, c].min(), offset[:, c].max()
        span = f"{low:.4g}" if len(names) == 1 else f"{low:.4g} to {high:.4g}"
        most = int(noise[:, c].argmax())
        table.add_row(
            *map(escape, (channel, unit, span, f"{np.median(noise[:, c]):.2g}")),
            escape(f"{names[most]} {noise[most, c]:.2g}"),
        )
    print_table(table)


def _show_fit(fit: "Fit", loads: "LoadTable") -> None:
    table = Table("axis", "unit", "full scale", "residual RMS", "of full scale", "R²", box=None)
    rows = zip(fit.axes, loads.units, fit.full_scale, fit.rms, fit.r_squared, strict=True)
    for axis, unit, full, rms, explained in rows:
        share = f"{100 * rms / full:.2g} %" if full else "-"
        table.add_row(
            axis, unit, f"{full:.4g}", f"{rms:.2g}", share, f"{explained:.6f}" if full else "-"
        )
    print_table(table)
    typer.echo(
        f"{len(loads.lines)} loads; condition number {fit.condition:.3g} of the readings, "
        f"{fit.load_condition:.3g} of the loads"
    )
    for row in fit.worst[:3]:
        left = ", ".join(
            f"{a} {r:+.2g} {u}"
            for a, r, u in zip(fit.axes, fit.residuals[row], loads.units, strict=True)
        )
        typer.echo(f"worst: line {loads.lines[row]}, off by {left}")
    for warning in fit.warnings:
        typer.echo(f"{typer.style('warning', fg='yellow')}: {warning}")


def _show_uncalibrated(calibration: "Calibration") -> None:
    if calibration.uncalibrated:
        typer.echo(
            f"without a matrix, and so never valid: {', '.join(calibration.uncalibrated)}", err=True
        )
