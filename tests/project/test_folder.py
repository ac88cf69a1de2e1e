"""A new project: what is in it, and what it refuses."""

import errno
import re
import shutil
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
import trimesh

from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.daemon.loading import load_config
from tactile_rt.project import folder as folder_module
from tactile_rt.project.budget import Budget, apply_budget, budget_sweeps, read_budget, write_budget
from tactile_rt.project.folder import KINDS, Project, new_project
from tactile_rt.project.making import make
from tactile_rt.project.report import list_confusions
from tactile_rt.sim_backend.arrays.files import ROBOTS, load_array, robot_text
from tactile_rt.sim_backend.datasets.dataset import describe_set
from tactile_rt.sim_backend.transducer import device_spec
from tactile_rt.sources.opening import check_source, open_source
from tests.helpers.source_tree import ROOT

MAGNETS = ROOT / "docs" / "arrays" / "magnets.toml"


@pytest.fixture
def project(tmp_path: Path) -> Project:
    return new_project(tmp_path / "mine")


def test_a_new_project_is_ready_to_be_made(project: Project) -> None:
    recipe = project.recipe()
    assert recipe.name == "mine"
    assert recipe.objects.categories == KINDS
    assert Path(recipe.array) == project.array
    assert len(load_array(str(project.array)).whiskers) == 8
    assert load_config(project.folder / "robot.toml").config.model[0].file == str(project.model)
    line = project.line()
    assert (line.wire, line.port, line.codec) == ("serial", "/tmp/mine", "native")
    assert {name.rpartition("-")[0] for name in project.unseen()} == set(KINDS)
    check_source(project.source_url(project.unseen()))


@pytest.mark.parametrize("array", ["mouse", "rat-both", str(MAGNETS)])
def test_its_array_is_the_one_that_was_asked_for(array: str, tmp_path: Path) -> None:
    project = new_project(tmp_path / "mine", array, ("mug", "gear"))
    mine, theirs = (device_spec((load_array(a),)) for a in (str(project.array), array))
    assert mine == theirs
    period_ms = 12.5 if array == str(MAGNETS) else 9.0
    assert project.recipe().period_ms == period_ms


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_a_robot_s_project_is_its_array_behind_its_codec(name: str, tmp_path: Path) -> None:
    project = new_project(tmp_path / "mine", name, ("mug", "gear"))
    assert project.array.read_text("utf-8") == robot_text(name), "a copy, to be changed"
    source = load_config(project.folder / "robot.toml").config.source[0]
    assert source.url == f"serial:///tmp/mine?{ROBOTS[name]}"
    assert source.array == str(project.folder / "array.json")
    assert check_source(source.url, array=source.array) == device_spec((load_array(name),))
    line = project.line()
    assert (line.wire, line.port) == ("serial", "/tmp/mine")
    assert urlencode({"codec": line.codec, **line.options}) == ROBOTS[name]
    assert project.spoken() == (line.codec, line.options)
    assert project.spoken("native", {"format": "int16"})[1]["format"] == "int16"


def test_a_model_of_another_array_is_refused(project: Project, refused) -> None:
    shutil.copy(shipped_model(), project.model)
    said = refused("config", "check", project.folder / "robot.toml")
    assert "source whiskers" in said and "mouse13.onnx" not in said


def test_the_device_meets_what_the_sweeps_say(tmp_path: Path) -> None:
    project = new_project(tmp_path / "mine", "hx711_whisker", ("mug", "gear"))
    sweeps = project.folder / "sweeps.toml"
    assert "size_mm = 66\nspeed_mm_s = { between = [46.2, 66] }\n" in sweeps.read_text()
    text = re.sub(r"yaw_deg = .*", "yaw_deg = 30", sweeps.read_text())
    sweeps.write_text(re.sub(r"distance_mm = .*", "", text))
    with open_source(project.source_url(["mug"], sweeps=2, pace="fast")) as source:
        for _ in source:
            pass
        first, second = (p.sweep for p in source.passes)
    assert (first.size_mm, first.yaw_deg) == (second.size_mm, second.yaw_deg) == (66, 30)
    assert first.distance_mm == second.distance_mm == pytest.approx(59.4, abs=0.1)
    assert first.speed_mm_s != second.speed_mm_s
    assert 46.2 <= min(first.speed_mm_s, second.speed_mm_s)


