from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tactile_rt.sim_backend.whiskers import Whisker, mouse_whiskers, rotation

WHISKERS = {w.name: w for w in mouse_whiskers()}
every = pytest.mark.parametrize("whisker", WHISKERS.values(), ids=WHISKERS)


def test_the_mouse_has_thirty_whiskers_372_mm_long_in_all() -> None:
    assert len(mouse_whiskers()) == len(WHISKERS) == 30
    assert sum(w.length for w in WHISKERS.values()) == pytest.approx(372, abs=0.5)


def test_five_cells_of_the_grid_are_empty() -> None:
    taken = {(w.row, w.column) for w in WHISKERS.values()}
    grid = {(row, column) for row in range(5) for column in range(7)}
    empty = {"ABCDE"[row] + str(column) for row, column in grid - taken}
    assert taken < grid
    assert empty == {"A5", "A6", "B5", "B6", "E6"}


@every
def test_a_name_is_a_place_on_the_grid(whisker: Whisker) -> None:
    assert whisker.name == "ABCDE"[whisker.row] + str(whisker.column)


def test_the_grid_lies_on_the_face_as_anatomists_number_it() -> None:
    for row in "ABCDE":
        lengths = [w.length for w in WHISKERS.values() if w.name[0] == row]
        rostral = [w.base[1] for w in WHISKERS.values() if w.name[0] == row]
        assert all(a > b for a, b in pairwise(lengths)), "caudal whiskers are the longest"
        assert all(a < b for a, b in pairwise(rostral)), "column 0 is the most caudal"
    heights = [np.mean([w.base[2] for w in WHISKERS.values() if w.row == i]) for i in range(5)]
    assert all(a > b for a, b in pairwise(heights)), "row A is the most dorsal"
    assert all(w.base[0] > 0 for w in WHISKERS.values()), "x leads away from the head"


# Base and tip diameters in um, worked out by hand from Belli et al.'s regressions; the tip of C6
# is at the least that is allowed.
@pytest.mark.parametrize(
    ("name", "base", "tip"),
    [("B0", 105.474, 20.032), ("C2", 96.730, 17.560), ("E5", 86.759, 20.450), ("C6", 61.826, 3)],
)
def test_diameters(name: str, base: float, tip: float) -> None:
    whisker = WHISKERS[name]
    ends = 2e3 * whisker.radius(np.array([0.0, whisker.length]))
    np.testing.assert_allclose(ends, [base, tip], atol=0.01)


@every
def test_a_whisker_tapers(whisker: Whisker) -> None:
    radii = whisker.radius(np.linspace(0, whisker.length, 50))
    assert radii.min() >= 0.0015
    assert radii[0] > radii[-1]
    np.testing.assert_allclose(np.diff(radii), (radii[-1] - radii[0]) / 49)  # a cone


@every
def test_the_centreline_is_as_long_as_the_whisker(whisker: Whisker) -> None:
    points = whisker.centreline(np.linspace(0, whisker.length, 4001))
    arcs = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert arcs.sum() == pytest.approx(whisker.length, rel=1e-5)
    np.testing.assert_allclose(arcs, whisker.length / 4000, rtol=1e-3)  # s is the arc length
    np.testing.assert_allclose(points[0], 0, atol=1e-12)
    np.testing.assert_allclose(points[:, 1], whisker.curvature * points[:, 0] ** 2, atol=1e-12)
    assert points[-1, 0] > 0 and points[-1, 1] > 0 and not points[:, 2].any()


@every
def test_the_orientation_is_azimuth_then_elevation_then_torsion(whisker: Whisker) -> None:
    theta, phi, zeta = whisker.angles
    wanted = Rotation.from_euler("ZYX", [theta - np.pi / 2, -phi, zeta + np.pi / 2])
    np.testing.assert_allclose(whisker.orientation, wanted.as_matrix(), atol=1e-12)
    # along the whisker at its base: theta from the caudal direction -y, phi upward
    along = [np.sin(theta) * np.cos(phi), -np.cos(theta) * np.cos(phi), np.sin(phi)]
    np.testing.assert_allclose(whisker.orientation[:, 0], along, atol=1e-12)


@pytest.mark.parametrize("axis", "xyz")
def test_rotations_are_right_handed(axis: str) -> None:
    np.testing.assert_allclose(
        rotation(axis, 0.7), Rotation.from_euler(axis, 0.7).as_matrix(), atol=1e-12
    )


def test_density_and_stiffness() -> None:
    c2 = WHISKERS["C2"]
    ends = np.array([0.0, c2.length])
    np.testing.assert_allclose(c2.density(ends), [1260, 1690])
    inertia = np.pi / 64 * np.array([96.730e-3, 17.560e-3]) ** 4  # mm^4
    np.testing.assert_allclose(c2.bending_stiffness(ends), 5e3 * inertia, rtol=1e-3)  # N mm^2
