"""Whisking bases: kinematics against rotation matrices, dynamics against rigid-body mechanics."""

import dataclasses

import mujoco
import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.sim_backend.arrays.files import mouse_whiskers
from tactile_rt.sim_backend.arrays.whisker_array import Mount, mirror_whisker
from tactile_rt.sim_backend.trajectories import Whisk, base_angles, mirror, read_trajectory
from tactile_rt.sim_backend.whisking import HEAD, WhiskSimulation
from tactile_rt.sim_backend.world import PROFILES, Profile, add_whiskers, empty_world, set_damping
from tests.helpers.beams import about
from tests.helpers.refusals import refusal

MOUSE = {w.name: w for w in mouse_whiskers()}
FEW = tuple(MOUSE[n] for n in ("A1", "B0", "C2", "D3", "E5"))
DATASET = PROFILES["dataset"]
AHEAD = np.array([0.0, 0.5, 0.0])  # by a post's radius
# Knutsen et al. (2008), as published: rows A-E.
ELEVATION = {"A": 0.398, "B": 0.591, "C": 0.578, "D": 0.393, "E": 0.217}
TORSION = {"A": -0.9, "B": -0.284, "C": 0.243, "D": 0.449, "E": 0.744}


@dataclasses.dataclass(frozen=True)
class Turning:
    """Any smooth turn: offsets (t,) -> (t, 3), the same for all whiskers."""

    turn: object
    duration_s: float

    def offsets(self, t_s, whiskers):
        return np.repeat(self.turn(np.maximum(t_s, 0))[:, None], len(whiskers), axis=1)


def orientation(theta, phi, zeta):
    ex, ey, ez = np.eye(3)
    return about(ez, theta - np.pi / 2) @ about(ey, -phi) @ about(ex, zeta + np.pi / 2)


def prism(centre, radius=0.5, height=16.0, sides=24):
    """A round post standing along z."""
    a = np.arange(sides) * 2 * np.pi / sides
    ring = np.stack([radius * np.cos(a), radius * np.sin(a), np.zeros(sides)], axis=1)
    up = np.array([0, 0, height / 2])
    return np.concatenate([ring - up, ring + up]) + centre


def point(whisker, protraction, s):
    """World position of arc length s on a whisker at rest that has turned by `protraction`."""
    row = whisker.name[0]
    t, p, z = whisker.angles
    turned = (t + protraction, p + ELEVATION[row] * protraction, z + TORSION[row] * protraction)
    at = np.array(whisker.base) + orientation(*turned) @ whisker.centreline(np.array([s]))[0]
    return about((0, 1, 0), np.radians(15)) @ at


def test_a_whisker_keeps_its_own_damping_ratio():
    """Rayleigh's c = 2 zeta k / omega, less the step times k that the integrator adds."""
    profile = PROFILES["accurate"]
    damping = []
    for ratio in (0.15, 0.45):
        c2 = dataclasses.replace(MOUSE["C2"], damping_ratio=ratio)
        still = Turning(lambda t: np.zeros((len(t), 3)), 0.01)
        model = WhiskSimulation((c2,), still, profile).model
        bending = model.jnt_stiffness[model.dof_jntid] > 0
        stiffness = model.jnt_stiffness[model.dof_jntid][bending]
        damping.append(model.dof_damping[bending] / stiffness + profile.timestep_ms)
    np.testing.assert_allclose(damping[1], 3 * damping[0], rtol=1e-9)


def test_a_simulation_that_went_unstable_is_not_taken_for_a_result():
    still = Turning(lambda t: np.zeros((len(t), 3)), 0.01)
    simulation = WhiskSimulation((MOUSE["C2"],), still, DATASET)
    simulation.data.qvel[-1] = np.nan
    with pytest.raises(SourceError, match="unstable: a whisker jams"):
        simulation.advance(2)


# ---- kinematics