def test_categories_that_feel_alike_may_be_one_class(project: Project) -> None:
    path = project.folder / "sweeps.toml"
    lines = path.read_text().splitlines()
    at = lines.index(next(line for line in lines if line.startswith("# [objects.classes]")))
    lines[at : at + 2] = [line.removeprefix("# ") for line in lines[at : at + 2]]
    path.write_text("\n".join(lines))
    manifest = describe_set(project.recipe())
    assert manifest.kinds == {"vessel": ("bottle", "mug")}
    assert set(manifest.categories) == {*KINDS, "vessel"} - {"bottle", "mug"}
    with open_source(project.source_url(["mug-0"], pace="fast", sweeps=1)) as source:
        while not source.passes:
            source.read(1.0)
    assert source.passes[0].category == "vessel"


def test_training_draws_the_drift_that_the_sensor_is_said_to_have(tmp_path: Path) -> None:
    drifting = new_project(tmp_path / "drifting", "hx711_whisker")
    assert drifting.recipe().faults.offset == pytest.approx(4.0, rel=0.05)
    array = tmp_path / "wild.toml"
    array.write_text(drifting.array.read_text().replace("drift = 1e-6", "drift = 1e-3"))
    assert new_project(tmp_path / "wild", str(array)).recipe().faults.offset == 100
    for name in ("mouse", str(ROOT / "docs" / "arrays" / "robot.toml")):
        assert new_project(tmp_path / Path(name).stem, name).recipe().faults.offset == 0


def test_full_scale_of_a_codec_that_rounds_is_the_sensor_s(tmp_path: Path) -> None:
    magnets = new_project(tmp_path / "magnets", str(MAGNETS))
    assert magnets.full_scale("native") == {"range_si": "0.0079"}
    assert magnets.full_scale("bota") == {}
    assert magnets.spoken(options={"rate_hz": "9"})[1] == {"range_si": "0.0079", "rate_hz": "9"}
    assert new_project(tmp_path / "loads").full_scale("native") == {}


def test_one_s_own_meshes_are_swept_by_the_device_too(project: Project) -> None:
    for kind, extents in (("box", (20, 30, 40)), ("slab", (40, 40, 10))):
        (project.folder / "things" / kind).mkdir(parents=True)
        for number in range(4):
            file = project.folder / "things" / kind / f"{kind}, no. {number}.stl"
            trimesh.creation.box(extents=extents).export(file)
    sweeps = project.folder / "sweeps.toml"
    text = sweeps.read_text().replace('"shapes"', '"things"').replace("per_category = 200", "")
    sweeps.write_text(re.sub(r"categories = .*", 'categories = ["box", "slab"]', text))
    recipe = apply_budget(project.recipe(), budget_sweeps(project, 60))
    assert len(describe_set(recipe).names()) == 8
    unseen = project.unseen()
    assert len(unseen) == 2 and all(Path(file).is_file() for file in unseen)
    with open_source(project.source_url(unseen, pace="fast", sweeps=2)) as source:
        for _ in source:
            pass
        assert {passed.name for passed in source.passes} == {Path(file).stem for file in unseen}


