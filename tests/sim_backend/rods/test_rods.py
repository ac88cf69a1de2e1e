"""Whiskers stepped one by one: ringing, pressing, flying, and that nothing depends on the cut."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.optimize import brentq

from bench.sim.beams import beams, flat
from bench.sim.ringing import release_error, rod_ring
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Whisker, rotation
from tactile_rt.sim_backend.objects.catalogue import TactileObject, make_object
from tactile_rt.sim_backend.rods.chains import Pose, place
from tactile_rt.sim_backend.rods.rod import make_rod
from tactile_rt.sim_backend.rods.touching import NEAR_MM, Contacts, Object, find_near, unseen
from tactile_rt.sim_backend.rods.world import Piece, RodWorld
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.world import PROFILES, Profile

Floats = NDArray[np.float64]


def alone(whisker: Whisker, profile: Profile, pieces: tuple[Piece, ...] = ()) -> RodWorld:
    root = np.concatenate([np.zeros((1, 3)), whisker.orientation])[None]
    steps = round(1 / profile.timestep_ms)
    return RodWorld((whisker,), root, pieces, profile.links, steps)


@pytest.mark.parametrize("profile", ["realtime", "dataset", "accurate"])
@pytest.mark.parametrize("name", [n for n, b in beams().items() if b.resonance_hz < 400][::3])
def test_it_rings_as_the_beam_at_every_step(name: str, profile: str) -> None:
    frequency, ratio = rod_ring(flat(name), PROFILES[profile])
    assert frequency == pytest.approx(beams()[name].resonance_hz, rel=2e-3)
    assert ratio == pytest.approx(0.32, abs=1e-3)


@pytest.mark.parametrize("name", ["B0", "C2", "A3"])
def test_a_tip_let_go_swings_as_all_modes_of_the_beam_do(name: str) -> None:
    short = 1.5 if name == "A3" else 1.0  # 360 Hz: a step of 0.25 ms is a third of a radian of it
    assert release_error(flat(name), PROFILES["accurate"]) < 0.02
    assert release_error(flat(name), PROFILES["dataset"]) < 0.03 * short
    assert release_error(flat(name), PROFILES["realtime"]) < 0.08


@pytest.mark.parametrize("ratio", [0.02, 0.05, 0.2])
def test_a_wanted_damping_ratio_is_had(ratio: float) -> None:
    whisker = replace(flat("robot A0"), damping_ratio=ratio)
    rod = make_rod(whisker, 8, 2)
    assert rod.damping_ratio == pytest.approx(ratio)
    assert (rod.steps_per_sample > 2) == (ratio < 0.1), "a finer step where it is needed"
    assert rod_ring(whisker, PROFILES["realtime"])[1] == pytest.approx(ratio, abs=2e-3)


def ball(radius: float, place: Floats) -> Piece:
    return Piece(np.array([place]), np.zeros((0, 4)), radius)


def test_a_light_touch_bends_as_a_beam() -> None:
    """A tenth of a micrometre of a ball pressed on a straight whisker."""
    whisker = replace(flat("C2", "straight"), friction=0.0)
    s, depth = 0.6 * whisker.length, 1e-4
    reach = 2.0 + float(whisker.radius(np.array([s]))[0])
    world = alone(whisker, PROFILES["dataset"], (ball(2.0, np.array([s, reach, 0.0])),))
    way = np.zeros((61, 3))
    way[:, 1] = -np.minimum(np.linspace(0, 2, 61), 1) * depth
    loads, contacts = world.advance(way)
    at = np.linspace(0, s, 20001)
    give = np.trapezoid((s - at) ** 2 / whisker.bending_stiffness(at), at)  # mm/N
    assert loads[-1, 0, 1] == pytest.approx(-depth / give, rel=0.02)
    assert loads[-1, 0, 5] == pytest.approx(-depth / give * s * 1e-3, rel=0.02)
    assert contacts[-1, 0, 0] == 1
    assert contacts[-1, 0, 2] / contacts[-1, 0, 1] == pytest.approx(s * 1e-3, rel=1e-3)


def test_nothing_overlaps_after_a_fall() -> None:
    """A tip that snaps off an edge onto the next face comes to rest on it."""
    stairs = (
        Piece.of(trimesh.creation.box(bounds=[[8, 0.2, -2], [9, 3, 2]])),
        Piece.of(trimesh.creation.box(bounds=[[9, 0.8, -2], [16, 3, 2]])),
    )
    whisker = replace(flat("C2", "straight"), friction=0.3)
    world = alone(whisker, PROFILES["dataset"], stairs)
    way = np.zeros((401, 3))
    way[:, 1] = -np.minimum(np.linspace(0, 2, 401), 1) * 3.0
    way[:, 0] = np.minimum(np.linspace(0, 2, 401), 1) * 1.5
    loads, contacts = world.advance(way)
    assert np.isfinite(loads).all() and contacts[-100:, 0, 0].min() == 1
    settled = loads[-50:, 0, 5]
    assert np.ptp(settled) < 0.05 * abs(settled.mean())


def passing(profile: str, array: WhiskerArray | None = None, **how: float) -> SweepSimulation:
    """A mug that passes an array, by default the mouse's."""
    mug = make_object("mug", 3)
    return SweepSimulation(array or load_array("mouse"), mug, Sweep(**how), PROFILES[profile])


