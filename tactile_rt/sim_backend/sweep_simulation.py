"""Simulation of a sweep: the world, the motion, the base loads at 1 kHz."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Protocol

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Floats, Whisker, link_nodes
from tactile_rt.sim_backend.mujoco_world import CONTACT_CHANNELS, MujocoWorld, sweep_model
from tactile_rt.sim_backend.objects.catalogue import TactileObject
from tactile_rt.sim_backend.sweep import (
    EARTH,
    Sweep,
    centrelines,
    draw_sweep,
    faces_right,
    way_to_contact,
    within_reach,
)
from tactile_rt.sim_backend.transducer import sensor_of
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, Profile, engine_of

TOO_MUCH = 1.1  # a damping ratio more than this many times its target is reported
FINER = ("dataset", "accurate")
FAR_MM = 200.0  # where the object is when the way to first contact is measured
DRAWS = 20  # tries to draw parameters with which an object meets the array
SHAKEN_IN_MS = 50.0  # time in which shaking grows to its full amplitude
WEDGED_MM, WEDGED_MS = 0.02, 25  # only a whisker without room overlaps deeper for longer
CLEAR_MM = 5.0  # how far a sweep continues past the last whisker


def ringing(animals: Sequence[WhiskerArray], profile: Profile) -> str:
    """Return a warning that counts whiskers over-damped at a profile; empty if none is."""
    if engine_of(profile) != "rods":
        return ""
    whiskers = [w for animal in animals for w in animal.whiskers]
    off = _find_damped(whiskers, profile)
    if not off:
        return ""
    target, had, worst = max(off, key=lambda found: found[1] / found[0])
    left = {key: len(_find_damped(whiskers, PROFILES[key])) for key in FINER}
    best = min(left, key=lambda key: left[key])
    better = f"; at profile {best} {left[best] or 'none'}" if left[best] < len(off) else ""
    return (
        f"{len(off)} of {len(whiskers)} whiskers ring shorter than they should at steps of "
        f"{profile.timestep_ms:g} ms, {worst} with a damping ratio of {had:.2g} instead of "
        f"{target:.2g}{better}"
    )


def _find_damped(whiskers: Sequence[Whisker], profile: Profile) -> list[tuple[float, float, str]]:
    """Find over-damped whiskers: (target damping ratio, simulated damping ratio, name) of each."""
    from tactile_rt.sim_backend.rods.rod import HEARD_HZ, make_rod

    steps = round(SAMPLE_MS / profile.timestep_ms)
    rods = [make_rod(w, profile.links, steps) for w in whiskers]
    return [
        (rod.wanted_ratio, rod.damping_ratio, w.name)
        for rod, w in zip(rods, whiskers, strict=True)
        if rod.resonance_hz < HEARD_HZ and rod.damping_ratio > TOO_MUCH * rod.wanted_ratio
    ]


def check_sweep(sweep: Sweep, profile: Profile) -> None:
    """Raise a `ConfigError` if the profile's engine cannot step such a sweep."""
    for name in ("head_moves", "shake_g", "gravity_x_g", "gravity_y_g", "gravity_z_g", "tilt_deg"):
        if getattr(sweep, name) and engine_of(profile) == "mujoco":
            raise ConfigError(f"{name}: MuJoCo simulates neither gravity nor a moving head")