def test_what_cannot_begin_is_one_line(refused, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("x")
    assert "is not empty: name a new folder" in refused("new", tmp_path / "full")
    assert "no category 'mugg'" in refused("new", tmp_path / "a", "--classes", "mugg,gear")
    assert "two or more" in refused("new", tmp_path / "a", "--classes", "mug")
    assert "no simulated array" in refused("new", tmp_path / "a", "--array", "hamster")
    new = ("new", tmp_path / "a", "--array")
    assert "did you mean hx711_whisker?" in refused(*new, "hx711_whiskers")
    assert "is a .toml file" in refused(*new, MAGNETS.parent / "robot.csv")
    assert not (tmp_path / "a").exists(), "nothing is half-written"
    assert "begin with `tactile-rt new" in refused("make", tmp_path / "a")
    assert "is no project, it has no array.toml" in refused("make", tmp_path / "full")
    assert "is no project" in refused("emulate", "--project", tmp_path / "full")
    assert "is no project" in refused("hil", "--project", tmp_path / "full")
    assert "name a CODEC" in refused("emulate")


def test_mistakes_in_its_files_are_told_before_the_work(project: Project, refused) -> None:
    assert "has no model yet" in refused("hil", "--project", project.folder)
    with pytest.raises(ConfigError, match="--minutes must be at least 1"):
        make(project, 0.5)
    robot = project.folder / "robot.toml"
    text = robot.read_text()
    robot.write_text(text.replace("serial:///tmp/mine?codec=native", "synthetic:3x6"))
    with pytest.raises(ConfigError, match="is no device to emulate"):
        make(project, 10)
    robot.write_text(text)
    sweeps = project.folder / "sweeps.toml"
    sweeps.write_text(sweeps.read_text().replace("array.toml", "mouse"))
    with pytest.raises(ConfigError, match=r'sweeps\.toml: array must be "array\.toml"'):
        make(project, 10)
    assert not project.build.exists()


def test_a_project_that_was_changed_is_not_gone_on_with(project: Project) -> None:
    assert read_budget(project) is None
    write_budget(project, Budget("other", 8, 1, 2, 3))
    with pytest.raises(ConfigError, match=r"has been changed since .*build was begun: remove"):
        read_budget(project)
    (project.build / "budget.json").write_text("{")
    with pytest.raises(ConfigError, match=r"budget\.json is damaged"):
        read_budget(project)


def test_what_is_taken_for_what_worst_first() -> None:
    table = np.array([[18, 2, 0], [5, 15, 0], [0, 0, 0]])
    assert list_confusions(table, ("a", "b", "c")) == [("b", "a", 0.25), ("a", "b", 0.1)]
    assert list_confusions(table, ("a", "b", "c"), 0.2) == [("b", "a", 0.25)]
    assert list_confusions(np.eye(3, dtype=np.int64), ("a", "b", "c")) == []


@pytest.mark.parametrize("name", ["my arm", 'the "arm"', "100%41", "arm?#&=+", "a\\b", "größe"])
def test_a_folder_may_have_any_name(name: str, tmp_path: Path) -> None:
    project = new_project(tmp_path / name)
    assert project.line().port == "/tmp/" + project.recipe().name
    load_config(project.folder / "robot.toml")
    with open_source(project.source_url(project.unseen()[:1], pace="fast")) as source:
        assert len(source.spec.elements) == 8


def test_an_array_of_other_files_is_copied_only_if_the_copy_finds_them(tmp_path: Path) -> None:
    pair = tmp_path / "pair.toml"
    pair.write_text('[[animal]]\narray = "magnets.toml"\n')
    (tmp_path / "magnets.toml").write_text(MAGNETS.read_text())
    with pytest.raises(
        ConfigError, match=r"pair\.toml: an \[\[animal\]\] names its array by a relative"
    ):
        new_project(tmp_path / "mine", str(pair))
    assert not (tmp_path / "mine").exists()
    pair.write_text(f'[[animal]]\narray = "{MAGNETS}"\n')
    mine = new_project(tmp_path / "mine", str(pair))
    assert load_array(str(mine.array)).whiskers == load_array(str(MAGNETS)).whiskers


def test_the_commands_of_its_readme_are_commands(project: Project, call) -> None:
    words = re.findall(r"`tactile-rt ([^`]+)`", (project.folder / "README.md").read_text())
    assert len(words) > 5
    for line in words:
        command = [word for word in line.split() if word in ("array", "fit")] or [line.split()[0]]
        code, helped, _ = call(*command, "--help")
        assert code == 0, line
        for option in re.findall(r"--\w+", line):
            assert f" {option} " in helped, line


def test_a_full_disk_leaves_a_folder_that_can_be_named_again(tmp_path, monkeypatch) -> None:
    write = folder_module.write_whole

    def full(path, fill):
        if path.name == "robot.toml":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        write(path, fill)

    with monkeypatch.context() as patch, pytest.raises(OSError, match="No space"):
        patch.setattr(folder_module, "write_whole", full)
        new_project(tmp_path / "arm")
    assert new_project(tmp_path / "arm").array.is_file()