def test_the_other_side_feels_the_mirror_image() -> None:
    cube = trimesh.creation.box((1, 1, 1))
    thing = TactileObject("cube", "cube", (cube,))
    sides = [
        SweepSimulation(load_array(name), thing, Sweep(yaw_deg=yaw), PROFILES["realtime"])
        for name, yaw in (("mouse", 20.0), ("mouse-left", -20.0))
    ]
    right, left = (s.advance(400) for s in sides)
    assert abs(right).max() > 1e-5
    signs = np.array([1, 1, -1, -1, -1, 1])
    scale = abs(right).max(axis=(0, 1))
    off = left / scale - right * signs / scale
    assert np.sqrt(np.mean(off**2)) < 1e-3
    assert abs(off).max() < 0.05, "where a tip snaps, the last digit decides when"


@pytest.mark.parametrize("links", [6, 12, 24])
def test_more_links_come_to_the_same(links: int) -> None:
    """A press by the elastica's own case does not hang on the number of links."""
    from bench.sim.pegs import press, presses

    case = next(c for c in presses() if c.whisker == "mouse C2" and c.depth > 0.5)
    assert abs(press(case, Profile(links, 0.25, 0.02)).moment_error) < 0.03


def rod_on_a_spring(stiffness: float, damping: float = 0.0, ratio: float = 0.05) -> Whisker:
    """A cylinder of steel, 60 mm long, on a mount that gives."""
    return replace(
        flat("C2", "straight"), length=60.0, base_radius=0.15, tip_radius=0.15,
        young_modulus=2e11, density_base=7800.0, density_tip=7800.0, damping_ratio=ratio,
        friction=0.0, mount_stiffness=stiffness, mount_damping=damping,
    )  # fmt: skip


@pytest.mark.parametrize("share", [0.2, 1.0, 5.0])
def test_a_base_that_gives_lowers_the_resonance_as_a_torsion_spring_does(share: float) -> None:
    """On a torsion spring k: k L / E I (1 + cos x cosh x) = x (cosh x sin x - sinh x cos x)."""
    whisker = rod_on_a_spring(1.0)
    bending = float(whisker.bending_stiffness(np.zeros(1))[0])  # N mm^2
    spring = share * bending / whisker.length * 1e-3  # N m / rad
    x = brentq(
        lambda x: share * (1 + np.cos(x) * np.cosh(x))
        - x * (np.cosh(x) * np.sin(x) - np.sinh(x) * np.cos(x)),
        0.05, 1.87,
    )  # fmt: skip
    line = 7800e-12 * np.pi * 0.15**2  # t/mm
    hertz = (x / whisker.length) ** 2 * np.sqrt(bending / line) / (2 * np.pi)
    rod = make_rod(replace(whisker, mount_stiffness=spring), 20, 4)
    assert rod.chain.clamped == 0
    assert rod.resonance_hz == pytest.approx(hertz, rel=5e-3)
    rigid = make_rod(replace(whisker, mount_stiffness=0.0), 20, 4)
    assert rod.resonance_hz < rigid.resonance_hz


