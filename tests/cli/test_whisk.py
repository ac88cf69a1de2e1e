"""`tactile-rt whisk`: the files that it writes, and what it says to mistakes."""

import json

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("trimesh")

QUICK = "--profile realtime --set protraction_deg=45 --set duration_s=1.3".split()
ROBOT = """whisker,row,col,arc_length_mm,curvature_a_per_mm,base_x_mm,base_y_mm,base_z_mm,\
base_theta_rad,base_phi_rad,base_zeta_rad,base_radius_mm,tip_radius_mm
top,1,0,20,0.005,3.7,-2,1,1.2,0.2,0.5,0.06,0.03
low,2,0,20,0.005,3.7,-2,-1,1.2,-0.1,0.5,0.06,0.03
"""


@pytest.fixture
def robot(tmp_path):
    """Two whiskers: quick to simulate."""
    path = tmp_path / "robot.csv"
    path.write_text(ROBOT)
    return path


def test_a_stimulus_is_written_with_its_parameters(done, tmp_path, robot):
    out = tmp_path / "out.npz"
    _, err = done(
        *("whisk", out, "--array", robot, "--stimulus", "concave-close,convex-close"),
        *QUICK,
        *("--set", "radius_mm=70"),
    )
    assert "first contact at" in err
    with np.load(out) as arrays:
        assert arrays["values"].shape == (2, 110, 2, 6)
        assert np.abs(arrays["values"]).max() > 1e-6
        assert arrays["angles"].shape == (1300, 2, 3)
        resting = arrays["angles"][0]
        np.testing.assert_allclose(resting, [[1.2, 0.2, 0.5], [1.2, -0.1, 0.5]])
        most = np.degrees(arrays["angles"][:, 0, 0].max() - 1.2)
        assert most == pytest.approx(45, abs=0.1)
    described = json.loads(out.with_suffix(".json").read_text())
    assert described["stimuli"] == ["concave-close", "convex-close"]
    assert described["approximate"] is True
    assert described["parameters"]["convex-close"]["radius_mm"] == 70
    assert described["parameters"]["concave-close"]["facet_error_mm"] < 0.1
    assert described["trajectory"]["protraction_deg"] == 45
    assert described["profile"]["name"] == "realtime"


def test_an_object_and_a_recorded_trajectory(done, tmp_path, robot):
    t = np.arange(0, 1.4, 0.01)
    path = tmp_path / "angles.csv"
    lines = [f"{a},{20 - 20 * np.cos(2 * np.pi * 2 * a)}" for a in t]
    path.write_text("\n".join(["time_s,theta_deg", *lines]))
    out = tmp_path / "mug.npz"
    done(
        *("whisk", out, "--array", robot, "--object", "mug-3", "--set", "position_mm=22,8,0"),
        *("--set", "size_mm=14", "--trajectory", path, "--profile", "realtime"),
    )
    described = json.loads(out.with_suffix(".json").read_text())
    assert described["stimuli"] == ["mug-3"]
    placed = {"position_mm": [22.0, 8.0, 0.0], "size_mm": 14.0, "yaw_deg": 0.0}
    assert described["parameters"]["mug-3"] == placed
    assert described["trajectory"]["file"] == "angles.csv"
    assert len(described["trajectory"]["sha256"]) == 64


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("out.txt",), "name a file that ends in .npz"),
        (("none/out.npz",), "no folder none"),
        (("out.npz", "--json", "./out.json"), "out.json is written beside out.npz"),
        (("out.npz", "--stimulus", "convex"), "no stimulus 'convex': there are convex-close"),
        (("out.npz", "--stimulus", "all", "--object", "mug"), "exclude each other"),
        (("out.npz", "--object", "mug", "--set", "size_mm=-3"), "size_mm must be above 0"),
        (("out.npz", "--set", "frequency_hz"), "a setting must be KEY=VALUE; there are"),
        (("out.npz", "--set", "step_mm=a"), "step_mm must be three numbers"),
        (("out.npz", "--profile", "best"), "no profile 'best'"),
        (("out.npz", "--array", "robot.csv", "--set", "duration_s=0.4"), "trajectory must last"),
        (("out.npz", "--array", "robot.csv", "--object", "mug", "--set", "position_mm=99,0,0",
          "--set", "duration_s=0.1"), "mug-0: no whisker touches it"),
        (("out.npz", "--array", "robot.csv", "--object", "mug", "--set", "position_mm=12,0,0"),
         "begin inside the object"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line_and_leave_nothing(refused, tmp_path, robot, monkeypatch, arguments,
                                                 said):  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert said in refused("whisk", *arguments)
    assert [p.name for p in tmp_path.iterdir()] == ["robot.csv"]


def test_the_left_side_meets_the_mirror_image(done, tmp_path, robot):
    """The same whiskers mirrored feel the same: fx, fy, mz alike, fz, mx, my of opposite sign."""
    mirrored = tmp_path / "mirrored.csv"
    signs = {"base_x_mm": -1, "base_theta_rad": -1, "base_zeta_rad": -1}
    header, *rows = (line.split(",") for line in ROBOT.splitlines())
    lines = [
        [str(float(v) * signs[c]) if c in signs else v for c, v in zip(header, row, strict=True)]
        for row in rows
    ]
    mirrored.write_text("\n".join(map(",".join, [header, *lines])))
    felt = []
    for array in (robot, mirrored):
        out = tmp_path / f"{array.stem}.npz"
        done("whisk", out, "--array", array, "--stimulus", "convex-close", *QUICK)
        with np.load(out) as arrays:
            felt.append(arrays["values"])
    right, left = felt[0], felt[1] * np.array([1, 1, -1, -1, -1, 1])
    assert np.linalg.norm(left - right) < 0.05 * np.linalg.norm(right)
    parameters = json.loads(out.with_suffix(".json").read_text())["parameters"]
    assert parameters["convex-close"]["mirrored"]
