from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tactile_rt.core.errors import SourceError
from tactile_rt.sim_backend.arrays.files import load_animals, load_array
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray, place
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.objects.catalogue import (
    CATEGORIES,
    TactileObject,
    load_object,
    make_object,
)
from tactile_rt.sim_backend.objects.solids import box
from tactile_rt.sim_backend.sweep import (
    Sweep,
    centrelines,
    draw_sweep,
    usual_distance,
    way_to_contact,
)
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.world import (
    MOUNT,
    OBJECT_BIT,
    PROFILES,
    WHISKER_BIT,
    read_base_loads,
    world_spec,
)

ALL = load_array("mouse")


def only(*names: str) -> WhiskerArray:
    """Some whiskers of the mouse."""
    return replace(ALL, whiskers=tuple(w for w in ALL.whiskers if w.name in names))


SOME, C2 = only("B1", "C1", "C2", "D2", "E1", "E5"), only("C2")
REALTIME = PROFILES["realtime"]
NOTHING_N = 1e-9  # a force below what any sensor or class could tell from rest


def block(*sides: float) -> TactileObject:
    """A box; unequal sides make MuJoCo turn the frame of its mesh."""
    return TactileObject("block", "block", (box((0, 0, 0), sides or (1, 1, 1)),))


def shown(simulation: SweepSimulation) -> mujoco.MjData:
    """Where everything is, in MuJoCo's terms."""
    data = mujoco.MjData(simulation.model)
    simulation.show(data)
    mujoco.mj_forward(simulation.model, data)
    return data


def stepped(
    simulation: SweepSimulation, sweep: Sweep, ms: float
) -> Iterator[tuple[mujoco.MjModel, mujoco.MjData]]:
    """Move the object by hand, one physics step at a time, as the docstring of `Sweep` says."""
    model, data = simulation.model, shown(simulation)
    start, step = data.mocap_pos[0].copy(), model.opt.timestep
    model.flg_surfacevel = True
    for geom in np.flatnonzero(model.geom_contype == OBJECT_BIT):
        along = data.geom_xmat[geom].reshape(3, 3).T @ (0, -sweep.speed_mm_s * 1e-3, 0)
        model.geom_surfacevel[geom, :3] = along
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
        assert simulation.touches and shown(simulation).ncon == 0
        way = 0.0
        for _, data in stepped(simulation, sweep, 60):
            if data.ncon:
                break
            way += sweep.speed_mm_s * 1e-3 * REALTIME.timestep_ms
        # where a face slants, nearness of 0.15 mm comes long before contact
        assert -0.2 < way - sweep.gap_mm < 1.5


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
    assert whole.shape == (160, len(SOME.whiskers), 6) and np.abs(whole).max() > 1e-6
    np.testing.assert_array_equal(whole, np.concatenate(pieces))
    again = SweepSimulation(SOME, target, sweep, REALTIME).advance(160)
    np.testing.assert_array_equal(whole, again)


def test_a_sample_is_the_mean_over_its_millisecond() -> None:
    sweep = Sweep(gap_mm=0.2)
    profile = PROFILES["mujoco"]
    loads = SweepSimulation(C2, block(), sweep, profile).advance(60)
    by_hand = SweepSimulation(C2, block(), sweep, profile)
    raw = np.array([d.sensordata.copy() for _, d in stepped(by_hand, sweep, 60)])
    steps = round(1 / profile.timestep_ms)
    assert len(raw) == 60 * steps and np.abs(loads[-1]).max() > 0
    means = read_base_loads(raw.reshape(60, steps, 6).mean(axis=1))
    np.testing.assert_allclose(loads, means, atol=1e-15)


# The face that slides along the whisker is parallel to the motion and faces -x, whatever the yaw.
@pytest.mark.parametrize("profile", ["realtime", "dataset"])
@pytest.mark.parametrize("yaw", [0.0, 90.0, 180.0])
def test_a_sliding_face_drags_the_whisker_along_by_coulombs_law(profile: str, yaw: float) -> None:
    """Friction is 0.5 of the normal force, towards -y: fails if the face seems to stand still."""
    sides = (1.0, 0.9, 0.7) if yaw % 180 == 0 else (0.9, 1.0, 0.7)
    sweep = Sweep(gap_mm=0.2, yaw_deg=yaw)
    simulation = SweepSimulation(C2, block(*sides), sweep, PROFILES[profile])
    force = in_world(simulation.advance(700)[:, 0], C2.whiskers[0])[500:]
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
    assert not simulation.advance_with_contacts(5)[1].any()
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
    model = simulation.model

    def corners() -> NDArray[np.float64]:
        data = shown(simulation)
        geom = int(np.flatnonzero(model.geom_contype == OBJECT_BIT)[0])
        turn = data.geom_xmat[geom].reshape(3, 3)
        return np.asarray(model.mesh_vert @ turn.T + data.geom_xpos[geom])

    low, high = corners().min(axis=0), corners().max(axis=0)
    np.testing.assert_allclose(high - low, [15, 30, 7.5], atol=1e-3)  # yawed by 90 degrees
    assert (low + high)[2] / 2 == pytest.approx(-3, abs=1e-3)
    roll, pitch, yaw = MOUNT.roll_pitch_yaw
    head = Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix()
    bases = np.array(MOUNT.position) + np.array([w.base for w in SOME.whiskers]) @ head.T
    assert low[0] == pytest.approx(bases[:, 0].mean() + 7, abs=1e-3)
    simulation.advance(100)
    np.testing.assert_allclose(corners().min(axis=0) - low, [0, -3, 0], atol=1e-3)


