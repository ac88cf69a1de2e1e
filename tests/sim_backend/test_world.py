"""The array's model: poses, signs, units, rest and profiles; its mechanics are `bench/sim`'s."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from tactile_rt.sim_backend.arrays.files import mouse_whiskers
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.world import (
    CHANNELS,
    MOUNT,
    PROFILES,
    UNITS,
    Mount,
    Profile,
    add_whiskers,
    array_spec,
    empty_world,
    read_base_loads,
    set_damping,
)
from tests.helpers.beams import abscissa, compliance, line_mass

# In the plane of the world's x and y, its base at the origin.
FLAT = {
    w.name: replace(w, base=(0.0, 0.0, 0.0), angles=(np.pi / 2, 0.0, -np.pi / 2))
    for w in mouse_whiskers()
}
ORIGIN = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


# The model: mm, mg, ms (so mN)


def build(
    profile: Profile, *whiskers: Whisker, mount: Mount = ORIGIN
) -> tuple[mujoco.MjModel, mujoco.MjData, dict[str, float]]:
    """Whiskers alone in the world: model, state at rest, first resonances (Hz)."""
    world = empty_world(profile)
    add_whiskers(world, whiskers, profile, mount)
    model = world.compile()
    resonances = set_damping(model)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data, resonances


def test_the_step_itself_over_damps_only_the_short_whiskers() -> None:
    for profile, most in (("realtime", 18), ("dataset", 11), ("accurate", 4)):
        model, _, resonances = build(PROFILES[profile], *mouse_whiskers())
        free = {
            model.joint(model.dof_jntid[i]).name.split()[0]
            for i in np.flatnonzero(model.dof_damping == 0)
        }
        assert len(free) <= most
        # 2 zeta / omega below the step, and no other whisker
        step = PROFILES[profile].timestep_ms
        assert free == {n for n, f in resonances.items() if 0.64 / (2e-3 * np.pi * f) <= step}


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("profile", ["realtime", "dataset"])
def test_base_loads_are_what_was_applied(profile: str, axis: int) -> None:
    """Signs, axes, units and lever arm, on whiskers in their places on a tilted head."""
    whiskers = tuple(w for w in mouse_whiskers() if w.name in ("B1", "C2", "E5"))
    model, data, resonances = build(PROFILES[profile], *whiskers, mount=MOUNT)
    roll, pitch, yaw = MOUNT.roll_pitch_yaw
    head = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    pushed = []
    for whisker in whiskers:
        theta, phi, zeta = whisker.angles
        turn = Rotation.from_euler("ZYX", [theta - np.pi / 2, -phi, zeta + np.pi / 2]).as_matrix()
        last = max(i for i in range(model.nbody) if _whisker_of(model, i) == whisker.name)
        force = np.full(3, 0.1)
        force[axis] = 1.0
        # along the element's axes: a tenth of the whisker's length of deflection, or so
        force *= 100 * whisker.length / compliance(whisker, 1)  # mN
        data.xfrc_applied[last, :3] = head @ turn @ force
        pushed.append((whisker, head @ turn, last, force))
    for _ in range(round(60e3 / min(resonances.values()) / model.opt.timestep)):
        mujoco.mj_step(model, data)
    mujoco.mj_forward(model, data)  # poses and sensors of the state reached
    loads = read_base_loads(data.sensordata)
    assert loads.shape == (3, 6)
    for (whisker, frame, last, force), load in zip(pushed, loads, strict=True):
        base = np.array(MOUNT.position) + head @ np.array(whisker.base)
        arm = frame.T @ (data.xipos[last] - base)  # mm
        assert np.linalg.norm(arm) > 0.5 * whisker.length
        wanted = np.concatenate([force * 1e-3, np.cross(arm, force) * 1e-6])  # N, N m
        for part in (slice(0, 3), slice(3, 6)):
            scale = np.linalg.norm(wanted[part])
            np.testing.assert_allclose(load[part], wanted[part], rtol=0, atol=1e-6 * scale)
        if axis == 1:
            assert load[1] > 0 and load[5] > 0  # as `array_spec` promises


def _whisker_of(model: mujoco.MjModel, body: int) -> str:
    """The name of the whisker that a link belongs to."""
    while not model.body(body).name:
        body = model.body_parentid[body]
    return str(model.body(body).name)


@pytest.mark.parametrize("profile", PROFILES)
def test_at_rest_there_is_exactly_no_load(profile: str) -> None:
    model, data, _ = build(PROFILES[profile], *mouse_whiskers(), mount=MOUNT)
    assert not model.opt.gravity.any()
    for _ in range(20):
        mujoco.mj_step(model, data)
        assert not data.sensordata.any() and not data.qpos.any() and data.ncon == 0


def test_the_spec_describes_the_array_in_si() -> None:
    whiskers = mouse_whiskers()
    spec = array_spec(whiskers, "mouse-right")
    assert (spec.name, spec.frame, spec.rate_hz) == ("mouse-right", "head", 1000.0)
    assert spec.channels == CHANNELS == ("fx", "fy", "fz", "mx", "my", "mz")
    assert spec.units == UNITS == ("N",) * 3 + ("N m",) * 3
    assert spec.shape == (30, 6) and spec.grid_shape == (5, 7)
    c2 = spec.elements.index("C2")
    assert spec.grid[c2] == (2, 2)
    np.testing.assert_allclose(spec.positions[c2], [4.3446e-3, -0.48847e-3, 0.33139e-3])
    w, x, y, z = spec.orientations[c2]
    turned = Rotation.from_quat([x, y, z, w]).as_matrix()
    np.testing.assert_allclose(turned, whiskers[c2].orientation, atol=1e-8)
    assert spec == array_spec(mouse_whiskers(), "mouse-right")


def test_a_chain_lies_on_its_whisker() -> None:
    whisker = FLAT["D0"]
    model, data, _ = build(PROFILES["accurate"], whisker)
    links = data.xpos[-PROFILES["accurate"].links :]
    a = whisker.curvature
    np.testing.assert_allclose(links[:, 1], a * links[:, 0] ** 2, atol=1e-6)
    last = data.xpos[-1] + 2 * model.geom_size[-1, 1] * data.xmat[-1].reshape(3, 3)[:, 0]
    end = abscissa(whisker, whisker.length)
    np.testing.assert_allclose(last, [end, a * end**2, 0.0], atol=1e-6)
    mass = 1e9 * quad(lambda s: float(line_mass(whisker, s)), 0, whisker.length)[0]  # mg
    assert model.body_mass.sum() == pytest.approx(mass, rel=2e-3)
