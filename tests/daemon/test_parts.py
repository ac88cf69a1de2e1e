"""What the daemon is made of, each piece alone."""

import json
import math
import os
import socket
import subprocess
import sys
import threading
import time
import types
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classification
from tactile_rt.core import locks as lock
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.locks import AlreadyRunning, Locks, device_keys, lock_keys
from tactile_rt.core.stream import Chunk
from tactile_rt.daemon.config import LimitsConfig, LogConfig
from tactile_rt.daemon.items import (
    Closed,
    Contact,
    Control,
    Decision,
    Event,
    Opened,
    Packet,
    SourceChunk,
)
from tactile_rt.daemon.log import Log
from tactile_rt.daemon.mailbox import Hub, Mailbox
from tactile_rt.daemon.messages import encode, message_of, topic_of
from tactile_rt.daemon.part import Part, reason_of
from tactile_rt.daemon.states import EDGES_S, LatencyMeter
from tactile_rt.drivers.codec import CanFrame
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.processes import start_program
from tests.helpers.waiting import PATIENCE_S, until

SPEC = small_spec()
OFFSET_NS = 1_700_000_000_000_000_000

pytestmark = pytest.mark.usefixtures("no_thread_left")


def samples(n=1, source="a", seq=0):
    chunk = cut_chunks(np.arange(n * 6).reshape(n, 3, 2), 1000.0, samples=n)[0]
    chunk = Chunk(chunk.seq + seq, chunk.t_ns, chunk.values, chunk.valid)
    return SourceChunk(source, SPEC, chunk, 5, OFFSET_NS)


def event(reason="", part="source.a", state="waiting", level="warning"):
    return Event(part, state, reason, level, 1_500_000_000, OFFSET_NS)


def decision():
    d = Classification(10, 20, 3, True, "y", ("x", "y"), np.array([0.25, 0.75], np.float32), 0.0012)
    return Decision("a", "m", "mount", d, 1_000_000, 3_500_000, OFFSET_NS)


def test_a_mailbox_is_bounded_in_bytes_but_takes_one_of_any_size():
    box = Mailbox({Packet}, items=1000, size=10_000)
    for _ in range(100):
        box.put(Packet("a", bytes(1000), 0))
    assert box.state.waiting_bytes <= 10_000 and box.state.waiting["packets"] == 6
    box.put(Packet("a", bytes(50_000), 0))
    assert [len(i.packet) for i in box.take()] == [50_000]
    assert box.state.dropped["packets"] == 100


def test_whoever_waits_for_room_gets_it_from_the_reader_or_when_there_is_none():
    box = Mailbox({SourceChunk}, 4, 1 << 20)
    for _ in range(4):
        box.put(samples())
    box.wait_for_room(PATIENCE_S)  # nobody takes: there is nobody to wait for
    box.taking = True
    thread = threading.Thread(target=lambda: box.wait_for_room(1000.0))
    thread.start()
    assert thread.is_alive()
    box.take()
    thread.join(PATIENCE_S)
    assert not thread.is_alive()


def test_a_mailbox_takes_what_it_wants_of_the_source_that_it_wants():
    box = Mailbox({SourceChunk}, 10, 1 << 20, source="a")
    box.put(samples(source="b"))
    box.put(event())
    box.put(replace(samples(source="a"), accepted=False))
    box.put(samples(source="a"))
    assert [i.source for i in box.take()] == ["a"] and box.state.put["samples"] == 1
    box = Mailbox({Event}, 10, 1 << 20, source="a")  # an event says nothing of arrays
    box.put(event())
    assert len(box.take()) == 1


def test_a_mailbox_counts_the_bytes_of_samples_and_frames():
    box, chunk = Mailbox({SourceChunk, Packet}, 10, 1 << 20), samples(4)
    box.put(chunk)
    arrays = sum(a.nbytes for a in (chunk.chunk.values, chunk.chunk.valid))
    box.put(Packet("a", [CanFrame(1, b"")] * 3, 0))
    assert box.state.waiting_bytes == (arrays + 4 * 16 + 500) + (500 + 3 * 200)


