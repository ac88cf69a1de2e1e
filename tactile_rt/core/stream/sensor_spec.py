"""Description of a sensor by its data sheet: channels, rate, noise, limits.

An array's file contains it (`sim_backend.arrays.files`), the simulation reproduces the sensor, and
sweep sets and models store it. The limits within which a network trusts a channel follow from it:
noise, silence, range (`ChannelLimits`).
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.stream import NS_PER_S, ArraySpec

# Quantities that a sensor can measure: the base loads, N and N m, and the rotation of the base of a
# compliantly mounted whisker about the element's y and z, rad.
LOADS = {
    **dict.fromkeys(("fx", "fy", "fz"), "N"),
    **dict.fromkeys(("mx", "my", "mz"), "N m"),
    **dict.fromkeys(("turn_y", "turn_z"), "rad"),
}
FIELD = ("x", "y", "z")
Point = tuple[float, float, float]

# For arrays without a description of their sensor, as a mouse's: noise per sample of the network,
# one standard deviation; the largest trusted load; the smallest scale of the logarithm, three
# times that noise; and the smallest noise that the contact detector assumes, for sources without
# noise. All SI.
RATED_NOISE = {"N": 10e-6, "N m": 5e-8}
CLIP = {"N": 5e-3, "N m": 5e-6}
SCALE = {"N": 3e-5, "N m": 1.5e-7}
CHANNEL_FLOOR = {"N": 2e-6, "N m": 1e-8}
SILENT = 0.2  # smallest noise assumed by the detector, in parts of a described sensor's noise
# Likewise in parts of the drift: an offset that wanders for 10 s after the baseline (by 0.6 of its
# spread, at a correlation time of a minute) causes no endless contact, even in the worst of dozens.
WANDERED = 1.5
ROUNDING = 1 / math.sqrt(12)  # standard deviation of a rounding error, in steps


@dataclass(frozen=True, kw_only=True)
class ChannelSpec:
    """Data sheet of one sensor channel, the same for every whisker of an array.

    It reads the sum of loads, each times its sensitivity, or one component of a magnet's field. A
    channel with the name and unit of a load reads that load by default.

    Attributes:
        name: The name of the channel, e.g. ``my``, ``bx`` or ``bridge_1``.
        unit: The SI unit of its readings, e.g. ``N m``, ``T`` or ``V``.
        of: The sensitivity to each of `LOADS`: reading per N, N m or rad.
        field: The component of the magnet's field that it reads, in the element's frame: ``x``,
            ``y`` or ``z``; empty for none.
        range: The largest reading of either sign, where it saturates.
        noise_density: The amplitude spectral density of the white noise (one-sided), in the unit
            per square root of a hertz.
        resolution: The step to which readings are rounded; 0 for none.
        offset: The standard deviation of the offset that remains after the device's own tare.
        drift: The standard deviation, at any one time, of an offset that wanders.

    Raises:
        ConfigError: the measured quantity is not given, or given twice; an unknown load or
            component; a negative number, no range, or neither noise nor resolution.
    """

    name: str
    unit: str
    of: Mapping[str, float] = field(default_factory=dict)
    field: str = ""
    range: float
    noise_density: float = 0.0
    resolution: float = 0.0
    offset: float = 0.0
    drift: float = 0.0

    def __post_init__(self) -> None:
        who = f"channel {self.name!r}"
        for name in ("range", "noise_density", "resolution", "offset", "drift"):
            value = getattr(self, name)
            if not 0 <= value < math.inf:
                raise ConfigError(f"{who}: {name} must be 0 or more, not {value}")
        if not self.range:
            raise ConfigError(f"{who}: range must be more than 0: what is its largest reading?")
        if not self.noise_density and not self.resolution:
            raise ConfigError(
                f"{who}: needs noise_density, resolution, or both: they say how exact its readings "
                "are"
            )
        for load, value in self.of.items():
            if load not in LOADS:
                raise ConfigError(f"{who}: of has no {load!r}: there are {', '.join(LOADS)}")
            if not math.isfinite(value):
                raise ConfigError(f"{who}: of.{load} must be finite, not {value}")
        if self.field and self.field not in FIELD:
            raise ConfigError(f"{who}: field must be x, y or z, not {self.field!r}")
        if self.field and self.of:
            raise ConfigError(f"{who}: reads the magnet's field or loads (of), not both")
        if not self.field and not self.of and LOADS.get(self.name) != self.unit:
            known = f"in {LOADS[self.name]}" if self.name in LOADS else "no load"
            raise ConfigError(
                f"{who} in {self.unit}: {self.name} is {known}; say what it reads with "
                "of = { mz = ... } or field"
            )

    @property
    def sensitivity(self) -> NDArray[np.float64]:
        """Reading per N, N m and rad, (load,), in the order of `LOADS`."""
        of = self.of or ({} if self.field else {self.name: 1.0})
        return np.array([of.get(load, 0.0) for load in LOADS])


@dataclass(frozen=True, kw_only=True)
class MagnetSpec:
    """Magnet on a compliantly mounted whisker, and the magnetometer below it.

    Both are points in the element's frame at rest, mm from the base point, about which the magnet
    rotates with the whisker. The field is that of a dipole.

    Attributes:
        moment_a_m2: The magnetic moment, A m^2: remanence times volume over the vacuum's
            permeability, 1.25 T x 0.79 mm^3 -> 7.8e-4.
        position_mm: The magnet's position at rest.
        sensor_mm: The position at which the field is measured.

    Raises:
        ConfigError: no moment, no direction, a number that is not finite, or the magnet and its
            sensor at one position.
    """

    moment_a_m2: float
    sensor_mm: Point
    position_mm: Point = (0.0, 0.0, 0.0)
    axis: Point = (1.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        numbers = (self.moment_a_m2, *self.axis, *self.position_mm, *self.sensor_mm)
        if not all(map(math.isfinite, numbers)):
            raise ConfigError("magnet: all its numbers must be finite")
        if self.moment_a_m2 == 0 or not any(self.axis):
            raise ConfigError("magnet: moment_a_m2 and axis must not be 0")
        if math.dist(self.position_mm, self.sensor_mm) == 0:
            raise ConfigError("magnet: position_mm and sensor_mm must be apart")


@dataclass(frozen=True, kw_only=True)
class SensorSpec:
    """Data sheet of the sensor that reads every whisker of an array.

    Attributes:
        rate_hz: The sample rate of the device, Hz.
        bandwidth_hz: The corner frequency of its first-order low-pass, Hz; 0 for no low-pass.
        latency_ms: The time from a sample to its receipt by the host, ms.
        magnet: The magnet of every whisker; None for no magnet.
        matrix: The calibrated sensitivities of single whiskers, by name: a row for each channel, a
            column for each of `LOADS` (the two rotations may be left out); they replace those of
            the channels.

    Raises:
        ConfigError: no channels, two with one name, a rate that is not positive, a negative number,
            a field without a magnet, or a matrix of another shape.
    """

    channels: tuple[ChannelSpec, ...]
    rate_hz: float = 1000.0
    bandwidth_hz: float = 0.0
    latency_ms: float = 0.0
    magnet: MagnetSpec | None = None
    matrix: Mapping[str, tuple[tuple[float, ...], ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names = [channel.name for channel in self.channels]
        if not names:
            raise ConfigError("sensor: has no channels; give at least one [[sensor.channel]]")
        if twice := [name for name in names if names.count(name) > 1]:
            raise ConfigError(f"sensor: two channels are called {twice[0]!r}; rename one")
        if not 0 < self.rate_hz < math.inf:
            raise ConfigError(f"sensor: rate_hz must be more than 0, not {self.rate_hz}")
        for name in ("bandwidth_hz", "latency_ms"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ConfigError(f"sensor: {name} must be 0 or more, not {getattr(self, name)}")
        for channel in self.channels:
            if channel.field and self.magnet is None:
                raise ConfigError(
                    f"sensor: channel {channel.name!r} reads a field, but there is no "
                    "[sensor.magnet]"
                )
            if channel.field and self.matrix:
                raise ConfigError(
                    f"sensor: channel {channel.name!r} reads a field, which a matrix cannot "
                    "describe; remove one of them"
                )
        for name, rows in self.matrix.items():
            widths = {len(row) for row in rows}
            if len(rows) != len(names) or not widths <= {6, len(LOADS)} or len(widths) != 1:
                raise ConfigError(
                    f"sensor: matrix of whisker {name} must have {len(names)} rows (channels) of 6 "
                    f"or {len(LOADS)} numbers ({', '.join(LOADS)})"
                )
            if not np.isfinite(rows).all():
                raise ConfigError(f"sensor: matrix of whisker {name} must be finite")

    @property
    def feels_turns(self) -> bool:
        """True if any reading depends on the rotation of the whiskers' bases."""
        rows = [self.sensitivity(name) for name in ("", *self.matrix)]
        return self.magnet is not None or any(row[:, 6:].any() for row in rows)

    @property
    def noise_bandwidth_hz(self) -> float:
        """Equivalent bandwidth of the white noise in a sample, Hz."""
        passed = self.rate_hz / 2
        # equivalent noise bandwidth of a first-order low-pass
        return min(passed, self.bandwidth_hz * math.pi / 2) if self.bandwidth_hz else passed

    def sensitivity(self, whisker: str) -> NDArray[np.float64]:
        """Return a whisker's readings per N, N m and rad, (channel, load), ordered as `LOADS`."""
        if whisker in self.matrix:
            rows = np.array(self.matrix[whisker])
            return np.pad(rows, ((0, 0), (0, len(LOADS) - rows.shape[1])))
        return np.array([channel.sensitivity for channel in self.channels])

    def noise(self) -> NDArray[np.float64]:
        """Return the standard deviation of each channel's white noise in a sample, (channel,)."""
        density = np.array([c.noise_density for c in self.channels])
        return density * math.sqrt(self.noise_bandwidth_hz)


