"""The simulated array as a `Source`: objects are swept past it one after another, without end.

Like every simulated source (`PacedSource`) it simulates when it is read, and delivers when due.

sim:mouse?objects=mug-50,bottle-51&seed=3&pace=fast&profile=realtime&sweeps=10
sim:mouse?noise_force=1e-5&noise_moment=5e-8&latency_ms=2&drop_probability=0.01
sim:mouse?friction=0.3&young_modulus=0.2&angles_deg=3&mount_mm=0.5
sim:mouse?recipe=wide24&speed_mm_s=34

An array whose file has a [sensor] delivers that sensor's readings, at its rate and in its units;
the options of `SensorModel` then act on these readings.
"""

import abc
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import cache, partial
from pathlib import Path
from typing import Final

import numpy as np

from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.datasets.recipes import SweepRecipe
from tactile_rt.sim_backend.objects.catalogue import CATEGORIES, TactileObject, promised_object
from tactile_rt.sim_backend.objects.mesh_detail import MeshDetail
from tactile_rt.sim_backend.randomisation import Randomisation
from tactile_rt.sim_backend.sensor import Sensor
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.sweep import Sweep, draw_sweep, usual_distance
from tactile_rt.sim_backend.sweep_simulation import (
    SweepSimulation,
    check_sweep,
    draw_simulation,
    ringing,
)
from tactile_rt.sim_backend.transducer import Transducer, device_spec, sensor_of
from tactile_rt.sim_backend.world import (
    CHANNELS,
    PROFILES,
    SAMPLE_MS,
    engine_version,
    stamp_samples,
)

log = logging.getLogger("tactile_rt.sim_backend")
CHUNK_SAMPLES: Final = 9
PACES: Final = ("realtime", "fast")
DRAGGED_SAMPLES = 300  # added while an object that has passed still drags a whisker along
LATEST_NS = 100_000_000  # largest lag of a live simulation behind real time
REST_SAMPLES = 600  # between objects: the episode ends, contact is released, the baseline settles


@dataclass(frozen=True)
class PacedOptions(SensorModel, MeshDetail):
    """Options of all simulated arrays.

    The fields of `SensorModel` are options too; without them, the sensors are perfect. So are those
    of `MeshDetail`, which apply to all mesh files named.

    Attributes:
        seed: The seed of all random draws; the same seed gives the same stream, and the same
            objects and sweeps whatever the sensors.
        profile: The name of the simulation profile, one of `world.PROFILES`.
        pace: ``realtime`` delivers samples when they are due, ``fast`` once they are simulated.
    """

    seed: int = 0
    profile: str = "realtime"
    pace: str = "realtime"

    def __post_init__(self) -> None:
        SensorModel.__post_init__(self)
        MeshDetail.__post_init__(self)
        if self.profile not in PROFILES:
            raise ConfigError(f"no profile {self.profile!r}: there are {', '.join(PROFILES)}")
        if self.pace not in PACES:
            raise ConfigError(f"no pace {self.pace!r}: there are {', '.join(PACES)}")
        if self.seed < 0:
            raise ConfigError(f"seed must be 0 or more, not {self.seed}")


class PacedSource(Source):
    """Base class of all simulated arrays; subclasses implement `_simulate`.

    Time is simulated: it starts at the first read, and in real time the reader waits for it. A
    simulation that falls more than 0.1 s behind real time, because the processor was busy, skips
    the time that it is behind: late samples are useless. The samples that a device would have
    measured meanwhile count as dropped.

    Attributes:
        live: Whether samples are due in real time.
    """

    def __init__(self, spec: ArraySpec, pace: str) -> None:
        super().__init__(spec)
        self.live = pace == "realtime"
        self._start_ns: int | None = None
        self._next: Chunk | None = None  # simulated, not yet due
        self._started = False
        self._skipped = 0  # samples that were not simulated in time
        self._closed = False

    @abc.abstractmethod
    def _simulate(self, start_ns: int) -> Chunk | None:
        """Simulate the next samples; None if all of them are dropped."""

    def read(self, timeout: float | None = None) -> Chunk | None:
        if self._start_ns is None:
            self._start_ns = time.monotonic_ns() if self.live else 0
        while self._next is None:
            if self._closed:
                raise EndOfStream
            self._next = self._simulate(self._start_ns)
            if self._next is not None and self.live:
                self._next = self._catch_up(self._next)
        chunk = self._next
        if self.live:
            wait = (int(chunk.t_ns[-1]) - time.monotonic_ns()) / NS_PER_S
            if timeout is not None and wait > timeout:
                time.sleep(max(timeout, 0))
                return None
            time.sleep(max(wait, 0))
        self._next = None
        self.stats.delivered += len(chunk)
        return chunk

    def close(self) -> None:
        self._closed = True
        self._next = None

    def _catch_up(self, chunk: Chunk) -> Chunk:
        """Shift a late chunk to the present; skipped samples leave a gap in `seq`."""
        assert self._start_ns is not None
        behind_ns = time.monotonic_ns() - int(chunk.t_ns[-1])
        shift_ns = 0
        if not self._started:  # the first samples may wait for code to be compiled
            self._started, shift_ns = True, max(0, behind_ns)
            self._start_ns += shift_ns
        elif behind_ns > LATEST_NS:
            lost = round(behind_ns * self.spec.rate_hz / NS_PER_S)
            shift_ns = round(lost * NS_PER_S / self.spec.rate_hz)
            self._start_ns += shift_ns
            self._skipped += lost
            self.stats.dropped += lost
        return Chunk(chunk.seq + self._skipped, chunk.t_ns + shift_ns, chunk.values, chunk.valid)