def test_bases_follow_the_published_slopes():
    move = Whisk(duration_s=0.16)
    sim = WhiskSimulation(FEW, move, DATASET)
    head = about((0, 1, 0), np.radians(15))
    for ms in (40, 60, 60):
        sim.advance(ms)
        step = round(sim.data.time / DATASET.timestep_ms)
        theta = move.offsets(np.array([step * DATASET.timestep_ms * 1e-3]), FEW)[0, :, 0]
        mujoco.mj_kinematics(sim.model, sim.data)
        for w, d in zip(FEW, theta, strict=True):
            t, p, z = w.angles
            row = w.name[0]
            want = head @ orientation(t + d, p + ELEVATION[row] * d, z + TORSION[row] * d)
            got = sim.data.body(w.name).xmat.reshape(3, 3)
            # Bodies' quaternions are rounded to 1e-9 as the array is built.
            np.testing.assert_allclose(got, want, rtol=0, atol=3e-9)
    assert np.ptp(theta) == 0
    assert abs(theta[0]) > 0.05


def test_protraction_is_rostral_on_both_sides():
    whiskers = tuple(
        dataclasses.replace(f(w), name=side + w.name)
        for side, f in (("R", lambda w: w), ("L", mirror_whisker))
        for w in FEW[1:4]
    )
    level = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    # A quarter second of protraction only.
    move = Turning(lambda t: np.stack([10 * t**3, 5 * t**3, -4 * t**3], axis=1), 0.25)
    sim = WhiskSimulation(whiskers, move, DATASET, mount=level)
    before = [sim.data.xpos[i].copy() for i in tips(sim, whiskers)]
    sim.advance(250)
    after = [sim.data.xpos[i].copy() for i in tips(sim, whiskers)]
    moved = np.array(after) - np.array(before)
    assert (moved[:, 1] > 1).all()
    np.testing.assert_allclose(moved[3:], moved[:3] * [-1, 1, 1], atol=2e-4)
    np.testing.assert_array_equal(mirror(whiskers)[:, 0], [1, 1, 1, -1, -1, -1])


def tips(sim, whiskers):
    """The last body of every whisker."""
    of = [sim._owner[g] for g in range(sim.model.ngeom)]
    return [sim.model.geom_bodyid[len(of) - 1 - of[::-1].index(i)] for i in range(len(whiskers))]


def test_a_cycle_has_the_asked_extent_and_frequency():
    move = Whisk(frequency_hz=5, protraction_deg=30, retraction_deg=8, duration_s=1)
    t = np.linspace(0.2, 1.0, 8001)  # whole cycles after the ramp
    theta = np.degrees(move.offsets(t, FEW)[:, 2, 0])
    assert theta.max() == pytest.approx(30, abs=1e-4)
    assert theta.min() == pytest.approx(-8, abs=1e-4)
    np.testing.assert_allclose(theta[2000:4000], theta[4000:6000], atol=1e-9)
    assert np.mean(np.diff(theta) > 0) == pytest.approx(0.5, abs=2e-3)
    # Twice continuously differentiable: the second difference changes little from step to step.
    bend = np.diff(np.degrees(move.offsets(np.arange(0, 1, 1e-4), FEW)[:, 2, 0]), 2) / 1e-8
    assert np.abs(np.diff(bend)).max() < 0.02 * np.abs(bend).max()


@pytest.mark.parametrize(
    "wrong",
    [{"frequency_hz": -1}, {"protraction_deg": 700}, {"duration_s": 0}, {"ramp_s": float("nan")}],
)  # fmt: skip
def test_impossible_whisks_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong))):
        Whisk(**wrong)


def test_tracking_is_exact_even_in_contact():
    """Before it is put right, a step ends where the trajectory goes."""
    c2 = MOUSE["C2"]
    post = prism(point(c2, np.radians(15), 8.0) + AHEAD)
    sim = WhiskSimulation((c2,), Whisk(duration_s=0.1), DATASET, (post,))
    worst, touched = 0.0, 0
    for _ in range(100):
        touched += sim.advance(1)[1].sum()
        worst = max(worst, np.abs(sim.data.qpos[sim._positions] - sim._compute_turns(1)[1]).max())
    assert touched > 20
    assert 0 < worst < 1e-7


