"""The simulated array that whisks, as an endless `Source`.

whisking:mouse?frequency_hz=8&amplitude_deg=20&offset_deg=0
whisking:mouse?object=mug-50&position_mm=25,5,0&size_mm=20&yaw_deg=30&pace=fast&noise_force=1e-5
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, Chunk, EndOfStream
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.arrays.whiskers import rotation
from tactile_rt.sim_backend.objects.catalogue import load_object
from tactile_rt.sim_backend.objects.solids import TactileObject
from tactile_rt.sim_backend.sensor import Sensor
from tactile_rt.sim_backend.source import CHUNK_SAMPLES, PacedOptions, PacedSource
from tactile_rt.sim_backend.whisking import HEAD, WhiskSimulation
from tactile_rt.sim_backend.whisking_drive import Drive, Whisking
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, array_spec, stamp_samples

LARGEST_MM = 1e3  # of an object's size and position


@dataclass(frozen=True)
class Placing:
    """The pose of the object that an array whisks against.

    Attributes:
        position_mm: The position of the object's centre: ``x,y,z``, x lateral (away from the head),
            y rostral, z up, from the array's origin, mm.
        size_mm: The largest extent of the object, mm.
        yaw_deg: The rotation of the object about z, degrees.
    """

    position_mm: str = "25,5,0"
    size_mm: float = 20.0
    yaw_deg: float = 0.0

    def __post_init__(self) -> None:
        if not 0 < self.size_mm <= LARGEST_MM:
            raise ConfigError(f"size_mm must be above 0, at most {LARGEST_MM:g}: {self.size_mm:g}")
        if not math.isfinite(self.yaw_deg):
            raise ConfigError(f"yaw_deg must be a number of degrees, not {self.yaw_deg}")
        parse_point(self.position_mm, "position_mm")

    def place(self, thing: TactileObject, left: bool) -> tuple[NDArray[np.float64], ...]:
        """Return the (points, 3) corners of the object's convex pieces in the world, mm."""
        at = np.array(parse_point(self.position_mm, "position_mm")) * (1 - 2 * left, 1, 1)
        turn = rotation("z", np.radians(self.yaw_deg))
        return tuple(p.vertices * self.size_mm @ turn.T + at for p in thing.pieces)


def parse_point(text: str, key: str) -> tuple[float, float, float]:
    """Parse the text ``x,y,z`` of an option `key` into a point, mm."""
    try:
        x, y, z = (float(part) for part in text.split(","))
        if not all(abs(v) <= LARGEST_MM for v in (x, y, z)):
            raise ValueError
    except ValueError:
        raise ConfigError(
            f"{key} must be three numbers x,y,z of at most {LARGEST_MM:g}, not {text!r}"
        ) from None
    return x, y, z


@dataclass(frozen=True)
class WhiskingOptions(PacedOptions, Placing):
    """Options of the whisking array: its initial motion, its object and its sensors.

    The fields of `PacedOptions` and `Placing` are options too; sensor errors affect the loads, not
    the angles.

    Attributes:
        frequency_hz: The whisking cycles per second, Hz.
        amplitude_deg, offset_deg: The protraction is offset + amplitude sin(2 pi f t) from rest,
            rostral positive, degrees. See `Whisking` for the ranges.
        object: The name (``mug-50``), category or mesh file of the object beside the array; if
            empty, the array whisks in air.
        seconds: The length of the stream, s; 0 for no end.
    """

    frequency_hz: float = 8.0
    amplitude_deg: float = 20.0
    offset_deg: float = 0.0
    object: str = ""
    seconds: float = 0.0

    def __post_init__(self) -> None:
        PacedOptions.__post_init__(self)
        Placing.__post_init__(self)
        if not 0 <= self.seconds < math.inf:
            raise ConfigError(f"seconds must be 0 or more, not {self.seconds}")
        _ = self.whisking

    @property
    def whisking(self) -> Whisking:
        """The initial whisking command."""
        turns = math.radians(self.amplitude_deg), math.radians(self.offset_deg)
        return Whisking(self.frequency_hz, *turns)


