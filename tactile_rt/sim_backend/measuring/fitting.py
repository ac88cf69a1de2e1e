"""Fit of an array's file to a recording of the device."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from tactile_rt.core.errors import ConfigError, SpecMismatch, name_some
from tactile_rt.core.settings import find_lines, parse_toml, read_text, read_toml
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk
from tactile_rt.core.stream.sensor_spec import SensorSpec
from tactile_rt.sim_backend.arrays.files import load_array, read_animals
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.measuring.findings import (
    MANY,
    SIGMAS,
    ArrayFinding,
    Edit,
    Figure,
    compare_sensor,
)
from tactile_rt.sim_backend.measuring.mechanics import compare_whiskers
from tactile_rt.sim_backend.measuring.resting import Rest, find_rest
from tactile_rt.sim_backend.measuring.ringing import Ring, find_swings, fit_ring
from tactile_rt.sim_backend.transducer import Transducer, device_spec

MISSING = 0.1  # of a recording's samples, at most
LEAST = 64  # samples
LINE = re.compile(r"(\s*[\w-]+\s*=\s*)(?:\{[^}]*\}|[^#{]*?)(\s*)(#.*)?")
MEASURED = re.compile(r"(;\s*|#\s*)measured: .*")


class Fitted(NamedTuple):
    """Findings about a recorded array, and the text of its file with corrected values."""

    findings: list[ArrayFinding]
    text: str


def read_described(path: Path, spec: ArraySpec) -> WhiskerArray:
    """Read an array from a .toml file; raise an error if a recording's spec differs."""
    if path.suffix.lower() != ".toml":
        raise ConfigError(f"{path}: an array that says what reads it is a .toml file")
    array = load_array(str(path))
    if "animal" in read_toml(path).value:
        raise ConfigError(f"{path} places animals of other files: name the array's own file")
    if array.sensor is None:
        channels = ", ".join(f"{c} ({u})" for c, u in zip(spec.channels, spec.units, strict=True))
        raise ConfigError(
            f"{path} has no [sensor]: add rate_hz and a [[sensor.channel]] for each of {channels}, "
            "with its unit, its range, which no recording shows, and a guess of its noise_density"
        )
    ours = device_spec((array,))
    where = f"the recording is not of {path}"
    if off := ours.differences(spec, tuple({*spec.__dataclass_fields__} - {"channels", "units"})):
        raise SpecMismatch(f"{where}: {off[0]}")
    if strange := [e for e in spec.elements if e not in ours.elements]:
        raise SpecMismatch(f"{where}, which has no whisker {strange[0]}")
    return array


def fit_array(path: Path, spec: ArraySpec, recorded: Chunk) -> Fitted:
    """Measure a recorded array; return findings and the corrected text of its file.

    Raises:
        ConfigError: too few samples, too many missing, no whisker is at rest for 3 s, or see
            `read_described`.
    """
    array = read_described(path, spec)
    sensor = array.sensor
    assert sensor is not None
    rate = _measure_rate(recorded)
    rests, rings = _measure_whiskers(spec, recorded, rate.value, sensor.bandwidth_hz)
    text = read_text(path)
    whiskers = [w for w in array.whiskers if w.name in spec.elements]
    untouched = {name: _predict_rest(sensor, name) for name in rests}
    findings = [
        *compare_sensor(sensor, rate, rests, untouched),
        *compare_whiskers(whiskers, rings, rate.value, _read_tables(text)),
    ]
    if restless := [e for e in spec.elements if e not in rests]:
        note = f"never at rest for 3 s, or often invalid: {name_some(restless, MANY)}"
        findings.append(ArrayFinding("rest", "", None, None, note))
    findings += _find_out_of_range(sensor, recorded)
    text = edit_text(path, text, [e for f in findings for e in f.edits])
    read_animals(path, text)  # invalid values raise now, not when the file is written
    return Fitted(findings, text)


def _predict_rest(sensor: SensorSpec, name: str) -> NDArray[np.float64]:
    """Return the (channel,) readings that the description predicts for an unloaded whisker."""
    now, there = np.zeros(1, np.int64), np.ones((1, 1), np.bool_)
    read = Transducer(sensor, (name,)).push(Chunk(now, now, np.zeros((1, 1, 8), np.float32), there))
    assert read is not None
    return np.asarray(read.values[0, 0].astype(np.float64))


def _find_out_of_range(sensor: SensorSpec, recorded: Chunk) -> list[ArrayFinding]:
    """Report channels whose readings exceed twice their range, the most that a tare explains."""
    largest = np.nanmax(np.abs(recorded.values[recorded.valid]), axis=0, initial=0.0)
    return [
        ArrayFinding(
            f"range of {c.name}", c.unit, c.range, None,
            f"reads up to {value:.3g}: is the recording in {c.unit}, and is that the range?",
        )
        for c, value in zip(sensor.channels, largest.tolist(), strict=True)
        if value > 2 * c.range
    ]  # fmt: skip


def _read_tables(text: str) -> dict[str, tuple[int, Mapping[str, Any]]]:
    """Parse a file's whisker tables: the number and content of each, by whisker name."""
    file = parse_toml(text, "array").plain()
    sides = ("R.", "L.") if file.get("mirror") else ("",)
    return {
        f"{side}{values['whisker'].strip()}": (number, values)
        for number, values in enumerate(file["whisker"])
        for side in sides
    }


