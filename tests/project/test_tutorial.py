"""docs/how-to/your-array.md, done as it says: from eight whiskers on a plate to a robot that
decides.
"""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tactile_rt.classifier.model_file import load_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.sensor_spec import SensorSpec
from tactile_rt.models.training.config import EMBEDDED
from tactile_rt.project.budget import Budget, fingerprint_set, write_budget
from tactile_rt.project.folder import KINDS, Project
from tactile_rt.project.making import make
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import read_skipped
from tests.helpers.processes import run_program, start_program
from tests.helpers.source_tree import ROOT

PAGE = ROOT / "docs" / "how-to" / "your-array.md"
PROGRAM = (
    "import sys; sys.argv[0] = 'tactile-rt'; from tactile_rt.cli import main\n"
    "if __name__ == '__main__': main()"
)


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text("utf-8"), re.S)


def commands() -> dict[str, list[str]]:
    """The page's commands by what they do, `new`, `make` ..., in order."""
    lines = [shlex.split(block) for block in blocks("sh")]
    return {words[1]: words[1:] for words in lines}


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the page's project has been made, of a handful of objects."""
    here: Path = tmp_path_factory.mktemp("tutorial")
    done(here, commands()["new"])
    project = Project(here / "whiskers")
    text = project.array.read_text()
    project.array.write_text(text.replace("[defaults]", blocks("toml")[0] + "\n[defaults]", 1))
    robot = project.folder / "robot.toml"
    robot.write_text(robot.read_text().replace("/tmp/whiskers", str(here / "device")))
    # All that is not as on the page: so many objects take a minute, not an hour.
    write_budget(project, Budget(fingerprint_set(project), 5, 1, 2, 2, updates=40))
    done(here, commands()["make"])
    return here


def done(here: Path, words: list[str]) -> str:
    """What a command prints, once it has left with 0."""
    run = run_program(*words, program=PROGRAM, cwd=here, timeout=600)
    assert run.returncode == 0, run.stderr
    return run.stdout


def test_the_page_s_commands_are_those_tested_here() -> None:
    assert list(commands()) == ["new", "make", "hil", "emulate", "run", "-m"]


def test_the_model_is_of_the_array_that_was_described(folder: Path) -> None:
    _, card = load_model(folder / "whiskers" / "model.onnx")
    assert card.array.channels == ("my", "mz")
    assert card.array.rate_hz == 100
    assert (card.period_ns, card.substeps) == (10_000_000, 4)
    assert card.labels == KINDS
    assert card.embedding == EMBEDDED
    assert card.clip == pytest.approx([1e-4] * 2)
    assert card.sensor["rate_hz"] == 100
    manifest = SweepManifest.read(folder / "whiskers" / "build" / "sweeps")
    assert isinstance(manifest.sensor, SensorSpec)
    assert [c.name for c in manifest.sensor.channels] == ["my", "mz"]
    assert not read_skipped(folder / "whiskers" / "build" / "sweeps")


def test_the_report_tells_what_it_measured(folder: Path) -> None:
    page = (folder / "whiskers" / "report" / "report.html").read_text()
    for said in (
        "8 whiskers, my (N m), mz (N m)",
        "support vector machine on the same windows",
        "the noise that the sensor is rated at",
        "What it cannot tell apart",
        "after the baseline",
        "12 objects, 24 sweeps",
        "100 % of all touch a whisker",
    ):
        assert said in page
    assert page.count("data:image/png;base64,") == 2
    figures = json.loads((folder / "whiskers" / "report" / "figures.json").read_text())
    assert "models.points above the SVM" in json.dumps(figures)


def test_made_again_it_only_writes_the_report_anew(folder: Path) -> None:
    run = folder / "whiskers" / "build" / "run"
    before = (run / "best.pt").stat().st_mtime_ns, (run / "history.csv").read_text()
    make(Project(folder / "whiskers"), 60)
    assert ((run / "best.pt").stat().st_mtime_ns, (run / "history.csv").read_text()) == before


def test_the_wire_decides_as_the_simulation(folder: Path) -> None:
    words = ["2" if word == "4" else word for word in commands()["hil"]]
    out = done(folder, words)
    (same,) = re.findall(r"same labels\s*│\s*(\d+) of (\d+)", out)
    assert int(same[1]) > 0
    assert int(same[0]) >= 0.99 * int(same[1])


def test_the_robot_decides_what_the_device_touches(folder: Path) -> None:
    options = {"program": PROGRAM, "cwd": folder, "stderr": None}
    with (
        start_program(*commands()["emulate"], stdout=subprocess.DEVNULL, **options) as device,
        start_program(*commands()["run"], **options) as robot,
    ):
        try:
            labels = (json.loads(line).get("label") for line in robot.stdout)
            assert next(label for label in labels if label) in KINDS
        finally:
            robot.terminate()
            device.terminate()


def test_the_robot_s_own_code_is_driven(folder: Path) -> None:
    words = [sys.executable, *commands()["-m"], "-q", "-p", "no:cacheprovider"]
    run = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=600)
    assert run.returncode == 0, run.stdout
    assert "1 passed" in run.stdout


def test_an_array_that_changes_after_that_is_told(folder: Path) -> None:
    project = Project(folder / "whiskers")
    text = project.array.read_text()
    project.array.write_text(text + "\n# thinner\n")
    try:
        with pytest.raises(ConfigError, match="has been changed since"):
            make(project, 10)
        words = ["1" if word == "4" else word for word in commands()["hil"]]
        told = run_program(*words, program=PROGRAM, cwd=folder, timeout=600).stderr
        assert "array.toml or sweeps.toml of" in told and "the model is the one made before" in told
    finally:
        project.array.write_text(text)
