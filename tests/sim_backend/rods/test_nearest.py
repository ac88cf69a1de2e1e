"""Nearest points against a quadratic programme that tries everything."""

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("numba")

import trimesh
from scipy.optimize import nnls

from tactile_rt.sim_backend.rods.nearest import nearest
from tactile_rt.sim_backend.rods.world import Piece

NONE = np.zeros((0, 4))


def truth(a: np.ndarray, b: np.ndarray, corners: np.ndarray) -> float:
    """The least norm of a hull of differences, by non-negative least squares (weights add to 1)."""
    points = np.concatenate([a - corners, b - corners]).T
    heavy = 1e3 * max(1.0, abs(points).max())
    weights, _ = nnls(np.vstack([points, heavy * np.ones(points.shape[1])]), [0, 0, 0, heavy])
    return float(np.linalg.norm(points @ (weights / weights.sum())))


@pytest.mark.parametrize("seed", range(60))
def test_the_distance_is_the_least_there_is(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(rng.integers(4, 40), 3)) * rng.uniform(0.5, 8)
    hull = trimesh.convex.convex_hull(corners)
    piece = Piece.of(hull)
    away = rng.normal(size=3)
    a = away / np.linalg.norm(away) * rng.uniform(2, 30)
    b = a + rng.normal(size=3) * rng.uniform(0.05, 2)
    found = np.empty(5)
    first = nearest(a, b, piece.corners, piece.faces, 0, found)
    wanted = truth(a, b, piece.corners)
    if wanted < 1e-4:
        assert found[0] <= 1e-3
        return
    assert found[0] == pytest.approx(wanted, rel=1e-6, abs=1e-7)
    assert 0 <= found[1] <= 1 and np.linalg.norm(found[2:]) == pytest.approx(1)
    # the piece lies behind the plane through its nearest point, the segment before it
    on_segment = a + found[1] * (b - a)
    on_piece = on_segment - found[0] * found[2:]
    assert ((piece.corners - on_piece) @ found[2:]).max() <= 1e-6
    assert min((a - on_segment) @ found[2:], (b - on_segment) @ found[2:]) >= -1e-6
    again = np.empty(5)
    nearest(a, b, piece.corners, piece.faces, first, again)
    assert again[0] == pytest.approx(found[0], rel=1e-9)


def test_points_and_lines_are_pieces() -> None:
    found = np.empty(5)
    ends = np.array([0.0, -1.0, 2.0]), np.array([0.0, 1.0, 2.0])
    nearest(*ends, np.zeros((1, 3)), NONE, 0, found)
    np.testing.assert_allclose(found, [2, 0.5, 0, 0, 1], atol=1e-12)
    peg = np.array([[-5.0, 0.3, 0.0], [5.0, 0.3, 0.0]])
    nearest(*ends, peg, NONE, 0, found)
    np.testing.assert_allclose(found, [2, 0.65, 0, 0, 1], atol=1e-12)


def test_what_overlaps_comes_out_through_the_nearest_face() -> None:
    box = Piece.of(trimesh.creation.box((2, 4, 6)))
    found = np.empty(5)
    nearest(np.array([0.9, 0, 0.0]), np.array([0.9, 0.5, 0.0]), box.corners, box.faces, 0, found)
    assert found[0] == pytest.approx(-0.1)
    np.testing.assert_allclose(found[2:], [1, 0, 0], atol=1e-12)
