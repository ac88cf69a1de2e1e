"""How much larger the readings of known loads are than the description predicts.

A ring tells nothing of gain, a known load does: one that pushes a whisker across, at a known place,
and is held still. Its direction is not asked for. Readings of such a load in any direction are
combinations of those of one along y and one along z, and the best combination of the two tells
direction and gain.
"""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.sensor_spec import SensorSpec
from tactile_rt.sim_backend.arrays.editing import Edit, rounded
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.measuring.findings import SIGMAS, ArrayFinding, Figure, about, pooled
from tactile_rt.sim_backend.measuring.resting import Rest
from tactile_rt.sim_backend.transducer import Transducer
from tactile_rt.stream import Chunk

__all__ = ["KnownLoad", "compare_gain", "readings"]

Floats = NDArray[np.float64]

LITTLE = 0.2  # of its place: beyond such a bend a lever is shorter than it was
ONE_WAY = 0.05  # of the best felt direction: what feels another one less feels one alone


class KnownLoad(NamedTuple):
    """A force that pushes a whisker across and is held.

    Attributes:
        whisker: The name of the whisker.
        force_n: The force across the whisker, N.
        at_mm: The arc length from the base at which it pushes, mm.
    """

    whisker: str
    force_n: float
    at_mm: float


def readings(sensor: SensorSpec, name: str, loads: Sequence[float]) -> Floats:
    """(channel,) readings of a whisker's (8,) loads, as `sensor_spec.LOADS`, as described."""
    now, there = np.zeros(1, np.int64), np.ones((1, 1), np.bool_)
    values = np.array([[loads]], dtype=np.float32)
    read = Transducer(sensor, (name,)).push(Chunk(now, now, values, there))
    assert read is not None
    found: Floats = read.values[0, 0].astype(np.float64)
    return found


def compare_gain(
    sensor: SensorSpec,
    whiskers: Mapping[str, Whisker],
    rests: Mapping[str, Rest],
    known: Sequence[KnownLoad],
) -> ArrayFinding:
    """The gain of all channels, from every known load.

    Args:
        sensor, whiskers: as they are described.
        rests: of the whiskers, by name.
        known: the loads that the longest stillness away from rest of each whisker is of.

    Raises:
        ConfigError: a load on a whisker that is not there or was never held still away from its
            rest, beyond its tip, that bends it too far, or that no channel feels.
    """
    if not known:
        note = "left: a known load tells it, --known WHISKER=NEWTON@MM"
        return ArrayFinding("gain", "", 1.0, None, note)
    for load in known:
        if load.whisker not in whiskers:
            there = ", ".join(whiskers)
            raise ConfigError(f"--known {load.whisker}: no such whisker; there are {there}")
    gains = [_gain(sensor, whiskers[k.whisker], rests.get(k.whisker), k) for k in known]
    figure, _ = pooled(gains, math.inf)
    if figure.low <= 1 <= figure.high:
        return ArrayFinding("gain", "", 1.0, figure)
    if sensor.matrix:
        return ArrayFinding("gain", "", 1.0, figure, "left: multiply [sensor.matrix] by it")
    edits = _multiplied(sensor, figure.value, f"gain {figure}")
    return ArrayFinding("gain", "", 1.0, figure, "", tuple(edits))


def _gain(sensor: SensorSpec, whisker: Whisker, rest: Rest | None, load: KnownLoad) -> Figure:
    """The gain by one load: that of the combination of its two directions that is felt."""
    who = f"--known {load.whisker}"
    if not (0 < load.at_mm <= whisker.length and load.force_n > 0):
        raise ConfigError(
            f"{who}: takes a force, 0.001 for a mN, and its place, 0 to {whisker.length:g} mm"
        )
    felt = _predicted(sensor, whisker, load)
    if not felt.any():
        raise ConfigError(f"{who}: by its description no channel feels a load across the whisker")
    if rest is None or not len(rest.held):
        raise ConfigError(f"{who}: nothing holds the whisker still in the recording")
    noise = np.maximum(np.hypot(rest.noise, rest.step / 12**0.5), 1e-30)
    moved = rest.held.mean(axis=0) / noise
    # What hardly feels a direction tells nothing of it: then the load is as one in the other.
    share, *_ = np.linalg.lstsq(felt / noise[:, None], moved, rcond=ONE_WAY)
    error = SIGMAS * float(np.linalg.norm(rest.jitter / noise) / np.linalg.norm(moved))
    return about(float(np.hypot(*share)), error)


def _predicted(sensor: SensorSpec, whisker: Whisker, load: KnownLoad) -> Floats:
    """(channel, 2) how readings change by the load along y, and along z."""
    force, at = load.force_n, 1e-3 * load.at_mm
    stiffness = 1e-6 * float(whisker.bending_stiffness(np.array([load.at_mm]))[0])  # N m^2
    gives = 1 / whisker.mount_stiffness if whisker.mount_stiffness else 0.0  # rad per N m
    if force * at**2 / (3 * stiffness) + force * at * gives > LITTLE:
        raise ConfigError(
            f"--known {load.whisker}: {force:g} N at {load.at_mm:g} mm bends it too far; take a "
            "lighter load, or one nearer to the base"
        )
    x, y, _ = 1e-3 * whisker.centreline(np.array([load.at_mm]))[0]
    rest = readings(sensor, whisker.name, [0.0] * 8)
    both = []
    for fy, fz in ((force, 0.0), (0.0, force)):
        mx, my, mz = y * fz, -x * fz, x * fy
        loads = [0.0, fy, fz, mx, my, mz, gives * my, gives * mz]
        both.append(readings(sensor, whisker.name, loads) - rest)
    return np.stack(both, axis=1)


def _multiplied(sensor: SensorSpec, gain: float, why: str) -> list[Edit]:
    """The description's sensitivities, each times a gain."""
    edits = []
    if sensor.magnet is not None:
        moment = rounded(gain * sensor.magnet.moment_a_m2)
        edits.append(Edit(("sensor", "magnet", "moment_a_m2"), moment, why))
    for k, channel in enumerate(sensor.channels):
        if not channel.field:
            of = channel.of or {channel.name: 1.0}
            new = {load: rounded(gain * value) for load, value in of.items()}
            edits.append(Edit(("sensor", "channel", k, "of"), new, why))
    return edits
