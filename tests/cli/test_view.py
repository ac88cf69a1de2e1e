"""`tactile-rt view`: pictures and videos of the size and length asked for; mistakes refused."""

import av
import numpy as np
import pytest
from PIL import Image

QUICK = ("--set", "speed_mm_s=300", "--set", "size_mm=20", "--profile", "realtime")


@pytest.fixture
def view(call, tmp_path, monkeypatch):
    """Call `view mug-1` with these options: the file that it wrote."""

    monkeypatch.setattr("tactile_rt.cli.view.WIDTH", 320)

    def run(name, *options):
        path = tmp_path / name
        code, out, err = call("view", "mug-1", "--out", path, *QUICK, *options)
        if "no OpenGL" in err:
            pytest.skip(err)
        assert (code, out) == (0, ""), err
        assert list(tmp_path.iterdir()) == [path]
        return path

    return run


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_a_picture_of_a_moment(view):
    early = pixels(view("a.png", "--at", 1, "--camera", "side"))
    assert early.shape == (180, 320, 3)
    late = pixels(view("a.png", "--at", 60, "--camera", "side"))
    assert (early != late).any()


def test_the_moment_of_most_force_shows_force(view):
    rest, most = pixels(view("a.png", "--at", 0)), pixels(view("a.png"))

    def vivid(picture):
        """Pixels of the map (right of the scene, above the traces) that have a strong colour."""
        cells = picture[20:110, 205:]
        return int((cells.max(axis=2) - cells.min(axis=2) > 80).sum())

    assert vivid(most) > vivid(rest) + 200


def test_a_video_lasts_as_much_longer_as_it_is_slower(view):
    frames = {}
    for slow in (2, 4):
        with av.open(str(view("a.mp4", "--slow", slow))) as file:
            stream = file.streams.video[0]
            assert (stream.width, stream.height, stream.average_rate) == (320, 180, 25)
            frames[slow] = sum(1 for _ in file.decode(video=0))
    assert abs(frames[4] - 2 * frames[2]) <= 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--out", "a.avi"), "ends in .png, .jpg for a picture, or .mp4 for a video"),
        (("--out", "a.png", "--camera", "above"), "no camera 'above': there are front, side, top"),
        (("--out", "a.png", "--profile", "fast"), "no profile 'fast'"),
        (("--out", "a.png", "--at", 1e6), "the sweep lasts"),
        (("--out", "a.mp4", "--at", 5), "--at needs a picture"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(refused, cwd, options, said):
    assert said in refused("view", "mug-1", *options)
    assert list(cwd.iterdir()) == []


def test_an_object_that_misses_is_said(call, tmp_path):
    path = tmp_path / "a.png"
    code, _, err = call("view", "mug-1", "--out", path, *QUICK, "--set", "height_mm=300")
    if "no OpenGL" in err:
        pytest.skip(err)
    assert code == 0
    assert "passes without touching" in err.replace("\n", " ")
    assert path.exists()