def _measure_whiskers(
    spec: ArraySpec, recorded: Chunk, hz: float, bandwidth_hz: float
) -> tuple[dict[str, Rest], dict[str, list[Ring]]]:
    rests: dict[str, Rest] = {}
    away: list[NDArray[np.float32]] = []
    for i, name in enumerate(spec.elements):
        values = _fill_gaps(recorded, i)
        rest = None if values is None else find_rest(values, hz, bandwidth_hz)
        if values is None or rest is None:
            away.append(np.zeros((0, spec.shape[1]), np.float32))
            continue
        rests[name] = rest
        at_s = np.arange(len(values)) / hz
        levels = [np.interp(at_s, rest.at_s, of_channel) for of_channel in rest.levels.T]
        noise = np.hypot(rest.noise, rest.step / 12**0.5)
        noise[noise == 0] = np.inf
        away.append(((values - np.stack(levels, axis=1)) / noise).astype(np.float32))
    if not rests:
        raise ConfigError(
            f"{spec.name}: no whisker is valid, and at rest for 3 s; record the array untouched "
            "for a minute, then pluck its whiskers, with some seconds between"
        )
    rings: dict[str, list[Ring]] = {}
    for swing in find_swings(away, hz):
        ring = fit_ring(away[swing.element][swing.begin : swing.end], hz)
        if ring is not None:
            rings.setdefault(spec.elements[swing.element], []).append(ring)
    return rests, rings


def _measure_rate(recorded: Chunk) -> Figure:
    """Measure the sample rate, Hz: the slope of sample numbers over time stamps."""
    if len(recorded) < LEAST:
        raise ConfigError(f"the recording has {len(recorded)} samples; at least {LEAST} are needed")
    count = int(recorded.seq[-1] - recorded.seq[0]) + 1
    if len(recorded) < (1 - MISSING) * count:
        raise ConfigError(
            f"the recording lacks {count - len(recorded)} of {count} samples: see `tactile-rt hz`"
        )
    t_s = (recorded.t_ns - recorded.t_ns[0]) / NS_PER_S
    if not t_s[-1] > 0:
        raise ConfigError("the recording's time stamps do not advance")
    line = stats.linregress(recorded.seq - recorded.seq[0], t_s)
    error = SIGMAS * line.stderr / line.slope
    return Figure(1 / line.slope, (1 - error) / line.slope, (1 + error) / line.slope)


def _fill_gaps(recorded: Chunk, element: int) -> NDArray[np.float32] | None:
    """Interpolate an element's (n, channel) readings over gaps; None if too many are missing."""
    valid = recorded.valid[:, element] & np.isfinite(recorded.values[:, element]).all(axis=1)
    seq = recorded.seq[valid] - recorded.seq[0]
    values: NDArray[np.float32] = recorded.values[valid, element]
    count = int(recorded.seq[-1] - recorded.seq[0]) + 1
    if len(seq) < (1 - MISSING) * count:
        return None
    if len(seq) < count:
        every = np.arange(count)
        filled = [np.interp(every, seq, of_channel) for of_channel in values.T]
        values = np.stack(filled, axis=1).astype(np.float32)
    return values


def edit_text(path: Path, text: str, edits: Sequence[Edit]) -> str:
    """Return the text of an array's file with edited values; comments and layout stay.

    A regular expression changes each line, which may fail on valid TOML. So the new text is parsed
    again, and a `ConfigError` raised unless just these numbers differ.
    """
    ending = "\r\n" if "\r\n" in text else "\n"
    text = text.replace("\r\n", "\n")
    expected = parse_toml(text, str(path)).plain()
    for edit in edits:
        at: Any = expected
        for part in edit.path[:-1]:
            at = at[part] if isinstance(part, int) else at.setdefault(part, {})
        at[edit.path[-1]] = edit.value
        text = _write_edit(text, edit)
        try:
            same = parse_toml(text, str(path)).plain() == expected
        except ConfigError:
            same = False
        if not same:
            raise ConfigError(
                f"{path}: cannot change {edit.path[-1]} as it is written there; put "
                f"{edit.path[-1]} = {edit.value:g} into its table by hand"
            )
    return text.replace("\n", ending)


def _write_edit(text: str, edit: Edit) -> str:
    lines, numbers = text.split("\n"), find_lines(text)
    table, note = edit.path[:-1], f"measured: {edit.why}"
    new = f"{edit.path[-1]} = {edit.value:g} # {note}"
    if edit.path in numbers:
        at = numbers[edit.path] - 1
        if found := LINE.fullmatch(lines[at]):
            key, gap, comment = found.groups()
            kept = MEASURED.sub("", comment or "").rstrip()
            comment = f"{kept}; {note}" if kept else f"# {note}"
            lines[at] = f"{key}{edit.value:g}{gap or ' '}{comment}"
    elif table in numbers:
        keys = [n for p, n in numbers.items() if p[:-1] == table and lines[n - 1].strip()[0] != "["]
        lines.insert(max([numbers[table], *keys]), new)
    else:
        lines += [f"[{'.'.join(map(str, table))}]", new, ""]
    return "\n".join(lines)
