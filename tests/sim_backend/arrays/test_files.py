"""Arrays by name and from files: mirror images, several animals, mistakes."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.files import (
    load_animals,
    load_array,
    mouse_whiskers,
    rat_whiskers,
    read_animals,
)
from tactile_rt.sim_backend.arrays.whisker_array import (
    MOUNT,
    Mount,
    WhiskerArray,
    both_sides,
    mirror_whisker,
    place,
)
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.world import (
    PROFILES,
    add_whiskers,
    array_spec,
    empty_world,
    read_base_loads,
    set_damping,
)
from tests.helpers.refusals import refusal
from tests.helpers.source_tree import ROOT

Floats = NDArray[np.float64]
MIRROR = np.diag([-1.0, 1.0, 1.0])
FLIPS = np.array([1, 1, -1, -1, -1, 1])  # of fx fy fz mx my mz under reflection
EXAMPLES = ROOT / "docs" / "arrays"
NAMES = ("mouse", "mouse-left", "mouse-both", "rat", "rat-left", "rat-both")


def points(whisker: Whisker, mount: Mount, n: int = 9) -> Floats:
    """(n, 3) in the world, mm."""
    line = whisker.centreline(np.linspace(0, whisker.length, n))
    in_head = np.array(whisker.base) + line @ whisker.orientation.T
    return np.asarray(np.array(mount.position) + in_head @ mount.rotation.T)


# By name


@pytest.mark.parametrize("name", NAMES)
def test_every_name_is_an_array_that_a_stream_can_describe(name: str) -> None:
    array = load_array(name)
    assert array.name == (name if "-" in name else f"{name}-right")
    spec = array_spec(array.whiskers, array.name)
    assert spec.shape == (60 if name.endswith("both") else 30, 6)
    assert spec.grid_shape == ((5, 14) if name.endswith("both") else (5, 7))
    assert load_array(name) == array and hash(array) == hash(load_array(name))
    assert load_animals(name) == (array,)


def test_the_right_side_is_the_measured_one() -> None:
    assert load_array("mouse") == load_array("mouse-right")
    assert load_array("mouse").whiskers == mouse_whiskers()
    assert load_array("mouse").mount == MOUNT
    assert load_array("rat").whiskers == rat_whiskers()


@pytest.mark.parametrize("name", ["cat", "mouse-top", "", "mouse-", "mouse.cvs"])
def test_an_unknown_array_is_refused(name: str) -> None:
    with pytest.raises(ConfigError, match=r"no simulated array .*(mouse|rat).*\.csv or \.toml"):
        load_array(name)


def test_the_rat_stands_where_the_mouse_stands() -> None:
    middles = [
        np.mean([points(w, a.mount, 2)[0] for w in a.whiskers], axis=0)
        for a in (load_array("mouse"), load_array("rat"))
    ]
    np.testing.assert_allclose(*middles, atol=1e-12)
    assert load_array("rat").mount.roll_pitch_yaw == MOUNT.roll_pitch_yaw


# The other side


@pytest.mark.parametrize("animal", ["mouse", "rat"])
def test_a_mirrored_whisker_is_the_reflected_curve(animal: str) -> None:
    for right in load_array(animal).whiskers:
        left = mirror_whisker(right)
        here = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        np.testing.assert_allclose(points(left, here), points(right, here) @ MIRROR, atol=1e-12)
        turn = left.orientation
        np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turn) == pytest.approx(1)
        assert left.curvature > 0  # y still points to the concave side
        assert mirror_whisker(left) == right


def test_a_reflected_push_in_the_simulator_gives_reflected_loads() -> None:
    right = next(w for w in mouse_whiskers() if w.name == "B1")
    loads = []
    for whisker, mount, force in (
        (right, MOUNT, np.array([0.02, -0.03, 0.01])),
        (mirror_whisker(right), MOUNT.mirror(), np.array([-0.02, -0.03, 0.01])),
    ):
        world = empty_world(PROFILES["dataset"])
        add_whiskers(world, (whisker,), PROFILES["dataset"], mount)
        model = world.compile()
        set_damping(model)
        data = mujoco.MjData(model)
        data.xfrc_applied[-1, :3] = force  # mN, on the last link
        felt = []
        for _ in range(60):
            mujoco.mj_step(model, data)
            felt.append(read_base_loads(data.sensordata)[0].copy())
        loads.append(np.array(felt))
    size = np.abs(loads[0]).max(axis=0)
    assert (size > 0).all()
    np.testing.assert_allclose(loads[1] / size, FLIPS * loads[0] / size, atol=1e-5)


def test_both_sides_make_a_face() -> None:
    both = {w.name: w for w in load_array("mouse-both").whiskers}
    assert {n[:2] for n in both} == {"L.", "R."}
    assert load_array("mouse-both").mount == MOUNT
    for w in mouse_whiskers():
        right, left = both[f"R.{w.name}"], both[f"L.{w.name}"]
        assert (right.row, right.column) == (w.row, w.column)
        assert (left.row, left.column) == (w.row, 13 - w.column)
        assert replace(left, name=w.name, column=w.column) == mirror_whisker(w)
    # face to face with the animal its right is at one's left; the nose is in the middle
    for row in range(5):
        along = sorted((w for w in both.values() if w.row == row), key=lambda w: w.column)
        rostral = [w.base[1] for w in along]
        half = len(rostral) // 2
        assert rostral[:half] == sorted(rostral[:half])
        assert rostral[half:] == rostral[:half][::-1]
    assert all((w.column < 7) == (w.base[0] > 0) for w in both.values())


# Several animals


def test_animals_in_one_world_have_names_and_cells_of_their_own() -> None:
    there = Mount((0.0, 60.0, 0.0), (0.0, 0.0, np.pi))
    first, second = place([load_array("mouse-both"), replace(load_array("rat"), mount=there)])
    assert (first.name, second.name) == ("1.mouse-both", "2.rat-right")
    assert first.whiskers[0].name == "1.R.A0" and second.whiskers[0].name == "2.A0"
    assert (first.mount, second.mount) == (MOUNT, there)
    spec = array_spec(first.whiskers + second.whiskers, "two")
    assert spec.shape == (90, 6) and spec.grid_shape == (10, 14)
    assert second.whiskers[0].row == 5 and second.whiskers[0].base == rat_whiskers()[0].base
    alone = load_array("rat")
    assert place([alone]) == (alone,)


def test_animals_are_not_put_in_the_same_place() -> None:
    mouse = load_array("mouse")
    assert "animal 2 (mouse-right) overlaps another" in refusal(place, [mouse, mouse])
    assert "must be finite" in refusal(Mount, (0.0, np.nan, 0.0), (0.0, 0.0, 0.0))


def test_an_array_holds_each_whisker_once() -> None:
    a0, a1 = mouse_whiskers()[:2]
    assert "A0 and A0 have the same name" in refusal(WhiskerArray, "x", (a0, a0))
    with pytest.raises(ConfigError, match="A0 and A1 have the same cell of the grid"):
        WhiskerArray("x", (a0, replace(a1, column=0)))
    assert "has no whiskers" in refusal(WhiskerArray, "x", ())


# Files


def test_the_example_is_the_same_array_in_both_formats() -> None:
    toml, table = (load_array(str(EXAMPLES / f"robot.{kind}")) for kind in ("toml", "csv"))
    assert replace(toml, gravity=(0.0, 0.0, 0.0)) == table, "a table of whiskers has no gravity"
    assert toml.gravity == (0.0, 0.0, -9.80665)
    assert (toml.name, len(toml.whiskers)) == ("robot", 8)
    assert {(w.row, w.column) for w in toml.whiskers} == {(r, c) for r in (0, 1) for c in range(4)}
    for w in toml.whiskers:
        assert (w.curvature, w.base_radius, w.tip_radius) == (0.0, 0.06, 0.06)
        assert (w.young_modulus, w.density_base, w.density_tip) == (2.9e9, 1130, 1130)
        assert (w.damping_ratio, w.friction) == (0.05, 0.3)
        assert points(w, toml.mount)[-1][0] > 12  # they reach out along x, where objects pass
    lengths = {w.name: w.length for w in toml.whiskers}
    assert lengths == {f"{r}{c}": 24 - 3 * c for r in "AB" for c in range(4)}
    middle = np.mean([points(w, toml.mount)[0] for w in toml.whiskers], axis=0)
    np.testing.assert_allclose(middle, 0, atol=1e-12)


HEADER = (
    "whisker,row,col,arc_length_mm,curvature_a_per_mm,base_x_mm,base_y_mm,base_z_mm,"
    "base_theta_rad,base_phi_rad,base_zeta_rad,base_radius_mm"
)
LINE = "A0,1,0,40,0,0,1,2,1.5,0.1,0,0.2"
OTHER = "A1,1,1,30,-0.01,0,5,2,1.5,0.1,0,0.2"
WHISKERS = """
[[whisker]]
whisker = "A0"
row = 1
col = 0
arc_length_mm = 40
[[whisker]]
whisker = "A1"
row = 1
col = 1
arc_length_mm = 30
"""
DEFAULTS = """
[defaults]
curvature_a_per_mm = 0
base_x_mm = 0
base_y_mm = 1
base_z_mm = 2.5
base_theta_rad = 1.5
base_phi_rad = 0
base_zeta_rad = 0
base_radius_mm = 0.2
"""


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_a_table_as_a_spreadsheet_writes_it(tmp_path: Path) -> None:
    text = f"\ufeff# mine\r\n{HEADER}\r\n\r\n {LINE} \r\n# one more\r\n{OTHER}\r\n,,,,,,,,,,,\r\n"
    array = load_array(str(write(tmp_path, "mine.CSV", text)))
    assert [w.name for w in array.whiskers] == ["A0", "A1"] and array.name == "mine"
    assert array.whiskers[1].curvature == -0.01 and array.whiskers[0].tip_radius == 0.2


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "a.csv: is empty"),
        (HEADER, "a.csv: has no whiskers"),
        (HEADER.replace(",col", ""), "a.csv:1: no column col; add it"),
        (HEADER.replace("_length", "_lenght"), "no column 'arc_lenght_mm'; did you mean arc_"),
        (f"#\n{HEADER}\n{LINE.replace('40', 'x')}", "a.csv:3: arc_length_mm is not a number: 'x'"),
        (f"{HEADER}\n{LINE.replace('40', '')}", "a.csv:2: no arc_length_mm; give it a value"),
        (
            f"{HEADER}\n{LINE.replace('40', '-4')}",
            "a.csv:2: whisker A0: arc_length_mm must be posi",
        ),
        (f"{HEADER}\n{LINE}\n\n{LINE}", r"a.csv:4: whisker A0 is taken already \(line 2\)"),
        (f"{HEADER}\n{LINE}\nB{LINE}", r"a.csv:3: row 1, col 0 is taken already \(line 2\)"),
        (f"{HEADER}\n{LINE.replace('A0', 'A 0')}", "a.csv:2: whisker 'A 0': a name is"),
    ],
)
def test_a_mistake_in_a_table_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = write(tmp_path, "a.csv", text)
    with pytest.raises(ConfigError, match=said) as caught:
        load_array(str(path))
    assert "\n" not in str(caught.value) and str(caught.value).startswith(str(path))


def test_a_toml_array_has_a_mount_and_defaults(tmp_path: Path) -> None:
    top = 'name = "bot"\nmount = { position_mm = [1, 2, 3.5], roll_pitch_yaw_rad = [0, 0.1, 0] }\n'
    text = top + DEFAULTS + WHISKERS.replace("= 30", "= 30\nfriction = 0.1\nbase_y_mm = 9")
    array = load_array(str(write(tmp_path, "a.toml", text)))
    assert array.name == "bot"
    assert array.mount == Mount((1.0, 2.0, 3.5), (0.0, 0.1, 0.0))
    a0, a1 = array.whiskers
    assert (a0.base, a0.friction) == ((0.0, 1.0, 2.5), 0.5)
    assert (a1.base, a1.friction) == ((0.0, 9.0, 2.5), 0.1)
    plain = load_array(str(write(tmp_path, "b.toml", DEFAULTS + WHISKERS)))
    assert plain.name == "b"
    assert plain.mount.position == (0.0, -1.0, -2.5)  # its middle at the origin
    two = load_array(str(write(tmp_path, "c.toml", "mirror = true\n" + DEFAULTS + WHISKERS)))
    assert two == both_sides(replace(plain, name="c"), "c")
    assert [w.column for w in two.whiskers] == [0, 1, 3, 2]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", r"needs \[\[whisker\]\] tables or"),
        ("naem = 'x'" + DEFAULTS + WHISKERS, "the file has no key 'naem'; did you mean name?"),
        (
            "[mount]\nroll_pitch_yaw_rad = [0,0,-90]" + DEFAULTS + WHISKERS,
            r"a.toml: mount.roll_pitch_yaw_rad must be within a turn, 6.28, not -90: mind the unit",
        ),
        (DEFAULTS + WHISKERS + "frction = 3", r"a.toml:22: whisker\[1\] has no key .* friction\?"),
        (WHISKERS, r"whisker\[0\] \(A0\): no curvature_a_per_mm"),
        (
            DEFAULTS + WHISKERS.replace('"A1"', "1"),
            r"whisker\[1\]: whisker must be a name, in quotes",
        ),
        (
            DEFAULTS + WHISKERS.replace('"A1"', '"A0"'),
            r"\[1\] \(A0\): whisker A0 is .* \(line 12: whisker",
        ),
        ("[[animal]]\narray = 'mouse'\n" + WHISKERS, "tables, one of the two"),
        ("name = 'x'\n[[animal]]\narray = 'mouse'", "no other keys are allowed"),
        ("[[animal]]\narray = 'a.toml'", "names this file itself"),
        ("[[animal]]\narray = 'no.csv'", "no.csv: no such file"),
        (
            "[[animal]]\narray = 'rat'\n[[animal]]\narray = 'rat'",
            "a.toml: animal 2 .* overlaps another",
        ),
    ],
)
def test_a_mistake_in_a_toml_file_is_one_line(tmp_path: Path, text: str, said: str) -> None:
    path = write(tmp_path, "a.toml", text)
    with pytest.raises(ConfigError, match=said) as caught:
        load_animals(str(path))
    assert "\n" not in str(caught.value)


def test_a_toml_file_places_several_animals(tmp_path: Path) -> None:
    write(tmp_path, "bot.csv", f"{HEADER}\n{LINE}\n")
    text = """
    [[animal]]
    array = "rat-both"
    [[animal]]
    array = "bot.csv"
    mount = { position_mm = [80, 0, 0] }
    """
    path = str(write(tmp_path, "world.toml", text))
    rat, bot = load_animals(path)
    assert (rat.name, bot.name, bot.whiskers[0].name) == ("1.rat-both", "2.bot", "2.A0")
    assert rat.mount == load_array("rat-both").mount
    assert bot.mount.position == (80, 0, 0) and bot.whiskers[0].row == 5
    assert "holds 2 animals where one array is needed" in refusal(load_array, path)


@settings(max_examples=150, deadline=None)
@given(
    text=st.text(max_size=12), cell=st.integers(0, 7 * 18), kind=st.sampled_from(["csv", "toml"])
)
def test_no_file_is_worse_than_a_config_error(
    tmp_path_factory: pytest.TempPathFactory, text: str, cell: int, kind: str
) -> None:
    cut = "," if kind == "csv" else " "
    parts = (EXAMPLES / f"robot.{kind}").read_text().split(cut)
    parts[cell % len(parts)] = text
    path = tmp_path_factory.getbasetemp() / f"any.{kind}"
    path.write_text(cut.join(parts), encoding="utf-8")
    try:
        assert read_animals(path)[0].whiskers
    except ConfigError as error:
        assert len(str(error).splitlines()) == 1


def test_arrays_come_without_a_simulator() -> None:
    code = (
        "import sys; from tactile_rt.sim_backend.arrays.files import load_array;"
        f"load_array({str(EXAMPLES / 'robot.toml')!r}); load_array('rat-both');"
        "sys.exit(bool({'mujoco', 'trimesh', 'torch'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