class World(Protocol):
    """Protocol of an engine that steps whiskers while an object passes."""

    @property
    def angles(self) -> Floats:
        """The (joint,) angles of all whiskers' hinges, rad, in the order of `sweep_model`'s."""

    @property
    def turns(self) -> Floats:
        """The (sample, whisker, 2) rotations of the bases in the last `advance`, rad."""

    def advance(
        self, way: Floats, look_every: int = 0, shaken: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Simulate some samples of 1 ms.

        Args:
            way: (sample + 1, 3) positions of the object at the beginning of each sample and at the
                end of the last, mm.
            look_every: interval in samples at which contacts are computed; 0 for never. An engine
                that has them anyway returns those of every sample.
            shaken: (sample, 3) acceleration of the head, mm/ms^2, in the world; `way` is then
                relative to the head. If None, the head is not accelerated.

        Returns:
            (sample, whisker, 6) loads, N and N m, and (sample, whisker, 3) contacts, see
            `mujoco_world.CONTACT_CHANNELS`.
        """


class SweepSimulation:
    """One sweep, simulated on demand: `advance` steps it, `loads` runs it to its end.

    Whiskers do not touch each other, so whiskers that the object misses stay at rest and are not
    simulated. Pieces of the object that no whisker can reach are left out.

    Args:
        array: the whiskers; a tuple of arrays for several animals in one world
            (`whisker_array.place`). The object passes on the side to which most of the whiskers
            reach.
        whole: whether to simulate everything, for complete pictures; the loads stay the same.

    Attributes:
        touches: False if the object passes without meeting any resting whisker.
        duration_ms: The simulated time until the object has passed all resting whiskers, ms; it
            may still drag a whisker along.
        wedged: The names of whiskers without room between parts of the object: their loads depend
            on the profile.
    """

    def __init__(
        self,
        array: WhiskerArray | tuple[WhiskerArray, ...],
        target: TactileObject,
        sweep: Sweep,
        profile: Profile,
        whole: bool = False,
    ) -> None:
        check_sweep(sweep, profile)
        animals = array if isinstance(array, tuple) else (array,)
        animals = tuple(_scale_friction(animal, sweep.surface_friction) for animal in animals)
        whiskers = [w for animal in animals for w in animal.whiskers]
        rods = engine_of(profile) == "rods"
        level = sweep.gravity(animals[0].gravity) * 1e-3 * rods  # mm/ms^2; MuJoCo's has none
        gravity = level if sweep.tilt_ms else sweep.gravity(animals[0].gravity, 1.0) * 1e-3 * rods
        resting = _bend_lines(animals, profile, tuple(gravity.tolist()))
        outward = faces_right(animals, resting)
        # All that follows is in the frame in which the object moves along -y.
        across = sweep.across
        lines = [line @ across.T for line in resting]
        turned = [piece.vertices * sweep.size_mm @ sweep.turn.T for piece in target.pieces]
        shape = [points @ across.T for points in turned]
        start = _compute_start(lines, outward, np.concatenate(shape), sweep)
        pieces = [
            trimesh.Trimesh(points + start, piece.faces, process=False)
            for points, piece in zip(shape, target.pieces, strict=True)
        ]
        way, met = way_to_contact(whiskers, lines, pieces)
        self.touches = bool(np.isfinite(way))
        if not self.touches:
            front = min(points[:, 1].min() for points in shape)
            way = FAR_MM + front - max(line[:, 1].max() for line in lines)
        start[1] += sweep.gap_mm - way
        self.reached = int(met.sum())
        tilted = bool(level.any() and sweep.tilt_deg)
        shakes = bool(sweep.shake_g or (sweep.head_moves and sweep.ramp_ms))
        self._simulated = np.flatnonzero(met | whole | tilted | shakes)
        self._elements = len(whiskers)
        self._animals, self._profile = animals, profile
        felt = [whiskers[i] for i in self._simulated]
        self._names = {w.name for w in felt}
        touched = [lines[i] for i in self._simulated]
        kept = (
            range(len(pieces)) if whole else within_reach(touched, [w.length for w in felt], pieces)
        )
        self._pieces = [
            trimesh.Trimesh(turned[i], target.pieces[i].faces, process=False) for i in kept
        ]
        self._sweep, self._start, self._heading = sweep, across.T @ start, across.T @ (0, -1, 0)
        self._samples, self._whiskers = 0, felt
        self._level_gravity, self._gravity = level, gravity
        self._tare: Floats | float = 0.0  # loads of the whiskers' weight before a tilt, N and N m
        self._tilts = tilted and bool(sweep.tilt_ms)
        self._base_turns, self.wedged = np.zeros((0, len(whiskers), 2)), set[str]()
        self._overlap_samples = np.zeros(len(felt), dtype=np.int64)
        rear = start[1] + max(points[:, 1].max() for points in shape)
        last = min(line[:, 1].min() for line in lines)
        # During a ramp the object covers half the distance.
        whole = (rear - last + CLEAR_MM) / (sweep.speed_mm_s * 1e-3)
        self.duration_ms = float(whole + sweep.ramp_ms / 2)

    @cached_property
    def _world(self) -> World:
        """The engine, created at the first sample, since a rejected draw needs none."""
        profile = self._profile
        if engine_of(profile) != "rods":
            if (sensor := sensor_of(self._animals)) and sensor.feels_turns:
                raise ConfigError(
                    "the engine mujoco does not report how bases rotate, which this sensor reads: "
                    "use profile realtime, dataset or accurate, with numba installed"
                )
            return MujocoWorld(self.model, self._whiskers, profile, self._start)
        from tactile_rt.sim_backend.rods.world import Piece, RodWorld

        parts = [Piece.of(piece) for piece in self._pieces]
        roots = _compute_roots(self._animals)[self._simulated]
        steps = round(SAMPLE_MS / profile.timestep_ms)
        if self._gravity.any():
            level = RodWorld(self._whiskers, roots, (), profile.links, steps, self._level_gravity)
            self._tare = level.rest_loads()
        return RodWorld(self._whiskers, roots, parts, profile.links, steps, self._gravity)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model of the sweep, for pictures even if another engine steps it."""
        return sweep_model(self._animals, self._names, self._pieces, self._profile)

    def first_touch(self) -> list[trimesh.Trimesh]:
        """Place the object's pieces where it first touches a whisker, in the world, mm."""
        place = self._start + self._sweep.gap_mm * self._heading
        return [trimesh.Trimesh(p.vertices + place, p.faces, process=False) for p in self._pieces]

    def show(self, data: mujoco.MjData) -> None:
        """Set whiskers and object in `data`, of `model`, to their present positions."""
        data.qpos[:] = self._world.angles
        data.mocap_pos[0] = self._compute_positions(np.array([self._samples]))[0]
        data.time = self._samples * SAMPLE_MS

    def advance(self, samples: int) -> Floats:
        """Simulate the next samples of 1 ms.

        Returns:
            (samples, element, 6) base loads, N and N m, each the mean over its millisecond.

        Raises:
            SourceError: the simulation has become unstable: whiskers too stiff for the profile
                jam against the object.
        """
        return self.advance_with_contacts(samples, 0)[0]

    def advance_with_contacts(self, samples: int, every: int = 1) -> tuple[Floats, Floats]:
        """Simulate the next samples like `advance`, and find where each whisker touches.

        Args:
            every: if finding contacts costs as much as a step, find them only at every so many
                samples, from the first, and hold them until the next.

        Returns:
            The loads, and (samples, element, 3) contacts, see `mujoco_world.CONTACT_CHANNELS`.
        """
        loads = np.zeros((samples, self._elements, 6))
        contacts = np.zeros((samples, self._elements, len(CONTACT_CHANNELS)))
        first = self._samples
        way = self._compute_positions(first + np.arange(samples + 1))
        self._base_turns = np.zeros((samples, self._elements, 2))
        self._samples += samples
        if len(self._simulated):
            found = self._world.advance(way, every, self._compute_acceleration(first, samples))
            loads[:, self._simulated] = found[0] - self._tare
            contacts[:, self._simulated] = found[1]
            if len(self._world.turns):  # none from MuJoCo
                self._base_turns[:, self._simulated] = self._world.turns
            self._note_wedged(getattr(self._world, "overlap", np.zeros((0, 0))))
        return loads, contacts

    def _note_wedged(self, overlap: Floats) -> None:
        for sample in overlap > WEDGED_MM:  # (whisker,) each
            self._overlap_samples = np.where(sample, self._overlap_samples + 1, 0)
            self.wedged |= {
                self._whiskers[i].name for i in np.flatnonzero(self._overlap_samples > WEDGED_MS)
            }

    def _compute_positions(self, samples: NDArray[np.int64]) -> Floats:
        """Compute the object's (n, 3) positions relative to the head, mm, at given samples."""
        t, ramp = samples * SAMPLE_MS, self._sweep.ramp_ms
        way = np.asarray(t, dtype=np.float64)
        if ramp:
            x = np.minimum(t / ramp, 1.0)
            way = np.maximum(t - ramp, 0.0) + ramp * (x**3 - x**4 / 2)
        place: Floats = self._start + (self._sweep.speed_mm_s * 1e-3 * way)[:, None] * self._heading
        return place

    def _compute_acceleration(self, first: int, samples: int) -> Floats | None:
        """Compute the head's (n, 3) acceleration from sample `first` on, mm/ms^2; None if zero."""
        sweep, ramp = self._sweep, self._sweep.ramp_ms
        moves = bool(sweep.head_moves) and first * SAMPLE_MS < ramp
        if not (moves or sweep.shake_g or self._tilts):
            return None
        times = (first + np.arange(samples) + 0.5) * SAMPLE_MS
        shaken = np.zeros((samples, 3))
        if moves:
            x = np.minimum(times / ramp, 1.0)
            # The head moves against `_heading`: the second derivative of x^3 - x^4 / 2.
            shaken += np.outer(sweep.speed_mm_s * 1e-3 * (6 * x - 6 * x**2) / ramp, -self._heading)
        if sweep.shake_g:
            grown = np.minimum(times / SHAKEN_IN_MS, 1.0)
            wave = grown * np.sin(2 * np.pi * sweep.shake_hz * 1e-3 * times)
            shaken += np.outer(sweep.shake_g * EARTH * 1e-3 * wave, np.ones(3) / np.sqrt(3))
        if self._tilts:  # the difference of gravity from that at the tare
            x = np.minimum(times / sweep.tilt_ms, 1.0)
            described = self._animals[0].gravity
            turned = [sweep.gravity(described, share) * 1e-3 for share in x**2 * (3 - 2 * x)]
            shaken -= np.array(turned) - self._level_gravity
        return shaken

    def turns(self) -> Floats:
        """Return (sample, element, 2) rotations of compliant bases about elements' y and z, rad.

        They are means over each sample of the last `advance`; zero for rigid mounts.
        """
        return self._base_turns

    def loads(self, samples_at_once: int = 50) -> Iterator[Floats]:
        """Yield the loads in chunks until the object has passed."""
        while self._samples * SAMPLE_MS < self.duration_ms:
            yield self.advance(samples_at_once)


def draw_simulation(
    rng: np.random.Generator,
    array: WhiskerArray | tuple[WhiskerArray, ...],
    target: TactileObject,
    profile: Profile,
    draw: Callable[[np.random.Generator], Sweep] = draw_sweep,
) -> tuple[Sweep, SweepSimulation]:
    """Draw sweeps until the object meets the array, at most 20; return the last."""
    for _ in range(DRAWS):
        sweep = draw(rng)
        simulation = SweepSimulation(array, target, sweep, profile)
        if simulation.touches:
            break
    return sweep, simulation


def _compute_start(
    lines: Sequence[Floats], outward: NDArray[np.bool_], shape: Floats, sweep: Sweep
) -> Floats:
    """Compute the object's initial centre, mm: far up the y axis, on the whiskers' side."""
    bases = np.array([line[0, 0] for line in lines])
    right = 2 * outward.sum() >= len(lines)
    face = bases[outward == right].mean()
    nearest = shape[:, 0].min() if right else shape[:, 0].max()
    x = face + (sweep.distance_mm if right else -sweep.distance_mm) - nearest
    return np.array([x, FAR_MM, sweep.height_mm])


@lru_cache(4)  # sweeps past one array follow each other
def _bend_lines(
    animals: Sequence[WhiskerArray], profile: Profile, gravity: tuple[float, ...]
) -> list[Floats]:
    """Find the centrelines (point, 3) of whiskers at rest, bent by their weight, mm."""
    from tactile_rt.sim_backend.rods.world import RodWorld

    lines = [line for a in animals for line in centrelines(a.whiskers, a.mount)]
    if not any(gravity):
        return lines
    whiskers = [w for animal in animals for w in animal.whiskers]
    steps = round(SAMPLE_MS / profile.timestep_ms)
    world = RodWorld(whiskers, _compute_roots(animals), (), profile.links, steps, np.array(gravity))
    for whisker, line, sag in zip(whiskers, lines, world.sag, strict=True):
        s = np.linspace(0, whisker.length, len(line))
        nodes = link_nodes(whisker, profile.links)
        line += np.stack([np.interp(s, nodes, sag[:, k]) for k in range(3)], axis=1)
    return lines


def _scale_friction(animal: WhiskerArray, friction: float) -> WhiskerArray:
    """Multiply the friction of all whiskers of an array by a factor."""
    if friction == 1:
        return animal
    whiskers = tuple(replace(w, friction=w.friction * friction) for w in animal.whiskers)
    return replace(animal, whiskers=whiskers)


def _compute_roots(animals: Sequence[WhiskerArray]) -> Floats:
    """Compute (whisker, 4, 3) base points, mm, and elements' frames, both in the world."""
    return np.array(
        [
            np.concatenate(
                [
                    [a.mount.rotation @ w.base + np.array(a.mount.position)],
                    a.mount.rotation @ w.orientation,
                ]
            )
            for a in animals
            for w in a.whiskers
        ]
    )
