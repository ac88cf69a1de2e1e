"""Views of a simulation, checked in the pixels: projections, arrows, the map, files."""

import re
from contextlib import closing
from dataclasses import replace

import av
import mujoco
import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text
from PIL import Image

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec
from tactile_rt.sim_backend.arrays.files import load_animals, load_array, mouse_whiskers
from tactile_rt.sim_backend.objects.catalogue import make_object
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.transducer import device_spec, sensor_of
from tactile_rt.sim_backend.views.film import (
    Film,
    Stage,
    camera_of,
    check_suffix,
    write_image,
    write_video,
)
from tactile_rt.sim_backend.views.footage import VIEWS, Camera, Footage, framing, record
from tactile_rt.sim_backend.views.sheet import ForceMap, ForceScale, Sheet, rostral_sign
from tactile_rt.sim_backend.world import OBJECT_BIT, PROFILES, WHISKER_BIT, array_spec
from tests.helpers.refusals import refusal
from tests.helpers.source_tree import ROOT

SCALE = ForceScale(1.0, 10.0)
SIDE = 200  # pixels of a test picture


def sweep_simulation():
    sweep = Sweep(size_mm=20, speed_mm_s=150)
    target, profile = make_object("mug", 1), PROFILES["realtime"]
    return SweepSimulation(load_array("mouse"), target, sweep, profile, whole=True)


@pytest.fixture(scope="module")
def footage():
    return record(sweep_simulation(), array_spec(mouse_whiskers(), "mouse-right"), 10)


