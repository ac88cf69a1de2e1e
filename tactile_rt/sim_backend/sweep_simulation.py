"""A sweep, simulated: the world, the motion, the base loads at 1 kHz."""

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
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, Profile, engine_of

TOO_MUCH = 1.1  # a damping ratio so many times the wanted one is told
FINER = ("dataset", "accurate")
FAR_MM = 200.0  # where the object is when the way to first contact is measured
DRAWS = 20  # tries to draw parameters with which an object meets the array at all
SHAKEN_IN_MS = 50.0  # in which shaking grows to its whole
WEDGED_MM, WEDGED_MS = 0.02, 25  # deeper and longer a whisker overlaps only without room
CLEAR_MM = 5.0  # how far past the last whisker a sweep goes on


def ringing(animals: Sequence[WhiskerArray], profile: Profile) -> str:
    """Say which whiskers ring too shortly at a profile; empty: none."""
    if engine_of(profile) != "rods":
        return ""
    whiskers = [w for animal in animals for w in animal.whiskers]
    off = _off(whiskers, profile)
    if not off:
        return ""
    wanted, had, worst = max(off, key=lambda one: one[1] / one[0])
    left = {key: len(_off(whiskers, PROFILES[key])) for key in FINER}
    best = min(left, key=lambda key: left[key])
    better = f"; at profile {best} {left[best] or 'none'}" if left[best] < len(off) else ""
    return (
        f"{len(off)} of {len(whiskers)} whiskers ring shorter than they should at steps of "
        f"{profile.timestep_ms:g} ms, {worst} with a damping ratio of {had:.2g} instead of "
        f"{wanted:.2g}{better}"
    )


def _off(whiskers: Sequence[Whisker], profile: Profile) -> list[tuple[float, float, str]]:
    """Return (ratio wanted, ratio had, name) of the whiskers that ring too shortly."""
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
            raise ConfigError(f"{name}: MuJoCo's world has no weight and a head that stands still")