@dataclass(frozen=True)
class SimOptions(PacedOptions, Randomisation):
    """Options of the simulated array: objects, sweeps, sensors and randomisation.

    The fields of `PacedOptions` are options too, and those of `Randomisation`, which draws a new
    array for every sweep.

    Attributes:
        objects: Comma-separated names (``mug-50``), categories (``mug``: its first instance) or
            mesh files (see `mesh_files`), drawn in random order; if empty, all categories. A comma
            in a file's name is written ``%2C``, in a URL ``%252C``.
        sweeps: The number of different objects that pass before the stream ends; 0 for no end.
        repeat: The number of sweeps of the same object in succession.
        recipe: The name of a recipe (see `datasets.recipes`), or its .toml file, whose paths are
            relative to its folder: sweeps are drawn as in the recipe, except for parameters given
            here. If empty, other parameters are drawn as below.
        size_mm, speed_mm_s, yaw_deg, height_mm, distance_mm, gap_mm: The parameters of every sweep,
            see `sweep.Sweep`; by default, the size is 40 mm and the others are drawn every time.
        roll_deg, pitch_deg, heading_deg, climb_deg, ramp_ms, head_moves, surface_friction, shake_g,
            shake_hz, gravity_x_g, gravity_y_g, gravity_z_g, tilt_deg, tilt_axis_deg, tilt_ms: The
            parameters of every sweep, see `sweep.Sweep`; by default the path is level, the speed
            full from the start, and nothing shaken.
    """

    objects: str = ""
    sweeps: int = 0
    repeat: int = 1
    recipe: str = ""
    size_mm: float | None = None
    speed_mm_s: float | None = None
    yaw_deg: float | None = None
    height_mm: float | None = None
    distance_mm: float | None = None
    gap_mm: float | None = None
    roll_deg: float | None = None
    pitch_deg: float | None = None
    heading_deg: float | None = None
    climb_deg: float | None = None
    ramp_ms: float | None = None
    head_moves: float | None = None
    surface_friction: float | None = None
    shake_g: float | None = None
    shake_hz: float | None = None
    gravity_x_g: float | None = None
    gravity_y_g: float | None = None
    gravity_z_g: float | None = None
    tilt_deg: float | None = None
    tilt_axis_deg: float | None = None
    tilt_ms: float | None = None

    def __post_init__(self) -> None:
        PacedOptions.__post_init__(self)
        Randomisation.__post_init__(self)
        check_sweep(Sweep(**self.chosen), PROFILES[self.profile])
        if self.sweeps < 0 or self.repeat < 1:
            raise ConfigError("sweeps must be 0 or more, and repeat 1 or more")

    @property
    def chosen(self) -> dict[str, float]:
        """The sweep parameters that are given instead of drawn."""
        every = {f.name: getattr(self, f.name) for f in fields(Sweep)}
        return {name: float(value) for name, value in every.items() if value is not None}

    @property
    def randomisation(self) -> Randomisation:
        """The options that randomise the array."""
        return Randomisation(**{f.name: getattr(self, f.name) for f in fields(Randomisation)})


@dataclass(frozen=True)
class Pass:
    """A record of an object that passed the array: the ground truth for scoring decisions."""

    start_ns: int
    name: str
    category: str
    sweep: Sweep


