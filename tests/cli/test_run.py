"""`tactile-rt run` and `demo`: what they print, how they end, what they say to a user's mistake."""

import io
import json
import signal
import subprocess
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from tactile_rt.classifier.classifier import Classification
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.stream import Chunk

pytest.importorskip("mujoco")

from tactile_rt.cli.demo import Demonstration, draw, watch

ONE_MUG = "sim:mouse?objects=mug-50&sweeps=1&pace=fast"
ENDLESS = "sim:mouse?objects=mug-50"
STEP_NS, SUBSTEP_NS = 45_000_000, 9_000_000
PROGRAM = "import sys; from tactile_rt.cli import main; sys.argv[0] = 'tactile-rt'; main()"


def start(*arguments, program=PROGRAM):
    """Run the command line in a process of its own."""
    return subprocess.Popen(
        [sys.executable, "-c", program, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_run_prints_every_step_of_an_episode(call):
    code, out, err = call("run", "--source", ONE_MUG)
    lines = [json.loads(line) for line in out.splitlines()]
    assert code == 0
    assert [line["step"] for line in lines] == list(range(1, 23))
    assert [line["final"] for line in lines] == [False] * 21 + [True]
    for line in lines:
        assert list(line) == [
            "type",
            "t_ns",
            "onset_ns",
            "step",
            "final",
            "label",
            "probabilities",
            "latency_ms",
        ]
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
    assert time.monotonic() - began < 5
    assert err.endswith(" samples, 0 decisions, 0 dropped\n")


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_run_cleanly(end):
    with start("run", "--source", ENDLESS) as process:
        assert json.loads(process.stdout.readline())["step"] == 1
        process.send_signal(end)
        out, err = process.communicate(timeout=10)
    assert process.returncode == 0
    assert all(json.loads(line) for line in out.splitlines())
    assert err.endswith(" dropped\n")
    assert err.count("\n") == 1


def test_a_closed_pipe_ends_run_cleanly():
    with start("run", "--source", ENDLESS + "&pace=fast") as process:
        process.stdout.readline()
        process.stdout.close()
        err = process.stderr.read()
    assert process.returncode == 0
    assert err.endswith(" dropped\n")
    assert err.count("\n") == 1


@pytest.fixture
def bad_models(tmp_path):
    """Files that are not the model that is wanted, by what is wrong with them."""
    good = shipped_model().read_bytes()
    files = {
        "missing": None,
        "text": b"this is not a model\n",
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
        ("text", "is not a readable ONNX model"),
        ("cut short", "is not a readable ONNX model"),
        ("another array", "channels[0] is 'fx', not 'gx'"),
    ],
)
@pytest.mark.parametrize("command", [("run", "--source", ONE_MUG), ("demo", "--sweeps", "1")])
def test_a_model_that_cannot_be_used_is_one_line(call, bad_models, wrong, said, command):
    code, _, err = call(*command, "--model", bad_models[wrong])
    assert code == 2
    assert err.startswith("tactile-rt: ")
    assert str(bad_models[wrong]) in err
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("simm:mouse", "did you mean sim:?"),
        ("nonsense", "unknown source"),
        ("sim:cat", "no simulated array 'cat'"),
        ("sim:mouse?object=mug", "did you mean objects?"),
        ("sim:mouse?objects=mugg", "did you mean 'mug'?"),
        ("sim:mouse?sweeps=many", "sweeps"),
    ],
)
def test_a_source_that_cannot_be_opened_is_one_line(call, source, said):
    code, out, err = call("run", "--source", source)
    assert (code, out) == (2, "")
    assert err.startswith("tactile-rt: ")
    assert said in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("command", [("run", "--source", ONE_MUG), ("demo",)])
def test_without_the_extra_the_way_to_install_it_is_named(command):
    with start(*command, program=f"import sys; sys.modules['mujoco'] = None; {PROGRAM}") as process:
        _, err = process.communicate(timeout=30)
    assert process.returncode == 2
    assert "pip install 'tactile-rt[sim]'" in err
    assert err.count("\n") == 1


def test_demo_without_a_terminal_prints_a_line_per_object(call):
    code, out, err = call("demo", "--fast", "--sweeps", "2")
    first, second, summary = out.splitlines()
    assert (code, err) == (0, "")
    for line in (first, second):
        assert line.endswith(("right", "WRONG"))
    assert " of 2 right (" in summary
    assert summary.endswith(" x real time; 0 dropped")
    assert call("demo", "--fast", "--sweeps", "2", "--plain")[1].startswith(f"{first}\n{second}\n")


def test_view_fits_a_terminal_and_says_what_it_shows():
    screen = Console(file=io.StringIO(), width=80, height=24, force_terminal=True, record=True)
    with Demonstration(shipped_model(), sweeps=1, seed=0, fast=True) as demo:
        screen.print(draw(demo))  # before the first sample
        before = screen.export_text().splitlines()
        watch(demo, screen)
        screen.export_text()
        screen.print(draw(demo))
    after = screen.export_text().splitlines()
    for lines in (before, after):
        assert len(lines) == 22
        assert max(map(len, lines)) <= 80
    text = "\n".join(after)
    (outcome,) = demo.outcomes
    assert f"({outcome.name})" in text
    assert "22/22" in text
    assert ("✓ RIGHT" if outcome.right else "✗ WRONG") in text
    assert f"{demo.right} of 1 right" in text
    assert text.count("▀▀▀▀") == 30  # whiskers


def decision(onset_ns, t_ns, label, final=True):
    return Classification(
        onset_ns, t_ns, 22, final, label, ("mug", "car"), np.array([0.5, 0.5], np.float32), 1e-3
    )


def test_only_the_first_episode_of_each_pass_is_scored():
    demo = Demonstration(shipped_model(), sweeps=1, seed=0, fast=True)
    demo._source.passes = [
        SimpleNamespace(start_ns=100 * i, name=f"mug-{i}", category="mug") for i in range(6)
    ]
    decisions = [
        decision(110, 130, "car", final=False),  # pass 0 brought no decision
        decision(110, 150, "mug"),
        decision(160, 190, "car"),  # the same object again: does not count
        decision(210, 310, "mug"),  # ends while the next object is on its way
        decision(340, 390, "car"),
    ]
    sample = Chunk(
        np.zeros(1, np.int64),
        np.zeros(1, np.int64),
        np.zeros((1, 1, 1), np.float32),
        np.ones((1, 1), bool),
    )
    demo._session = [(sample, [d]) for d in decisions]
    settled = [outcome.said for outcomes in demo.run() for outcome in outcomes]
    assert settled == [None, "mug", "mug", "car", None, None]
    assert demo.right == 2