def test_a_base_turns_by_its_moment_and_its_damping_counts() -> None:
    spring = 2e-3
    whisker = rod_on_a_spring(spring, damping=2e-6)
    s, depth = 40.0, 0.5
    world = alone(whisker, PROFILES["dataset"], (ball(2.0, np.array([s, 2.15, 0.0])),))
    way = np.zeros((401, 3))
    way[:, 1] = -np.minimum(np.linspace(0, 4, 401), 1) * depth
    loads, _ = world.advance(way)
    moment, turn = loads[-1, 0, 5], world.turns[-1, 0, 1]
    assert moment < 0 and turn == pytest.approx(moment / spring, rel=1e-3)
    assert abs(world.turns[-1, 0, 0]) < 1e-9
    # pushed at s by a force: the spring's turn and the beam's bend add up
    force = -loads[-1, 0, 1]
    bending = float(whisker.bending_stiffness(np.zeros(1))[0])
    give = s**3 / (3 * bending) + s**2 / (spring * 1e3)
    assert force * give == pytest.approx(depth, rel=0.02)
    damped, free = (make_rod(rod_on_a_spring(spring, c), 10, 4) for c in (2e-6, 0.0))
    assert damped.damping_ratio > 1.5 * free.damping_ratio


@pytest.mark.parametrize(
    "pose",
    [
        {"roll_deg": 40.0}, {"pitch_deg": -30.0}, {"heading_deg": -30.0},
        {"heading_deg": 30.0, "distance_mm": 2.0},
        {"climb_deg": 25.0}, {"heading_deg": 20.0, "climb_deg": -20.0, "roll_deg": 90.0},
        {"speed_mm_s": 100.0}, {"size_mm": 80.0}, {"size_mm": 20.0, "speed_mm_s": 20.0},
    ],
)  # fmt: skip
def test_an_object_comes_in_any_pose(pose: dict[str, float]) -> None:
    simulation = passing("realtime", gap_mm=1.0, **pose)
    assert simulation.touches
    before = round(0.7 / (pose.get("speed_mm_s", 34.0) * 1e-3))
    assert not simulation.advance(before).any(), "clear of the whiskers at first"
    loads = simulation.advance(int(simulation.duration_ms) - before)
    assert (abs(loads[..., :3]) > 1e-6).any(axis=(0, 2)).sum() >= 5
    assert abs(loads[-3:, :, :3]).max() < 0.2 * abs(loads[..., :3]).max(), "and past them at last"


def test_the_way_s_direction_turns_with_the_world() -> None:
    """The array and all turned about z feel the same, but for the side on which it passes."""
    mouse, cube = load_array("mouse"), trimesh.creation.box((1, 1, 1))
    thing = TactileObject("cube", "cube", (cube,))
    roll, pitch, yaw = mouse.mount.roll_pitch_yaw
    turn = np.radians(25.0)
    where = rotation("z", turn) @ np.array(mouse.mount.position)
    mount = replace(
        mouse.mount, position=tuple(where.tolist()), roll_pitch_yaw=(roll, pitch, yaw + turn)
    )
    one, other = (
        SweepSimulation(a, thing, sweep, PROFILES["realtime"]).advance(300)
        for a, sweep in (
            (mouse, Sweep(yaw_deg=10.0)),
            (replace(mouse, mount=mount), Sweep(yaw_deg=35.0, heading_deg=25.0)),
        )
    )
    assert abs(one).max() > 1e-5
    np.testing.assert_allclose(other, one, atol=1e-3 * abs(one).max())