def test_an_object_of_several_pieces_is_felt_as_their_union() -> None:
    halves = tuple(box((x, 0, 0), (0.5, 1, 1)) for x in (-0.25, 0.25))
    sweep = Sweep(gap_mm=0.2)
    whole = SweepSimulation(C2, block(), sweep, REALTIME).advance(300)
    cut = SweepSimulation(C2, TactileObject("cut", "cut", halves), sweep, REALTIME).advance(300)
    assert np.sqrt(np.mean((cut - whole) ** 2)) < 0.05 * np.sqrt(np.mean(whole**2))


def test_what_is_left_out_changes_no_load() -> None:
    target, sweep = make_object("chair", 3), Sweep(yaw_deg=70, height_mm=3, gap_mm=0.5)
    some = SweepSimulation(ALL, target, sweep, REALTIME)
    everything = SweepSimulation(ALL, target, sweep, REALTIME, whole=True)
    assert some.model.nv < everything.model.nv and some.model.nmesh < everything.model.nmesh
    loads, wanted = some.advance(300), everything.advance(300)
    assert (wanted != 0).any(axis=(0, 2)).sum() > 5
    np.testing.assert_allclose(loads, wanted, atol=1e-6 * np.abs(wanted).max())


def test_animals_share_a_world() -> None:
    """Two mice one above the other: the lower meets the block as it does when alone."""
    above = replace(ALL.mount, position=(-6.934, -11.642, 60.0))
    both = place((ALL, replace(ALL, mount=above)))
    sweep = Sweep(gap_mm=0.3, height_mm=-8)
    loads = SweepSimulation(both, block(), sweep, REALTIME).advance(100)
    alone = SweepSimulation(ALL, block(), sweep, REALTIME).advance(100)
    assert loads.shape == (100, 60, 6) and np.abs(alone).max() > 1e-5
    np.testing.assert_allclose(loads[:, :30], alone, atol=1e-3 * np.abs(alone).max())
    assert not loads[:, 30:].any()


def test_a_simulation_that_has_become_unstable_says_so() -> None:
    simulation = SweepSimulation(C2, block(), Sweep(gap_mm=0.2), REALTIME)
    simulation.advance(20)
    simulation._world.angles[:] = np.nan
    with pytest.raises(SourceError, match="unstable"):
        simulation.advance(20)
    assert not Path("MUJOCO_LOG.TXT").exists()


def test_a_world_of_two_animals_has_one_spec() -> None:
    mirrored = load_array("mouse-left")
    spec = world_spec(place((ALL, mirrored)))
    assert spec.frame == "world" and spec.shape == (60, 6)
    assert spec.elements[0].startswith("1.") and spec.elements[30].startswith("2.")
    # world x is what the two heads are mirror images in
    right, left = np.array(spec.positions[:30]), np.array(spec.positions[30:])
    np.testing.assert_allclose(left, right * [-1, 1, 1], atol=1e-12)
    turn = Rotation.from_quat(spec.orientations[2], scalar_first=True).as_matrix()
    np.testing.assert_allclose(turn, MOUNT.rotation @ ALL.whiskers[2].orientation, atol=1e-8)
    assert world_spec((ALL,)).frame == "head"


def test_an_object_passes_a_mouse_of_two_sides_as_it_passes_the_right_one() -> None:
    """On the turned head two left whiskers point across: the distance is not theirs."""
    sweep, target = Sweep(size_mm=30, yaw_deg=90), load_object("mug-1")
    one, both = (
        SweepSimulation(load_array(n), target, sweep, REALTIME) for n in ("mouse", "mouse-both")
    )
    np.testing.assert_allclose(shown(both).mocap_pos[0], shown(one).mocap_pos[0], atol=1e-9)


def test_distances_grow_with_the_reach_of_the_whiskers() -> None:
    """As large a share of the whiskers as of a mouse's reaches beyond it, within one in 30."""

    def beyond(name: str) -> float:
        animals = load_animals(name)
        (array,) = animals
        tips = [
            array.mount.rotation
            @ (w.orientation @ w.centreline(np.array([w.length]))[0] + np.array(w.base))
            for w in array.whiskers
        ]
        bases = [array.mount.rotation @ np.array(w.base) for w in array.whiskers]
        middle = np.mean(bases, axis=0)[0]
        return float(np.mean([t[0] - middle > usual_distance(animals) for t in tips]))

    assert usual_distance(load_animals("mouse")) == Sweep.distance_mm == 6.5
    assert usual_distance(load_animals("mouse-both")) == 6.5
    assert usual_distance(load_animals("mouse-left")) == 6.5
    assert abs(beyond("rat") - beyond("mouse")) <= 1 / 30 + 1e-9
    near, far = (draw_sweep(np.random.default_rng(1), d) for d in (6.5, 13.0))
    assert far == replace(near, distance_mm=2 * near.distance_mm)
    assert 5.5 <= near.distance_mm <= 8


def test_an_object_first_touches_where_it_is_said_to() -> None:
    simulation = SweepSimulation(ALL, make_object("mug", 1), Sweep(), REALTIME, whole=True)
    lines = centrelines(ALL.whiskers, ALL.mount)
    way, _ = way_to_contact(ALL.whiskers, lines, simulation.first_touch())
    assert way == pytest.approx(0, abs=1e-6)
