"""Nearest points against a quadratic programme that tries everything."""

import numpy as np
import pytest
import trimesh
from scipy.optimize import nnls

from tactile_rt.sim_backend.rods.nearest import WORK, nearest
from tactile_rt.sim_backend.rods.world import Piece

NONE = np.zeros((0, 4))


def found_by(
    a: np.ndarray,
    b: np.ndarray,
    corners: np.ndarray,
    faces: np.ndarray = NONE,
    known: np.ndarray | None = None,
) -> np.ndarray:
    found = np.empty(6)
    known = np.full(4, -1) if known is None else known
    none = np.zeros(0, np.int64), np.zeros(len(corners) + 1, np.int64)
    nearest(a, b, corners, faces, *none, known, np.empty(WORK), found)
    return found


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
    known = np.full(4, -1)
    found = found_by(a, b, piece.corners, piece.faces, known)
    wanted = truth(a, b, piece.corners)
    if wanted < 1e-4:
        assert found[0] <= 1e-3
        return
    assert found[0] == pytest.approx(wanted, rel=1e-6, abs=1e-7)
    assert 0 <= found[1] <= 1 and np.linalg.norm(found[2:5]) == pytest.approx(1)
    # the piece lies behind the plane through its nearest point, the segment before it
    on_segment = a + found[1] * (b - a)
    on_piece = on_segment - found[0] * found[2:5]
    assert ((piece.corners - on_piece) @ found[2:5]).max() <= 1e-6
    assert min((a - on_segment) @ found[2:5], (b - on_segment) @ found[2:5]) >= -1e-6
    assert (piece.corners @ found[2:5]).max() <= found[5] + 1e-9
    assert found[5] == pytest.approx(on_piece @ found[2:5], abs=1e-6)


@pytest.mark.parametrize("seed", range(20))
def test_going_on_from_the_last_pairs_finds_the_same(seed: int) -> None:
    rng = np.random.default_rng(seed)
    piece = Piece.of(trimesh.convex.convex_hull(rng.normal(size=(30, 3)) * 4))
    a, b = np.array([9.0, 0, 0]), np.array([9.0, 1, 0])
    known = np.full(4, -1)
    for _ in range(300):  # a small step, and now and then a leap: what is known is of no use
        a, b = a + rng.normal(size=3) * 0.05, b + rng.normal(size=3) * 0.05
        if rng.random() < 0.1:
            away = rng.normal(size=3)
            a = away / np.linalg.norm(away) * rng.uniform(0, 15)
            b = a + rng.normal(size=3)
        on = found_by(a, b, piece.corners, piece.faces, known)
        anew = found_by(a, b, piece.corners, piece.faces)
        if anew[0] > 1e-6:
            assert on[0] == pytest.approx(anew[0], rel=1e-9)
            np.testing.assert_allclose(on[2:5], anew[2:5], atol=1e-6)
        else:
            assert on[0] <= 1e-6


def test_points_and_lines_are_pieces() -> None:
    ends = np.array([0.0, -1.0, 2.0]), np.array([0.0, 1.0, 2.0])
    found = found_by(*ends, np.zeros((1, 3)))
    np.testing.assert_allclose(found[:5], [2, 0.5, 0, 0, 1], atol=1e-12)
    peg = np.array([[-5.0, 0.3, 0.0], [5.0, 0.3, 0.0]])
    found = found_by(*ends, peg)
    np.testing.assert_allclose(found[:5], [2, 0.65, 0, 0, 1], atol=1e-12)


def test_what_overlaps_comes_out_through_the_nearest_face() -> None:
    box = Piece.of(trimesh.creation.box((2, 4, 6)))
    ends = np.array([0.9, 0, 0.0]), np.array([0.9, 0.5, 0.0])
    found = found_by(*ends, box.corners, box.faces)
    assert found[0] == pytest.approx(-0.1)
    np.testing.assert_allclose(found[2:], [1, 0, 0, 1], atol=1e-12)