class SimSource(PacedSource):
    """A simulated whisker array with objects sweeping past it.

    Samples that the sensors drop count as missing.

    Args:
        array: its name or file, see `files.load_animals`: ``mouse`` (also if empty), ``rat-left``,
            a .csv or .toml file.

    Attributes:
        notes: Metadata for recordings: the version of the engine.
    """

    Options = SimOptions

    def __init__(self, array: str, options: SimOptions) -> None:
        self._animals = load_animals(array or "mouse")
        spec, described = device_spec(self._animals), sensor_of(self._animals)
        self._sensor = Sensor(options, spec, options.seed, described)
        self._transducer = Transducer(described, spec.elements) if described else None
        self._feels_turns = bool(described and described.feels_turns)
        super().__init__(spec, options.pace)
        self._options = options
        self._objects = _make_factories(options) or [promised_object(name) for name in CATEGORIES]
        self._rng = np.random.default_rng(options.seed)
        # Its own generator, so that the objects are the same with and without randomisation.
        self._array_rng = np.random.default_rng([options.seed, 1])
        self._draw = _make_sweep_draw(self._animals, options)
        recipe = _read_recipe(options)
        self._class_of = recipe.objects.class_of if recipe else {}
        self.notes = {"engine": engine_version(PROFILES[options.profile])}
        self.passes: list[Pass] = []
        if line := ringing(self._animals, PROFILES[options.profile]):
            log.warning(line)
        self._sent = 0  # samples simulated so far
        self._rest_left = 0  # samples of rest still to deliver
        self._simulation: SweepSimulation | None = None
        self._sweep_left = 0  # samples of the sweep still to deliver
        self._order: list[int] = []
        self._reported_wedged: set[str] = set()
        compile_simulator()

    @staticmethod
    def check(array: str, options: SimOptions) -> ArraySpec:
        """Return the spec without opening the array; raise the `ConfigError` that opening would."""
        animals = load_animals(array or "mouse")
        _make_sweep_draw(animals, options)
        _make_factories(options)
        return device_spec(animals)

    def close(self) -> None:
        super().close()
        self._simulation = None

    def _simulate(self, start_ns: int) -> Chunk | None:
        true = self._simulate_loads(start_ns)
        if self._transducer is not None:
            sampled = self._transducer.push(true)
            if sampled is None:
                return None
            true = sampled
        read = self._sensor.push(true)
        self.stats.missing = self._sensor.dropped
        return read

    def _simulate_loads(self, start_ns: int) -> Chunk:
        """Simulate the next chunk of true loads, before any sensor."""
        if self._sweep_left == 0 and self._rest_left == 0:
            self._begin_sweep(start_ns)
        if self._rest_left:
            n = min(CHUNK_SAMPLES, self._rest_left)
            channels = len(CHANNELS) + (2 if self._feels_turns else 0)
            values = np.zeros((n, len(self.spec.elements), channels), dtype=np.float32)
            self._rest_left -= n
        else:
            assert self._simulation is not None
            n = min(CHUNK_SAMPLES, self._sweep_left)
            loads, contacts = self._simulation.advance_with_contacts(n, every=n)
            values = loads.astype(np.float32)
            if self._feels_turns:
                turns = self._simulation.turns().astype(np.float32)
                values = np.concatenate([values, turns], axis=2)
            self._sweep_left -= n
            if wedged := self._simulation.wedged - self._reported_wedged:
                self._reported_wedged |= wedged
                log.warning(
                    "no room for whiskers %s in %s: their loads depend on the profile",
                    name_some(sorted(wedged), 8),
                    self.passes[-1].name,
                )
            if not self._sweep_left and contacts[-1, :, 0].any():
                self._sweep_left = DRAGGED_SAMPLES
        chunk = stamp_samples(values, self._sent, start_ns)
        self._sent += n
        return chunk

    def _begin_sweep(self, start_ns: int) -> None:
        done = len(self.passes)
        if self._options.sweeps and done == self._options.sweeps * self._options.repeat:
            if self._simulation is None:  # the rest after the last object is over
                self._closed = True
                raise EndOfStream
            self._simulation, self._rest_left = None, REST_SAMPLES
            return
        if not self._order:
            order = self._rng.permutation(len(self._objects))
            self._order = [int(i) for i in order for _ in range(self._options.repeat)]
        target = self._objects[self._order.pop(0)]()
        draw, profile = self._options.randomisation.draw, PROFILES[self._options.profile]
        animals = tuple(draw(self._array_rng, animal) for animal in self._animals)
        sweep, self._simulation = draw_simulation(self._rng, animals, target, profile, self._draw)
        self._rest_left = REST_SAMPLES
        self._sweep_left = round(self._simulation.duration_ms / SAMPLE_MS)
        now = start_ns + round(self._sent * SAMPLE_MS * 1e6)
        category = self._class_of.get(target.category, target.category)
        self.passes.append(Pass(now, target.name, category, sweep))


@cache
def compile_simulator() -> None:
    """Compile the code that steps sweeps, so that no stream waits for it."""
    target, rng = promised_object(next(iter(CATEGORIES)))(), np.random.default_rng(0)
    mouse = load_animals("mouse")
    _, sweep = draw_simulation(rng, mouse, target, PROFILES["realtime"], draw_sweep)
    sweep.advance(1)


def _make_sweep_draw(
    animals: tuple[WhiskerArray, ...], options: SimOptions
) -> Callable[[np.random.Generator], Sweep]:
    chosen = options.chosen
    if (recipe := _read_recipe(options)) is None:
        return partial(draw_sweep, distance_mm=usual_distance(animals), chosen=chosen)
    sweeps = recipe.sweeps

    def draw(rng: np.random.Generator) -> Sweep:
        return replace(sweeps.draw(rng, int(rng.integers(len(sweeps))), rng), **chosen)

    return draw


def _read_recipe(options: SimOptions) -> SweepRecipe | None:
    return read_recipe(options.recipe, Path(options.recipe).parent) if options.recipe else None


def _make_factories(options: SimOptions) -> list[Callable[[], TactileObject]]:
    """Return a factory for each object that the options name; empty if they name none."""
    names = [name.replace("%2C", ",") for name in options.objects.split(",") if name]
    return [promised_object(name, options) for name in names]