def test_what_is_urgent_does_not_wait_for_what_is_gathered():
    box = Mailbox({SourceChunk, Event}, 100, 1 << 20, gather_s=1000.0)
    box.put(samples())
    taken = []
    thread = threading.Thread(target=lambda: taken.extend(box.take()))
    thread.start()
    box.put(samples())
    assert not taken
    box.put(event())
    thread.join(PATIENCE_S)
    assert len(taken) == 3


def test_every_item_has_a_class():
    opened = Opened("a", SPEC, "u", ArraySource(SPEC, []), 1, 2)
    others = (opened, Closed("a", 1), Contact("a", "m", "f", True, 1, 2), Control("x"), event())
    items = (*others, samples(4), Packet("a", b"x", 0), decision())
    box = Mailbox({type(item) for item in items}, 100, 1 << 20)
    for item in items:
        box.put(item)
    assert box.state.waiting == {"samples": 4, "packets": 1, "decisions": 1, "events": len(others)}


def test_who_joins_late_hears_of_open_streams_once_and_of_closed_ones_not_at_all():
    hub = Hub()
    for name in ("a", "b"):
        hub.post(Opened(name, SPEC, "u", ArraySource(SPEC, []), 1, 2))
    hub.post(Closed("a", 3))
    box, other = Mailbox({Opened, Closed}, 10, 1 << 20), Mailbox({SourceChunk}, 10, 1 << 20)
    hub.join("x", box)
    hub.join("y", other)
    hub.post(Closed("b", 4))
    hub.post(samples())
    assert len(other.take()) == 1
    assert [(type(i).__name__, i.source) for i in box.take()] == [("Opened", "b"), ("Closed", "b")]
    assert not hub.streams()
    hub.leave("x", Mailbox({Opened}, 10, 10))  # another one of that name: not this one
    assert hub.box("x") is box
    hub.leave("x", box)
    hub.post(Closed("b", 5))
    box.close()
    assert box.take() == []


def test_percentiles_are_those_of_the_newest_and_buckets_of_all():
    meter = LatencyMeter()
    for _ in range(50):
        meter.add(9.0)
    values = np.random.default_rng(0).gamma(2.0, 0.004, 1000)
    for value in values:
        meter.add(float(value))
    state = meter.state
    assert state.count == 1050 and sum(state.buckets) == 1050 and state.buckets[-1] == 50
    assert math.isclose(state.sum_s, 450 + values.sum())
    assert state.p50_ms == 1e3 * np.percentile(values, 50, method="inverted_cdf")
    assert state.p99_ms == 1e3 * np.percentile(values, 99, method="inverted_cdf")
    assert state.max_ms == 1e3 * values.max()
    expected = np.histogram(values, [-1, *EDGES_S, np.inf])[0]
    assert list(state.buckets[:-1]) == list(expected[:-1])
    assert LatencyMeter().state.p99_ms == 0


@pytest.mark.usefixtures("still_clock")
def test_messages_are_as_documented():
    utc = OFFSET_NS
    said = [json.loads(encode(message_of(i))) for i in (
        decision(), event("gone"), Contact("a", "m", "mount", True, 7, utc), samples(1),
    )]  # fmt: skip
    assert said[0] == {
        "type": "decision", "version": 1, "t_ns": 20, "utc_ns": 20 + utc, "source": "a",
        "frame": "mount", "model": "m", "onset_ns": 10, "step": 3, "final": True, "label": "y",
        "probabilities": {"x": 0.25, "y": 0.75}, "model_ms": 1.2, "latency_ms": 2.5, "age_ms": 2.0,
        "late": False, "prediction_set": [], "coverage": None, "names": [], "names_coverage": None,
        "object": "", "object_margin": None, "object_touches": 0,
    }  # fmt: skip
    assert said[1] == {
        "type": "health", "version": 1, "t_ns": 1_500_000_000, "utc_ns": 1_500_000_000 + utc,
        "part": "source.a", "state": "waiting", "reason": "gone", "level": "warning",
    }  # fmt: skip
    assert said[2] == {
        "type": "contact", "version": 1, "t_ns": 7, "utc_ns": 7 + utc, "source": "a",
        "frame": "mount", "model": "m", "touching": True,
    }  # fmt: skip
    assert said[3] == {
        "type": "samples", "version": 1, "t_ns": 0, "utc_ns": utc, "source": "a",
        "frame": "mount", "elements": ["A0", "A1", "A2"], "channels": ["fy", "mz"],
        "units": ["N", "N m"], "seq": [0], "times_ns": [0],
        "values": [[[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]]],
    }  # fmt: skip