def still(geoms="", site="", load=(0, 0, 0, 0, 0, 0)):
    """One frame of one whisker at the origin, too small to be seen, and these geoms."""
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><worldbody>{geoms}
          <body name="w" {site}><site name="w"/>
            <geom type="capsule" fromto="0 0 0 .01 0 0" size=".001" contype="{WHISKER_BIT}"/>
          </body>
        </worldbody></mujoco>""")
    spec = ArraySpec(
        name="one", elements=("w",), grid=((0, 0),), positions=((0.0, 0.0, 0.0),),
        orientations=((1.0, 0.0, 0.0, 0.0),), channels=("fx", "fy", "fz", "mx", "my", "mz"),
        units=("N",) * 3 + ("N m",) * 3, rate_hz=1000.0, frame="head",
    )  # fmt: skip
    size = np.array([[np.linalg.norm(load[:3])]])
    return Footage(model, spec, 1.0, np.array([[load]], dtype=float), np.zeros((1, 0)), size)


def thing(kind, size, pos, more=""):
    return f'<geom type="{kind}" size="{size}" pos="{pos}" contype="{OBJECT_BIT}" {more}/>'


def photograph(recorded, camera, frame=0):
    """(height, width, 3) picture, or skip where nothing can be drawn."""
    try:
        with closing(Stage(recorded, camera, SCALE, SIDE, SIDE)) as stage:
            return stage.picture(frame)
    except ConfigError as error:
        if "no OpenGL" in str(error):
            pytest.skip(str(error))
        raise


def bluish(picture):
    """(height, width) where an object is: half of it, as it is drawn as glass."""
    return picture[..., 2].astype(int) - picture[..., 0] > 5


def extent_of(mask):
    """(width, height) in pixels."""
    return int(mask.any(axis=0).sum()), int(mask.any(axis=1).sum())


# ---- projections

AHEAD = Camera(0.0, 0.0, (0.0, 0.0, 0.0), 40.0)  # looks along +x, y to the left, z up


@pytest.mark.parametrize("depth", [-12, 0, 30])
def test_size_over_depth_is_that_of_the_projection(depth):
    camera = Camera(0.0, 0.0, (0, 0, 0), 40.0)
    plate = thing("box", ".01 4 6", f"{depth} 0 0")
    width, height = extent_of(bluish(photograph(still(plate), camera)))
    eye = 20 / np.tan(np.radians(35 / 2))
    shrink = eye / (eye + depth)
    assert width == pytest.approx(8 * SIDE / 40 * shrink, abs=1.5)
    assert height == pytest.approx(12 * SIDE / 40 * shrink, abs=1.5)


@pytest.mark.parametrize("view", VIEWS)
def test_the_axes_of_a_camera_are_those_of_its_picture(view):
    azimuth, elevation = VIEWS[view]
    camera = Camera(azimuth, elevation, (3.0, -5.0, 2.0), 40.0)
    place = np.array(camera.lookat) + 9 * camera.right + 4 * camera.up
    ball = thing("sphere", "1", " ".join(map(str, place)))
    rows, columns = np.nonzero(bluish(photograph(still(ball), camera)))
    assert columns.mean() == pytest.approx(SIDE / 2 + 9 * SIDE / 40, abs=1)
    assert rows.mean() == pytest.approx(SIDE / 2 - 4 * SIDE / 40, abs=1)


def test_named_views_are_what_they_are_called():
    right = {view: Camera(*VIEWS[view], (0, 0, 0), 1.0).right for view in VIEWS}
    np.testing.assert_allclose(right["side"], (0, 1, 0), atol=1e-12)  # nose on the right
    np.testing.assert_allclose(right["front"], (-1, 0, 0), atol=1e-12)  # face to face
    np.testing.assert_allclose(right["top"], (1, 0, 0), atol=1e-12)
    np.testing.assert_allclose(Camera(*VIEWS["top"], (0, 0, 0), 1).up, (0, 1, 0), atol=1e-12)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("left", [False, True])
def test_a_named_view_shows_all_that_it_frames(view, left):
    points = np.random.default_rng(3).normal(size=(50, 3)) * (9, 2, 5) + (40, -7, 1)
    camera = framing(view, points, aspect=2.0, left=left)
    from_middle = points - camera.lookat
    nearness = camera.distance_mm / (camera.distance_mm + from_middle @ camera.forward)
    assert np.abs(nearness * (from_middle @ camera.right)).max() < camera.extent_mm * 2.0 / 2
    assert np.abs(nearness * (from_middle @ camera.up)).max() < camera.extent_mm / 2
    assert Camera(camera.azimuth, camera.elevation, (0, 0, 0), 1).forward[0] == pytest.approx(
        (-1) ** left * Camera(*VIEWS[view], (0, 0, 0), 1).forward[0]
    )


# ---- the scene


def test_drawing_changes_neither_the_model_nor_the_loads(footage):
    plain, drawn = sweep_simulation(), sweep_simulation()
    before = {name: getattr(drawn.model, name).copy() for name in ("geom_size", "geom_rgba")}
    drawn.duration_ms = 40.0
    half = record(drawn, footage.spec, 40)
    photograph(half, camera_of(half, "side"))
    for name, array in before.items():
        np.testing.assert_array_equal(getattr(drawn.model, name), array)
    plain.advance(40)
    np.testing.assert_array_equal(drawn.advance(40), plain.advance(40))


def test_a_force_is_an_arrow_from_the_base_as_long_as_its_scale_says():
    # y of the element frame is -x of the world: half the scale's force points left, from above
    recorded = still(site='pos="6 2 0" euler="0 0 90"', load=(0, 0.5e-3, 0, 0, 0, 0))
    picture = photograph(recorded, Camera(*VIEWS["top"], (0, 0, 0), 40.0))
    rows, columns = np.nonzero((picture < 240).any(axis=2))
    pixel = SIDE / 40
    assert columns.min() == pytest.approx(SIDE / 2 + (6 - 0.5 * SCALE.arrow_mm) * pixel, abs=2)
    assert columns.max() == pytest.approx(SIDE / 2 + 6 * pixel, abs=3)  # the dot on the base
    assert rows.mean() == pytest.approx(SIDE / 2 - 2 * pixel, abs=1)


def test_no_force_is_no_arrow():
    picture = photograph(still(), AHEAD)
    width, height = extent_of((picture < 240).any(axis=2))
    assert 0 < width <= 5
    assert 0 < height <= 5


def test_a_whisker_shows_through_what_hides_it():
    post = '<geom type="capsule" fromto="0 0 -5 0 0 5" size=".4" contype="1"/>'
    lone = still()
    model = mujoco.MjModel.from_xml_string(f"""
        <mujoco><worldbody>{thing("box", ".1 15 15", "-8 0 0")}
          <body name="w"><site name="w"/>{post}</body></worldbody></mujoco>""")
    picture = photograph(replace(lone, model=model), AHEAD)
    hidden, beside = picture[SIDE // 2 - 10, SIDE // 2], picture[SIDE // 2 - 10, SIDE // 2 + 30]
    assert int(beside.min()) - int(hidden.min()) > 20
    assert (picture[2, 2] == 255).all()  # paper


def test_without_a_way_to_draw_it_is_one_line(monkeypatch):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert "no OpenGL to draw with" in refusal(Stage, still(), AHEAD, SCALE, 64, 64)


# ---- recording and scale


def test_frames_are_means_of_the_simulations_loads(footage):
    loads = sweep_simulation().advance(10 * len(footage))
    means = loads.reshape(len(footage), 10, *loads.shape[1:]).mean(axis=1)
    np.testing.assert_allclose(footage.loads, means, atol=1e-15)
    assert footage.times_ms[-1] >= sweep_simulation().duration_ms
    total = np.linalg.norm(means[..., :3], axis=2).sum(axis=1)
    assert footage.strongest == total.argmax()
    assert [footage.at(ms) for ms in (0, 10, 21, 1e9)] == [0, 0, 1, len(footage) - 1]


def test_states_are_those_at_the_end_of_their_frames(footage):
    simulation = sweep_simulation()
    simulation.advance(30)
    data = mujoco.MjData(footage.model)
    footage.restore(2, data)
    wanted = mujoco.MjData(footage.model)
    simulation.show(wanted)
    np.testing.assert_array_equal(data.qpos, wanted.qpos)
    np.testing.assert_array_equal(data.mocap_pos, wanted.mocap_pos)


def test_a_scale_fits_the_forces_but_not_a_rare_snap():
    forces = np.full((200, 30), 0.2e-3)
    forces[7, 3] = 9e-3
    scale = ForceScale.fitting(forces, 40.0)
    assert 0.1 <= scale.top <= 0.3
    assert scale.length(scale.top) == scale.arrow_mm
    assert scale.length(9.0) <= 2 * scale.arrow_mm
    assert scale.colour(0.0) == scale.colour(1e-9) != scale.colour(scale.top)


# ---- the map and the whole picture


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("name", ["mouse", "mouse-left", "rat"])
@pytest.mark.parametrize(
    ("head_force", "points"), [((0, 1, 0), (1, 0)), ((0, 0, 1), (0, 1)), ((0, -1, -1), (-1, -1))]
)
def test_the_map_points_where_the_force_goes_on_the_head(name, mirrored, head_force, points):
    array = load_array(name)
    figure = Figure(figsize=(4, 3))
    spec = array_spec(array.whiskers, name)
    force_map = ForceMap(figure, (0, 0, 1, 1), spec, SCALE, mirrored)
    loads = np.zeros((len(spec.elements), 6))
    for i, whisker in enumerate(array.whiskers):
        loads[i, :3] = whisker.orientation.T @ np.array(head_force) * 1e-3
    force_map.show(loads, np.linalg.norm(loads[:, :3], axis=1))
    wanted = np.array(points) * (-1 if mirrored else 1, 1) / np.linalg.norm(points)
    for i in (0, len(spec.elements) // 2, -1):
        tail, tip = np.array(force_map._cells[i][1]._posA_posB)
        drawn = (tip - tail) / np.linalg.norm(tip - tail) * (1, -1)  # rows are counted downward
        np.testing.assert_allclose(drawn, wanted, atol=0.05)


def test_only_touched_cells_change(footage):
    figure = Figure(figsize=(4, 3))
    force_map = ForceMap(figure, (0, 0, 1, 1), footage.spec, SCALE)
    loads = np.zeros((30, 6))
    assert force_map.show(loads, loads[:, 0]) == []
    loads[12, 0] = 1e-3
    changed = force_map.show(loads, loads[:, 0])
    assert len(changed) == 3
    assert changed[2].get_text() == footage.spec.elements[12]
    assert changed[0].get_facecolor() == pytest.approx(SCALE.colour(1.0), abs=1e-6)


def test_columns_of_a_face_go_to_the_nose_from_both_sides():
    both = load_array("mouse-both")
    signs = rostral_sign(array_spec(both.whiskers, both.name))
    assert [signs[i] for i, w in enumerate(both.whiskers) if w.name[0] == "R"] == [1] * 30
    assert [signs[i] for i, w in enumerate(both.whiskers) if w.name[0] == "L"] == [-1] * 30


def test_a_robot_is_drawn_in_what_its_sensor_reads():
    magnets = load_animals(str(ROOT / "docs" / "arrays" / "magnets.toml"))
    sweep, target = Sweep(size_mm=20, speed_mm_s=150, distance_mm=12), make_object("mug", 1)
    simulation = SweepSimulation(magnets, target, sweep, PROFILES["realtime"], whole=True)
    footage = record(simulation, device_spec(magnets), 10, sensor=sensor_of(magnets))
    scale = ForceScale.fitting(footage.sizes, 40.0, "T")
    assert 1e-6 < footage.sizes.max() < 1e-2 and not footage.sizes[0].any()
    sheet = Sheet(footage, camera_of(footage, "oblique"), scale, "a", "b", 320)
    words = " ".join(text.get_text() for text in sheet._figure.findobj(Text))
    assert f"arrow of {scale.top:g} mT" in words and "size of bx, by, bz" in words
    assert not re.search(r"nose|cheek|mN", words)


@pytest.fixture(scope="module")
def film(footage):
    try:
        with closing(Film(footage, "oblique", title="a title", pixels=320)) as opened:
            yield opened
    except ConfigError as error:
        pytest.skip(str(error))


def test_a_picture_depends_on_its_frame_alone(film, footage):
    early, late = 1, footage.strongest
    first = film.picture(early)
    assert first.shape == (180, 320, 3)
    other = film.picture(late)
    assert (other != first).any()
    np.testing.assert_array_equal(film.picture(early), first)  # nothing of another stays behind


# ---- files

FRAMES = [np.full((96, 128, 3), level, dtype=np.uint8) for level in range(40, 250, 30)]


def test_an_mp4_has_its_frames_size_and_rate(tmp_path):
    path = tmp_path / "a.mp4"
    write_video(path, iter(FRAMES), 25)
    with av.open(str(path)) as file:
        stream = file.streams.video[0]
        assert (stream.width, stream.height, stream.average_rate) == (128, 96, 25)
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        read = [frame.to_ndarray(format="rgb24") for frame in file.decode(video=0)]
    assert len(read) == len(FRAMES)
    for got, wanted in zip(read, FRAMES, strict=True):
        assert abs(got.astype(int) - wanted).mean() < 4


def test_a_video_that_fails_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.mp4"
    path.write_bytes(b"before")

    def frames():
        yield from FRAMES[:2]
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        write_video(path, frames(), 25)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_image_is_what_was_drawn(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_image(path, FRAMES[3])
    with Image.open(path) as image:
        most = 3 if suffix == ".jpg" else 0
        assert abs(np.asarray(image).astype(int) - FRAMES[3]).max() <= most
    assert list(tmp_path.iterdir()) == [path]


def test_other_files_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"ends in \.png, \.jpg for a picture"):
        check_suffix(tmp_path / "a.avi")
    assert check_suffix(tmp_path / "a.MP4") == ".mp4"
