import functools
import zlib

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.objects.catalogue import (
    CATEGORIES,
    OUTLIERS,
    VARIED,
    WITHHELD,
    TactileObject,
    load_object,
    make_object,
)
from tests.helpers.mesh_truth import inside

KINDS = CATEGORIES + WITHHELD
INDICES = (0, 1, 2, 3, 17, 1000)
# corners of instance 17, see `digest`
GOLDEN = {
    "beehive": 1536081327,
    "birdcage": 2649613695,
    "bottle": 3043000262,
    "bowl": 1939618908,
    "cactus": 1583569730,
    "car": 3072276019,
    "castle": 2795257816,
    "chair": 1553187143,
    "dumbbell": 1224340781,
    "gear": 1706378425,
    "grapes": 1986311934,
    "hourglass": 878662480,
    "house": 4063130710,
    "jack": 2999354546,
    "ladder": 417698551,
    "lamp": 2102001367,
    "mug": 782511131,
    "mushroom": 1649591086,
    "pagoda": 3548658227,
    "plane": 4104205935,
    "pumpkin": 4014450080,
    "snowman": 298180363,
    "spring": 150304655,
    "table": 1115701192,
    "goblet": 3539172797,
    "stool": 4172743264,
    "teapot": 992711460,
    "truck": 830049534,
}
MANY = 14  # instances drawn where one in a few takes a rare option


@functools.cache
def drawn(category: str, index: int) -> TactileObject:
    """make_object, drawn once for all tests that look at it."""
    return make_object(category, index)


def digest(thing: TactileObject) -> int:
    """A number for all the corners, to 1e-6 of the size."""
    corners = np.vstack([p.vertices for p in thing.pieces])
    return zlib.crc32((np.round(corners * 1e6) + 0.0).astype(np.int64).tobytes())


def extents(thing: TactileObject) -> np.ndarray:
    """(2, 3) lowest and highest corner of the bounding box."""
    bounds = np.array([p.bounds for p in thing.pieces])
    return np.array([bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)])


def hanging_together(thing: TactileObject) -> int:
    """How many of its pieces are reached from the first by way of bounding boxes that overlap."""
    boxes = np.array([p.bounds for p in thing.pieces])
    reached, todo = {0}, [0]
    while todo:
        low, high = boxes[todo.pop()]
        near = ((boxes[:, 0] <= high + 1e-9) & (boxes[:, 1] >= low - 1e-9)).all(axis=1)
        new = set(np.flatnonzero(near).tolist()) - reached
        reached |= new
        todo += new
    return len(reached)


def test_a_name_stands_for_the_same_corners_for_good() -> None:
    # recordings and models go by these names, in every process and release
    assert {c: digest(drawn(c, 17)) for c in GOLDEN} == GOLDEN


@pytest.mark.parametrize("category", OUTLIERS)
def test_things_of_no_kind_are_solid_and_all_others(category: str) -> None:
    things = [drawn(category, index) for index in range(40)]
    for thing in things:
        assert thing.category == category and 2 <= len(thing.pieces) <= 60
        assert all(p.is_convex and p.is_watertight and p.volume > 0 for p in thing.pieces)
        if category == "assembly":
            assert hanging_together(thing) == len(thing.pieces), thing.name
        assert np.ptp(np.vstack([p.bounds for p in thing.pieces]), axis=0).max() == pytest.approx(1)
    assert len({digest(thing) for thing in things}) == len(things)
    assert digest(make_object(category, 3)) == digest(things[3])


@pytest.mark.parametrize("category", KINDS)
def test_pieces_are_solid_convex_few_and_hang_together(category: str) -> None:
    for index in range(MANY):
        thing = drawn(category, index)
        assert len(thing.pieces) <= 24
        assert hanging_together(thing) == len(thing.pieces), f"{thing.name} is in parts"
        for piece in thing.pieces:
            assert piece.is_watertight and piece.is_winding_consistent, thing.name
            assert piece.volume > 1e-5, thing.name
            assert len(piece.vertices) <= 48, thing.name
            across = piece.vertices @ piece.face_normals.T
            planes = (piece.triangles[:, 0] * piece.face_normals).sum(axis=1)
            assert (across - planes).max() < 1e-8, f"{thing.name} has a piece that is not convex"
            assert np.ptp(across, axis=0).min() >= 0.02, f"{thing.name} has a sliver"


@pytest.mark.parametrize("category", KINDS)
def test_it_is_centred_with_largest_extent_one(category: str) -> None:
    for index in INDICES:
        thing = drawn(category, index)
        assert (thing.name, thing.category) == (f"{category}-{index}", category)
        low, high = extents(thing)
        np.testing.assert_allclose(low + high, 0, atol=1e-9)
        assert (high - low).max() == pytest.approx(1)


@pytest.mark.parametrize("category", KINDS)
def test_much_of_it_is_where_whiskers_reach(category: str) -> None:
    heights = np.linspace(-0.25, 0.25, 21)
    for index in range(MANY):
        bounds = np.array([p.bounds[:, 2] for p in drawn(category, index).pieces])
        met = ((bounds[:, :1] <= heights) & (heights <= bounds[:, 1:])).any(axis=0)
        assert met.mean() >= 0.3, f"{category}-{index}"
        assert met[8:13].any(), f"{category}-{index} is missed at its middle height"


