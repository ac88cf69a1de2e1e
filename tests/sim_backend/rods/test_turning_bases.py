"""Whiskers whose bases turn: rigid bodies, a turned point of view, and MuJoCo say the same."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.sim.beams import flat
from tactile_rt.sim_backend.arrays.files import mouse_whiskers
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.rods.world import Piece, RodWorld
from tactile_rt.sim_backend.trajectories import base_angles
from tactile_rt.sim_backend.whisking import HEAD, WhiskSimulation
from tactile_rt.sim_backend.whisking_drive import Drive, Whisking
from tactile_rt.sim_backend.world import PROFILES, Profile
from tests.helpers.beams import about

Floats = NDArray[np.float64]

FINE = Profile(10, 0.1, 0.01)


def alone(whisker: Whisker, profile: Profile, pieces: tuple[Piece, ...] = ()) -> RodWorld:
    root = np.concatenate([np.zeros((1, 3)), np.eye(3)])[None]
    return RodWorld((whisker,), root, pieces, profile.links, round(1 / profile.timestep_ms))


def frames(angles: Floats, axis: tuple[float, float, float] = (0, 0, 1)) -> Floats:
    """(sample + 3, 1, 3, 3) from angles (sample + 3,)."""
    return np.array([about(axis, a) for a in angles])[:, None]


def test_a_base_that_does_not_turn_is_one_that_stands_still() -> None:
    whisker, ball = flat("C2"), Piece(np.array([[6.0, 2.5, 0.0]]), np.zeros((0, 4)), 2.0)
    way = np.zeros((61, 3))
    way[:, 1] = -np.linspace(0, 1.5, 61)
    still, turning = (alone(whisker, PROFILES["realtime"], (ball,)) for _ in range(2))
    same = turning.advance(way, turning=frames(np.zeros(63)))
    for one, other in zip(still.advance(way), same, strict=True):
        assert abs(one).max() > 0
        np.testing.assert_array_equal(one, other)


def test_a_stiff_whisker_loads_its_base_with_its_inertia() -> None:
    """Centripetal and tangential: the second moment of the mass by the angular acceleration."""
    stiff = replace(flat("C2", "straight"), young_modulus=5e12)
    s = np.linspace(0, stiff.length, 20001)
    r = stiff.radius(s)
    line = stiff.density(s) * np.pi * (r * 1e-3) ** 2  # kg/m
    inertia = np.trapezoid(line * ((s * 1e-3) ** 2 + (r * 1e-3) ** 2 / 4), s * 1e-3)
    first = np.trapezoid(line * s * 1e-3, s * 1e-3)
    t, w = np.arange(-1, 302) * 1e-3, 2 * np.pi * 8
    loads, _ = alone(stiff, FINE).advance(np.zeros((301, 3)), turning=frames(0.3 * np.sin(w * t)))
    middle = (np.arange(300) + 0.5) * 1e-3
    spin, alpha = 0.3 * w * np.cos(w * middle), -0.3 * w**2 * np.sin(w * middle)
    late = slice(100, 300)
    for channel, want in ((5, -inertia * alpha), (1, -first * alpha), (0, first * spin**2)):
        error = abs(loads[late, 0, channel] - want[late]).max()
        assert error < 0.01 * abs(want[late]).max(), channel


def test_turning_onto_a_ball_is_a_ball_that_comes() -> None:
    """Slow, without friction: seen from the base, the ball goes round it."""
    whisker = replace(flat("C2"), friction=0.0)
    axis = (0.0, 0.6, 0.8)
    ball = about(axis, 0.2) @ (whisker.centreline(np.array([7.0]))[0] + np.array([0, 1.55, 0]))
    t = np.arange(-1, 402) * 1e-3
    angles = 0.35 * np.sin(np.pi * np.clip(t, 0, 0.4) / 0.4) ** 2
    piece = Piece(ball[None], np.zeros((0, 4)), 1.5)
    turned = alone(whisker, FINE, (piece,))
    loads, contacts = turned.advance(np.zeros((401, 3)), turning=frames(angles, axis))
    at = np.array([about(axis, -a) @ ball for a in angles[1:-1]])
    still = alone(whisker, FINE, (replace(piece, corners=np.zeros((1, 3))),))
    want, touching = still.advance(at)
    assert 0.2 < touching[:, 0, 0].mean() < 0.9
    assert abs(contacts[..., 0] - touching[..., 0]).sum() <= 4, "samples"
    for part in (slice(0, 3), slice(3, 6)):
        error = np.linalg.norm(loads[..., part] - want[..., part])
        assert error < 0.02 * np.linalg.norm(want[..., part])


def test_it_does_not_depend_on_the_cut() -> None:
    t = np.arange(-1, 82) * 1e-3
    turning = frames(0.4 * np.sin(2 * np.pi * 10 * t), (0.6, 0.0, 0.8))
    piece = Piece(np.array([[7.0, 2.2, 0.5]]), np.zeros((0, 4)), 1.5)
    way = np.zeros((81, 3))
    whole, parts = (alone(flat("C2"), PROFILES["realtime"], (piece,)) for _ in range(2))
    loads, contacts = whole.advance(way, turning=turning)
    assert contacts[..., 0].any()
    at, found = 0, []
    for n in (1, 30, 49):
        found.append(parts.advance(way[: n + 1], turning=turning[at : at + n + 3])[0])
        at += n
    np.testing.assert_allclose(np.concatenate(found), loads, rtol=1e-9, atol=1e-15)


def test_one_sample_at_a_time_a_shaken_head_is_felt() -> None:
    """A single sample's acceleration is not taken for none."""
    whole, parts = (alone(flat("C2"), PROFILES["realtime"]) for _ in range(2))
    shaken = np.full((20, 3), 1e-3)
    loads, _ = whole.advance(np.zeros((21, 3)), shaken=shaken)
    felt = [parts.advance(np.zeros((2, 3)), shaken=shaken[:1])[0] for _ in range(20)]
    assert abs(loads).max() > 0
    np.testing.assert_allclose(np.concatenate(felt), loads, rtol=1e-9, atol=1e-18)


def test_whisking_in_air_is_as_mujoco_has_it() -> None:
    whiskers = tuple(w for w in mouse_whiskers() if w.name in ("A1", "B0", "C2", "D3", "E5"))
    drive = Drive(Whisking(8.0, 0.35, 0.1))
    want, _ = WhiskSimulation(whiskers, drive, PROFILES["dataset"]).advance(250)
    angles = base_angles(drive, np.arange(-1, 252) * 1e-3, whiskers)
    turned = np.empty((*angles.shape[:2], 3, 3))
    for at in np.ndindex(angles.shape[:2]):
        theta, phi, zeta = angles[at]
        azimuth, elevation = about((0, 0, 1), theta - np.pi / 2), about((0, 1, 0), -phi)
        turned[at] = azimuth @ elevation @ about((1, 0, 0), zeta + np.pi / 2)
    turned = HEAD.rotation @ turned
    roots = np.concatenate([np.zeros((len(whiskers), 1, 3)), turned[1]], axis=1)
    loads, _ = RodWorld(whiskers, roots, (), 10, 4).advance(np.zeros((251, 3)), turning=turned)
    for channels in (slice(0, 3), slice(3, 6)):
        error = np.linalg.norm(loads[..., channels] - want[..., channels])
        assert error < 0.02 * np.linalg.norm(want[..., channels])
