"""`tactile-rt run` and `demo`: what they print, how they end, what they say to a user's mistake."""

import json
import signal
import time

import msgspec
import numpy as np
import pytest

from tactile_rt.classifier.model_file import METADATA_KEY, load_model, shipped_model
from tactile_rt.core.packages import install_extra
from tactile_rt.teaching.onnx_bytes import with_metadata
from tactile_rt.testing import FakeSerial
from tests.helpers.processes import PROGRAM, start_program

pytest.importorskip("mujoco")

ONE_MUG = "sim:mouse?objects=mug-50&sweeps=1&pace=fast"
ENDLESS = "sim:mouse?objects=mug-50"
STEP_NS, SUBSTEP_NS = 45_000_000, 9_000_000


def test_run_prints_every_step_of_an_episode(call):
    code, out, err = call("run", "--source", ONE_MUG)
    lines = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert [line["step"] for line in lines] == list(range(1, 23))
    assert [line["final"] for line in lines] == [False] * 21 + [True]
    for line in lines:
        assert list(line) == [
            "type", "t_ns", "onset_ns", "step", "final", "label", "probabilities", "prediction_set",
            "coverage", "names", "names_coverage", "object", "object_margin", "object_touches",
            "latency_ms",
        ]  # fmt: skip
        assert line["type"] == "classification"
        # the sample at onset is the first of the first step
        assert line["t_ns"] - line["onset_ns"] == line["step"] * STEP_NS - SUBSTEP_NS
        p = line["probabilities"]
        assert sum(p.values()) == pytest.approx(1, abs=1e-3)
        assert p[line["label"]] == max(p.values())
        assert line["latency_ms"] > 0
    assert err.endswith(" samples, 22 decisions, 0 dropped\n")
    assert err.count("\n") == 1


def test_run_prints_only_final_decisions_when_asked(call):
    _, every, _ = call("run", "--source", ONE_MUG)
    _, final, _ = call("run", "--source", ONE_MUG, "--final-only")
    first, last = json.loads(final), json.loads(every.splitlines()[-1])
    assert first["final"]
    assert first["probabilities"] == last["probabilities"]


def test_run_ends_after_seconds_even_when_nothing_is_decided(call):
    began = time.monotonic()
    code, out, err = call("run", "--source", ENDLESS, "--seconds", "0.2")
    assert (code, out) == (0, "")
    assert time.monotonic() - began < 60
    assert err.endswith(" samples, 0 decisions, 0 dropped\n")


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_run_cleanly(end):
    with start_program("run", "--source", ENDLESS) as process:
        assert json.loads(process.stdout.readline())["step"] == 1
        process.send_signal(end)
        out, err = process.communicate(timeout=120)
    assert process.returncode == 0
    assert all(json.loads(line) for line in out.splitlines())
    assert err.endswith(" dropped\n")
    assert err.count("\n") == 1


def test_a_closed_pipe_ends_run_cleanly():
    with start_program("run", "--source", ENDLESS + "&pace=fast") as process:
        process.stdout.readline()
        process.stdout.close()
        err = process.stderr.read()
    assert process.returncode == 0
    assert err.endswith(" dropped\n")
    assert err.count("\n") == 1


def test_an_element_of_a_device_that_hangs_is_named(tmp_path):
    """The model says that every element's readings change at rest."""
    card = msgspec.structs.replace(load_model(shipped_model())[1], changes=0.9)
    data, told = shipped_model().read_bytes(), msgspec.json.encode(card).decode()
    (tmp_path / "m.onnx").write_bytes(with_metadata(data, METADATA_KEY, told))
    values = np.random.default_rng(0).normal(scale=1e-6, size=(30_000, *card.array.shape))
    values[:, 3] = 0.0
    with FakeSerial(values, spec=card.array, pace="realtime") as fake:
        options = ("--source", fake.url, "--model", tmp_path / "m.onnx", "--seconds", "300")
        with start_program("run", *options) as process:
            said = process.stderr.readline()
            process.terminate()
    assert said == "no value of A3 changes: stuck, or out of range\n"


@pytest.fixture
def bad_models(tmp_path):
    """Files that are not the model that is wanted, by what is wrong with them."""
    good = shipped_model().read_bytes()
    files = {
        "missing": None,
        "cut short": good[: len(good) // 2],
        "another array": good.replace(rb"\"fx\"", rb"\"gx\""),
    }
    for name, content in files.items():
        if content is not None:
            (tmp_path / f"{name}.onnx").write_bytes(content)
    return {name: tmp_path / f"{name}.onnx" for name in files}


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("missing", "no model file"),
        ("cut short", "is not a readable ONNX model"),
        ("another array", "channels[0] is 'fx', not 'gx'"),
    ],
)
@pytest.mark.parametrize("command", [("run", "--source", ONE_MUG), ("demo", "--sweeps", "1")])
def test_a_model_that_cannot_be_used_is_one_line(refused, bad_models, wrong, said, command):
    line = refused(*command, "--model", bad_models[wrong])
    assert str(bad_models[wrong]) in line and said in line


@pytest.mark.parametrize("source", ["serial:///dev/none?codec=bota", "sim:rat"])
def test_a_model_of_another_array_is_refused_before_a_device_is_looked_for(refused, source):
    said = refused("run", "--source", source)
    assert said.startswith(f"tactile-rt: {source}: {shipped_model()} was made for another array")
    assert "; name a model of it" in said


def test_a_source_is_run_as_the_array_that_it_is_said_to_be(call, refused, tmp_path):
    """A synthetic plate of thirty whiskers, said to be the mouse's by the model's own file."""
    source = f"synthetic:30x6?pace=fast&seconds=2&array={shipped_model()}"
    code, out, _ = call("run", "--source", source)
    steps = [json.loads(line)["step"] for line in out.splitlines()]
    assert code == 0 and steps[:3] == [1, 2, 3]
    said = refused("run", "--source", source.replace("30x6", "8x6"))
    assert "elements: the array 'mouse-right' has 30 (A0, A1," in said and "synthetic 8" in said


def test_without_the_extra_the_way_to_install_it_is_named():
    without = f"import sys; sys.modules['mujoco'] = None; {PROGRAM}"
    with start_program("view", "mug-50", program=without) as process:
        _, err = process.communicate(timeout=120)
    assert process.returncode == 2
    assert err.endswith(f", which is not installed: {install_extra('view')}\n")
    assert err.count("\n") == 1