@pytest.mark.parametrize("category", KINDS)
def test_no_two_instances_are_equal(category: str) -> None:
    shapes = [drawn(category, i) for i in range(MANY)]
    assert len({digest(s) for s in shapes}) == MANY
    # and not by a hair, nor by little on the whole: sides of the bounding box, surface
    figures = [[*np.ptp(extents(s), axis=0), sum(p.area for p in s.pieces)] for s in shapes]
    apart = np.abs(np.array(figures)[:, None] - np.array(figures)).max(axis=2)
    assert apart[~np.eye(MANY, dtype=bool)].min() > 0.003
    assert np.median(apart) > 0.05


@pytest.mark.parametrize("index", INDICES)
def test_hollows_stay_hollow(index: int) -> None:
    bowl = drawn("bowl", index)
    assert not inside(bowl, (0, 0, 0.1))
    assert inside(bowl, (0, 0, extents(bowl)[0, 2] + 0.01))
    mug = drawn("mug", index)
    axis = (extents(mug)[0, 0] + mug.pieces[0].extents[0] / 2 + 0.05, 0.0)
    for z in (-0.2, 0.0, 0.2):
        assert not inside(mug, (*axis, z))
    assert inside(mug, (*axis, extents(mug)[0, 2] + 0.02)), "the mug has no floor"
    gear = drawn("gear", index)
    assert not inside(gear, (0, 0, 0)) and inside(gear, (0.3, 0, 0))


@pytest.mark.parametrize("index", INDICES)
def test_there_is_air_under_tables_chairs_and_shades(index: int) -> None:
    assert not inside(drawn("table", index), (0, 0, -0.1))
    assert not inside(drawn("chair", index), (0, 0, -0.25))
    shade = drawn("lamp", index)
    assert not inside(shade, (0.12, 0, 0.2))
    assert inside(shade, (0, 0, -0.2)), "the pole is missing"


def test_there_is_a_gap_behind_the_handle() -> None:
    for index in INDICES:
        mug = drawn("mug", index)
        row = [inside(mug, (x, 0, 0.02)) for x in np.arange(0.5, -0.5, -0.004)]
        # from outside: handle, gap, wall, cavity, wall
        assert (np.diff(np.array(row, int)) == 1).sum() >= 2


@pytest.mark.parametrize("category", KINDS)
def test_a_varied_one_is_of_its_kind_solid_and_whole(category: str) -> None:
    for index in range(MANY):
        thing = drawn(VARIED + category, index)
        assert (thing.name, thing.category) == (f"{VARIED}{category}-{index}", category)
        assert len(thing.pieces) <= 64
        for piece in thing.pieces:
            assert piece.is_convex and piece.is_watertight and piece.volume > 0, thing.name
        low, high = extents(thing)
        np.testing.assert_allclose(low + high, 0, atol=1e-9)
        assert (high - low).max() == pytest.approx(1)
        assert hanging_together(thing) == len(thing.pieces), f"{thing.name} falls apart"


@pytest.mark.parametrize("category", ["chair", "table", "house", "car", "lamp", "bottle", "mug"])
def test_varied_ones_differ_by_far_more_than_those_of_one_plan(category: str) -> None:
    def spread(prefix: str) -> float:
        """Over the share of the bounding box that things fill, and over its sides."""
        shapes = [drawn(prefix + category, i) for i in range(MANY)]
        filled = [
            sum(p.volume for p in s.pieces) / np.ptp(extents(s), axis=0).prod() for s in shapes
        ]
        sides = np.array([np.ptp(extents(s), axis=0) for s in shapes])
        return float(np.std(np.log(filled)) + np.log(sides).std(axis=0).sum())

    assert spread(VARIED) > 1.5 * spread("")


def test_load_object_takes_a_name_with_or_without_an_index() -> None:
    assert load_object("mug-17").name == "mug-17"
    assert load_object("mug").name == "mug-0"
    assert digest(load_object("mug")) == digest(make_object("mug", 0))


@pytest.mark.parametrize(
    ("target", "said"),
    [
        ("mugg", r"no object called 'mugg'; did you mean 'mug'\? \(or a mesh file: .*\.glb"),
        ("Table-3", r"'Table'; did you mean 'table'\?"),
        ("qqq", r"no object called 'qqq'; there are beehive, birdcage"),
        ("cup.step", r"cup\.step.*'\.step'.*\.obj, \.stl, \.ply, \.glb"),
        ("nowhere/cup.stl", "no such file"),
    ],
)
def test_what_cannot_be_loaded_is_said_in_one_line(target: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as caught:
        load_object(target)
    assert "\n" not in str(caught.value)


def test_an_index_below_zero_is_refused() -> None:
    with pytest.raises(ConfigError, match="0 or more"):
        make_object("mug", -1)
