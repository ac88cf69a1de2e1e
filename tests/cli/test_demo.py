"""`tactile-rt demo`: what it prints, what its view shows, how it keeps the score."""

import io
from importlib.util import find_spec
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from rich.console import Console

from tactile_rt.classifier import model_file
from tactile_rt.classifier.classifier import Classification
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.cli import demo as demo_module
from tactile_rt.cli.demo import Demonstration, draw, watch
from tactile_rt.core.packages import install_extra
from tactile_rt.recording.replay import DEMO
from tactile_rt.testing import cut_chunks

simulated = pytest.mark.skipif(not find_spec("mujoco"), reason="MuJoCo is not installed")


@pytest.fixture
def unseen(monkeypatch):
    """Three of the objects that the shipped model has not seen: all 312 take seconds to make."""
    load = model_file.load_model
    some = load(shipped_model())[1].provenance["unseen_objects"][::120]
    assert len(some) == 3

    def with_some(path, *more):
        session, card = load(path, *more)
        provenance = {**card.provenance, "unseen_objects": some}
        return session, msgspec.structs.replace(card, provenance=provenance)

    monkeypatch.setattr(model_file, "load_model", with_some)
    return some


@simulated
def test_demo_without_a_terminal_prints_a_line_per_object(call, unseen):
    code, out, err = call("demo", "--fast", "--sweeps", "2")
    first, second, summary = out.splitlines()
    assert (code, err) == (0, "")
    for line in (first, second):
        assert line.endswith(("right", "WRONG"))
        assert line.split()[0] in unseen
    assert " of 2 right (" in summary
    assert summary.endswith(" x real time; 0 dropped")


@simulated
@pytest.mark.usefixtures("unseen")
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
        assert len(lines) <= 22
        assert max(map(len, lines)) <= 80
    text = "\n".join(after)
    (outcome,) = demo.outcomes
    assert f"({outcome.name})" in text
    assert "22/22" in text
    assert ("✓ RIGHT" if outcome.right else "✗ WRONG") in text
    assert f"{demo.right} of 1 right" in text
    assert sum(line[1] in "ABCDE" for line in after) == 5


def decision(onset_ns, t_ns, label, final=True):
    p = np.array([0.5, 0.5], np.float32)
    return Classification(onset_ns, t_ns, 22, final, label, ("cup", "block"), p, 1e-3)


@simulated
@pytest.mark.usefixtures("unseen")
def test_only_the_first_episode_of_each_pass_is_scored():
    demo = Demonstration(shipped_model(), sweeps=1, seed=0, fast=True)
    demo.passes = [
        SimpleNamespace(start_ns=100 * i, name=f"mug-{i}", category="mug") for i in range(6)
    ]  # cups
    decisions = [
        decision(110, 130, "block", final=False),  # pass 0 brought no decision
        decision(110, 150, "cup"),
        decision(160, 190, "block"),  # the same object again: does not count
        decision(210, 310, "cup"),  # ends while the next object is on its way
        decision(340, 390, "block"),
    ]
    (sample,) = cut_chunks(np.zeros((1, 1, 1)), 1000.0)
    demo._session = [(sample, [d]) for d in decisions]
    settled = [outcome.said for outcomes in demo.run() for outcome in outcomes]
    assert settled == [None, "cup", "cup", "block", None, None]
    assert demo.right == 2


def test_without_mujoco_a_recording_is_played_over_a_serial_port(call, refused, monkeypatch):
    monkeypatch.setattr(demo_module, "find_spec", lambda name: None)
    for _ in range(3):  # it plays in real time: where another process has the cores, samples drop
        code, out, err = call("demo", "--sweeps", "2")
        first, second, summary = out.splitlines()
        if summary.endswith("; 0 dropped"):
            break
    assert code == 0 and (not err or "busy" in err)
    assert first.startswith("birdcage-58 ") and second.startswith("grapes-49 ")
    assert first.endswith("right") and second.endswith("right")
    assert "2 of 2 right (100 %)" in summary
    assert f"are for a simulation: {install_extra('sim')}" in refused("demo", "--fast")


def test_a_recording_that_is_asked_for_is_as_fast_as_it_was(refused) -> None:
    assert "for a simulation: leave out --recorded" in refused("demo", "--recorded", "--fast")


def test_the_view_of_a_recording_says_that_it_is_one() -> None:
    screen = Console(file=io.StringIO(), width=80, height=24, force_terminal=True, record=True)
    with Demonstration(shipped_model(), 1, 0, fast=False, recorded=True) as demo:
        watch(demo, screen)
        screen.export_text()
        screen.print(draw(demo))
    text = screen.export_text()
    assert "30 recorded whiskers" in text and "s of a recording" in text
    assert DEMO.stat().st_size < 1_000_000
