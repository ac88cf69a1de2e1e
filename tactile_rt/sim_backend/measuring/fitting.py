"""An array's file brought to what a recording of the device tells."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tactile_rt.errors import ConfigError, SpecMismatch
from tactile_rt.sensor_spec import SensorSpec
from tactile_rt.settings import parse_toml, read_text, read_toml
from tactile_rt.sim_backend.arrays.editing import edited
from tactile_rt.sim_backend.arrays.files import load_array, read_animals
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.measuring.channels import compare_sensor
from tactile_rt.sim_backend.measuring.findings import ArrayFinding, listed
from tactile_rt.sim_backend.measuring.gains import KnownLoad, compare_gain, readings
from tactile_rt.sim_backend.measuring.measured import measure
from tactile_rt.sim_backend.measuring.mechanics import compare_whiskers
from tactile_rt.sim_backend.transducer import device_spec
from tactile_rt.stream import ArraySpec, Chunk

__all__ = ["Fitted", "fit_array", "read_described"]


class Fitted(NamedTuple):
    """An array's description beside a recording of the array.

    Attributes:
        findings: Everything that was compared.
        text: The array's file, brought to what was measured.
    """

    findings: list[ArrayFinding]
    text: str


def read_described(path: Path, spec: ArraySpec) -> WhiskerArray:
    """The array of a file, if a recording can be compared with it.

    Args:
        path: of a .toml file.
        spec: what the recording is of.

    Raises:
        ConfigError: no such file, a mistake in it, or it does not describe a sensor.
        SpecMismatch: the recording is of another array.
    """
    if path.suffix.lower() != ".toml":
        raise ConfigError(f"{path}: an array that says what reads it is a .toml file")
    array = load_array(str(path))
    if "animal" in read_toml(path).value:
        raise ConfigError(f"{path} places animals of other files: name the array's own file")
    if array.sensor is None:
        channels = ", ".join(f"{c} ({u})" for c, u in zip(spec.channels, spec.units, strict=True))
        raise ConfigError(
            f"{path} has no [sensor]: add rate_hz and a [[sensor.channel]] for each of {channels}, "
            "with its unit, its range, which no recording tells, and a guess of its noise_density"
        )
    ours = device_spec((array,))
    where = f"the recording is not of {path}"
    if off := ours.differences(spec, tuple({*spec.__dataclass_fields__} - {"channels", "units"})):
        raise SpecMismatch(f"{where}: {off[0]}")
    if strange := [e for e in spec.elements if e not in ours.elements]:
        raise SpecMismatch(f"{where}, which has no whisker {strange[0]}")
    return array


def fit_array(
    path: Path, spec: ArraySpec, recorded: Chunk, known: Sequence[KnownLoad] = ()
) -> Fitted:
    """Measure an array, and bring its description to that; nothing is written.

    Args:
        path: the array's .toml file.
        spec: what the samples are of.
        recorded: all samples, of the array at rest and of its whiskers plucked.
        known: the loads that the longest stillness away from rest of some whiskers is of.

    Raises:
        ConfigError, SpecMismatch: as `read_described`, `measure` and `compare_gain`.
    """
    array = read_described(path, spec)
    sensor = array.sensor
    assert sensor is not None
    measured = measure(spec, recorded, sensor.bandwidth_hz)
    text = read_text(path)
    whiskers = [w for w in array.whiskers if w.name in spec.elements]
    swings, fitted = compare_whiskers(whiskers, measured.rings, measured.rate.value, _tables(text))
    gain = compare_gain(sensor, fitted, measured.rests, known)
    larger = gain.measured.value if gain.measured and gain.edits else 1.0
    untouched = {name: larger * readings(sensor, name, [0.0] * 8) for name in measured.rests}
    findings = [*compare_sensor(sensor, measured, untouched), gain, *swings]
    if restless := [e for e in spec.elements if e not in measured.rests]:
        note = f"never at rest for 3 s, or often invalid: {listed(restless)}"
        findings.append(ArrayFinding("rest", "", None, None, note))
    findings += _beyond_range(sensor, recorded)
    text = edited(path, text, [e for f in findings for e in f.edits])
    read_animals(path, text)  # what no array can have is told now, not when the file is written
    return Fitted(findings, text)


def _beyond_range(sensor: SensorSpec, recorded: Chunk) -> list[ArrayFinding]:
    """The channels that read what they cannot by their description, even after a tare."""
    largest = np.nanmax(np.abs(recorded.values[recorded.valid]), axis=0, initial=0.0)
    return [
        ArrayFinding(
            f"range of {c.name}", c.unit, c.range, None,
            f"reads up to {value:.3g}: is the recording in {c.unit}, and is that the range?",
        )
        for c, value in zip(sensor.channels, largest.tolist(), strict=True)
        if value > 2 * c.range
    ]  # fmt: skip


def _tables(text: str) -> dict[str, tuple[int, Mapping[str, Any]]]:
    """The number and the content of every whisker's table, by its name in the stream."""
    file = parse_toml(text, "array").plain()
    sides = ("R.", "L.") if file.get("mirror") else ("",)
    return {
        f"{side}{values['whisker'].strip()}": (number, values)
        for number, values in enumerate(file["whisker"])
        for side in sides
    }