# ---- dynamics


@pytest.mark.parametrize("mount", [0.0, 1e-2])
def test_a_stiff_whisker_loads_its_base_with_its_inertia(mount):
    stiff = dataclasses.replace(
        MOUSE["C2"], curvature=0.0, angles=(1.2, 0.0, -np.pi / 2), young_modulus=5e12,
        mount_stiffness=mount, mount_damping=1e-3 * mount,
    )  # fmt: skip
    s = np.linspace(0, stiff.length, 20001)
    r = stiff.radius(s)
    line = stiff.density(s) * np.pi * (r * 1e-3) ** 2  # kg / m
    inertia = np.trapezoid(line * ((s * 1e-3) ** 2 + (r * 1e-3) ** 2 / 4), s * 1e-3)
    first = np.trapezoid(line * s * 1e-3, s * 1e-3)  # mass times arm, kg m
    f, amplitude = 8.0, 0.3

    # In azimuth alone, about the whisker's own z; from rest, so there are no transients.
    def turn(t):
        u = np.clip(t / 0.1, 0, 1)
        grow = u**3 * (10 - 15 * u + 6 * u**2)
        return np.outer(grow * amplitude * np.sin(2 * np.pi * f * t), [1.0, 0, 0])

    level = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    loads, _ = WhiskSimulation((stiff,), Turning(turn, 0.3), DATASET, mount=level).advance(300)
    # Middle of each millisecond's steps, which are read at their beginnings.
    t = (np.arange(300) + 0.4) * 1e-3
    w = 2 * np.pi * f
    spin = amplitude * w * np.cos(w * t)
    alpha = -amplitude * w**2 * np.sin(w * t)
    late = slice(150, 300)
    for channel, want in ((5, -inertia * alpha), (1, -first * alpha), (0, first * spin**2)):
        error = np.abs(loads[late, 0, channel] - want[late]).max()
        assert error < 0.01 * np.abs(want[late]).max(), channel


def test_turning_against_a_post_is_the_same_as_a_post_that_comes():
    """Slow and without friction, the moving base against a fixed base and a moving post."""
    c2 = dataclasses.replace(MOUSE["C2"], friction=0.0)
    here = point(c2, np.radians(6), 10.0) + AHEAD
    move = Whisk(frequency_hz=1, protraction_deg=12, retraction_deg=0, ramp_s=0.1, duration_s=0.5)
    profile = Profile(10, 0.2, 0.02)
    sim = WhiskSimulation((c2,), move, profile, (prism(here),))
    sim.model.geom_friction[:] = 1e-9
    turned, touch = sim.advance(500)

    world = empty_world(profile)
    add_whiskers(world, (c2,), profile, HEAD)
    body = world.worldbody.add_body(name="post", mocap=True)
    world.add_mesh(name="post", uservert=prism(np.zeros(3)).astype(np.float32).ravel())
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH, meshname="post", contype=2, conaffinity=1, group=2
    )
    model = world.compile()
    set_damping(model)
    model.geom_friction[:] = 1e-9
    data = mujoco.MjData(model)
    head = HEAD.rotation
    base = head @ np.array(c2.base)
    rest = head @ orientation(*c2.angles)
    # Steps are read at their beginnings.
    times = np.arange(2500) * 0.2e-3
    readings = []
    for angles in base_angles(move, times, (c2,))[:, 0]:
        back = rest @ (head @ orientation(*angles)).T
        data.mocap_pos[0] = base + back @ (here - base)
        mujoco.mju_mat2Quat(data.mocap_quat[0], np.ascontiguousarray(back).ravel())
        mujoco.mj_step(model, data)
        readings.append(data.sensordata.copy())
    scale = np.repeat([1e-3, 1e-6], 3)
    still = -np.array(readings).reshape(500, 5, 6).mean(axis=1) * scale
    assert touch[:, 0].sum() > 200
    for part in (slice(0, 3), slice(3, 6)):
        error = np.sqrt(np.square(turned[:, 0, part] - still[:, part]).sum())
        assert error < 0.02 * np.sqrt(np.square(still[:, part]).sum())


