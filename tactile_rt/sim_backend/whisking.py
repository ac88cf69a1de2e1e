"""Simulation of active whisking: the rotating bases, and the loads that result.

The base angles are prescribed, not driven: each base has three hinges of so large an inertia that
loads on the whisker do not move it, and in every physics step a force accelerates it along the
trajectory. So the bases have a velocity, which friction and the whiskers' inertia need and which
a body that is merely placed (a mocap body) does not have.
"""

import math
from typing import Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.sim_backend.arrays.whisker_array import Mount
from tactile_rt.sim_backend.arrays.whiskers import Whisker, rotation
from tactile_rt.sim_backend.mujoco_world import UNSTABLE, add_piece
from tactile_rt.sim_backend.trajectories import ANGLES, Trajectory, mirror
from tactile_rt.sim_backend.world import (
    SAMPLE_MS,
    Profile,
    add_whiskers,
    empty_world,
    read_base_loads,
    set_damping,
)

# Head of the published whisking simulations (Chung et al. 2025, code): there its "pitch" of 15
# degrees is about the rostral axis, right side down. The world's origin is the array's: x to the
# right, y rostral, z up.
HEAD = Mount((0.0, 0.0, 0.0), (0.0, float(np.radians(15.0)), 0.0))
# mg mm^2; a whisker has 10 at most. From 1e8 on the solver converges badly.
BASE_INERTIA = 1e6
NO_MASS = 1e-9  # mg and mg mm^2: negligible
ENDLESS: Final = 1 << 62  # samples
# Of the solver. Its default of 1e-8 includes the bases' inertia, so it is met before contacts are
# solved.
TOLERANCE = 1e-16


