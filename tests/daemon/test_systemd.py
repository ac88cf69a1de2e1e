"""What systemd is told, at a notify socket of the test."""

import contextlib
import os
import socket
import threading
import time
from queue import SimpleQueue
from typing import ClassVar

import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Source
from tactile_rt.daemon.daemon import Daemon
from tactile_rt.daemon.process import _serve
from tactile_rt.daemon.states import Snapshot
from tactile_rt.daemon.systemd import Systemd, hanging, status_of
from tactile_rt.testing import small_spec
from tests.helpers.daemons import load_checked, running_daemon
from tests.helpers.published import View, busy_snapshot, event, running
from tests.helpers.waiting import PATIENCE_S, until

SMALL = 'version = 1\n[[source]]\nname = "a"\nurl = "synthetic:2x2"\n'
pytestmark = pytest.mark.usefixtures("no_thread_left")


@contextlib.contextmanager
def managing(name):
    """(what $NOTIFY_SOCKET says, what has come since the last look: lines)"""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as bound:
        bound.bind(name)
        bound.settimeout(0.2)

        def told():
            lines = []
            try:
                while True:
                    lines += bound.recv(4096).decode().split("\n")
            except TimeoutError:
                return lines

        yield name.replace("\0", "@"), told


@pytest.fixture(params=["path", "abstract"])
def manager(request, tmp_path):
    name = str(tmp_path / "notify") if request.param == "path" else f"\0tactile-test-{tmp_path}"
    with managing(name) as made:
        yield made


def notifier(address, **environment):
    return Systemd("systemd", None, {"NOTIFY_SOCKET": address, **environment})


def test_it_tells_ready_reloading_and_stopping_once_each(manager):
    address, told = manager
    view = View(snapshot=Snapshot("0", 1, "x", 5, 5, 1, 0, "starting"))
    with running(consumer := notifier(address), view):
        consumer.handle([event(state="starting")])
        assert told() == ["STATUS=starting: 0 sources, 0 models, 0 publishers"]
        view.shown = Snapshot("0", 1, "x", 5, 5, 1, 0, "running")
        consumer.handle([event()])
        assert told() == ["READY=1", "STATUS=running: 0 sources, 0 models, 0 publishers"]
        consumer.handle([event(part="source.a", state="stopping")])  # no concern of systemd
        assert told() == []
        before = time.monotonic_ns() // 1000
        consumer.handle([event(state="reloading"), event(state="refused", level="error")])
        first, stamp, ready = told()
        assert (first, ready) == ("RELOADING=1", "READY=1")
        name, _, number = stamp.partition("=")
        assert name == "MONOTONIC_USEC" and before <= int(number) <= time.monotonic_ns() // 1000
        consumer.handle([event(state="reloading"), event(state="reloaded")])
        assert [x.partition("=")[0] for x in told()] == ["RELOADING", "MONOTONIC_USEC", "READY"]
        consumer.handle([event(state="stopping")])
        assert told() == ["STOPPING=1"]


def test_a_daemon_that_starts_degraded_is_ready_and_says_what_it_lacks(manager):
    address, told = manager
    with running(consumer := notifier(address), View(snapshot=busy_snapshot())):
        consumer.handle([])
        lines = told()
    assert lines[0] == "READY=1"
    assert lines[1] == "STATUS=degraded: no samples: source.finger: the device is lost"


class Turning(View):
    """A daemon whose threads have been at their turn for so long, s."""

    turns: ClassVar = {}

    def silent(self):
        return self.turns


def test_the_watchdog_is_fed_while_every_thread_that_matters_turns(manager):
    address, told = manager
    view = Turning()
    consumer = notifier(address, WATCHDOG_USEC="4000000")
    assert consumer.tick_s == 1.0
    with running(consumer, view):
        view.turns = {"main": 0.3, "source.a": 1.9, "model.a": 0.0}
        consumer.handle([])
        assert told().count("WATCHDOG=1") == 1
        view.turns = {"main": 0.3, "source.a": 2.1, "model.a": 0.0}
        for _ in range(3):
            consumer.handle([])
        assert "WATCHDOG=1" not in told()
        assert view.reports == [("systemd", "withheld", "error")]  # once
        assert (consumer.details()["pings"], consumer.details()["withheld"]) == (1, 3)
        view.turns = {"main": 0.3, "source.a": 0.0, "model.a": 0.0}
        consumer.handle([])
        assert told().count("WATCHDOG=1") == 1
        assert view.reports[1:] == [("systemd", "fed", "info")]


def test_what_hangs_is_named():
    turns = {"main": 9, "watch": 9, "source.a": 9, "source.b": 0, "model.a": 9, "model.b": 0}
    assert hanging(turns, 5) == ("main", "watch", "source.a")
    assert hanging({**turns, "model.b": 9}, 5) == (
        "main", "watch", "source.a", "model.a", "model.b",
    )  # fmt: skip
    assert hanging(turns, 10) == hanging({}, 0) == ()


def test_without_a_watchdog_or_with_another_process_s_it_is_not_fed(manager):
    address, told = manager
    for environment in ({}, {"WATCHDOG_USEC": "1000", "WATCHDOG_PID": "1"}):
        with running(consumer := notifier(address, **environment)):
            consumer.handle([])
        assert "WATCHDOG=1" not in told() and consumer.tick_s == 1.0


