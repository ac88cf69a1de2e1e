"""A daemon that was stopped, or whose model is too slow: what it decides is about now, what it left
out is recorded, and a replay decides the same."""

import signal
import time
from pathlib import Path

import pytest

pytest.importorskip("onnx")

from bench.daemon.process import DaemonProcess, free_port, messages_of
from tactile_rt.recording.reader import Recording
from tests.helpers.processes import run_program

CONFIGURATION = """version = 1
[[source]]
name = "whiskers"
url = "synthetic:mouse"
[[model]]
source = "whiskers"
{model}
[[publisher]]
kind = "jsonl"
options = {{ file = "said.jsonl" }}
[recorder]
folder = "recordings"
min_free_mb = 0
[metrics]
port = {port}
[limits]
{limits}
"""


@pytest.fixture
def overloaded(tmp_path):
    """Run a daemon that is stopped twice for 1.2 s while things are touched; its folder."""

    def run(model="", limits=""):
        port = free_port()
        text = CONFIGURATION.format(model=model, limits=limits, port=port)
        with DaemonProcess(tmp_path, text, port) as daemon:
            for n in (1, 2):
                daemon.await_state(lambda s, n=n: sum(decided(s)) >= 30 * n)
                daemon.process.send_signal(signal.SIGSTOP)
                time.sleep(1.2)
                daemon.process.send_signal(signal.SIGCONT)
                seen = daemon.await_state(lambda s: "starved" in daemon.log())
            daemon.await_state(lambda s: sum(decided(s)) >= sum(decided(seen)) + 30)
            state = daemon.await_state(lambda s: s["state"] == "running")
            code, _ = daemon.stop()
        assert code == 0
        return tmp_path, state

    return run


def decided(state: dict) -> list[int]:
    """How many decisions each model has made; none while it is being made."""
    return [m["decisions"] for m in state["models"]]


def replayed(folder: Path) -> str:
    """What `tactile-rt replay --check` says."""
    (file,) = (folder / "recordings").glob("*.mcap")
    done = run_program("replay", file, "--check", timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def said(folder: Path, kind: str) -> list[dict]:
    return messages_of(folder / "said.jsonl", kind)


def test_after_a_stop_decisions_are_about_now_and_a_replay_decides_the_same(overloaded):
    folder, state = overloaded()
    skips, decisions = said(folder, "skip"), said(folder, "decision")
    assert skips and state["models"][0]["skipped"] == len(skips)
    (file,) = (folder / "recordings").glob("*.mcap")
    assert Recording(file).skips("whiskers") == skips
    # that is never more than may be, but where the process was stopped just then
    assert sum(d["latency_ms"] > 150 for d in decisions) <= 2
    assert all(d["late"] for d in decisions if d["age_ms"] > 45)
    assert f"{len(skips)} stretches were skipped live" in replayed(folder)


def test_a_mailbox_that_overflows_is_a_hole_that_no_network_is_fed(overloaded):
    folder, state = overloaded('catch_up = "all"', "model_queue_items = 4")
    skips = said(folder, "skip")
    model = state["models"][0]
    assert skips and sum(s["lost"] for s in skips) == model["queue"]["dropped"]["samples"] > 0
    assert "as recorded" in replayed(folder)


def test_all_decides_on_every_step_and_marks_what_is_late(overloaded):
    folder, state = overloaded('catch_up = "all"')
    assert not said(folder, "skip") and state["models"][0]["late"] > 0
    late = [d for d in said(folder, "decision") if d["late"]]
    assert late and max(d["age_ms"] for d in late) > 500
    assert "skipped" not in replayed(folder)
