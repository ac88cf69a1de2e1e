"""A daemon whose model is replaced: nothing waits for the new one, and nothing is lost for it."""

import signal
import time

import pytest

from bench.daemon.process import DaemonProcess, free_port, messages_of
from tactile_rt.classifier.model_file import shipped_model
from tests.helpers.hostile_models import BURNERS, GREEDY, write_burdened
from tests.helpers.waiting import until

CONFIGURATION = """version = 1
[[source]]
name = "a"
url = "synthetic:mouse"
[[model]]
file = "model.onnx"
catch_up = "all"
[[publisher]]
kind = "jsonl"
options = {{ file = "said.jsonl" }}
[metrics]
port = {port}
[limits]
model_s = 20
"""
TERM_S = 4.0  # on a busy machine; alone 0.3


@pytest.fixture
def daemon(tmp_path):
    (tmp_path / "model.onnx").write_bytes(shipped_model().read_bytes())
    port = free_port()
    with DaemonProcess(tmp_path, CONFIGURATION.format(port=port), port) as process:
        process.await_state(lambda s: sum(m["decisions"] for m in s["models"]) > 5)
        yield process


def hostile(folder, burden):
    """The bytes of the shipped model with a burden."""
    return write_burdened(folder / "hostile.onnx", burden, shipped_model()).read_bytes()


def said(folder, kind):
    return messages_of(folder / "said.jsonl", kind)


def events(folder, state):
    return [m for m in said(folder, "health") if m["state"] == state and "model" in m["part"]]


def put(folder, data):
    """A file takes the place of the model's, whole."""
    (folder / "new.onnx").write_bytes(data)
    (folder / "new.onnx").replace(folder / "model.onnx")


def steps_of(decisions):
    """The steps that were decided on, by onset."""
    found = {}
    for d in decisions:
        found.setdefault(d["onset_ns"], []).append(d["step"])
    return list(found.values())


def test_a_good_model_takes_over_without_a_step_being_lost(daemon, tmp_path):
    good = shipped_model().read_bytes()
    for n in range(1, 5):
        put(tmp_path, good)  # another file, though it says the same
        daemon.reload()
        until(lambda n=n: len(events(tmp_path, "admitted")) == n)
    before = daemon.state()["models"][0]["decisions"]
    state = daemon.await_state(lambda s: s["models"][0]["decisions"] > before + 60)
    daemon.stop()
    touches = steps_of(said(tmp_path, "decision"))
    assert len(touches) > 3
    # each was decided on at every step, once
    assert all(steps == list(range(1, len(steps) + 1)) for steps in touches)
    # A machine that gives the daemon no turn for seconds may cost some; each is told then: what a
    # full mailbox dropped as a skip, a model that waited too long for a touch's end where it began.
    skips = said(tmp_path, "skip")
    late = [m for m in events(tmp_path, "admitted") if "in the middle of a touch" in m["reason"]]
    assert sum(s["lost"] for s in skips) >= state["models"][0]["queue"]["dropped"]["samples"]
    short = sum(len(steps) < max(map(len, touches)) for steps in touches[:-1])  # the end cuts one
    assert short <= 2 * len(skips) + len(late)


@pytest.mark.parametrize("burden", [*GREEDY.values(), BURNERS["chained_products"]][::3])
def test_a_hostile_model_is_refused_and_the_one_before_goes_on(daemon, tmp_path, burden):
    resident = daemon.usage
    resident.look()
    before = daemon.state()
    put(tmp_path, hostile(tmp_path, burden))
    daemon.reload()
    found = daemon.await_state(
        lambda s: "old model" in [t["what"] for t in s["diagnostics"]], every_s=0.02
    )
    assert found["state"] == "degraded"  # on a busy machine for another reason, too
    daemon.await_state(
        lambda s: s["models"][0]["decisions"] > before["models"][0]["decisions"] + 30
    )
    resident.look()
    assert resident.resident[-1] - resident.resident[0] < 50e6
    state = daemon.state()
    assert state["sources"][0]["stats"]["dropped"] == 0
    assert state["models"][0]["queue"]["dropped"]["samples"] == 0
    put(tmp_path, shipped_model().read_bytes())
    daemon.reload()
    daemon.await_state(lambda s: s["state"] == "running")


def test_a_signal_is_obeyed_while_a_model_is_on_trial(tmp_path):
    """One that takes as long as it may, at the start and at a reload."""
    port = free_port()
    put(tmp_path, hostile(tmp_path, BURNERS["chained_products"]))
    text = CONFIGURATION.format(port=port)
    with DaemonProcess(tmp_path, text, port) as process:
        state = process.await_state(lambda s: any(x["samples"] > 100 for x in s["sources"]))
        assert state["models"][0]["part"]["state"] == "starting"
        # samples come, and what is missing is told
        degraded = process.await_state(lambda s: s["diagnostics"])
        assert degraded["diagnostics"][0]["what"] == "no decisions"
        code, took = process.stop()
        assert code == 0 and took < TERM_S


def test_a_signal_is_obeyed_while_a_reload_tries_a_model(daemon, tmp_path):
    put(tmp_path, hostile(tmp_path, BURNERS["chained_products"]))
    daemon.reload()
    daemon.reload()
    time.sleep(0.5)  # in the middle of it, or before
    code, took = daemon.stop()
    assert code == 0 and took < TERM_S


def test_the_newest_of_several_wins(daemon, tmp_path):
    """A slow one that is being tried keeps nobody waiting: the file after it is admitted."""
    put(tmp_path, hostile(tmp_path, BURNERS["chained_products"]))
    daemon.reload()
    time.sleep(0.3)
    put(tmp_path, shipped_model().read_bytes())
    daemon.reload()
    until(lambda: events(tmp_path, "admitted"))
    assert daemon.await_state(lambda s: s["state"] == "running")["models"][0]["refused"] == ""
    assert daemon.process.poll() is None and not events(tmp_path, "refused")
    daemon.process.send_signal(signal.SIGTERM)
    assert daemon.process.wait(60) == 0


def test_another_way_to_decide_takes_over_as_another_model_does(daemon, tmp_path):
    text = daemon.path.read_text()
    sure = 'catch_up = "all"\nsure = 0.01\nin_a_row = 1'
    daemon.path.write_text(text.replace('catch_up = "all"', sure))
    daemon.reload()
    until(lambda: events(tmp_path, "admitted"))
    (event,) = events(tmp_path, "admitted")

    def after():
        return [d for d in said(tmp_path, "decision") if d["onset_ns"] > event["t_ns"]]

    until(lambda: len(after()) > 2)
    assert all(d["final"] and d["step"] == 1 for d in after())