class WhiskSimulation:
    """The simulation of an array that whisks, alone or against a stationary object.

    Args:
        pieces: (points, 3) corners of the convex pieces of an object, mm, in the world frame.

    Attributes:
        samples: The length of the trajectory in samples of 1 ms; `ENDLESS` if it has no end.

    Raises:
        ConfigError: a whisker begins inside the object.
    """

    def __init__(
        self,
        whiskers: tuple[Whisker, ...],
        trajectory: Trajectory,
        profile: Profile,
        pieces: tuple[NDArray[np.float64], ...] = (),
        mount: Mount = HEAD,
    ) -> None:
        world = empty_world(profile)
        add_whiskers(world, whiskers, profile, mount)
        clamped = world.compile()
        set_damping(clamped, whiskers)  # by the resonance of a whisker whose base stands still
        for whisker in whiskers:
            _add_base_joints(world, whisker)
        for i, points in enumerate(pieces):
            add_piece(world, world.worldbody, f"piece {i}", points)
        self.model = world.compile()
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(f"{w.name} {a}") for w in whiskers for a in ANGLES]
        self._dofs = np.array([j.dofadr[0] for j in joints])
        self._positions = np.array([j.qposadr[0] for j in joints])
        bending = np.setdiff1d(np.arange(self.model.nv), self._dofs)
        self.model.dof_damping[bending] = clamped.dof_damping
        # Set after compiling: the solver's tolerance is relative to the mean inertia at that time.
        self.model.opt.tolerance = TOLERANCE
        self.model.dof_armature[self._dofs] = BASE_INERTIA
        self._count = len(whiskers)
        self._owner = _find_owners(self.model, whiskers)

        self._steps_per_sample = round(SAMPLE_MS / profile.timestep_ms)
        duration_s = trajectory.duration_s
        endless = math.isinf(duration_s)
        self.samples = ENDLESS if endless else int(duration_s * 1e3 / SAMPLE_MS + 1e-6)
        self._trajectory, self._whiskers, self._mirror = trajectory, whiskers, mirror(whiskers)
        self._step = 0
        self._prescribe(self._compute_turns(1))
        mujoco.mj_forward(self.model, self.data)
        if (touched := self._find_touched()).any():
            names = ", ".join(w.name for w, hit in zip(whiskers, touched, strict=True) if hit)
            raise ConfigError(f"{names} begin inside the object: move it away from the array")

    def advance(self, samples: int) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Simulate the next samples of 1 ms, fewer where the trajectory ends.

        Returns:
            (samples, element, 6) base loads, N and N m, each the mean over its millisecond, in the
            element's own frame, which rotates with its base; and (samples, element) flags of
            contact with the object.
        """
        samples = min(samples, self.samples - self._step // self._steps_per_sample)
        sensors = np.zeros((samples, self.model.nsensordata))
        touch = np.zeros((samples, self._count), dtype=np.bool_)
        turns = self._compute_turns(samples * self._steps_per_sample)
        for i in range(samples):
            for k in range(self._steps_per_sample):
                self._prescribe(turns[i * self._steps_per_sample + k :])
                mujoco.mj_step(self.model, self.data)
                self._step += 1
                sensors[i] += self.data.sensordata
                touch[i] |= self._find_touched()
        if any(self.data.warning[kind].number for kind in UNSTABLE):
            raise SourceError(
                "the simulation has become unstable: a whisker jams that is too stiff for this "
                "profile; move the object away, whisk less far, or take a finer profile"
            )
        return read_base_loads(sensors / self._steps_per_sample), touch

    def _compute_turns(self, steps: int) -> NDArray[np.float64]:
        """Compute base angles from rest, (steps + 2, base angle), rad, starting one step back."""
        at = np.arange(self._step - 1, self._step + steps + 1)
        times = at.astype(np.float64) * (self.model.opt.timestep * 1e-3)
        turns = self._trajectory.offsets(times, self._whiskers) * self._mirror
        return turns.reshape(len(times), -1)

    def _prescribe(self, turns: NDArray[np.float64]) -> None:
        """Set the bases' angles and velocities, and the forces for the next step."""
        h = self.model.opt.timestep
        before, now, after = turns[:3]
        self.data.qpos[self._positions] = now
        self.data.qvel[self._dofs] = (now - before) / h
        # The integrator's own second difference: v += h a, then q += h v.
        self.data.qfrc_applied[self._dofs] = BASE_INERTIA * (after - 2 * now + before) / h**2

    def _find_touched(self) -> NDArray[np.bool_]:
        touched = np.zeros(self._count + 1, dtype=np.bool_)  # the last (-1): the object itself
        if self.data.ncon:
            touched[self._owner[self.data.contact.geom]] = True
        return touched[:-1]


def _add_base_joints(world: mujoco.MjSpec, whisker: Whisker) -> None:
    """Add hinges for theta, phi and zeta to a whisker's base.

    With A = Rz(theta - pi/2), B = Ry(-phi) and C = Rx(zeta + pi/2), changing the angles in ABC is
    the same as rotating ABC itself about these axes, one after the other, in the whisker's frame.
    """
    *_, zeta = whisker.angles
    c = rotation("x", zeta + np.pi / 2)
    axes = (whisker.orientation[2], -c[1], np.array([1.0, 0.0, 0.0]))
    base = world.body(whisker.name)
    for angle, axis in zip(ANGLES, axes, strict=True):
        base.add_joint(name=f"{whisker.name} {angle}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis)
    if whisker.mount_stiffness:  # no link is fixed to the base then, but a moving body needs mass
        base.explicitinertial = True
        base.mass, base.inertia = NO_MASS, (NO_MASS, NO_MASS, NO_MASS)


def _find_owners(model: mujoco.MjModel, whiskers: tuple[Whisker, ...]) -> NDArray[np.int64]:
    """Find the index of the whisker that each geom belongs to; -1 for the object."""
    names = {w.name: i for i, w in enumerate(whiskers)}
    owner = np.full(model.nbody, -1, dtype=np.int64)
    for body in range(1, model.nbody):  # parents come before their children
        owner[body] = names.get(model.body(body).name, owner[model.body_parentid[body]])
    found: NDArray[np.int64] = owner[model.geom_bodyid]
    return found