def test_a_head_that_moves_feels_what_the_object_s_motion_gives_and_its_own_acceleration() -> None:
    how = {"ramp_ms": 40.0, "gap_mm": 5.0, "speed_mm_s": 60.0}
    still, moving = (passing("dataset", head_moves=m, **how) for m in (0.0, 1.0))
    calm, shaken = still.advance(40), moving.advance(40)
    assert not calm.any(), "nothing is touched while it speeds up"
    # all that a whisker weighs, times the acceleration: mean over the ramp of what it came to
    b0 = load_array("mouse").whiskers[5]
    s = np.linspace(0, b0.length, 2001)
    mass = np.trapezoid(b0.density(s) * np.pi * (b0.radius(s) * 1e-3) ** 2, s * 1e-3)  # kg
    impulse = np.linalg.norm(shaken[:, 5, :3].sum(axis=0)) * 1e-3
    assert impulse == pytest.approx(mass * 0.06, rel=0.1)
    calm, shaken = still.advance(300), moving.advance(300)
    assert abs(calm).max() > 1e-5
    off = shaken[50:] - calm[50:]  # but for tips that slip a sample earlier or later
    assert np.sqrt((off**2).mean()) < 0.01 * np.sqrt((calm**2).mean())
    assert abs(off).max() < 0.05 * abs(calm).max()


def test_a_shaken_whisker_weighs_what_its_mass_does_in_the_shaking() -> None:
    """Slowly shaken, every base holds mass times acceleration, whether it touches or not."""
    mouse = load_array("mouse")
    loads = passing("dataset", gap_mm=30.0, shake_g=0.5, shake_hz=5.0).advance(400)
    for k in (0, 5, 29):
        whisker = mouse.whiskers[k]
        s = np.linspace(0, whisker.length, 2001)
        section = np.pi * (whisker.radius(s) * 1e-3) ** 2
        mass = np.trapezoid(whisker.density(s) * section, s * 1e-3)  # kg
        size = np.linalg.norm(loads[200:, k, :3], axis=1)
        assert size.max() == pytest.approx(mass * 0.5 * 9.80665, rel=0.1)
        # a quarter of 200 ms, twice a period
        assert size.argmax() % 100 == pytest.approx(50, abs=5)


def test_a_surface_has_a_friction_of_its_own() -> None:
    mouse = load_array("mouse")
    slippery = replace(mouse, whiskers=tuple(replace(w, friction=0.0) for w in mouse.whiskers))
    one = passing("realtime", surface_friction=0.0).advance(300)
    np.testing.assert_array_equal(one, passing("realtime", slippery).advance(300))
    rough = passing("realtime").advance(300)
    assert abs(rough - one).max() > 0.02 * abs(one).max()


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("name", ["mouse A0", "mouse C2", "long nitinol"])
def test_a_gap_is_that_of_the_curve_and_not_of_its_chords(name: str, side: int) -> None:
    whisker = flat(name)
    rod = make_rod(whisker, 10, 4)
    pose = Pose(np.zeros((12, 3)), np.zeros((11, 3, 3)), np.zeros((20, 3)))
    pose.frames[0] = whisker.orientation @ rod.to_element.T
    place(rod.chain, np.zeros(20), pose)
    s = np.linspace(0, whisker.length, 200_001)
    line, radii = whisker.centreline(s) @ whisker.orientation.T, whisker.radius(s)
    rng = np.random.default_rng(1)
    for at in rng.integers(40_000, 190_000, 40):
        ahead = line[at + 1] - line[at]
        across = side * np.array([-ahead[1], ahead[0], 0.0]) / np.linalg.norm(ahead)
        centre = line[at] + across * (1.0 + radii[at] + 0.05)
        thing = Object(
            np.zeros((1, 3)), np.array([0, 1]), np.zeros((0, 4)), np.array([0, 0]), np.ones(1),
            np.zeros(0, np.int64), np.zeros(2, np.int64),
        )  # fmt: skip
        number = len(rod.segments.link)
        whole = unseen(1, number, 1)
        seen = whole._replace(travelled=whole.travelled[0], soonest=whole.soonest[0])
        near = Contacts(
            np.full(8, np.inf), np.zeros((8, 3)), np.zeros((8, 3)), np.zeros(8, np.int64),
            np.zeros(8),
        )  # fmt: skip
        ends, now = np.empty((number, 2, 3)), np.empty((number, 6))
        count = find_near(pose, rod.segments, thing, centre, NEAR_MM, seen, ends, now, near)
        wanted = (np.linalg.norm(line - centre, axis=1) - radii).min() - 1.0
        assert count >= 1 and near.gaps[:count].min() == pytest.approx(wanted, abs=5e-5)
