"""Bounds by geometry: shapes are found again however turned; a picture is what is in front."""

import numpy as np
import pytest
import trimesh

from bench.perception.geometry import ACROSS, DENSE, ROWS, SIZE_MM, nearest_shape, take_picture


def surface(mesh, seed=0, turn_deg=0.0):
    points, _ = trimesh.sample.sample_surface(mesh, DENSE, seed=seed)
    angle = np.radians(turn_deg)
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(points) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])


BRICK = trimesh.creation.box((40, 20, 10))
SHAPES = [BRICK, trimesh.creation.icosphere(3, 20), trimesh.creation.cylinder(5, 40)]


@pytest.mark.parametrize("number", range(len(SHAPES)))
def test_a_shape_is_found_again_however_it_is_turned(number):
    others = [surface(shape, seed=1) for shape in SHAPES]
    assert nearest_shape(surface(SHAPES[number], turn_deg=50), others) == number


def test_a_picture_shows_how_deep_the_side_lies():
    picture = take_picture(surface(BRICK), 0.0, 0.0)
    assert picture.shape == (ROWS, ACROSS)
    seen = picture < SIZE_MM
    assert seen[3:7].all() and not seen[[0, 1, -2, -1]].any()  # 10 mm high, of 20 mm shown
    assert picture[3:7].max() < 2  # all of it the near face
    across = take_picture(surface(BRICK), 90.0, 0.0)
    assert (across[5] < SIZE_MM).sum() == pytest.approx(ACROSS / 2, abs=2)  # and the edges
    above = take_picture(surface(BRICK), 0.0, 8.0) < SIZE_MM
    assert above.any() and not above[ROWS // 2 :].any()
