"""What was measured is taken, by this machine and for this file only; a bad file stops nobody."""

import json
import os
from pathlib import Path

import pytest

pytest.importorskip("onnx")

from tactile_rt.classifier import engine_choice
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.engine_choice import choices_file, choose_engine, keep_engine
from tactile_rt.classifier.engines import Engine
from tactile_rt.errors import ConfigError
from tests.helpers.tiny_model import write_model
from tests.helpers.touch_streams import SAME_RATE


class Machine:
    """The releases of engines that are installed, and the processor."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.releases = {"onnxruntime": "1.0", "openvino": "2.0"}
        self.processor = "a processor"
        monkeypatch.setattr(
            Engine, "version", property(lambda e: self.releases.get(e.package, ""))
        )  # fmt: skip
        monkeypatch.setattr(engine_choice, "_processor", lambda: self.processor)


@pytest.fixture
def machine(monkeypatch, tmp_path) -> Machine:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return Machine(monkeypatch)


@pytest.fixture
def model(tmp_path) -> Path:
    return write_model(tmp_path / "m.onnx")


def chosen(model: Path) -> tuple[str, bool, str]:
    found = choose_engine(model)
    return found.engine, found.kept, found.remark


def test_nothing_is_kept_and_nothing_is_said(machine, model):
    assert chosen(model) == ("onnxruntime", False, "")
    assert not choices_file().exists()


def test_what_is_kept_is_of_one_file_on_one_processor(machine, model, tmp_path):
    assert keep_engine(model, "openvino-bf16", 0.25) == choices_file()
    assert chosen(model) == ("openvino-bf16", True, "")
    other = write_model(tmp_path / "other.onnx", temperature=2.0)
    assert chosen(other) == ("onnxruntime", False, "")
    keep_engine(other, "openvino", 0.5)
    assert (chosen(other)[0], chosen(model)[0]) == ("openvino", "openvino-bf16")
    machine.processor = "another processor"
    assert chosen(model) == ("onnxruntime", False, "")


def test_what_is_asked_for_comes_before_what_is_kept(machine, model):
    keep_engine(model, "openvino", 0.25)
    assert choose_engine(model, "onnxruntime").engine == "onnxruntime"
    assert choose_engine(model, providers=("cuda",)).engine == "onnxruntime"
    assert choose_engine(model, "openvino-bf16").engine == "openvino-bf16"


def test_an_engine_that_is_gone_is_told_and_onnxruntime_decides(machine, model):
    keep_engine(model, "openvino", 0.25)
    del machine.releases["openvino"]
    classifier = Classifier(model, SAME_RATE)
    assert classifier.engine == "onnxruntime"
    assert classifier.remark == (
        "engine 'openvino', kept for m.onnx, is not installed: `tactile-rt model bench MODEL "
        "--engines` chooses anew; onnxruntime runs it"
    )


def test_other_releases_are_measured_anew(machine, model):
    keep_engine(model, "openvino", 0.25)
    machine.releases["onnxruntime"] = "1.1"
    assert "other releases" in chosen(model)[2] and chosen(model)[0] == "onnxruntime"
    keep_engine(model, "onnxruntime", 0.2)
    machine.releases["onnxruntime"] = "1.2"
    assert chosen(model) == ("onnxruntime", True, "")  # which runs it in any case


DAMAGED = {
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-20]),
    "text": lambda path: path.write_text("hello"),
    "another version": lambda path: path.write_text('{"version": 2, "choices": {}}'),
    "another form": lambda path: path.write_text('{"version": 1, "choices": [1]}'),
    "huge": lambda path: path.write_bytes(b" " * (engine_choice.LARGEST + 1)),
    "folder": lambda path: (path.unlink(), path.mkdir()),
    "pipe": lambda path: (path.unlink(), os.mkfifo(path)),
}


@pytest.mark.parametrize("how", DAMAGED)
def test_a_damaged_file_is_one_line_and_stops_nobody(machine, model, how):
    keep_engine(model, "openvino", 0.25)
    DAMAGED[how](choices_file())
    classifier = Classifier(model, SAME_RATE)
    assert classifier.engine == "onnxruntime"
    assert classifier.remark.startswith(f"{choices_file()} cannot be read (")
    assert "\n" not in classifier.remark
    if how == "folder":
        with pytest.raises(ConfigError, match=r"engines\.json cannot be written: "):
            keep_engine(model, "openvino", 0.25)
    else:
        keep_engine(model, "openvino", 0.25)
        assert chosen(model) == ("openvino", True, "")


def test_an_engine_of_a_later_release_is_not_taken(machine, model):
    keep_engine(model, "openvino", 0.25)
    path = choices_file()
    path.write_text(path.read_text().replace('"openvino",', '"quantum",', 1))
    assert chosen(model)[0] == "onnxruntime" and "'quantum'" in chosen(model)[2]


def test_the_oldest_of_many_go(machine, model, tmp_path, monkeypatch):
    monkeypatch.setattr(engine_choice, "MOST", 2)
    models = [write_model(tmp_path / f"{i}.onnx", temperature=1.0 + i) for i in range(3)]
    for each in models:
        keep_engine(each, "openvino", 0.25)
    assert [chosen(each)[1] for each in models] == [False, True, True]
    assert len(json.loads(choices_file().read_text())["choices"]) == 2


def test_without_a_home_nothing_is_kept(machine, model, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", "not/absolute")

    def no_home(cls=None):
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", no_home)
    assert choices_file() is None and chosen(model) == ("onnxruntime", False, "")
    with pytest.raises(ConfigError, match="there is no home folder to keep it in"):
        keep_engine(model, "openvino", 0.25)
