"""Objects enrolled by a few touches, on a made-up network whose embedding is how hard it was."""

import io
import sys

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.enrolment import NONE_OF_THESE, EnrolledObject, identify
from tactile_rt.classifier.model_file import load_model, verify_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.recording import StreamWriter
from tactile_rt.recording.labels import LABELS, relabel
from tactile_rt.teaching.lesson import FEATURES, MODEL, Lesson, check_label
from tactile_rt.teaching.model import Enrolment
from tactile_rt.teaching.teacher import Teacher
from tactile_rt.testing import ArraySource
from tests.helpers.refusals import refusal
from tests.helpers.tiny_model import force_rule, write_model
from tests.helpers.touch_streams import SAME_RATE, push_all, pushes

SIZES = {"cup": 8.0, "jug": -8.0, "red mug": 1.0}


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    return write_model(tmp_path_factory.mktemp("network") / "net.onnx", identity=force_rule())


def record(path, sizes):
    with StreamWriter(path, ArraySource(SAME_RATE, chunks := pushes(sizes))) as writer:
        for chunk in chunks:
            writer.push(chunk)
    return f"replay:{path}?speed=0"


@pytest.fixture
def lesson(call, network, tmp_path):
    """Three objects, three touches of each, by the command."""
    source = record(
        tmp_path / "stream.mcap", [s * k for s in SIZES.values() for k in (1, 0.9, 1.1)]
    )
    code, out, err = call(
        "teach", source, tmp_path / "mine", "--classes", ",".join(SIZES), "--touches", 3,
        "--model", network,
    )  # fmt: skip
    assert code == 0, err
    return tmp_path / "mine", out


def decided(folder, sizes):
    found = push_all(Classifier(folder / MODEL, SAME_RATE), pushes(sizes, seed=1))
    return [d.object for d in found if d.final]


def test_objects_are_told_apart_and_a_stranger_is_none_of_these(lesson, network):
    folder, out = lesson
    assert "names are objects" in out and "9 of 9 touches" in out
    assert "found in it: " + ", ".join(f"3 {name}" for name in SIZES) in out
    assert "knows cup, jug, red mug beside 5 classes, and what is none of these" in out
    assert decided(folder, [-8, 7.5, 1, 4.5]) == ["jug", "cup", "red mug", NONE_OF_THESE]
    card = load_model(folder / MODEL)[1]
    assert [(one.name, one.touches) for one in card.enrolled] == [(name, 3) for name in SIZES]
    assert card.labels == load_model(network)[1].labels, "its classes are as they were"
    verify_model(folder / MODEL)


def test_a_recording_that_was_taught_before_or_holds_more_is_told(lesson, call, network, tmp_path):
    folder, how = lesson[0], ("teach", f"replay:{tmp_path}/stream.mcap?speed=0")
    labels = (folder / LABELS).read_text()
    (folder / LABELS).write_text(labels.replace("jug", "pot"))
    code, said, err = call("teach", f"replay:{tmp_path}/./stream.mcap", folder, "--touches", 6)
    assert code == 0 and "it only learns again, as its labels.csv says" in said, err
    assert (folder / LABELS).read_text() == labels.replace("jug", "pot"), "no touch twice"
    assert decided(folder, [-8, 7.5]) == ["pot", "cup"]
    assert len([*folder.glob("session-*")]) == 1
    how = *how, "--classes", ",".join(SIZES)
    _, said, _ = call(*how, tmp_path / "b", "--touches", 4, "--model", network)
    assert "9 touches: if each was touched 3 times, teach another folder with --touches 3\n" in said


def test_orders_rename_and_forget_objects(lesson, call, tmp_path, monkeypatch):
    folder, _ = lesson
    text = (folder / LABELS).read_bytes()
    orders = ("list", 'rename "red mug" bowl', "forget jug", "forget", "rename a b", "done")
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n".join(orders)))
    source = record(tmp_path / "more.mcap", [8, 8])
    code, out, err = call("teach", source.replace("speed=0", "speed=0.5"), folder)
    assert code == 0, err
    for said in ("jug: 3 touches, 3 right", "red mug is called bowl now", "jug is forgotten",
                 "say forget NAME or rename OLD NEW", "there is no 'a'"):  # fmt: skip
        assert said in out, said
    card = load_model(folder / MODEL)[1]
    assert [(one.name, one.touches) for one in card.enrolled] == [("cup", 3), ("bowl", 3)]
    assert decided(folder, [-8, 8, 1]) == [NONE_OF_THESE, "cup", "bowl"]
    again = Lesson.read(folder)
    assert [touch.label for touch in again.touches] == ["cup"] * 3 + ["bowl"] * 3
    for _ in range(3):
        assert again.undo().label == "bowl"
    relabel(folder / LABELS, "cup", "x,y")
    relabel(folder / LABELS, "x,y", "cup")
    left = [line for line in text.splitlines() if b"mug" not in line and b"jug" not in line]
    assert (folder / LABELS).read_bytes().splitlines() == left


def test_another_network_feels_the_recordings_again(lesson, call, tmp_path):
    folder, _ = lesson
    other = write_model(tmp_path / "other.onnx", identity=force_rule(), floor=(2e-3, 1e-3))
    with (folder / LABELS).open("a") as file:
        file.write("session-1.mcap,0.1,0.2,pot,\n")  # where nothing was touched
    source = record(tmp_path / "none.mcap", [1.0])
    code, out, err = call("teach", source, folder, "--model", other)
    assert code == 0, err
    assert "in the recordings: 9\n" in out and f"pot: touches that {other} does not find: 1" in out
    assert (folder / FEATURES).read_bytes() == other.read_bytes()
    assert load_model(folder / MODEL)[1].floor == (2e-3, 1e-3)
    assert decided(folder, [-8, 8]) == ["jug", "cup"]
    again = Lesson.read(folder)
    again.rename("pot", "")
    assert again.lost == 1 and not Lesson.read(folder).lost
    assert "has enrolled objects" in refusal(Enrolment, folder / MODEL)


def test_a_network_without_the_rule_says_that_it_cannot_enrol(refused, tmp_path):
    plain = write_model(tmp_path / "plain.onnx")
    source = record(tmp_path / "one.mcap", [8])
    said = refused("teach", source, tmp_path / "x", "--model", plain)
    assert f"{plain} cannot enrol objects: it has no rule `identity`" in said


def test_leave_one_out_is_what_enrolling_the_others_decides(network):
    sizes = np.repeat([8.0, -8.0, 7.8], 4) + 0.5 * np.random.default_rng(0).normal(size=12)
    features = np.stack([np.full(12, 4.0), sizes], axis=1)[:, None]
    labels = [name for name in "abc" for _ in range(4)]
    found = Enrolment(network).leave_one_out(features, labels)
    others = [EnrolledObject.of("a", features[1:4, 0])] * 3
    margin = identify(force_rule(), others, features[0])[1]
    assert found.distances[0, 0, 0] == pytest.approx(-margin, abs=0.05)
    assert found.right[4:8].all() and not found.right.all(), "a and c are alike"


def test_an_object_cannot_have_a_name_with_a_meaning(network, tmp_path):
    lesson = Lesson.on(tmp_path / "mine", network)
    assert Teacher(lesson, [], 3).obey("list") == "nothing is taught yet"
    for name in (NONE_OF_THESE, "list", "rename me", "forget"):
        with pytest.raises(ConfigError, match="choose another"):
            check_label(name)
    with pytest.raises(ConfigError, match="there is no 'cup'"):
        lesson.rename("cup", "mug")