def test_a_mount_that_gives_is_held_by_the_loads_that_its_spring_tells():
    """Turned against a post, the moment at the base is the spring's stiffness times its turn."""
    c2 = dataclasses.replace(MOUSE["C2"], mount_stiffness=2e-6, mount_damping=2e-8)
    move = Whisk(frequency_hz=1, protraction_deg=12, retraction_deg=0, ramp_s=0.1, duration_s=0.4)
    here = point(c2, np.radians(6), 10.0) + AHEAD
    sim = WhiskSimulation((c2,), move, DATASET, (prism(here),))
    clamped = WhiskSimulation((MOUSE["C2"],), move, DATASET, (prism(here),))
    (loads, touch), (stiffer, _) = sim.advance(400), clamped.advance(400)
    assert touch[-1, 0]
    turn = sim.data.qpos[[sim.model.joint(f"C2 0 {axis}").qposadr[0] for axis in "yz"]]
    np.testing.assert_allclose(np.abs(loads[-1, 0, 4:]), 2e-6 * np.abs(turn), rtol=0.05, atol=1e-9)
    assert np.linalg.norm(loads[-1, 0, :3]) < 0.9 * np.linalg.norm(stiffer[-1, 0, :3])


# ---- contact


@pytest.mark.parametrize("name", ["B1", "C2", "E1"])
def test_a_post_is_met_when_and_as_geometry_says(name):
    whisker = MOUSE[name]
    s = 0.6 * whisker.length
    meets = np.radians(12)
    on_axis = point(whisker, meets, s)
    ahead = point(whisker, meets + 1e-4, s) - on_axis
    ahead[2] = 0
    ahead /= np.linalg.norm(ahead)
    radius = 0.5
    along = point(whisker, meets, s + 0.01) - point(whisker, meets, s - 0.01)
    # The post's axis is its radius, and the whisker's, off the whisker's line.
    normal = np.cross(along, [0, 0, 1.0])
    normal /= np.linalg.norm(normal)
    normal *= np.sign(normal @ ahead)
    post = prism(on_axis + normal * (radius + whisker.radius(s)), radius)
    move = Whisk(duration_s=0.1)
    sim = WhiskSimulation((whisker,), move, Profile(20, 0.1, 0.02), (post,))
    loads, touch = sim.advance(100)
    grid = np.arange(0, 0.0625, 1e-5)
    theta = move.offsets(grid, (whisker,))[:, 0, 0]
    expected_ms = grid[np.argmax(theta >= meets)] * 1e3
    assert abs(touch[:, 0].argmax() - expected_ms) <= 2
    # The post pushes the whisker back: against the motion, so caudally, in the world frame.
    i = touch[:, 0].argmax() + 5
    turn = orientation(*base_angles(move, np.array([i * 1e-3]), (whisker,))[0, 0])
    force = HEAD.rotation @ turn @ loads[i, 0, :3]
    assert force @ normal < 0
    # Moment about the base: arm cross force, in the base's own frame.
    arm = whisker.centreline(np.array([s]))[0] * 1e-3
    expected = np.cross(arm, loads[i, 0, :3])
    np.testing.assert_allclose(
        loads[i, 0, 3:], expected, atol=0.15 * np.linalg.norm(expected), rtol=0
    )


