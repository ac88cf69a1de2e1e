"""An object swept past the array: the world, the motion, the base loads at 1 kHz.

World frame: z up, x away from the head, y rostral; its origin is where the published sweeps have
it (see `array.MOUNT`). The object moves along -y, as things do past a head that moves forward.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from tactile_rt.sim_backend.array import (
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
from tactile_rt.sim_backend.objects import TactileObject
from tactile_rt.sim_backend.whiskers import Whisker, rotation

__all__ = ["Sweep", "SweepSimulation", "draw_simulation", "draw_sweep"]

FAR_MM = 200.0  # where the object waits while the way to first contact is measured
RAY_SPACING_MM = 0.25
DRAWS = 20  # tries to draw parameters with which an object meets the array at all
CLEAR_MM = 5.0  # how far past the last whisker a sweep goes on


@dataclass(frozen=True)
class Sweep:
    """How an object is swept past the array (Chung et al. 2025, appendix A1).

    Attributes:
        size_mm: largest extent of the object, mm.
        speed_mm_s: speed along -y, mm/s.
        yaw_deg: rotation of the object about z, degrees.
        height_mm: z of the object's centre in the world frame, mm.
        distance_mm: from the mean of the whiskers' base points to the object's nearest face,
            along world x, mm; below 5.5 the stiff rostral whiskers jam.
        gap_mm: how far before first contact the object starts, mm.
    """

    size_mm: float = 40.0
    speed_mm_s: float = 34.0
    yaw_deg: float = 0.0
    height_mm: float = -2.0
    distance_mm: float = 6.5
    gap_mm: float = 2.0


class SweepSimulation:
    """One sweep, simulated on demand: `advance` steps it, `loads` runs it to its end.

    Args:
        whiskers: the array.
        target: the object.
        sweep: how it moves.
        profile: how finely to simulate.

    Attributes:
        touches: False when the object passes without meeting any resting whisker.
        duration_ms: simulated time after which the object has passed all whiskers.
    """

    def __init__(
        self,
        whiskers: tuple[Whisker, ...],
        target: TactileObject,
        sweep: Sweep,
        profile: Profile,
    ) -> None:
        world = empty_world(profile)
        add_whiskers(world, whiskers, profile)
        turn = rotation("z", np.radians(sweep.yaw_deg))
        _add_object(world, target, sweep.size_mm, turn)
        self.model = world.compile()
        set_damping(self.model)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_kinematics(self.model, self.data)

        points = np.concatenate([p.vertices for p in target.pieces]) * sweep.size_mm @ turn.T
        face = np.mean([self.data.body(w.name).xpos[0] for w in whiskers])
        self._start = np.array(
            [face + sweep.distance_mm - points[:, 0].min(), FAR_MM, sweep.height_mm]
        )
        self._step_mm = np.array([0.0, -sweep.speed_mm_s * 1e-3 * profile.timestep_ms, 0.0])
        self.data.mocap_pos[0] = self._start
        mujoco.mj_forward(self.model, self.data)
        way = _way_to_contact(self.model, self.data)
        self.touches = way is not None
        self._start[1] -= way - sweep.gap_mm if way is not None else FAR_MM
        self.data.mocap_pos[0] = self._start
        # The solver takes a mocap body to stand still; friction must see its surface move. The
        # flag is set at compile time by non-zero velocities only: without it they are ignored.
        self.model.flg_surfacevel = True
        for geom in np.flatnonzero(self.model.geom_contype == OBJECT_BIT):
            frame = self.data.geom_xmat[geom].reshape(3, 3)
            self.model.geom_surfacevel[geom, :3] = frame.T @ (self._step_mm / profile.timestep_ms)
        mujoco.mj_forward(self.model, self.data)

        rear = self._start[1] + points[:, 1].max()
        last = self.data.geom_xpos[self.model.geom_contype == WHISKER_BIT, 1].min()
        self.duration_ms = float((rear - last + CLEAR_MM) / (sweep.speed_mm_s * 1e-3))
        self._steps_per_sample = round(SAMPLE_MS / profile.timestep_ms)
        self._steps_done = 0

    def advance(self, samples: int) -> NDArray[np.float64]:
        """Simulate the next samples of 1 ms.

        Returns:
            (samples, element, 6) base loads, N and N m, each the mean over its millisecond.
        """
        steps = samples * self._steps_per_sample
        when = self._steps_done + np.arange(1, steps + 1)
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, state, spec)
        _, sensors = rollout.rollout(
            self.model,
            self.data,
            state[None],
            (self._start + when[:, None] * self._step_mm)[None],
            control_spec=int(mujoco.mjtState.mjSTATE_MOCAP_POS),
            initial_warmstart=self.data.qacc_warmstart.copy()[None],
        )
        self._steps_done += steps
        return read_base_loads(sensors[0].reshape(samples, self._steps_per_sample, -1).mean(axis=1))

    def loads(self, samples_at_once: int = 50) -> Iterator[NDArray[np.float64]]:
        """Advance in pieces until the object has passed."""
        while self._steps_done * self.model.opt.timestep < self.duration_ms:
            yield self.advance(samples_at_once)


def draw_sweep(rng: np.random.Generator) -> Sweep:
    """Draw the parameters of one sweep: any yaw, a spread of heights, distances and speeds."""
    return Sweep(
        speed_mm_s=float(rng.uniform(28, 40)),
        yaw_deg=float(rng.uniform(0, 360)),
        height_mm=float(rng.uniform(-8, 4)),
        distance_mm=float(rng.uniform(5.5, 8)),
        gap_mm=float(rng.uniform(0.5, 4)),
    )


def draw_simulation(
    rng: np.random.Generator, whiskers: tuple[Whisker, ...], target: TactileObject, profile: Profile
) -> tuple[Sweep, SweepSimulation]:
    """Draw sweeps until the object meets the array; give up, with a miss, after many tries."""
    for _ in range(DRAWS):
        sweep = draw_sweep(rng)
        simulation = SweepSimulation(whiskers, target, sweep, profile)
        if simulation.touches:
            break
    return sweep, simulation


def _add_object(
    world: mujoco.MjSpec, target: TactileObject, size_mm: float, turn: NDArray[np.float64]
) -> None:
    body = world.worldbody.add_body(name="object", mocap=True, quat=quaternion(turn))
    for i, piece in enumerate(target.pieces):
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


def _way_to_contact(model: mujoco.MjModel, data: mujoco.MjData) -> float | None:
    """How far the object can move along -y before it meets a resting whisker, mm."""
    group = np.zeros(6, dtype=np.uint8)
    group[OBJECT_BIT] = 1
    hit, normal = np.zeros(1, dtype=np.int32), np.zeros(3)
    nearest = np.inf
    for geom in np.flatnonzero(model.geom_contype == WHISKER_BIT):
        radius, half = model.geom_size[geom, :2]
        along = data.geom_xmat[geom].reshape(3, 3)[:, 2]
        for at in np.linspace(-half, half, max(2, round(2 * half / RAY_SPACING_MM) + 1)):
            point = data.geom_xpos[geom] + at * along
            d = mujoco.mj_ray(model, data, point, [0.0, 1.0, 0.0], group, 1, -1, hit, normal)
            if d >= 0:
                nearest = min(nearest, d - radius)
    return float(nearest) if np.isfinite(nearest) else None
