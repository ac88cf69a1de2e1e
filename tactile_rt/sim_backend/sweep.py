"""An object swept past the array: the world, the motion, the base loads at 1 kHz.

World frame: z up, x away from the head, y rostral; its origin is where the published sweeps have
it (see `whisker_array.MOUNT`). The object moves along -y, as things do past a head that moves
forward.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache

import mujoco
import numpy as np
import trimesh
from mujoco import rollout
from numpy.typing import NDArray

from tactile_rt.sim_backend.approach import (
    centrelines,
    faces_right,
    lateral_reach,
    way_to_contact,
    within_reach,
)
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.arrays.head import add_head
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import rotation
from tactile_rt.sim_backend.contacts import CONTACT_CHANNELS, ContactProbe
from tactile_rt.sim_backend.objects.catalogue import TactileObject
from tactile_rt.sim_backend.world import (
    OBJECT_BIT,
    SAMPLE_MS,
    WHISKER_BIT,
    Profile,
    add_whiskers,
    empty_world,
    quaternion,
    read_base_loads,
    set_damping,
)
from tactile_rt.stream import SourceError

__all__ = [
    "UNSTABLE",
    "Sweep",
    "SweepSimulation",
    "draw_simulation",
    "draw_sweep",
    "usual_distance",
]

FAR_MM = 200.0  # where the object is when the way to first contact is measured
DRAWS = 20  # tries to draw parameters with which an object meets the array at all
CLEAR_MM = 5.0  # how far past the last whisker a sweep goes on

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sweep:
    """How an object is swept past the array (Chung et al. 2025, appendix A1).

    Attributes:
        size_mm: The largest extent of the object, mm.
        speed_mm_s: The speed of the object along -y, mm/s.
        yaw_deg: The rotation of the object about z, degrees.
        height_mm: The z of the object's centre in the world frame, mm.
        distance_mm: The distance from the mean of the whiskers' base points to the object's nearest
            face, along world x, mm; below 5.5 the stiff rostral whiskers of a mouse jam.
        gap_mm: The way before first contact at which the object starts, mm.
    """

    size_mm: float = 40.0
    speed_mm_s: float = 34.0
    yaw_deg: float = 0.0
    height_mm: float = -2.0
    distance_mm: float = 6.5
    gap_mm: float = 2.0


class SweepSimulation:
    """One sweep, simulated on demand: `advance` steps it, `loads` runs it to its end.

    Whiskers do not touch each other, so those that the object passes by stay at rest and are not
    simulated, nor are pieces of the object that no whisker could reach.

    Args:
        array: the whiskers; a tuple of arrays for several animals in one world
            (`whisker_array.place`). The object passes on the side to which most of the whiskers
            reach.
        target: the object.
        sweep: how it moves.
        profile: how finely to simulate.
        whole: simulate everything all the same: the loads are those, and a picture is complete.

    Attributes:
        touches: False when the object passes without meeting any resting whisker.
        duration_ms: The simulated time after which the object has passed all whiskers, ms.
    """

    def __init__(
        self,
        array: WhiskerArray | tuple[WhiskerArray, ...],
        target: TactileObject,
        sweep: Sweep,
        profile: Profile,
        whole: bool = False,
    ) -> None:
        animals = array if isinstance(array, tuple) else (array,)
        whiskers = [w for animal in animals for w in animal.whiskers]
        lines = [line for a in animals for line in centrelines(a.whiskers, a.mount)]
        turn = rotation("z", np.radians(sweep.yaw_deg))
        shape = [piece.vertices * sweep.size_mm @ turn.T for piece in target.pieces]
        start = _beside(lines, faces_right(animals, lines), np.concatenate(shape), sweep)
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
        self._simulated = np.flatnonzero(met | whole)
        self._elements = len(whiskers)
        self._felt = [whiskers[i] for i in self._simulated]
        self._profile = profile
        self._probe: ContactProbe | None = None  # made when contacts are first asked for

        world = empty_world(profile)
        names = {whiskers[i].name for i in self._simulated}
        for animal in animals:
            some = tuple(w for w in animal.whiskers if w.name in names)
            head = add_whiskers(world, some, profile, animal.mount, f"head {animal.name}")
            if animal.head is not None:
                add_head(world, head, animal.head)
        touched = [lines[i] for i in self._simulated]
        lengths = [whiskers[i].length for i in self._simulated]
        kept = range(len(pieces)) if whole else within_reach(touched, lengths, pieces)
        _add_object(world, [target.pieces[i] for i in kept], sweep.size_mm, turn)
        self.model = world.compile()
        set_damping(self.model, whiskers)
        self.data = mujoco.MjData(self.model)
        self._start = start
        self._step_mm = np.array([0.0, -sweep.speed_mm_s * 1e-3 * profile.timestep_ms, 0.0])
        self.data.mocap_pos[0] = start
        mujoco.mj_kinematics(self.model, self.data)
        # The solver takes a mocap body to stand still; friction must see its surface move. The
        # flag is set at compile time by non-zero velocities only: without it they are ignored.
        self.model.flg_surfacevel = True
        for geom in np.flatnonzero(self.model.geom_contype == OBJECT_BIT):
            frame = self.data.geom_xmat[geom].reshape(3, 3)
            self.model.geom_surfacevel[geom, :3] = frame.T @ (self._step_mm / profile.timestep_ms)
        mujoco.mj_forward(self.model, self.data)

        rear = start[1] + max(points[:, 1].max() for points in shape)
        last = min(line[:, 1].min() for line in lines)
        self.duration_ms = float((rear - last + CLEAR_MM) / (sweep.speed_mm_s * 1e-3))
        self._steps_per_sample = round(SAMPLE_MS / profile.timestep_ms)
        self._steps_done = 0

    def advance(self, samples: int) -> Floats:
        """Simulate the next samples of 1 ms.

        Returns:
            (samples, element, 6) base loads, N and N m, each the mean over its millisecond.

        Raises:
            SourceError: the simulation has become unstable: whiskers too stiff for the profile
                jam against the object.
        """
        return self._advance(samples)[0]

    def advance_with_contacts(self, samples: int, every: int = 1) -> tuple[Floats, Floats]:
        """As `advance`, and where each whisker touches at the end of each sample.

        Args:
            samples: as for `advance`.
            every: look only at every so many samples, from the first, and take what is seen to
                last until the next look, which costs as much as a step.

        Returns:
            The loads, and (samples, element, 3) contacts, see `contacts.CONTACT_CHANNELS`.

        Raises:
            SourceError: as `advance`.
        """
        done, steps = self._steps_done, self._steps_per_sample
        loads, states = self._advance(samples)
        contacts = np.zeros((samples, self._elements, len(CONTACT_CHANNELS)))
        if len(self._simulated):
            self._probe = self._probe or ContactProbe(self.model, self._felt, self._profile)
            for k in range(0, samples, every):
                step = (k + 1) * steps
                place = self._start + (done + step) * self._step_mm
                seen = self._probe.read(states[step - 1], place)
                contacts[k : k + every, self._simulated] = seen
        return loads, contacts

    def _advance(self, samples: int) -> tuple[Floats, Floats]:
        """The loads, and the (step, ...) states that the steps began with."""
        steps = samples * self._steps_per_sample
        when = self._steps_done + np.arange(1, steps + 1)
        self._steps_done += steps
        loads = np.zeros((samples, self._elements, 6))
        if not len(self._simulated):
            return loads, np.zeros((steps, 0))
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, state, spec)
        states, sensors = rollout.rollout(
            self.model,
            self.data,
            state[None],
            (self._start + when[:, None] * self._step_mm)[None],
            control_spec=int(mujoco.mjtState.mjSTATE_MOCAP_POS),
            initial_warmstart=self.data.qacc_warmstart.copy()[None],
        )
        if any(self.data.warning[kind].number for kind in UNSTABLE):
            raise SourceError(
                "the simulation has become unstable: a whisker jams that is too stiff for this "
                "profile; sweep at a larger distance, or at a finer profile"
            )
        sampled = sensors[0].reshape(samples, self._steps_per_sample, -1).mean(axis=1)
        loads[:, self._simulated] = read_base_loads(sampled)
        return loads, np.concatenate([state[None], states[0, :-1]])

    def loads(self, samples_at_once: int = 50) -> Iterator[Floats]:
        """Advance in pieces until the object has passed."""
        while self._steps_done * self.model.opt.timestep < self.duration_ms:
            yield self.advance(samples_at_once)


UNSTABLE = tuple(
    int(kind)
    for kind in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
)


def usual_distance(animals: tuple[WhiskerArray, ...]) -> float:
    """A mouse's 6.5 mm, for other arrays as much more as their whiskers reach further, mm.

    So an object comes to the same share of the whiskers: 20 of a mouse's 30 reach beyond its
    6.5 mm, 19 of a rat's 30 beyond its 8.75.
    """
    return round(Sweep.distance_mm * lateral_reach(animals) / _mouse_reach(), 2)


@cache
def _mouse_reach() -> float:
    return lateral_reach(load_animals("mouse"))


def draw_sweep(rng: np.random.Generator, distance_mm: float = Sweep.distance_mm) -> Sweep:
    """Draw the parameters of one sweep: any yaw, a spread of heights, distances and speeds.

    Args:
        rng: to draw from.
        distance_mm: about which distances spread, see `usual_distance`.
    """
    return Sweep(
        speed_mm_s=float(rng.uniform(28, 40)),
        yaw_deg=float(rng.uniform(0, 360)),
        height_mm=float(rng.uniform(-8, 4)),
        distance_mm=float(rng.uniform(5.5, 8)) * distance_mm / Sweep.distance_mm,
        gap_mm=float(rng.uniform(0.5, 4)),
    )


def draw_simulation(
    rng: np.random.Generator,
    array: WhiskerArray | tuple[WhiskerArray, ...],
    target: TactileObject,
    profile: Profile,
    distance_mm: float = Sweep.distance_mm,
) -> tuple[Sweep, SweepSimulation]:
    """Draw sweeps until the object meets the array; give up, with a miss, after many tries.

    Args:
        rng, distance_mm: see `draw_sweep`.
        array, target, profile: see `SweepSimulation`.
    """
    for _ in range(DRAWS):
        sweep = draw_sweep(rng, distance_mm)
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


def _add_object(
    world: mujoco.MjSpec, pieces: Sequence[trimesh.Trimesh], size_mm: float, turn: Floats
) -> None:
    body = world.worldbody.add_body(name="object", mocap=True, quat=quaternion(turn))
    for i, piece in enumerate(pieces):
        world.add_mesh(
            name=f"piece {i}",
            uservert=(piece.vertices * size_mm).astype(np.float32).ravel(),
            userface=piece.faces.astype(np.int32).ravel(),
        )
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"piece {i}",
            contype=OBJECT_BIT,
            conaffinity=WHISKER_BIT,
            group=OBJECT_BIT,
            rgba=(0.75, 0.55, 0.3, 1.0),
        )
