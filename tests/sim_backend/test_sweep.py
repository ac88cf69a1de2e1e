from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("trimesh")

import mujoco
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tactile_rt.sim_backend.array import MOUNT, OBJECT_BIT, PROFILES, WHISKER_BIT, read_base_loads
from tactile_rt.sim_backend.objects import CATEGORIES, TactileObject, load_object, make_object
from tactile_rt.sim_backend.solids import box
from tactile_rt.sim_backend.sweep import Sweep, SweepSimulation
from tactile_rt.sim_backend.whiskers import Whisker, mouse_whiskers

ALL = mouse_whiskers()
SOME = tuple(w for w in ALL if w.name in ("B1", "C1", "C2", "D2", "E1", "E5"))
C2 = tuple(w for w in ALL if w.name == "C2")
REALTIME = PROFILES["realtime"]
NOTHING_N = 1e-9  # a force below what any sensor or class could tell from rest


def block(*sides: float) -> TactileObject:
    """A box; unequal sides make MuJoCo turn the frame of its mesh."""
    return TactileObject("block", "block", (box((0, 0, 0), sides or (1, 1, 1)),))


def stepped(
    simulation: SweepSimulation, sweep: Sweep, ms: float
) -> Iterator[tuple[mujoco.MjModel, mujoco.MjData]]:
    """Move the object by hand, one physics step at a time, as the docstring of `Sweep` says."""
    model, data = simulation.model, simulation.data
    start, step = data.mocap_pos[0].copy(), model.opt.timestep
    for i in range(1, round(ms / step) + 1):
        data.mocap_pos[0] = start - (0, i * step * sweep.speed_mm_s * 1e-3, 0)
        mujoco.mj_step(model, data)
        yield model, data


def in_world(loads: NDArray[np.float64], whisker: Whisker) -> NDArray[np.float64]:
    """Force (..., 3) of one whisker's loads (..., 6), turned into the world frame."""
    roll, pitch, yaw = MOUNT.roll_pitch_yaw
    theta, phi, zeta = whisker.angles
    head = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    turn = Rotation.from_euler("ZYX", [theta - np.pi / 2, -phi, zeta + np.pi / 2])
    return np.asarray(loads[..., :3] @ (head * turn).as_matrix().T)


@pytest.mark.parametrize("category", CATEGORIES)
def test_it_starts_clear_of_the_whiskers_and_meets_them_when_said(category: str) -> None:
    for yaw in (0.0, 40.0):
        sweep = Sweep(gap_mm=1.0, yaw_deg=yaw)
        simulation = SweepSimulation(ALL, make_object(category, 0), sweep, REALTIME)
        assert simulation.touches and simulation.data.ncon == 0
        way = 0.0
        for _, data in stepped(simulation, sweep, 60):
            if data.ncon:
                break
            way += sweep.speed_mm_s * 1e-3 * REALTIME.timestep_ms
        # early where a slanted edge meets a whisker's side before the ray through its axis
        assert -0.2 < way - sweep.gap_mm < 0.05


def test_only_whiskers_and_object_touch() -> None:
    sweep = Sweep(gap_mm=0.5)
    simulation = SweepSimulation(ALL, make_object("chair", 1), sweep, REALTIME)
    seen = 0
    for model, data in stepped(simulation, sweep, 500):
        kinds = model.geom_contype[data.contact.geom]
        assert (np.sort(kinds, axis=1) == [WHISKER_BIT, OBJECT_BIT]).all()
        seen += len(kinds)
    assert seen > 1000


def test_a_sweep_does_not_depend_on_how_it_is_cut() -> None:
    sweep = Sweep(gap_mm=0.2, yaw_deg=30)
    target = make_object("gear", 2)
    whole = SweepSimulation(SOME, target, sweep, REALTIME).advance(160)
    cut = SweepSimulation(SOME, target, sweep, REALTIME)
    pieces = [cut.advance(n) for n in (1, 9, 7, 40, 3, 100)]
    assert whole.shape == (160, len(SOME), 6) and np.abs(whole).max() > 1e-6
    np.testing.assert_array_equal(whole, np.concatenate(pieces))
    again = SweepSimulation(SOME, target, sweep, REALTIME).advance(160)
    np.testing.assert_array_equal(whole, again)


def test_a_sample_is_the_mean_over_its_millisecond() -> None:
    sweep = Sweep(gap_mm=0.2)
    profile = PROFILES["dataset"]
    loads = SweepSimulation(C2, block(), sweep, profile).advance(60)
    by_hand = SweepSimulation(C2, block(), sweep, profile)
    raw = np.array([d.sensordata.copy() for _, d in stepped(by_hand, sweep, 60)])
    assert len(raw) == 300 and np.abs(loads[-1]).max() > 0
    np.testing.assert_allclose(
        loads, read_base_loads(raw.reshape(60, 5, 6).mean(axis=1)), atol=1e-15
    )


