"""`tactile-rt array`: what it lists; what `fit` shows, writes and refuses."""

import re
import shlex
from pathlib import Path

import pytest

from tactile_rt.project.folder import Project, new_project
from tactile_rt.sim_backend.arrays.files import ROBOTS, SPECIES, load_array
from tests.helpers.plucked import plucked
from tests.helpers.recordings import write
from tests.helpers.source_tree import ROOT

PAGE = ROOT / "docs" / "how-to" / "your-array.md"


@pytest.fixture(scope="module")
def device(tmp_path_factory) -> tuple[Path, Path]:
    """The page's array, read fast enough to hear it, and plucks of a noisier and stiffer one."""
    folder: Path = tmp_path_factory.mktemp("device")
    array = new_project(folder / "whiskers").array
    (sensor,) = re.findall(r"```toml[^\n]*\n(.*?)```", PAGE.read_text("utf-8"), re.S)
    sensor = sensor.replace("rate_hz = 100", "rate_hz = 500")
    array.write_text(array.read_text().replace("[defaults]", f"{sensor}\n[defaults]", 1))
    real = folder / "real.toml"
    text = array.read_text().replace("noise_density = 2e-9", "noise_density = 3e-9")
    text = text.replace("2.9e9", "4.1e9").replace("damping_ratio = 0.05", "damping_ratio = 0.03")
    real.write_text(text)
    spec, chunk = plucked(real, ("A0",), rest_s=20, angle=1.2)
    return array, write(folder / "plucks.mcap", [chunk], spec)


@pytest.fixture
def project(device, cwd: Path) -> Project:
    """The page's project, where the page's commands are given."""
    (cwd / "plucks.mcap").symlink_to(device[1])
    made = new_project(cwd / "whiskers")
    made.array.write_text(device[0].read_text())
    return Project(Path("whiskers"))


def test_every_array_that_has_a_name_is_listed(call) -> None:
    code, out, err = call("array", "list")
    assert (code, err) == (0, "")
    cells = [re.split(r"\s{2,}", line.strip()) for line in out.splitlines()[1:]]
    rows = {name: tuple(rest) for name, *rest in cells}
    assert list(rows) == [*SPECIES, *ROBOTS]
    assert rows["hx711_whisker"] == ("9", "bridge0, bridge1", "V", "80", "codec=hx711_whisker")


def test_the_page_s_commands_measure_and_then_write(project: Project, call) -> None:
    (block,) = re.findall(r"```console\n(.*?)```", PAGE.read_text("utf-8"), re.S)
    lines = re.findall(r"^\$ (.*array fit.*)", block, re.M)
    look, change = (shlex.split(line)[1:] for line in lines)
    before = project.array.read_text()
    code, out, err = call(*look)
    assert (code, err) == (0, "")
    assert out.endswith(
        "not written: give --out FILE to save them; the array's own file is allowed\n"
    )
    assert project.array.read_text() == before
    shown = {" ".join(line.split()[:4]) for line in out.splitlines()}
    assert {"rate Hz 500 500", "resolution of my N", "resonance of A0 Hz"} <= shown
    code, out, err = call(*change)
    assert (code, err) == (0, "")
    assert re.search(r"whiskers/array.toml: \d values set to the measured ones\n$", out)
    array = load_array(str(project.array))
    assert [c.noise_density for c in array.sensor.channels] == pytest.approx([3e-9] * 2, rel=0.1)
    assert array.whiskers[0].young_modulus == pytest.approx(4.1e9, rel=0.05)
    assert array.whiskers[0].damping_ratio == pytest.approx(0.03, rel=0.25)


def test_another_file_is_written_whole_and_nothing_kept(project: Project, done, tmp_path) -> None:
    alone = tmp_path / "alone.toml"
    alone.write_text(project.array.read_text())
    out = tmp_path / "fitted.toml"
    said, _ = done("array", "fit", "replay:plucks.mcap?speed=0", "--array", alone, "--out", out)
    assert "fitted.toml: " in said
    assert load_array(str(out)).whiskers[0].young_modulus == pytest.approx(4.1e9, rel=0.05)
    assert sorted(p.name for p in tmp_path.iterdir()) == [
        "alone.toml", "fitted.toml", "plucks.mcap", "whiskers",
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["plucks.mcap", "--array", "nothing.toml"], "nothing.toml: no such file"),
        (["nothing.mcap", "--array", "whiskers/array.toml"], "is no source"),
        (["plucks.mcap", "--array", "whiskers/robot.toml"], "whiskers/robot.toml"),
        (["plucks.mcap", "--array", "whiskers/array.toml", "--out", "no/a"], "no folder no"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line(project: Project, refused, words, said) -> None:
    before = project.array.read_text()
    assert said in refused("array", "fit", *words)
    assert project.array.read_text() == before