def test_an_element_without_a_trustworthy_value_is_null():
    item = samples(2)
    item.chunk.valid[1, 2] = False
    assert json.loads(encode(message_of(item)))["values"][1] == [[6.0, 7.0], [8.0, 9.0], None]


def test_an_array_is_described_and_the_rest_is_not_published():
    opened = Opened("a b/ä", SPEC, "synthetic:", ArraySource(SPEC, []), 1, OFFSET_NS)
    message = message_of(opened)
    said = json.loads(encode(message))
    assert said["array"]["positions"] == [[0.0, 0.002 * i, 0.0] for i in range(3)]
    assert topic_of(message) == "tactile/a%20b%2F%C3%A4/array"
    assert topic_of(message_of(event()), "robot") == "robot/health"
    for item in (Closed("a", 1), Packet("a", b"", 1), Control("start")):
        assert message_of(item) is None


def logged(path, *batches, **options):
    log = Log("log", LogConfig(file=str(path), **options))
    log.open(None)
    for batch in batches:
        log.handle(list(batch))
    log.close()
    return path.read_text().splitlines()


def test_a_storm_is_written_once_and_counted(tmp_path):
    storm = [event("no route") for _ in range(1000)]
    lines = logged(tmp_path / "log", storm[:600], [event("other")], storm[600:])
    assert lines[:2] == [
        "2023-11-14T22:13:21.500Z warning source.a waiting: no route",
        "2023-11-14T22:13:21.500Z warning source.a waiting: other",
    ]
    assert lines[2].endswith("Z warning source.a waiting: no route (repeated 999 times since)")
    assert sorted(lines) == lines  # the count has the time at which it is written


def test_no_event_is_lost_among_very_many_different_ones(tmp_path):
    events = [event(f"reason {i % 700}") for i in range(5000)]
    lines = logged(tmp_path / "log", events, format="json")
    said = [json.loads(line) for line in lines]
    assert sum(s["repeated"] or 1 for s in said) == 5000
    assert {s["reason"] for s in said} == {f"reason {i}" for i in range(700)}
    assert said[0]["time"] == "2023-11-14T22:13:21.500Z" and said[0]["t_ns"] == 1_500_000_000