def test_a_status_is_one_line_of_bounded_length():
    long = Snapshot("0", 1, "x", 5, 5, 1, 0, "degraded", ("y" * 5000,))
    assert len(status_of(long)) <= 400 and "\n" not in status_of(long)


@pytest.mark.parametrize(
    "environment", [{"NOTIFY_SOCKET": "relative"}, {"NOTIFY_SOCKET": "/x", "WATCHDOG_USEC": "1 s"}]
)
def test_what_systemd_never_says_is_refused(environment):
    with pytest.raises(ConfigError, match=r"^systemd: "):
        Systemd("systemd", None, environment)


def test_a_real_daemon_tells_a_manager_that_goes_and_comes(manager, tmp_path, monkeypatch):
    address, told = manager
    monkeypatch.setenv("NOTIFY_SOCKET", address)
    monkeypatch.setenv("WATCHDOG_USEC", "1000000")
    lines = []
    # On a busy machine it is ready before its log keeps up, and says so.
    wanted = {"READY=1", "STATUS=running: 1 source, 0 models, 0 publishers"}
    text = f'{SMALL}[limits]\nstop_s = 60\n[log]\nfile = "{tmp_path}/log"\n'
    with running_daemon(load_checked(tmp_path, text)):
        until(lambda: lines.extend(told()) or {*wanted, "WATCHDOG=1"} <= {*lines})
        until(lambda: lines.extend(told()) or lines.count("WATCHDOG=1") > 1)
    lines += told()
    assert lines.index("READY=1") < lines.index("STOPPING=1")


class Hanging(Source):
    """Silent, until reading it hangs."""

    goes_on = threading.Event()

    def read(self, timeout=None):
        self.goes_on.wait(PATIENCE_S)
        time.sleep(0.01)

    def close(self):
        pass


@pytest.fixture
def watched(tmp_path, monkeypatch):
    """Start a daemon under a watchdog of three seconds: (the daemon, its notifier, what came)"""
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    monkeypatch.setenv("WATCHDOG_USEC", "3000000")
    started = []

    def start(text):
        text = f'version = 1\n[log]\nfile = "{tmp_path}/log"\n{text}'
        started.append(Daemon(load_checked(tmp_path, text)))
        started[0].start()
        notifies = started[0]._consumers["systemd"][1].consumer
        until(lambda: notifies.details()["pings"] > 1)
        return started[0], notifies, told

    with managing(str(tmp_path / "notify")) as (_, told):
        yield start
        started[0].stop()


def lines_of(log, *words):
    return [line for line in log.read_text().splitlines() if all(w in line for w in words)]


def test_a_source_that_hangs_starves_the_watchdog_and_is_told_once(watched, tmp_path, monkeypatch):
    opened = "tactile_rt.daemon.source_part.open_source"
    monkeypatch.setattr(opened, lambda url, **more: Hanging(small_spec()))
    Hanging.goes_on.set()
    one = '[[source]]\nname = "a"\nurl = "synthetic:"\n'
    _, notifies, told = watched(one + "[limits]\nstall_s = 0.5\n")
    Hanging.goes_on.clear()
    until(lambda: notifies.details()["withheld"] > 0)
    told()
    before = notifies.details()
    until(lambda: notifies.details()["withheld"] > before["withheld"] + 2)
    assert notifies.details()["pings"] == before["pings"] and "WATCHDOG=1" not in told()
    Hanging.goes_on.set()
    until(lambda: notifies.details()["pings"] > before["pings"] + 1)
    assert "WATCHDOG=1" in told()
    log = tmp_path / "log"
    until(lambda: lines_of(log, "systemd fed"))
    assert len(lines_of(log, "source.a stalled")) == len(lines_of(log, "systemd withheld")) == 1
    assert "source.a: not a turn for 1.5 s" in lines_of(log, "systemd withheld")[0]


def test_a_main_loop_that_hangs_starves_the_watchdog(watched, tmp_path):
    daemon, notifies, _ = watched('[[source]]\nname = "a"\nurl = "synthetic:2x2"\n')
    daemon.note_turn("main")
    until(lambda: notifies.details()["withheld"] > 0)
    until(lambda: lines_of(tmp_path / "log", "systemd withheld", "main: not a turn"))
    pings = notifies.details()["pings"]
    before = daemon.silent()["main"]
    _serve(daemon, tmp_path, (), SimpleQueue(), 0.6)  # the main loop tells that it turns
    assert daemon.silent()["main"] < before
    until(lambda: daemon.note_turn("main") or notifies.details()["pings"] > pings)


def test_a_device_that_is_not_there_or_silent_does_not(watched, tmp_path):
    master, slave = os.openpty()
    daemon, _, told = watched(
        '[[source]]\nname = "gone"\nurl = "serial:/dev/gone?codec=native"\n'
        f'[[source]]\nname = "mute"\nurl = "serial:{os.ttyname(slave)}?codec=native&start_s=60"\n'
        "[limits]\nstall_s = 0.5\nstop_s = 60\n"
    )
    until(lambda: daemon._sources["mute"]._opening)
    end = time.monotonic_ns() + 3_000_000_000  # twice the time that a hanging thread is given
    until(lambda: time.monotonic_ns() > end)
    log = tmp_path / "log"
    until(lambda: "WATCHDOG=1" in told())
    assert not lines_of(log, "systemd withheld", "source.")
    assert daemon.stop() == [] and not lines_of(log, "source.", "stalled")
    for handle in (master, slave):
        os.close(handle)  # and with it the wait
