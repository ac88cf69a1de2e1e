"""Whiskers let go, held, heavy, shaken and struck: what no press on a peg shows."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import trimesh

from bench.sim.beams import flat
from bench.sim.motion import HELD_MS, hold, release, strike
from bench.sim.pegs import PEG
from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.objects.catalogue import make_object
from tactile_rt.sim_backend.rods import stepping
from tactile_rt.sim_backend.rods.world import FEW_CORNERS, Piece, RodWorld
from tactile_rt.sim_backend.sweep import EARTH, Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.world import PROFILES
from tests.helpers import beams

G = EARTH * 1e-3  # mm/ms^2
ROOT = np.concatenate([np.zeros((1, 3)), np.eye(3)])[None]  # of a whisker at the origin


@pytest.mark.parametrize(("profile", "bar"), [("realtime", 0.03), ("dataset", 0.01)])
@pytest.mark.parametrize("name", ["B0", "C2", "robot A0"])
def test_a_tip_let_go_swings_as_in_fine_steps(name: str, profile: str, bar: float) -> None:
    for share in (0.01, 0.08):  # of its length
        error, undershoot = release(flat(name), PROFILES[profile], share)
        assert error < bar, share
        assert undershoot == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("profile", ["realtime", "dataset"])
def test_a_touch_that_is_held_keeps_its_friction(profile: str, axis: int) -> None:
    whisker = flat("C2")
    force = hold(whisker, PROFILES[profile], axis=axis)
    early, late = force[-HELD_MS + 50], force[-1]
    assert np.linalg.norm(late - early) < 0.02 * np.linalg.norm(early)
    normal, along = (early[1], early[0]) if axis == 0 else (np.hypot(*early[:2]), early[2])
    # within the cone, tilted by the whisker's own slope where it was pressed
    assert 0.2 * abs(normal) < abs(along) < (whisker.friction + 0.15) * abs(normal)


@pytest.mark.parametrize("name", ["C2", "robot A0", "long ABS"])
@pytest.mark.parametrize("axis", [1, 2])
def test_a_whisker_sags_as_a_beam(name: str, axis: int) -> None:
    whisker, down, finest = flat(name), np.zeros(3), PROFILES["accurate"]
    down[axis] = 1e-3  # so little that a beam's deflection is in proportion
    steps = round(1 / finest.timestep_ms)
    world = RodWorld((whisker,), ROOT, (), finest.links, steps, down * G)
    tip = world.sag[0][-1] * 1e3
    wanted = beams.sag(whisker, EARTH * 1e3)
    if axis == 2 and whisker.curvature:  # out of its plane a curved one also hangs by its bow
        wanted = tip[2]
    assert tip[axis] == pytest.approx(wanted, rel=0.01)
    mass = world.rest_loads()[0][:3] @ down / (down @ down) / EARTH
    s = np.linspace(0, whisker.length, 20_001)
    section = np.pi * (whisker.radius(s) * 1e-3) ** 2
    assert mass == pytest.approx(np.trapezoid(whisker.density(s) * section, s * 1e-3), rel=1e-3)


def test_weight_rests_and_is_tared() -> None:
    robot, mug = load_array("docs/arrays/robot.toml"), make_object("mug", 3)
    assert robot.gravity == (0, 0, -EARTH)
    far = {"gap_mm": 30.0, "distance_mm": 14.0}
    level = SweepSimulation(robot, mug, Sweep(**far), PROFILES["dataset"], whole=True)
    assert abs(level.advance(200)).max() < 1e-15
    tilted, tilting = (
        SweepSimulation(robot, mug, Sweep(tilt_deg=90.0, tilt_ms=t, **far), PROFILES["dataset"])
        for t in (0.0, 150.0)
    )
    still, moved = tilted.advance(400), tilting.advance(400)
    assert not abs(moved[0]).max() > 1e-9 and np.ptp(still, axis=0).max() < 1e-12
    np.testing.assert_allclose(moved[-1], still[-1], atol=2e-3 * abs(still).max())
    # a weight that lay along -z lies along +y in the frame of a head that turned about x
    weight = np.linalg.norm(still[0, :, :3], axis=1)
    s, whisker = np.linspace(0, 24.0, 2001), robot.whiskers[0]
    one = np.trapezoid(whisker.density(s) * np.pi * (whisker.radius(s) * 1e-3) ** 2, s * 1e-3)
    assert weight[0] == pytest.approx(np.sqrt(2) * one * EARTH, rel=1e-3)


def test_weightless_arrays_stay_so() -> None:
    mouse = load_array("mouse")
    assert mouse.gravity == (0, 0, 0)
    with pytest.raises(ConfigError, match="too soft to carry"):
        soft = replace(flat("long nitinol"), young_modulus=1e6)
        RodWorld((soft,), ROOT, (), 10, 4, np.array([0.0, -G, 0.0]))


@pytest.mark.parametrize("profile", ["realtime", "dataset"])
def test_a_shaken_whisker_answers_in_proportion(profile: str) -> None:
    """Near rest, whole samples by the linear answers give what single steps give."""
    mouse, mug = load_array("mouse"), make_object("mug", 3)
    shaken = Sweep(shake_g=0.5, shake_hz=60.0, distance_mm=9.0)
    fast, slow = (SweepSimulation(mouse, mug, shaken, PROFILES[profile]) for _ in range(2))
    loads = fast.advance(300)
    args = list(slow._world._advance.args)
    args[5] = args[5]._replace(answers=args[5].answers[:0])
    args[1] = args[1]._replace(answers=np.zeros_like(args[1].answers))
    slow._world._advance = partial(stepping.advance, *args)
    stepped = slow.advance(300)
    error = np.sqrt(((loads - stepped) ** 2).mean(axis=(0, 1)))
    assert (error < 1e-2 * np.sqrt((stepped**2).mean(axis=(0, 1)))).all()


@pytest.mark.parametrize(("profile", "bar"), [("realtime", 0.1), ("dataset", 0.05)])
@pytest.mark.parametrize("speed", [0.3, 3.0])
def test_a_fast_plate_is_felt(profile: str, bar: float, speed: float) -> None:
    for name, place in (("C2", 0.7), ("A4", 0.8), ("E5", 0.6)):
        assert strike(flat(name), PROFILES[profile], speed, place) < bar, name


def test_what_is_too_fast_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"speed_mm_s must be 0\.001 to 3000"):
        Sweep(speed_mm_s=3001)
    world = RodWorld((flat("C2"),), ROOT, (PEG,), 7, 2)
    with pytest.raises(ConfigError, match=r"moves at 4 m/s; at most 3"):
        world.advance(np.outer(np.arange(3), [0.0, 4.0, 0.0]))


def test_a_body_of_many_corners_is_as_far_as_its_hull() -> None:
    """Uphill along its edges: the loads on a fine sphere are those when every corner is tried."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=4.0)
    piece = Piece.of(ball)
    assert len(piece.corners) > FEW_CORNERS and len(piece.edges) == 2 * len(ball.edges_unique)
    way = np.array([9.0, 5.0, 0.7]) + np.outer(np.linspace(0, 1, 121), [2.0, -2.5, 0.0])
    one, other = (
        RodWorld((flat("C2"),), ROOT, (p,), 10, 4).advance(way)
        for p in (piece, replace(piece, edges=piece.edges[:0]))
    )
    assert one[1][:, 0, 0].any()
    np.testing.assert_allclose(one[0], other[0], atol=1e-9 * abs(other[0]).max())


def test_a_whisker_without_room_is_told() -> None:
    slit = (
        Piece.of(trimesh.creation.box(bounds=[[5, 0.01, -2], [9, 3, 2]])),
        Piece.of(trimesh.creation.box(bounds=[[5, -3, -2], [9, -0.01, 2]])),
    )
    whisker = flat("robot A0")  # 0.12 mm thick
    world = RodWorld((whisker,), ROOT, slit, 10, 4)
    world.advance(np.zeros((51, 3)))
    assert world.overlap[-10:].min() > 0.01
    free = RodWorld((whisker,), ROOT, slit[:1], 10, 4)
    free.advance(np.outer(np.linspace(0, 1, 51), [0.0, -0.5, 0.0]))
    assert free.overlap[-10:].max() < 1e-3