# The face that slides along the whisker is parallel to the motion and faces -x, whatever the yaw.
@pytest.mark.parametrize("profile", ["realtime", "dataset"])
@pytest.mark.parametrize("yaw", [0.0, 90.0, 180.0])
def test_a_sliding_face_drags_the_whisker_along_by_coulombs_law(profile: str, yaw: float) -> None:
    """Friction is 0.5 of the normal force, towards -y: fails if the face seems to stand still."""
    sides = (1.0, 0.9, 0.7) if yaw % 180 == 0 else (0.9, 1.0, 0.7)
    sweep = Sweep(gap_mm=0.2, yaw_deg=yaw)
    simulation = SweepSimulation(C2, block(*sides), sweep, PROFILES[profile])
    force = in_world(simulation.advance(700)[:, 0], C2[0])[500:]
    normal, along, up = force.T
    assert (normal < -2e-5).all()  # pushed back towards the head
    np.testing.assert_allclose(along / normal, 0.5, atol=0.03)
    np.testing.assert_allclose(up / normal, 0.0, atol=0.05)


def test_whiskers_come_to_rest_when_it_has_passed() -> None:
    simulation = SweepSimulation(ALL, make_object("bottle", 0), Sweep(), REALTIME)
    pieces = list(simulation.loads(samples_at_once=20))
    loads = np.concatenate(pieces)
    assert {len(p) for p in pieces} == {20}
    assert 0 <= len(loads) - simulation.duration_ms < 20
    touched = (np.abs(loads[..., :3]) > NOTHING_N).any(axis=(0, 2))
    assert touched.sum() >= 10
    assert np.abs(loads[-10:, :, :3]).max() < NOTHING_N
    assert simulation.data.ncon == 0
    assert np.isfinite(loads).all()


@pytest.mark.parametrize("sweep", [Sweep(height_mm=60), Sweep(distance_mm=40)])
def test_an_object_out_of_reach_touches_nothing(sweep: Sweep) -> None:
    simulation = SweepSimulation(SOME, block(), sweep, REALTIME)
    assert simulation.touches is False
    assert 0 < simulation.duration_ms < 5000
    assert not np.concatenate(list(simulation.loads())).any()


def test_the_parameters_place_the_object() -> None:
    """Its pose in the world, from the corners of its mesh as MuJoCo has them."""
    sweep = Sweep(size_mm=30, yaw_deg=90, height_mm=-3, distance_mm=7, speed_mm_s=30)
    target = block(1.0, 0.5, 0.25)
    simulation = SweepSimulation(SOME, target, sweep, REALTIME)
    model, data = simulation.model, simulation.data

    def corners() -> NDArray[np.float64]:
        geom = int(np.flatnonzero(model.geom_contype == OBJECT_BIT)[0])
        turn = data.geom_xmat[geom].reshape(3, 3)
        return np.asarray(model.mesh_vert @ turn.T + data.geom_xpos[geom])

    low, high = corners().min(axis=0), corners().max(axis=0)
    np.testing.assert_allclose(high - low, [15, 30, 7.5], atol=1e-3)  # yawed by 90 degrees
    assert (low + high)[2] / 2 == pytest.approx(-3, abs=1e-3)
    roll, pitch, yaw = MOUNT.roll_pitch_yaw
    head = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    bases = np.array(MOUNT.position) + np.array([w.base for w in SOME]) @ head.T
    assert low[0] == pytest.approx(bases[:, 0].mean() + 7, abs=1e-3)
    simulation.advance(100)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(corners().min(axis=0) - low, [0, -3, 0], atol=1e-3)


def test_faster_objects_pass_sooner() -> None:
    slow, fast = (
        SweepSimulation(C2, block(), Sweep(speed_mm_s=v), REALTIME).duration_ms for v in (20, 40)
    )
    assert slow == pytest.approx(2 * fast)


def test_a_mesh_file_feels_like_the_thing_it_holds(tmp_path: Path) -> None:
    solid = block(1.0, 0.9, 0.7)
    path = tmp_path / "brick.stl"
    solid.pieces[0].copy().apply_scale(83.0).export(path)
    sweep = Sweep(gap_mm=0.2)
    wanted = SweepSimulation(C2, solid, sweep, REALTIME).advance(150)
    found = SweepSimulation(C2, load_object(str(path)), sweep, REALTIME).advance(150)
    assert np.abs(wanted).max() > 1e-6
    # STL stores single precision, and where a whisker slips off an edge that shows
    assert np.sqrt(np.mean((found - wanted) ** 2)) < 0.02 * np.sqrt(np.mean(wanted**2))


def test_an_object_of_several_pieces_is_felt_as_their_union() -> None:
    halves = tuple(box((x, 0, 0), (0.5, 1, 1)) for x in (-0.25, 0.25))
    sweep = Sweep(gap_mm=0.2)
    whole = SweepSimulation(C2, block(), sweep, REALTIME).advance(300)
    cut = SweepSimulation(C2, TactileObject("halves", "halves", halves), sweep, REALTIME).advance(
        300
    )
    assert np.sqrt(np.mean((cut - whole) ** 2)) < 0.05 * np.sqrt(np.mean(whole**2))