class ChannelLimits(NamedTuple):
    """Limits within which a network trusts an array's channels; arrays (channel,), SI units.

    Attributes:
        noise: The rated noise per sample of the network, one standard deviation.
        floor: The smallest noise that the contact detector assumes.
        clip: The largest trusted magnitude.
        scale: The smallest scale of the logarithm that compresses loads.
    """

    noise: NDArray[np.float32]
    floor: NDArray[np.float32]
    clip: NDArray[np.float32]
    scale: NDArray[np.float32]


def channel_limits(
    spec: ArraySpec, sensor: SensorSpec | None = None, period_ns: int = 0
) -> ChannelLimits:
    """Return the limits within which a network trusts each channel of an array.

    Args:
        sensor: the array's sensor; None for a sensor with the rated noise.
        period_ns: period of the network's samples; the noise of a sensor that samples faster is
            averaged by the resampler.

    Raises:
        ConfigError: no sensor, and a channel is neither a force nor a moment.
    """
    if sensor is not None:
        rounding = np.array([c.resolution for c in sensor.channels]) * ROUNDING
        noise = np.hypot(sensor.noise(), rounding) * _noise_factor(sensor.rate_hz, period_ns)
        clip = np.array([c.range for c in sensor.channels])
        drift = np.array([c.drift for c in sensor.channels])
        # Within a rounding step a resting sensor reads a constant; its true noise is not 0.
        floor = np.maximum(np.maximum(SILENT * noise, rounding), WANDERED * drift)
        return ChannelLimits(*(a.astype(np.float32) for a in (noise, floor, clip, 2 * noise)))
    if unknown := sorted(set(spec.units) - set(RATED_NOISE)):
        raise ConfigError(
            f"channels in {name_some(unknown)} cannot be learnt from without a [sensor] in the "
            "array's file, which says how noisy they are"
        )

    def fill(table: Mapping[str, float]) -> NDArray[np.float32]:
        return np.array([table[unit] for unit in spec.units], dtype=np.float32)

    return ChannelLimits(fill(RATED_NOISE), fill(CHANNEL_FLOOR), fill(CLIP), fill(SCALE))


def _noise_factor(rate_hz: float, period_ns: int) -> float:
    """Return the factor by which `classifier.resampler.Resampler` reduces white noise."""
    reach = max(period_ns / NS_PER_S * rate_hz, 1.0)  # half width of the kernel, in samples
    apart: Iterable[float] = np.arange(-math.ceil(reach) + 1, math.ceil(reach))
    weights = 1 + np.cos(np.pi * np.asarray(apart) / reach)
    return float(np.sqrt(np.square(weights).sum()) / weights.sum())