def test_what_comes_again_later_is_written_again(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(
        "tactile_rt.daemon.log.time", types.SimpleNamespace(monotonic=lambda: now[0])
    )
    log = Log("log", LogConfig(file=str(tmp_path / "log"), repeat_s=60.0))
    log.open(None)
    for now[0] in (100.0, 130.0, 159.0, 161.0, 170.0):
        log.handle([event("again")])
    log.close()
    ends = [line.rpartition(": ")[2] for line in (tmp_path / "log").read_text().splitlines()]
    assert ends == ["again", "again (repeated 3 times since)", "again"]


def test_the_level_is_the_least_that_is_written(tmp_path):
    events = [event(level=level, reason=level) for level in ("info", "warning", "error")]
    assert len(logged(tmp_path / "log", events, level="warning")) == 2


def test_a_log_that_is_moved_or_deleted_is_begun_anew_as_soon_as_it_can_be(tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    log = Log("log", LogConfig(file=str(folder / "log")))
    log.open(None)
    log.handle([event("one")])
    (folder / "log").rename(folder / "log.1")
    log.handle([event("two")])
    (folder / "log").unlink()
    log.handle([event("three")])
    assert [(folder / name).read_text()[-5:] for name in ("log.1", "log")] == [" one\n", "hree\n"]
    folder.rename(tmp_path / "away")
    log.handle([event("four"), event("five")])
    assert "No such file" in log.diagnose() and log.details()["dropped"] == 2
    folder.mkdir()
    log.handle([])
    log.close()
    assert "log dropped: 2 lines: " in (folder / "log").read_text() and not log.diagnose()
    assert log.details()["lines"] == 3


def test_what_nobody_reads_any_more_is_dropped_and_counted(tmp_path):
    reader, writer = os.pipe()
    log = Log("log", LogConfig(file=f"/proc/self/fd/{writer}"))
    log.open(None)
    log.handle([event("one")])
    os.close(reader)
    for n in range(3):
        log.handle([event(f"more {n}")])
    assert log.details() == {**log.details(), "lines": 1, "dropped": 3}
    assert log.diagnose().endswith("Broken pipe")
    log.close()
    os.close(writer)


@contextmanager
def held_by_another(key, user=None):
    """A process, of another user if one is given, that holds a lock."""
    become = "" if user is None else f"import os; os.setuid({user}); "
    code = (
        f"import sys; from tactile_rt.core.locks import Locks; {become}held = Locks(); "
        "held.hold([sys.argv[1]]); print('held', flush=True); sys.stdin.read()"
    )
    with start_program(key, program=code, stdin=subprocess.PIPE) as other:
        assert other.stdout.readline() == "held\n"
        yield other
        other.kill()


def test_a_lock_ends_with_its_process_and_is_anothers_until_then(tmp_path):
    device = f"device {tmp_path}/tty"
    keys = [f"configuration {tmp_path}/robot.toml", device]
    with held_by_another(device) as other:
        mine = Locks()
        for _ in range(3):  # whoever asks takes nothing from who asks next
            with pytest.raises(AlreadyRunning, match=f"/tty is in use by process {other.pid}$"):
                mine.hold(keys)
        mine.hold(keys[:1])
    mine.hold(keys)
    with pytest.raises(AlreadyRunning):
        Locks().hold(keys[:1])
    mine.hold(keys[1:])
    second = Locks()
    second.hold(keys[:1])
    second.close()
    mine.close()


def test_many_start_at_once_and_one_of_them_is_alone(tmp_path):
    """Also while the name is bound and not yet listened at."""
    key, won, lost = f"device {tmp_path}/tty", [], []
    together = threading.Barrier(8)

    def start():
        locks = Locks()
        together.wait()
        try:
            locks.hold([key])
            won.append(locks)
        except AlreadyRunning:
            lost.append(locks)

    with ThreadPoolExecutor(8) as threads:
        for _ in range(8):
            threads.submit(start)
    assert (len(won), len(lost)) == (1, 7)
    won[0].close()


@pytest.mark.skipif(os.geteuid() != 0, reason="becomes another user")
def test_a_lock_of_another_user_is_a_lock_and_names_the_user(tmp_path):
    key = f"device {tmp_path}/tty"
    with held_by_another(key, user=65534) as other:
        with pytest.raises(AlreadyRunning, match=f"process {other.pid} of user 65534"):
            Locks().hold([key])


def bound(key):
    """What has a lock's name, and does not listen yet."""
    holder = socket.socket(socket.AF_UNIX)
    holder.bind(lock._make_name(key))
    return holder


def test_a_holder_that_listens_a_moment_later_is_named(tmp_path, monkeypatch):
    key = f"device {tmp_path}/tty"
    with bound(key) as holder:
        monkeypatch.setattr(lock.time, "sleep", lambda _: holder.listen())
        with pytest.raises(AlreadyRunning, match=f"in use by process {os.getpid()}$"):
            Locks().hold([key])


def test_a_holder_that_never_listens_is_a_lock_too(tmp_path):
    key = f"device {tmp_path}/tty"
    with bound(key), pytest.raises(AlreadyRunning, match="by an unknown process"):
        Locks().hold([key])


def test_a_holder_that_very_many_have_asked_is_not_waited_for(tmp_path):
    key = f"device {tmp_path}/tty"
    with bound(key) as holder, ExitStack() as asking:
        holder.listen(1)
        with pytest.raises(BlockingIOError):
            for _ in range(100):
                one = asking.enter_context(socket.socket(socket.AF_UNIX))
                one.setblocking(False)
                one.connect(lock._make_name(key))
        with pytest.raises(AlreadyRunning, match="in use by another process"):
            Locks().hold([key])


@pytest.mark.skipif(os.geteuid() != 0, reason="makes a container")
def test_a_holder_outside_of_the_container_is_a_lock(tmp_path):
    key, held = f"device {tmp_path}/tty", Locks()
    held.hold([key])
    code = "import sys; from tactile_rt.core.locks import Locks; Locks().hold([sys.argv[1]])"
    command = ["unshare", "--pid", "--fork", sys.executable, "-c", code, key]
    asked = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S)
    held.close()
    if "unshare" in asked.stderr:
        pytest.skip(asked.stderr.strip())
    assert "in use by a process that cannot be seen from this container" in asked.stderr


def test_ports_that_differ_after_a_hash_are_two():
    assert len(device_keys(["serial:///dev/null#1?codec=bota", "serial:///dev/null#2"])) == 2


def test_two_names_of_a_configuration_or_a_port_are_one(cwd):
    link, file = cwd / "whiskers", cwd / "robot.toml"
    link.symlink_to("/dev/null")
    urls = ["serial:///dev/null?codec=bota", f"serial:{link}?codec=native", "can:slcan:/dev/null"]
    urls += ["serial://whiskers?codec=bota"]
    assert device_keys([*urls, "synthetic:"]) == ["device /dev/null"]
    assert lock_keys(file, urls) == [f"configuration {file}", "device /dev/null"]
    # A link may lead elsewhere by the time a second one starts, so its own name is held, too.
    named = cwd / "named.toml"
    named.symlink_to(file)
    assert lock_keys(named, []) == [f"configuration {file}", f"configuration {named}"]


class Fragile(Part):
    """Breaks as it is told: each entry is an exception, or a number of seconds to work."""

    def __init__(self, plan, **limits):
        self.told = []
        self.plan, self.released = list(plan), 0
        limits = LimitsConfig(retry_first_s=0.01, retry_last_s=0.04, **limits)
        super().__init__("fragile", lambda *told: self.told.append(told), limits)

    def _work(self):
        step = self.plan.pop(0) if self.plan else None
        if isinstance(step, Exception):
            raise step
        self._report_running()
        if step is None:
            return
        self._busy_ns = time.monotonic_ns()
        step.wait(PATIENCE_S)
        self._busy_ns = 0
        self._stop.wait(PATIENCE_S)

    def _release(self):
        self.released += 1


def test_a_part_is_started_again_until_it_works_and_says_why_it_did_not():
    pauses = []
    part = Fragile([ConfigError("no such port"), ConfigError("no such port"), ValueError("odd")])
    part._stop.wait = lambda s: pauses.append(s)  # type: ignore[method-assign]
    part.start()
    assert part.join(time.monotonic() + PATIENCE_S)
    assert [t[1] for t in part.told] == ["waiting", "waiting", "waiting", "running", "ended"]
    assert part.told[0] == ("fragile", "waiting", "no such port", "warning")
    assert part.told[2][2].startswith("ValueError: odd (test_parts.py:")
    assert pauses == [0.01, 0.02, 0.04]
    state = part.state
    assert (state.state, state.starts, state.failures, part.released) == ("ended", 4, 3, 4)


def test_a_part_that_stalls_is_told_and_so_is_its_return():
    hangs = threading.Event()
    part = Fragile([hangs], stall_s=0.5)
    part.start()
    until(lambda: part.state.state == "stalled")
    part.watch()
    part.watch()
    hangs.set()
    until(lambda: part.state.state == "running")
    part.watch()
    part.stop()
    assert part.join(time.monotonic() + PATIENCE_S)
    assert [t[1] for t in part.told] == ["running", "stalled", "running", "stopped"]
    assert part.told[1][2] == "in a call that has not returned for 0.5 s"


def test_a_part_in_its_pause_stops_at_once():
    part = Fragile([ConfigError("x")] * 1000)
    part.limits = LimitsConfig(retry_first_s=60.0, retry_last_s=60.0)
    part._pause_s = 60.0
    part.start()
    until(lambda: part.state.state == "waiting")
    part.stop()
    assert part.join(time.monotonic() + PATIENCE_S) and part.state.state == "stopped"


def test_reasons_are_one_line():
    assert reason_of(ConfigError("a\nb")) == "a b"
    assert reason_of(OSError(28, "No space left on device", "/x")) == "/x: No space left on device"
    assert reason_of(KeyError("k")) == "KeyError: 'k'"
    assert reason_of(TimeoutError()) == "TimeoutError"
