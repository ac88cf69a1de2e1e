"""Conversion of whisker loads into the readings of an array's own sensor, at the sensor's rate.

    loads, turns at 1 kHz -> sensitivity, or the field of a magnet -> low-pass -> sampling

Noise, offset, drift, rounding and saturation come after it: see `sensor.Sensor`.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.core.stream.sensor_spec import FIELD, MagnetSpec, SensorSpec, channel_limits
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.world import SAMPLE_MS, world_spec

FORCES_MOMENTS = 6
MU0_4PI = 1e-7  # of the vacuum's permeability, T m / A
FASTEST_HZ = 1e3 / SAMPLE_MS

Floats = NDArray[np.float64]


def sensor_of(animals: Sequence[WhiskerArray]) -> SensorSpec | None:
    """Return the sensor of all whiskers in one world; None if base loads are delivered.

    Raises:
        ConfigError: the arrays have different sensors, or the sensor samples faster than the
            simulation, reads the rotation of rigid mounts, or has a matrix for a whisker that
            does not exist.
    """
    sensors = [animal.sensor for animal in animals]
    first = sensors[0]
    if first is None:
        if any(sensors):
            raise ConfigError("one array of the world has a [sensor] and another has none")
        return None
    matrix: dict[str, tuple[tuple[float, ...], ...]] = {}
    for animal in animals:
        if animal.sensor is None or replace(animal.sensor, matrix={}) != replace(first, matrix={}):
            raise ConfigError("the arrays of one world must have the same [sensor], or none")
        matrix.update(animal.sensor.matrix)
    names = {w.name for animal in animals for w in animal.whiskers}
    if strange := sorted(set(matrix) - names):
        raise ConfigError(f"sensor: matrix of {strange[0]!r}: there is no such whisker")
    if first.rate_hz > FASTEST_HZ:
        raise ConfigError(
            f"sensor: rate_hz must be at most {FASTEST_HZ:g}, the simulation's own, not "
            f"{first.rate_hz:g}; describe a faster one at {FASTEST_HZ:g}"
        )
    whole = replace(first, matrix=matrix)
    if whole.feels_turns:
        for animal in animals:
            if stiff := [w.name for w in animal.whiskers if not w.mount_stiffness]:
                raise ConfigError(
                    f"sensor: reads how far bases turn, but the mount of whisker {stiff[0]} of "
                    f"{animal.name} is rigid; give it mount_stiffness_nm_rad"
                )
    return whole


def device_spec(animals: Sequence[WhiskerArray]) -> ArraySpec:
    """Describe the output of all arrays in one world: sensor readings, else base loads."""
    spec, sensor = world_spec(animals), sensor_of(animals)
    if sensor is None:
        return spec
    return replace(
        spec,
        channels=tuple(c.name for c in sensor.channels),
        units=tuple(c.unit for c in sensor.channels),
        rate_hz=sensor.rate_hz,
    )


def sensor_drift(animals: Sequence[WhiskerArray], period_ms: float) -> float:
    """Return the largest ratio of a channel's drift to its rated noise.

    Args:
        period_ms: the period of the samples that carry the noise, ms.
    """
    sensor = sensor_of(animals)
    if sensor is None:
        return 0.0
    period_ns = round(max(period_ms, 1e3 / sensor.rate_hz) * 1e6)
    noise = channel_limits(device_spec(animals), sensor, period_ns).noise
    return max(c.drift / float(n) for c, n in zip(sensor.channels, noise, strict=True))


class Transducer:
    """A sensor applied to one stream of loads, without its noise and limits.

    The result does not depend on how the samples were cut into chunks.
    """

    def __init__(self, sensor: SensorSpec, elements: Sequence[str]) -> None:
        self._sensor = sensor
        self._sensitivity = np.array([sensor.sensitivity(name) for name in elements])
        self._axes = [FIELD.index(c.field) if c.field else -1 for c in sensor.channels]
        self._decay = np.exp(-2e-3 * np.pi * sensor.bandwidth_hz * SAMPLE_MS)
        self._filtered: Floats | None = None
        self._start_ns: int | None = None
        self._taken = 0  # of the device's samples
        self._last: tuple[int, Floats] | None = None  # time and readings of the newest sample

    def push(self, chunk: Chunk) -> Chunk | None:
        """Feed loads to the sensor; return the samples that are due, or None.

        Args:
            chunk: (n, element, load) loads at 1 kHz, the first six of `sensor_spec.LOADS` or all.
        """
        readings = self.read(chunk.values.astype(np.float64))
        if self._sensor.bandwidth_hz:
            from scipy.signal import lfilter  # imported here, because the import is slow

            keeps = self._decay
            if self._filtered is None:  # starts in steady state
                self._filtered = keeps * readings[:1]
            readings, self._filtered = lfilter(
                [1 - keeps], [1, -keeps], readings, axis=0, zi=self._filtered
            )
        times = chunk.t_ns
        if self._start_ns is None:
            self._start_ns = int(times[0])
        if self._last is not None:
            times = np.concatenate([[self._last[0]], times])
            readings = np.concatenate([self._last[1], readings])
        self._last = (int(times[-1]), readings[-1:])
        due = self._take_due(int(times[-1]))
        if not len(due):
            return None
        # Linear interpolation between the simulation's samples.
        at = np.searchsorted(times, due, side="right") - 1
        after = np.minimum(at + 1, len(times) - 1)
        share = (due - times[at]) / np.maximum(times[after] - times[at], 1)
        values = readings[at] + share[:, None, None] * (readings[after] - readings[at])
        seq = self._taken - len(due) + np.arange(len(due), dtype=np.int64)
        valid = np.ones(values.shape[:2], dtype=np.bool_)
        return Chunk(seq, due, values.astype(np.float32), valid)

    def _take_due(self, until_ns: int) -> NDArray[np.int64]:
        """Return the times of the samples due by `until_ns`, ns, and count them as delivered."""
        assert self._start_ns is not None
        period = 1e9 / self._sensor.rate_hz
        count = int((until_ns - self._start_ns) / period) + 2 - self._taken
        times = self._start_ns + np.rint((self._taken + np.arange(count)) * period)
        due: NDArray[np.int64] = times[times <= until_ns].astype(np.int64)
        self._taken += len(due)
        return due

    def read(self, loads: Floats) -> Floats:
        """Convert loads (n, element, load) to readings (n, element, channel), before filtering."""
        readings = np.zeros((*loads.shape[:2], self._sensitivity.shape[1]))
        # Sums in a fixed order: a matrix product's rounding may depend on the number of samples.
        for load in range(loads.shape[2]):
            readings += self._sensitivity[:, :, load] * loads[:, :, load, None]
        if self._sensor.magnet is not None:
            field = dipole_field(self._sensor.magnet, loads[..., FORCES_MOMENTS:])
            for channel, axis in enumerate(self._axes):
                if axis >= 0:
                    readings[..., channel] = field[..., axis]
        return readings


def dipole_field(magnet: MagnetSpec, turns: Floats) -> Floats:
    """Compute a magnet's field (..., 3) on a rotated base, T, in the element's frame.

    Args:
        turns: (..., 2) rotation vector of the base about the element's y and z, rad.
    """
    axis = np.array(magnet.axis) / np.linalg.norm(magnet.axis)
    vector = np.concatenate([np.zeros_like(turns[..., :1]), turns], axis=-1)
    moment = magnet.moment_a_m2 * _rotate(axis, vector)
    apart = 1e-3 * (np.array(magnet.sensor_mm) - _rotate(np.array(magnet.position_mm), vector))
    distance = np.linalg.norm(apart, axis=-1, keepdims=True)
    along = apart / distance
    field: Floats = MU0_4PI * (
        (3 * (moment * along).sum(axis=-1, keepdims=True) * along - moment) / distance**3
    )
    return field


def _rotate(point: Floats, vector: Floats) -> Floats:
    """Rotate a point by (..., 3) rotation vectors, rad (Rodrigues), to (..., 3)."""
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    axis = np.divide(vector, angle, out=np.zeros_like(vector), where=angle > 0)
    along = (axis * point).sum(axis=-1, keepdims=True) * axis
    turned: Floats = along + (point - along) * np.cos(angle) + np.cross(axis, point) * np.sin(angle)
    return turned