class World(Protocol):
    """What steps whiskers while an object goes by."""

    @property
    def angles(self) -> Floats:
        """(joint,) angles of all whiskers' hinges, rad, in the order of `sweep_model`'s."""

    @property
    def turns(self) -> Floats:
        """(sample, whisker, 2) turns of the bases in the samples of the last `advance`, rad."""

    def advance(
        self, way: Floats, look_every: int = 0, shaken: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Simulate some samples of 1 ms.

        Args:
            way: (sample + 1, 3) where the object is at the beginning of each sample and at the end
                of the last, mm.
            look_every: look for contacts at every so many samples; 0: not at all. An engine that
                knows them anyway gives those of every sample.
            shaken: (sample, 3) acceleration of the head, mm/ms^2, in the world; the object's way is
                then relative to the head. None: it is not accelerated.

        Returns:
            (sample, whisker, 6) loads, N and N m, and (sample, whisker, 3) contacts, see
            `contacts.CONTACT_CHANNELS`.
        """


class SweepSimulation:
    """One sweep, simulated on demand: `advance` steps it, `loads` runs it to its end.

    Whiskers do not touch each other, so those that the object passes by stay at rest and are not
    simulated, nor are pieces of the object that no whisker could reach.

    Args:
        array: the whiskers; a tuple of arrays for several animals in one world
            (`whisker_array.place`). The object passes on the side to which most of the whiskers
            reach.
        whole: simulate everything all the same: the loads are those, and a picture is complete.

    Attributes:
        touches: False when the object passes without meeting any resting whisker.
        duration_ms: The simulated time after which the object has passed where all whiskers rest,
            ms; it may still drag one along.
        wedged: The names of whiskers that had no room between parts of the object: their loads
            depend on the profile.
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
        animals = tuple(_on_surface(animal, sweep.surface_friction) for animal in animals)
        whiskers = [w for animal in animals for w in animal.whiskers]
        rods = engine_of(profile) == "rods"
        level = sweep.gravity(animals[0].gravity) * 1e-3 * rods  # mm/ms^2; MuJoCo's has none
        gravity = level if sweep.tilt_ms else sweep.gravity(animals[0].gravity, 1.0) * 1e-3 * rods
        resting = _bend_lines(animals, profile, tuple(gravity.tolist()))
        outward = faces_right(animals, resting)
        # All that follows is in the frame in which the object goes along -y.
        across = sweep.across
        lines = [line @ across.T for line in resting]
        turned = [piece.vertices * sweep.size_mm @ sweep.turn.T for piece in target.pieces]
        shape = [points @ across.T for points in turned]
        start = _beside(lines, outward, np.concatenate(shape), sweep)
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
        self._sweep, self._start, self._ahead = sweep, across.T @ start, across.T @ (0, -1, 0)
        self._samples, self._felt = 0, felt
        self._level, self._gravity = level, gravity
        self._tare: Floats | float = 0.0  # loads of the whiskers' weight before a tilt, N and N m
        self._tilts = tilted and bool(sweep.tilt_ms)
        self._turned, self.wedged = np.zeros((0, len(whiskers), 2)), set[str]()
        self._overlapping = np.zeros(len(felt), dtype=np.int64)
        rear = start[1] + max(points[:, 1].max() for points in shape)
        last = min(line[:, 1].min() for line in lines)
        # with a ramp it has gone half as far by its end
        whole = (rear - last + CLEAR_MM) / (sweep.speed_mm_s * 1e-3)
        self.duration_ms = float(whole + sweep.ramp_ms / 2)

    @cached_property
    def _world(self) -> World:
        """Step the whiskers; made with the first sample, not for a rejected draw."""
        profile = self._profile
        if engine_of(profile) != "rods":
            return MujocoWorld(self.model, self._felt, profile, self._start)
        from tactile_rt.sim_backend.rods.world import Piece, RodWorld

        parts = [Piece.of(piece) for piece in self._pieces]
        roots = _roots(self._animals)[self._simulated]
        steps = round(SAMPLE_MS / profile.timestep_ms)
        if self._gravity.any():
            level = RodWorld(self._felt, roots, (), profile.links, steps, self._level)
            self._tare = level.rest_loads()
        return RodWorld(self._felt, roots, parts, profile.links, steps, self._gravity)

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The MuJoCo model of the sweep, also where another engine steps it: for pictures."""
        return sweep_model(self._animals, self._names, self._pieces, self._profile)

    def first_touch(self) -> list[trimesh.Trimesh]:
        """Place the object's pieces where it first touches a whisker, in the world, mm."""
        place = self._start + self._sweep.gap_mm * self._ahead
        return [trimesh.Trimesh(p.vertices + place, p.faces, process=False) for p in self._pieces]

    def show(self, data: mujoco.MjData) -> None:
        """Put the whiskers and the object of a `model` where they are now."""
        data.qpos[:] = self._world.angles
        data.mocap_pos[0] = self._place(np.array([self._samples]))[0]
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
        """As `advance`, and where each whisker touches.

        Args:
            every: where looking costs as much as a step, look only at every so many samples, from
                the first, and take what is seen to last until the next look.

        Returns:
            The loads, and (samples, element, 3) contacts, see `contacts.CONTACT_CHANNELS`.
        """
        loads = np.zeros((samples, self._elements, 6))
        contacts = np.zeros((samples, self._elements, len(CONTACT_CHANNELS)))
        first = self._samples
        way = self._place(first + np.arange(samples + 1))
        self._turned = np.zeros((samples, self._elements, 2))
        self._samples += samples
        if len(self._simulated):
            found = self._world.advance(way, every, self._shaken(first, samples))
            loads[:, self._simulated] = found[0] - self._tare
            contacts[:, self._simulated] = found[1]
            if len(self._world.turns):  # MuJoCo's bases do not give
                self._turned[:, self._simulated] = self._world.turns
            self._note_wedged(getattr(self._world, "overlap", np.zeros((0, 0))))
        return loads, contacts

    def _note_wedged(self, overlap: Floats) -> None:
        for sample in overlap > WEDGED_MM:  # (whisker,) each
            self._overlapping = np.where(sample, self._overlapping + 1, 0)
            self.wedged |= {
                self._felt[i].name for i in np.flatnonzero(self._overlapping > WEDGED_MS)
            }

    def _place(self, samples: NDArray[np.int64]) -> Floats:
        """(n, 3) where the object is after so many samples, mm, from the head."""
        t, ramp = samples * SAMPLE_MS, self._sweep.ramp_ms
        way = np.asarray(t, dtype=np.float64)
        if ramp:
            x = np.minimum(t / ramp, 1.0)
            way = np.maximum(t - ramp, 0.0) + ramp * (x**3 - x**4 / 2)
        place: Floats = self._start + (self._sweep.speed_mm_s * 1e-3 * way)[:, None] * self._ahead
        return place

    def _shaken(self, first: int, samples: int) -> Floats | None:
        """(n, 3) acceleration of the head from sample `first` on, mm/ms^2; None: it has none."""
        sweep, ramp = self._sweep, self._sweep.ramp_ms
        moves = bool(sweep.head_moves) and first * SAMPLE_MS < ramp
        if not (moves or sweep.shake_g or self._tilts):
            return None
        times = (first + np.arange(samples) + 0.5) * SAMPLE_MS
        shaken = np.zeros((samples, 3))
        if moves:
            x = np.minimum(times / ramp, 1.0)
            # the head goes against the object's way: of x^3 - x^4 / 2, the second derivative
            shaken += np.outer(sweep.speed_mm_s * 1e-3 * (6 * x - 6 * x**2) / ramp, -self._ahead)
        if sweep.shake_g:
            grown = np.minimum(times / SHAKEN_IN_MS, 1.0)
            wave = grown * np.sin(2 * np.pi * sweep.shake_hz * 1e-3 * times)
            shaken += np.outer(sweep.shake_g * EARTH * 1e-3 * wave, np.ones(3) / np.sqrt(3))
        if self._tilts:  # what gravity is more than at the tare
            x = np.minimum(times / sweep.tilt_ms, 1.0)
            described = self._animals[0].gravity
            turned = [sweep.gravity(described, share) * 1e-3 for share in x**2 * (3 - 2 * x)]
            shaken -= np.array(turned) - self._level
        return shaken

    def turns(self) -> Floats:
        """(sample, element, 2) turns of bases that give, about the elements' y and z, rad.

        Of the samples of the last `advance`, means; zero of mounts that do not give.
        """
        return self._turned

    def loads(self, samples_at_once: int = 50) -> Iterator[Floats]:
        """Advance in pieces until the object has passed."""
        while self._samples * SAMPLE_MS < self.duration_ms:
            yield self.advance(samples_at_once)


def draw_simulation(
    rng: np.random.Generator,
    array: WhiskerArray | tuple[WhiskerArray, ...],
    target: TactileObject,
    profile: Profile,
    draw: Callable[[np.random.Generator], Sweep] = draw_sweep,
) -> tuple[Sweep, SweepSimulation]:
    """Draw sweeps until the object meets the array; give up, with a miss, after many tries."""
    for _ in range(DRAWS):
        sweep = draw(rng)
        simulation = SweepSimulation(array, target, sweep, profile)
        if simulation.touches:
            break
    return sweep, simulation


def _beside(
    lines: Sequence[Floats], outward: NDArray[np.bool_], shape: Floats, sweep: Sweep
) -> Floats:
    """Where the object's centre is far up the y axis, mm, on the side that whiskers reach to."""
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
    """Find the lines (point, 3) of whiskers at rest, bent by their weight, mm."""
    from tactile_rt.sim_backend.rods.world import RodWorld

    lines = [line for a in animals for line in centrelines(a.whiskers, a.mount)]
    if not any(gravity):
        return lines
    whiskers = [w for animal in animals for w in animal.whiskers]
    steps = round(SAMPLE_MS / profile.timestep_ms)
    world = RodWorld(whiskers, _roots(animals), (), profile.links, steps, np.array(gravity))
    for whisker, line, sag in zip(whiskers, lines, world.sag, strict=True):
        s = np.linspace(0, whisker.length, len(line))
        nodes = link_nodes(whisker, profile.links)
        line += np.stack([np.interp(s, nodes, sag[:, k]) for k in range(3)], axis=1)
    return lines


def _on_surface(animal: WhiskerArray, friction: float) -> WhiskerArray:
    """The array on a surface of so many times the friction."""
    if friction == 1:
        return animal
    whiskers = tuple(replace(w, friction=w.friction * friction) for w in animal.whiskers)
    return replace(animal, whiskers=whiskers)


def _roots(animals: Sequence[WhiskerArray]) -> Floats:
    """(whisker, 4, 3) base points, mm, and the elements' frames, both in the world."""
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