def test_it_is_the_same_every_time_and_in_any_pieces():
    c2 = (MOUSE["C2"], MOUSE["D1"])
    post = prism(point(c2[0], np.radians(15), 12.0) + AHEAD)

    def run(*pieces):
        sim = WhiskSimulation(c2, Whisk(duration_s=0.1), DATASET, (post,))
        return [np.concatenate(p) for p in zip(*map(sim.advance, pieces), strict=True)]

    loads, touch = run(100)
    assert touch.any()
    for pieces in ((100,), (1,) * 10 + (37, 53), (99, 40)):
        again, touched = run(*pieces)
        np.testing.assert_array_equal(again, loads)
        np.testing.assert_array_equal(touched, touch)


def test_an_object_in_the_way_at_the_start_is_refused():
    post = prism(point(MOUSE["C2"], 0.0, 10.0))
    with pytest.raises(ConfigError, match="C2 begin inside the object"):
        WhiskSimulation((MOUSE["C2"], MOUSE["A1"]), Whisk(), DATASET, (post,))


# ---- recorded trajectories


def written(tmp_path, text):
    path = tmp_path / "angles.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_recorded_trajectory_is_followed(tmp_path):
    t = np.arange(0, 0.5, 0.004) + 7.0  # a recording need not begin at 0
    theta = 20 * np.sin(2 * np.pi * 6 * (t - 7)) + 3
    lines = ["# high-speed video", "time_s,theta_deg,theta_deg_D,zeta_deg_C2"]
    lines += [f"{a:.6f},{b:.9f},{2 * b:.9f},{-b:.9f}" for a, b in zip(t, theta, strict=True)]
    move = read_trajectory(written(tmp_path, "\n".join(lines) + "\n"), FEW)
    assert move.duration_s == pytest.approx(0.496)
    late = np.arange(0.1, 0.49, 0.00037)
    want = np.radians(20 * np.sin(2 * np.pi * 6 * late) + 3)
    got = move.offsets(late, FEW)
    names = [w.name for w in FEW]
    c2, d3, b0 = (names.index(n) for n in ("C2", "D3", "B0"))
    for k, angle, factor in (
        (c2, 0, 1), (c2, 1, 0.578), (c2, 2, -1), (d3, 0, 2), (d3, 2, 2 * 0.449), (b0, 1, 0.591)
    ):  # fmt: skip
        np.testing.assert_allclose(got[:, k, angle], factor * want, atol=3e-5)
    # It begins standing still in the first posture.
    start = move.offsets(np.array([-1.0, 0.0, 1e-4]), FEW)[:, b0, 0]
    np.testing.assert_allclose(start, np.radians(3), atol=1e-7)
    sim = WhiskSimulation(FEW, move, DATASET)
    assert sim.samples == 496
    loads, _ = sim.advance(60)
    assert np.abs(loads[..., :3]).max() < 1e-4


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty; its first line names the columns"),
        ("time_s,theta_deg\n", "0 samples; a cubic spline needs"),
        ("t,theta_deg\n0,1\n", ":1: the first column must be time_s"),
        ("time_s,theta_deg_Z9\n0,1\n", ":1: column 'theta_deg_Z9' is none of"),
        ("time_s,theta_deg\n0,1\n0.1,x\n", ":3: theta_deg: expected a number, got 'x'"),
        ("time_s,theta_deg\n0,1\n1,1\n2,1\n", "3 samples; a cubic spline needs at least 4"),
        ("time_s,theta_deg\n0,1\n1,1\n1,1\n2,1\n", ":4: time_s does not increase"),
        ("time_s,theta_deg\n0,1\n1,1\n2,150\n3,1\n", ":4: theta_deg is beyond 120"),
        ("time_s,theta_deg_C\n0,1\n1,1\n2,1\n3,1\n", "no theta_deg for whisker A1"),
    ],
)
def test_mistakes_in_a_recording_are_named(tmp_path, text, said):
    path = written(tmp_path, text)
    found = refusal(read_trajectory, path, FEW)
    assert found.startswith(str(path)) and said in found
