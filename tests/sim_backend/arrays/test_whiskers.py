import csv
from dataclasses import replace
from importlib import resources
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.files import mouse_whiskers, rat_whiskers
from tactile_rt.sim_backend.arrays.whiskers import OPTIONAL, REQUIRED, Whisker, keratin_radii

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


def test_density_and_stiffness() -> None:
    c2 = WHISKERS["C2"]
    ends = np.array([0.0, c2.length])
    np.testing.assert_allclose(c2.density(ends), [1260, 1690])
    inertia = np.pi / 64 * np.array([96.730e-3, 17.560e-3]) ** 4  # mm^4
    np.testing.assert_allclose(c2.bending_stiffness(ends), 5e3 * inertia, rtol=1e-3)  # N mm^2


def test_the_rat_has_thirty_whiskers_without_e0_and_with_e6() -> None:
    rat = {w.name: w for w in rat_whiskers()}
    assert len(rat) == 30 and "E0" not in rat and "E6" in rat
    assert all(w.name == "ABCDE"[w.row] + str(w.column) for w in rat.values())
    assert rat["C0"].length == 52.8 and rat["D6"].angles == (1.7802, -0.26529, 1.0734)
    # the floor of the tip's radius binds on 21 of them
    assert sum(w.tip_radius == 0.0015 for w in rat.values()) == 21
    # by hand, um
    ends = 2e3 * rat["A0"].radius(np.array([0.0, 39.9]))
    np.testing.assert_allclose(ends, [131.8, 11.237], atol=0.01)


@pytest.mark.parametrize("animal", ["mouse", "rat"])
def test_every_number_of_the_tables_is_used_once(animal: str) -> None:
    text = (
        resources.files("tactile_rt.sim_backend.arrays").joinpath(f"data/{animal}.csv").read_text()
    )
    rows = list(csv.reader(line for line in text.splitlines() if not line.startswith("#")))
    assert tuple(rows[0]) == REQUIRED
    made = mouse_whiskers() if animal == "mouse" else rat_whiskers()
    for w, (name, row, column, *numbers) in zip(made, rows[1:], strict=True):
        assert (w.name, w.row, w.column) == (name, int(row) - 1, int(column))
        assert (w.length, w.curvature, *w.base, *w.angles) == tuple(map(float, numbers))


STRAIGHT = replace(WHISKERS["C2"], curvature=0.0)


@pytest.mark.parametrize("a", [1e-300, 1e-17, 1e-12, 6e-11, 7e-11, 1e-8, 1e-4, 0.02, 0.05])
@pytest.mark.parametrize("length", [1.0, 15.0, 200.0])
def test_a_centreline_of_any_curvature(a: float, length: float) -> None:
    whisker = replace(STRAIGHT, curvature=a, length=length)
    s = np.linspace(0, length, 9)
    points = whisker.centreline(s)
    for at, (x, y, z) in zip(s, points, strict=True):
        arc = quad(lambda u: np.sqrt(1 + (2 * a * u) ** 2), 0, x, epsabs=1e-12, epsrel=1e-12)[0]
        assert arc == pytest.approx(at, rel=2e-7, abs=1e-12 + length * 2e-6 * min(1, a * length))
        assert y == pytest.approx(a * x**2, rel=1e-12) and z == 0
    other = replace(whisker, curvature=-a).centreline(s)
    np.testing.assert_array_equal(other, points * [1, -1, 1])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"name": "a/b"}, "letters, digits"),
        ({"name": "head"}, "none of world, head, object"),
        ({"row": -1}, "counted from 0"),
        ({"length": 0.0}, "C2: arc_length_mm must be positive, not 0"),
        ({"tip_radius": 0.2}, "tip_radius_mm 0.2 exceeds base_radius_mm 0.04"),
        ({"base_radius": 48.365}, "is less than 10 times base_radius_mm 48.365"),
        ({"length": 2000.0}, "arc_length_mm must be 0.1 to 500, not 2000: mind the unit"),
        ({"young_modulus": 2.9}, "young_modulus_pa must be 10000 to .*, not 2.9: mind the unit"),
        ({"friction": float("nan")}, "friction must be 0 or more, not nan"),
        ({"curvature": float("nan")}, "must be finite"),
    ],
)
def test_what_no_whisker_can_be_is_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        replace(WHISKERS["C2"], **wrong)


ROW: dict[str, object] = dict.fromkeys(REQUIRED, 1) | {"whisker": "B1", "arc_length_mm": "30"}


def test_a_row_of_a_table_is_a_whisker() -> None:
    units = {"young_modulus_pa": 1e6, "density_base_kg_m3": 1e6, "density_tip_kg_m3": 1e6}
    every_field = {n: 0.01 * (9 - i) * units.get(n, 1.0) for i, n in enumerate(OPTIONAL)}
    made = Whisker.from_columns(ROW | every_field)
    assert (made.name, made.row, made.column, made.length) == ("B1", 0, 1, 30.0)
    for column, name in OPTIONAL.items():
        assert getattr(made, name) == every_field[column]


def test_what_a_row_leaves_out_is_keratin_or_goes_on_to_the_tip() -> None:
    made = Whisker.from_columns(ROW | {"friction": ""})
    assert (made.base_radius, made.tip_radius) == keratin_radii(30.0, 0, 1)
    assert (made.density_base, made.density_tip, made.friction) == (1260, 1690, 0.5)
    made = Whisker.from_columns(ROW | {"base_radius_mm": "0.2", "density_base_kg_m3": 1100})
    assert made.base_radius == made.tip_radius == 0.2
    assert made.density_base == made.density_tip == 1100


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"arc_length_mm": ""}, "no arc_length_mm"),
        ({"arc_length_mm": "3O"}, "arc_length_mm is not a number: '3O'"),
        ({"base_phi_rad": "nan"}, "base_phi_rad is not a finite number: 'nan'"),
        ({"base_phi_rad": 10**400}, "base_phi_rad is not a number"),
        ({"base_theta_rad": "57.3"}, "base_theta_rad must be within a turn, .*: mind the unit"),
        ({"whisker": 3}, "in quotes, not 3"),
        ({"row": 0}, "row must be a whole number from 1, not 0"),
        ({"tip_radius_mm": 0.1}, "tip_radius_mm is given without base_radius_mm"),
    ],
)
def test_a_mistake_in_a_row_is_named(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Whisker.from_columns(ROW | wrong)