class WhiskingSource(PacedSource):
    """A source: an array in MuJoCo that whisks, alone or against an object beside it.

    Its channels are the six base loads, in the rotating frame of each base, and ``angle``: the
    protraction of each base from rest, rad, rostral positive; each the mean over its millisecond.
    Two sources with the same commands at the same samples deliver the same.

    Args:
        array: its name or file, see `files.load_array`: ``mouse`` (also if empty), ``rat-left``, a
            .csv or .toml file.

    Attributes:
        commands: The (first affected sample, command) pairs in time order.

    Raises:
        ConfigError: no such array or object, or whiskers begin inside the object.
    """

    Options = WhiskingOptions

    def __init__(self, array: str, options: WhiskingOptions) -> None:
        animal = load_array(array or "mouse")
        loads = array_spec(animal.whiskers, animal.name)
        spec = replace(loads, channels=(*loads.channels, "angle"), units=(*loads.units, "rad"))
        super().__init__(spec, options.pace)
        left = all(w.base[0] < 0 for w in animal.whiskers)
        self._sensor = Sensor(options, loads, options.seed)
        self._loads = loads
        self._drive = Drive(options.whisking)
        self.notes = {"engine": "mujoco"}
        profile = PROFILES[options.profile]
        self._simulation: WhiskSimulation | None = WhiskSimulation(
            animal.whiskers,
            self._drive,
            profile,
            options.place(load_object(options.object, options), left) if options.object else (),
            HEAD.mirror() if left else HEAD,
        )
        steps = np.arange(round(SAMPLE_MS / profile.timestep_ms))
        self._steps_s = steps * (profile.timestep_ms * 1e-3)
        self._samples = round(options.seconds * 1e3 / SAMPLE_MS) or None
        self._sent = 0  # samples simulated so far
        self._next_command: Whisking | None = None
        self.commands: list[tuple[int, Whisking]] = [(0, options.whisking)]

    @staticmethod
    def check(array: str, options: WhiskingOptions) -> ArraySpec:
        """Open and close the array; return its spec, or raise a `ConfigError` on failure."""
        with WhiskingSource(array, options) as source:
            return source.spec

    def set_whisking(self, frequency_hz: float, amplitude_rad: float, offset_rad: float) -> None:
        """Change the whisking from the next sample to simulate on; callable from any thread.

        The motion changes smoothly, see `whisking_drive`.

        Raises:
            ConfigError: out of range; the array goes on as before.
        """
        self._next_command = Whisking(frequency_hz, amplitude_rad, offset_rad)

    def may_whisk(self, frequency_hz: float, amplitude_rad: float, offset_rad: float) -> bool:
        """Return whether `set_whisking` accepts this motion."""
        try:
            Whisking(frequency_hz, amplitude_rad, offset_rad)
        except ConfigError:
            return False
        return True

    def close(self) -> None:
        super().close()
        self._simulation = None

    def _simulate(self, start_ns: int) -> Chunk | None:
        left = CHUNK_SAMPLES if self._samples is None else self._samples - self._sent
        simulation = self._simulation
        if left <= 0 or simulation is None:
            raise EndOfStream
        command, self._next_command = self._next_command, None
        if command is not None:
            self._drive.command(command, self._sent * SAMPLE_MS * 1e-3)
            self.commands.append((self._sent, command))
        n = min(CHUNK_SAMPLES, left)
        seq = self._sent + np.arange(n, dtype=np.int64)
        values, _ = simulation.advance(n)
        self._sent += n
        angles = self._compute_angles(seq)
        felt = self._sensor.push(stamp_samples(values.astype(np.float32), seq[0], start_ns))
        self.stats.missing = self._sensor.dropped
        if felt is None:
            return None
        angle = np.empty((len(felt), values.shape[1], 1), dtype=np.float32)
        angle[:] = angles[felt.seq - seq[0], None, None]
        return Chunk(felt.seq, felt.t_ns, np.concatenate([felt.values, angle], 2), felt.valid)

    def _compute_angles(self, seq: NDArray[np.int64]) -> NDArray[np.float64]:
        """Compute the (n,) mean protractions over each sample's physics steps, rad."""
        times = seq[:, None] * (SAMPLE_MS * 1e-3) + self._steps_s
        means: NDArray[np.float64] = (
            self._drive.protraction(times.ravel()).reshape(times.shape).mean(axis=1)
        )
        return means
