"""The mechanics of a chain beside MuJoCo's, which knows nothing of ours."""

from itertools import pairwise

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from tactile_rt.sim_backend.arrays.files import mouse_whiskers
from tactile_rt.sim_backend.arrays.whiskers import link_inertia, link_nodes
from tactile_rt.sim_backend.rods import chains
from tactile_rt.sim_backend.rods.rod import make_rod, match_ringing
from tactile_rt.sim_backend.world import Mount, Profile, add_whiskers, empty_world

LINKS, FREE = 10, 20
Floats = NDArray[np.float64]


class Both:
    """A whisker in a drawn posture, in motion, as MuJoCo's model and as ours."""

    def __init__(self, name: str, seed: int) -> None:
        rng = np.random.default_rng(seed)
        whisker = next(w for w in mouse_whiskers() if w.name == name)
        profile = Profile(LINKS, 0.25, 0.02, "mujoco")
        world = empty_world(profile)
        add_whiskers(world, (whisker,), profile, Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
        self.model = world.compile()
        self.model.jnt_stiffness[:] = 0.0
        self.data = mujoco.MjData(self.model)
        self.q, self.v, self.a = (rng.normal(size=FREE) * size for size in (0.2, 0.05, 0.01))
        self.data.qpos[:], self.data.qvel[:], self.data.qacc[:] = self.q, self.v, self.a
        self.rod = make_rod(whisker, LINKS, 4)
        s = link_nodes(whisker, LINKS)
        self.inertia = np.array([link_inertia(whisker, x, y) for x, y in pairwise(s)])
        self.chain = self.rod.chain
        nodes, frames = np.zeros((LINKS + 2, 3)), np.zeros((LINKS + 1, 3, 3))
        self.pose = chains.Pose(nodes, frames, np.zeros((FREE, 3)))
        nodes[0] = whisker.base
        frames[0] = whisker.orientation @ self.rod.to_element.T
        chains.place(self.chain, self.q, self.pose)


@pytest.mark.parametrize("name", ["B0", "C2", "E5"])
@pytest.mark.parametrize("seed", range(3))
def test_places_masses_and_forces_are_mujoco_s(name: str, seed: int) -> None:
    both = Both(name, seed)
    model, data = both.model, both.data
    mujoco.mj_inverse(model, data)
    np.testing.assert_allclose(both.pose.nodes[1:-1], data.xanchor[::2], atol=1e-6)  # mm
    np.testing.assert_allclose(both.pose.axes, data.xaxis, atol=1e-7)

    wanted = np.empty((FREE, FREE))
    mujoco.mj_fullM(model, data, wanted)
    lower = np.zeros((FREE, FREE))
    chains.mass_matrix(both.chain, both.pose, np.empty((3, 3)), lower)
    np.testing.assert_allclose(np.tril(lower), np.tril(wanted), atol=1e-7 * abs(wanted).max())

    torques, wrench = np.zeros(FREE), np.zeros(6)
    none, work = np.zeros((LINKS + 1, 6)), np.empty((LINKS + 1, 6))
    still = np.zeros((4, 3))
    chains.inertial_forces(
        both.chain, both.pose, both.v, both.a, still, none, work, torques, wrench
    )
    scale = abs(data.qfrc_inverse).max()
    np.testing.assert_allclose(torques, data.qfrc_inverse, atol=1e-7 * scale)
    # The base gives the whole momentum's change: Newton's second law on all the links.
    wrong = np.linalg.norm(wrench[:3] - _rate_of_momentum(both))
    assert wrong <= 1e-4 * np.linalg.norm(wrench[:3])


def _momentum(both: Both, q: Floats, v: Floats) -> Floats:
    """(3,) linear momentum, by differences of where the centres of mass are."""
    h, at = 1e-4, []  # ms; shorter, and rounding is all that differs
    for shift in (-h, h):
        pose = chains.Pose(*(x.copy() for x in both.pose))
        chains.place(both.chain, q + shift * v, pose)
        at.append(pose.nodes[:-1] + pose.frames[:, :, 0] * both.inertia[:, 1:2])
    momentum: Floats = both.inertia[:, 0] @ (at[1] - at[0]) / (2 * h)
    return momentum


def _rate_of_momentum(both: Both) -> Floats:
    h = 1e-4
    before = _momentum(both, both.q - h * both.v + h * h / 2 * both.a, both.v - h * both.a)
    after = _momentum(both, both.q + h * both.v + h * h / 2 * both.a, both.v + h * both.a)
    rate: Floats = (after - before) / (2 * h)
    return rate


def test_a_base_that_is_accelerated_pulls_every_mass_along() -> None:
    both = Both("C2", 0)
    base = np.zeros((4, 3))
    base[2] = 0.3, -0.2, 0.1
    torques, wrench, still = np.zeros(FREE), np.zeros(6), np.zeros(FREE)
    none, work = np.zeros((LINKS + 1, 6)), np.empty((LINKS + 1, 6))
    chains.inertial_forces(both.chain, both.pose, still, still, base, none, work, torques, wrench)
    centres = both.pose.nodes[:-1] + both.pose.frames[:, :, 0] * both.inertia[:, 1:2]
    mass = both.inertia[:, 0]
    np.testing.assert_allclose(wrench[:3], mass.sum() * base[2], rtol=1e-12)
    moment = np.cross(mass @ (centres - both.pose.nodes[0]), base[2])
    np.testing.assert_allclose(wrench[3:], moment, rtol=1e-9)


@pytest.mark.parametrize("ratio", [0.02, 0.32, 0.9, 1.5])
@pytest.mark.parametrize("turn", [0.01, 0.2, 0.5])
def test_a_matched_step_multiplies_a_mode_as_time_does(ratio: float, turn: float) -> None:
    """Both poles of backward Euler with the mass and damping found are those of the oscillator."""
    omega, h = 0.8, turn / 0.8
    heavier, beta = match_ringing(omega, ratio, h)
    k, m = 1.0, heavier / omega**2
    step = np.linalg.inv([[1.0, -h], [h * k / m, 1 + h * beta * k / m]])
    lam = np.roots([1, 2 * ratio * omega, omega**2]).astype(complex)
    wanted = np.exp(lam * h)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(step).astype(complex)), np.sort_complex(wanted), rtol=1e-6
    )
    assert (beta >= 0) == (wanted.sum().real >= 2 * np.prod(wanted).real)
