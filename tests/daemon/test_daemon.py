"""The daemon as a whole, on real lines: arrays on ptys, models, consumers, and what goes wrong."""

import io
import json
import logging
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from tactile_rt.calibration import Calibration, save_calibration
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.enrolment import EnrolledObject
from tactile_rt.cli.top import picture
from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.core.locks import AlreadyRunning, Locks
from tactile_rt.daemon import publishers
from tactile_rt.daemon.checks import check_config
from tactile_rt.daemon.clock import Clock
from tactile_rt.daemon.consumer import Consumer
from tactile_rt.daemon.daemon import Daemon
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
from tactile_rt.daemon.loading import load_config
from tactile_rt.daemon.metrics import exposition
from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, FakeSerial, cut_chunks, small_spec
from tests.helpers.tiny_model import force_rule, write_model
from tests.helpers.touch_streams import same
from tests.helpers.waiting import PATIENCE_S, until

SPEC = small_spec()
JSONL = '[[publisher]]\nkind = "jsonl"\noptions = {file = "out"}\n'
OPEN_SOURCE = "tactile_rt.daemon.source_part.open_source"

pytestmark = pytest.mark.usefixtures("no_thread_left")


def touching(n=4000, seed=0):
    """(n, 3, 2): rest for half a second, then a touch every second."""
    t = np.arange(n) / 1000.0
    noise = np.random.default_rng(seed).normal(scale=1e-4, size=(n, 3, 2))
    on = (t > 0.5) & (t % 1.0 < 0.4)
    return (noise + 0.5 * on[:, None, None]).astype(np.float32)


class Spy(Consumer):
    """Keeps all that it is given; does as the test says."""

    made: list["Spy"] = []  # noqa: RUF012
    wants = frozenset({Opened, Closed, SourceChunk, Packet, Decision, Contact, Event, Control})

    def __init__(self, name, options):
        self.items, self.log = [], []
        self.opening = self.handling = lambda: None
        self.view = None
        type(self).made.append(self)

    def open(self, view):
        self.log.append("open")
        self.view = view
        self.opening()

    def handle(self, items):
        self.handling()
        self.items += items

    def close(self):
        self.log.append("close")

    def of(self, kind, source=None):
        found = [i for i in list(self.items) if isinstance(i, kind)]
        return found if source is None else [i for i in found if i.source == source]

    def told(self, part, state):
        return [e for e in self.of(Event) if (e.part, e.state) == (part, state)]


@pytest.fixture
def spy(monkeypatch):
    monkeypatch.setitem(publishers.PUBLISHERS, "spy", (f"{__name__}:Spy", ""))
    Spy.made.clear()
    return Spy.made


@pytest.fixture
def robot(tmp_path, spy):
    """A daemon on a configuration; `robot(text)` starts it and gives (daemon, spy)."""
    running = []

    def start(text, **options):
        daemon = Daemon(configured(tmp_path, text), **options)
        running.append(daemon)
        daemon.start()
        return daemon, spy[-1]

    yield start
    for daemon in running:
        assert daemon.stop() == []


def configured(folder, text, checked=True, stop_s=60):
    """Loaded; calls may take as long as a busy machine makes them, and no model skips for that."""
    file = folder / "robot.toml"
    text = text.replace("[[model]]\n", '[[model]]\ncatch_up = "all"\n')
    file.write_text(
        'version = 1\n[[publisher]]\nkind = "spy"\n[limits]\nretry_first_s = 0.02\n'
        "retry_last_s = 0.1\nstall_s = 600\nbehind_s = 600\nsample_age_s = 600\n"
        "model_queue_items = 10000\nqueue_items = 100000\nqueue_mb = 512\n"
        f'stop_s = {stop_s}\n[log]\nfile = "log"\n{text}'
    )
    loaded = load_config(file)
    if checked:
        count = len(Spy.made)
        check_config(loaded)
        del Spy.made[count:]  # those that were made to see whether they can be
    return loaded


def source(name, url):
    return f'[[source]]\nname = "{name}"\nurl = "{url}"\n'


def model_of(file, **keys):
    keys = "".join(f'{key} = "{value}"\n' for key, value in keys.items())
    return f'[[model]]\n{keys}file = "{file}"\n'


def state_of(daemon, name):
    snapshot = daemon.snapshot()
    parts = [s.part for s in (*snapshot.sources, *snapshot.models, *snapshot.consumers)]
    return next(p for p in parts if p.name == name)


def seqs(spy, name):
    found = [i.chunk.seq for i in spy.of(SourceChunk, name)]
    return np.concatenate(found) if found else np.zeros(0, int)


def test_two_arrays_and_three_models_on_ptys_lose_nothing(robot, tmp_path):
    """Where the line waits for its reader and the mailboxes hold all, on a busy machine, too."""
    cup = EnrolledObject.of("cup", np.array([[4.0, 8.0]]))
    model = write_model(tmp_path / "m.onnx", identity=force_rule(), enrolled=(cup,))
    with (
        FakeSerial(touching(2000), spec=SPEC, pace="fast") as left,
        FakeSerial(touching(2000, 1), spec=small_spec(), pace="fast") as right,
    ):
        daemon, spy = robot(
            source("left", f"{left.url}&clock=device")
            + source("right", f"{right.url}&clock=device")
            + model_of(model, source="left")
            + model_of(model, source="right")
            + model_of(model, source="right", name="last", decisions="final")
        )
        assert left.wait(PATIENCE_S) and right.wait(PATIENCE_S)
        until(lambda: all(len(seqs(spy, n)) == 2000 for n in ("left", "right")))
        until(lambda: daemon.snapshot().state != "starting")
        # Nothing more comes, and a slow machine is late: that may be told already, but no loss.
        late = ("late: ", "no samples: ", "late samples: ", "late decisions: ")
        told = daemon.snapshot().degraded
        assert all(line.startswith(late) for line in told), told
        until(lambda: all(m.queue.taken["samples"] == 2000 for m in daemon.snapshot().models))
        # Each has decided all that it will once it has seen the touch end.
        until(lambda: len({c.model for c in spy.of(Contact) if not c.touching}) == 3)
        part = daemon._consumers["publisher.spy"][1]
        until(lambda: part.consumer_state.latency.count == len(spy.of(Decision)))
        snapshot = daemon.snapshot()
    for name in ("left", "right"):
        assert np.array_equal(seqs(spy, name), np.arange(2000))
        assert len(spy.of(Opened, name)) == 1
        # Packets hold the whole stream as it came, beginning where the line was opened.
        packets = [p.packet for p in spy.of(Packet, name)]
        assert packets[0] is None and sum(map(len, packets[1:])) > 2000 * 3 * 2 * 4
    states = {s.part.name: s for s in snapshot.sources}
    assert states["source.left"].stats.delivered == states["source.left"].samples == 2000
    assert states["source.right"].frame == "mount" and states["source.right"].device is not None
    first, second, final = snapshot.models
    assert [m.part.name for m in snapshot.models] == ["model.left", "model.right", "model.last"]
    made = spy.of(Decision)
    assert {d.model for d in made} == {"left", "right", "last"}
    assert all(d.decision.final for d in made if d.model == "last")
    assert first.decisions == sum(d.model == "left" for d in made) == first.latency.count
    assert final.final == sum(d.model == "last" for d in made) == second.final
    objects = [d.decision.object for d in made if d.model == "left" and d.decision.object]
    assert first.object == objects[-1]
    assert all(d.sample_ns <= d.made_ns and d.frame == "mount" for d in made)
    published = next(c for c in snapshot.consumers if c.kind == "spy")
    assert published.latency.count == len(made) and published.queue.dropped["samples"] == 0
    contacts = [(c.source, c.touching) for c in spy.of(Contact) if c.model == "left"]
    assert contacts[:2] == [("left", True), ("left", False)]


def received(daemon):
    """Of the first source: what came, and what is known not to have come."""
    s = daemon.snapshot().sources[0].stats
    return s.delivered + s.corrupt + s.missing + s.dropped + s.duplicates


def test_what_a_classifier_warns_of_is_an_event(robot):
    _, spy = robot('[[source]]\nname = "a"\nurl = "synthetic:2x2"\n')
    logging.getLogger("tactile_rt.classifier.classifier").warning("hand: %s", "contact for 10 s")
    until(lambda: spy.told("model", "warns"))


def test_every_sample_is_accounted_for_through_faults(robot, tmp_path):
    """From the wire to each consumer: what was sent came, or was counted where it was lost."""
    model = write_model(tmp_path / "m.onnx")
    kinds = ("bit_flip", "truncate", "duplicate", "drop", "burst")
    faults = FaultSchedule([Fault(kind, rate=4.0) for kind in kinds], seed=1)
    with (
        FakeSerial(touching(6000), spec=SPEC, faults=faults, pace="fast") as fake,
        FakeSerial(touching(1000), spec=SPEC) as calm,
    ):
        text = source("a", fake.url) + source("calm", calm.url) + model_of(model, source="a")
        daemon, spy = robot(text)
        assert fake.wait(PATIENCE_S) and calm.wait(PATIENCE_S)
        until(lambda: len(seqs(spy, "calm")) == 1000)
        told = fake.log
        until(lambda: received(daemon) == told.sent + told.duplicated)
        until(lambda: not any(daemon.snapshot().models[0].queue.waiting.values()))
        log, snapshot = fake.log, daemon.snapshot()
    stats = snapshot.sources[0].stats
    assert log.sent == 6000 and stats.corrupt > 10 and stats.missing > 5 and stats.duplicates > 5
    assert log.sent + log.duplicated == received(daemon)
    queue = snapshot.models[0].queue
    assert queue.put["samples"] == stats.delivered == snapshot.sources[0].samples
    assert queue.put["samples"] == queue.taken["samples"] + queue.dropped["samples"]
    box = daemon._consumers["publisher.spy"][1].box.state
    assert len(seqs(spy, "a")) + len(seqs(spy, "calm")) == box.taken["samples"]
    assert box.put["samples"] == stats.delivered + 1000
    calm_stats = snapshot.sources[1].stats
    assert (calm_stats.delivered, calm_stats.missing, calm_stats.corrupt) == (1000, 0, 0)


def test_decisions_are_those_of_the_classifier_alone(robot, tmp_path, monkeypatch):
    model = write_model(tmp_path / "m.onnx")
    chunks = cut_chunks(touching(3000), SPEC.rate_hz, samples=7)
    alone = Classifier(model, SPEC)
    expected = [d for chunk in chunks for d in alone.push(chunk)]
    monkeypatch.setattr(OPEN_SOURCE, lambda url, **more: ArraySource(SPEC, chunks))
    over = threading.Event()
    text = source("a", "serial:none?codec=native") + model_of(model)
    daemon, spy = robot(text, on_over=over.set)
    assert over.wait(PATIENCE_S)
    daemon.stop()
    found = [d.decision for d in spy.of(Decision)]
    assert same(found, expected)
    assert len(found) > 4 and len(seqs(spy, "a")) == 3000
    assert spy.log == ["open", "close"] and isinstance(spy.items[-1], Event)


def test_a_device_that_goes_and_comes_is_told_and_the_other_goes_on(robot, tmp_path):
    link = str(tmp_path / "tty")
    with (
        FakeSerial(touching(60_000), spec=SPEC, link=link) as goes,
        FakeSerial(touching(60_000), spec=SPEC) as stays,
    ):
        daemon, spy = robot(source("goes", goes.url) + source("stays", stays.url))
        until(lambda: len(seqs(spy, "goes")) > 50)
        goes.unplug()
        until(lambda: spy.told("source.goes", "device:lost"))
        until(lambda: spy.told("daemon", "degraded"))
        assert daemon.snapshot().state == "degraded"
        lost = "no samples: source.goes: the device is lost"
        until(lambda: any(line.startswith(lost) for line in daemon.snapshot().degraded))
        before = len(seqs(spy, "stays"))
        until(lambda: len(seqs(spy, "stays")) > before + 100)
        goes.replug()
        until(lambda: len(spy.told("source.goes", "device:streaming")) > 1)
        until(lambda: daemon.snapshot().state == "running")
    kept = seqs(spy, "stays")
    assert np.array_equal(kept, kept[0] + np.arange(len(kept)))
    assert len(spy.of(Opened, "goes")) == 1  # the same stream goes on


def test_a_source_that_breaks_is_opened_again_and_its_counts_add_up(robot, monkeypatch):
    opened = []

    class Breaking(ArraySource):
        def read(self, timeout=None):
            if not self._left:
                raise SourceError("the cable is loose")
            return super().read(timeout)

    def open_it(url, **more):
        if len(opened) == 3:
            raise SourceError("no such port")
        opened.append(Breaking(SPEC, cut_chunks(touching(100), 1000.0)))
        return opened[-1]

    monkeypatch.setattr(OPEN_SOURCE, open_it)
    daemon, spy = robot(source("a", "synthetic:"))
    until(lambda: state_of(daemon, "source.a").failures > 4)
    state = daemon.snapshot().sources[0]
    assert state.samples == state.stats.delivered == 300 == len(seqs(spy, "a"))
    assert len(spy.of(Opened)) == len(spy.of(Closed)) == 3
    reasons = [e.reason for e in spy.told("source.a", "waiting")]
    assert reasons[:4] == ["the cable is loose"] * 3 + ["no such port"]
    assert "no samples: source.a fails: no such port" in daemon.snapshot().degraded


def renamed(prefix):
    return replace(SPEC, elements=tuple(f"{prefix}{e}" for e in SPEC.elements))


def test_a_model_of_another_array_has_failed_and_is_not_tried_again(robot, tmp_path):
    """A native device says what it is only when it is opened: nobody could know before."""
    model = write_model(tmp_path / "m.onnx", spec=renamed("x").to_json())
    with FakeSerial(touching(60_000), spec=SPEC) as device:
        daemon, spy = robot(source("a", device.url) + model_of(model))
        until(lambda: spy.told("model.a", "failed"))
        (event,) = spy.told("model.a", "failed")
        assert event.level == "error" and not spy.told("model.a", "waiting")
        assert event.reason.startswith(f"source a: {model} was made for another array than ")
        assert "lacks xA0, xA1, xA2" in event.reason
        until(lambda: len(seqs(spy, "a")) > 1000)  # many times the longest pause between tries
        state = state_of(daemon, "model.a")
        assert (state.state, state.starts, state.failures) == ("failed", 1, 1)
        said = f"no decisions: model.a has failed: {event.reason}; acquisition goes on"
        assert said in daemon.snapshot().degraded
        # and whoever looks at the daemon is told as plainly
        metrics = exposition(daemon.snapshot()).decode()
        assert 'tactile_part_state{part="model.a",state="failed"} 1\n' in metrics
        states = [x for x in metrics.splitlines() if x.startswith("tactile_part_state")]
        assert sum('part="model.a"' in x and x.endswith(" 1") for x in states) == 1
        console = Console(file=io.StringIO(), width=1000)
        console.print(picture(daemon.snapshot()))
        lines = console.file.getvalue().splitlines()
        shown = next(line for line in lines if line.split()[:2] == ["a", "failed"])
        assert event.reason in shown
        # Of another file it is worth a try, with or without being told.
        write_model(model)
        until(lambda: spy.of(Decision))
        until(lambda: daemon.snapshot().state == "running")
    assert len(spy.told("model.a", "failed")) == 1


def test_a_source_that_is_not_what_it_should_be_has_failed_until_a_reload(robot, tmp_path):
    """The same of a calibration of another device: no try can mend it, but another file can."""
    other, mine = (Calibration.of("cell", spec) for spec in (renamed("x"), SPEC))
    save_calibration(other, tmp_path / "cell.toml")
    with FakeSerial(touching(60_000), spec=SPEC) as device:
        text = source("a", device.url) + 'calibration = "cell.toml"\n'
        daemon, spy = robot(text)
        until(lambda: spy.told("source.a", "failed"))
        until(lambda: daemon.snapshot().state == "degraded")
        (event,) = spy.told("source.a", "failed")
        assert event.level == "error"
        assert event.reason.startswith("calibration of cell is for elements xA0, xA1, xA2; ")
        assert f"no samples: source.a has failed: {event.reason}" in daemon.snapshot().degraded
        save_calibration(mine, tmp_path / "cell.toml")
        assert state_of(daemon, "source.a").starts == 1
        daemon.reload(configured(tmp_path, text))
        until(lambda: spy.of(SourceChunk, "a"))
        until(lambda: daemon.snapshot().state == "running")


def test_a_device_is_what_its_configuration_says(robot, tmp_path):
    """Declared to be the array of the model's file, it is that in all that is told of it."""
    array = replace(SPEC, name="robot", elements=("left", "middle", "right"), frame="plate")
    write_model(tmp_path / "m.onnx", spec=array.to_json())
    columns = ",".join(f"{e}.{c}" for e in SPEC.elements for c in ("fy:N", "mz:N m"))
    options = {"columns": columns, "rate_hz": "1000"}
    with FakeSerial(touching(60_000), "ascii_line", options=options) as device:
        plain = source("a", device.url) + '{}[[model]]\nfile = "m.onnx"\n'
        with pytest.raises(ConfigError, match=r"source a: .* was made for another array than 'asc"):
            configured(tmp_path, plain.format(""))
        daemon, spy = robot(plain.format('array = "m.onnx"\n'))
        until(lambda: spy.of(Decision))
        state = daemon.snapshot().sources[0]
        assert (state.array, state.elements, state.frame) == ("robot", array.elements, "plate")
        assert state.device is not None and spy.of(Decision)[0].frame == "plate"
        assert spy.of(Packet)  # of the device behind it


def test_a_consumer_that_breaks_or_hangs_harms_itself_alone(robot, tmp_path):
    with FakeSerial(touching(60_000), spec=SPEC) as device:
        daemon, spy = robot(source("a", device.url) + JSONL)
        until(lambda: len(spy.items) > 10)

        def fail():
            raise ConnectionRefusedError(111, "Connection refused", "tcp://peer")

        spy.handling = fail
        until(lambda: state_of(daemon, "publisher.spy").failures > 3)
        assert any("not published: publisher.spy fails" in x for x in daemon.snapshot().degraded)
        spy.handling = lambda: None
        until(lambda: state_of(daemon, "publisher.spy").state == "running")
        assert spy.log.count("open") == spy.log.count("close") + 1
        hangs = threading.Event()
        part = daemon._consumers["publisher.spy"][1]
        part.limits = type(part.limits)(stall_s=0.5)
        spy.handling = lambda: hangs.wait(PATIENCE_S)
        until(lambda: state_of(daemon, "publisher.spy").state == "stalled")
        until(lambda: part._stalled)  # and told
        before = daemon.snapshot().sources[0].samples
        until(lambda: daemon.snapshot().sources[0].samples > before + 200)
        spy.handling = lambda: None
        hangs.set()
        until(lambda: state_of(daemon, "publisher.spy").state == "running")
        queue = part.box.state
    for kind in queue.put:
        assert queue.put[kind] == queue.taken[kind] + queue.dropped[kind] + queue.waiting[kind]
    events = [json.loads(line) for line in (tmp_path / "out").read_text().splitlines()]
    told = [e for e in events if e["type"] == "health" and e["part"] == "publisher.spy"]
    assert "tcp://peer: Connection refused" in {e["reason"] for e in told}
    assert {"stalled", "waiting", "running"} <= {e["state"] for e in told}


def test_a_reload_disturbs_only_what_has_changed(robot, tmp_path, spy):
    model = write_model(tmp_path / "m.onnx")
    with FakeSerial(touching(60_000), spec=SPEC) as device:
        base = source("a", device.url) + model_of(model, source="a")
        daemon, first = robot(base)
        until(lambda: first.of(Decision))
        models = daemon.snapshot().models[0]
        daemon.reload(configured(tmp_path, base + source("b", "synthetic:1x1") + JSONL))
        assert len(spy) == 1  # what goes on is not made again
        until(lambda: first.of(SourceChunk, "b"))
        until(lambda: '"source":"b"' in (tmp_path / "out").read_text())
        snapshot = daemon.snapshot()
        assert snapshot.reloads == 1 and first.told("daemon", "reloaded")
        assert [s.part.starts for s in snapshot.sources] == [1, 1]
        assert snapshot.models[0].part.since_ns == models.part.since_ns
        assert snapshot.models[0].decisions >= models.decisions
        daemon.reload(configured(tmp_path, base))
        assert len(daemon.snapshot().sources) == 1 and len(daemon.snapshot().consumers) == 2
        until(lambda: first.of(Closed, "b"))
        with pytest.raises(ConfigError):
            configured(tmp_path, base + source("a", "synthetic:"))
        before = len(seqs(first, "a"))
        until(lambda: len(seqs(first, "a")) > before + 100)
        kept = seqs(first, "a")
        assert np.array_equal(kept, kept[0] + np.arange(len(kept)))
        assert first.log == ["open"]


def test_a_source_that_is_still_being_opened_disturbs_no_other_after_a_reload(robot, monkeypatch):
    answers, closed = threading.Event(), []

    class Late(ArraySource):
        def close(self):
            closed.append(self)

    def open_it(url, **more):
        if url.endswith("1x1"):
            answers.wait(PATIENCE_S)
            return Late(SPEC, [], live=True)
        return open_source(url)

    monkeypatch.setattr(OPEN_SOURCE, open_it)
    daemon, spy = robot(source("a", "synthetic:1x1"))
    until(lambda: daemon._sources["a"]._opening)
    old = daemon._sources["a"]
    daemon.reload(configured(Path(daemon.snapshot().config).parent, source("a", "synthetic:2x2")))
    until(lambda: spy.of(SourceChunk, "a"))
    (stopped,) = spy.told("source.a", "stopped")
    assert not closed and stopped.reason == "while it waited for its device"
    answers.set()
    until(lambda: closed)
    until(lambda: not old._thread.is_alive())
    assert set(daemon.streams()) == {"a"} and not spy.of(Closed)
    assert len(spy.of(Opened)) == len(spy.told("source.a", "stopped")) == 1


@pytest.mark.parametrize("other, words", [
    ({"spec": SPEC, "options": {"serial_number": "B"}}, "its serial number is B, not A"),
    ({"spec": small_spec(4)}, "it describes itself otherwise: elements: 4 entries, not 3"),
])  # fmt: skip
def test_another_array_is_told_and_nothing_is_decided_of_it_until_it_is_accepted(
    robot, tmp_path, other, words
):
    model, link = write_model(tmp_path / "m.onnx"), str(tmp_path / "w")
    first = {"spec": SPEC, "options": {"serial_number": "A"}, "link": link}
    recorded = '[recorder]\nfolder = "rec"\nmin_free_mb = 0\n'
    with FakeSerial(touching(60_000), **first) as array:
        text = source("w", array.url) + model_of(model, source="w") + recorded
        daemon, spy = robot(text)
        until(lambda: spy.of(Decision))
        assert daemon.snapshot().sources[0].device.identity == "A"
    values = np.repeat(touching(60_000), 2, axis=1)[:, : len(other["spec"].elements)]
    with FakeSerial(values, link=link, **other):
        until(lambda: len(spy.of(Opened)) == 2)
        until(lambda: len(seqs(spy, "w")) and not spy.of(SourceChunk)[-1].accepted)
        (line,) = [d for d in daemon.snapshot().diagnostics if d.what == "another array"]
        assert line.part == "source.w" and words in line.why
        n, since_ns = len(seqs(spy, "w")), spy.of(Opened)[1].t_ns
        until(lambda: len(seqs(spy, "w")) > n + 1500)  # a touch
        assert not [d for d in spy.of(Decision) if d.sample_ns > since_ns]
        until(lambda: len(list((tmp_path / "rec").glob("*.mcap"))) == 2)
        daemon.reload(configured(tmp_path, text))
        until(lambda: not daemon.snapshot().sources[0].another and spy.of(Opened)[-1].accepted)
        if len(other["spec"].elements) == 3:
            until(lambda: any(d.sample_ns > since_ns for d in spy.of(Decision)))


def test_which_array_was_accepted_outlives_the_daemon(robot, tmp_path, monkeypatch):
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    memory, link = tmp_path / "arrays.json", str(tmp_path / "w")
    memory.write_text('{"')
    found = []
    for number, accepts in (("A", False), ("B", True), ("B", False), ("A", False)):
        options = {"serial_number": number}
        with FakeSerial(touching(60_000), spec=SPEC, link=link, options=options) as array:
            text = source("w", array.url.partition("&")[0])
            daemon, spy = robot(text)
            until(lambda spy=spy: spy.of(SourceChunk))
            found.append(daemon.snapshot().sources[0].another)
            if accepts:
                daemon.reload(configured(tmp_path, text))
            kept = f'"serial_number":"{"A" if len(found) == 1 else "B"}"'
            until(lambda kept=kept: kept in memory.read_text())
            assert len(spy.told("daemon", "memory")) == (len(found) == 1)
            daemon.stop()
    assert found == ["", "its serial number is B, not A", "", "its serial number is A, not B"]


def test_zeros_are_a_fault_where_the_tare_found_noise_and_else_foreseen(robot, tmp_path):
    save_calibration(replace(Calibration.of("pad", SPEC), changes=0.9), tmp_path / "pad.toml")
    zeros = np.zeros((60_000, *SPEC.shape))
    with FakeSerial(zeros, spec=SPEC) as tared, FakeSerial(zeros, spec=SPEC) as other:
        tables = source("a", tared.url) + 'calibration = "pad.toml"\n', source("b", other.url)
        daemon, _ = robot("".join(tables))
        line = "stuck-at fault: source.a: all zeros: the device hangs"
        until(lambda: line in daemon.snapshot().degraded)
        until(lambda: daemon.snapshot().soon)
        (soon,) = daemon.snapshot().soon
        assert soon.line.startswith("all zeros: source.b: ")


def test_a_drift_is_foreseen_and_says_which_reading(robot, tmp_path):
    values = np.random.default_rng(0).normal(scale=0.1, size=(60_000, *SPEC.shape))
    values[:, 1, 0] += 0.4 * np.arange(60_000) / 1000  # a second
    with FakeSerial(values.astype(np.float32), spec=SPEC) as array:
        model = model_of(write_model(tmp_path / "m.onnx"), source="w")
        daemon, _ = robot(source("w", array.url) + model)
        until(lambda: daemon.snapshot().soon)
        (soon,) = daemon.snapshot().soon
    where = f"{SPEC.elements[1]} {SPEC.channels[0]}"
    assert soon.line.startswith(f"offset drifts: model.w: {where} moves by 2")  # 24 N a minute


def test_a_reload_that_needs_a_device_of_another_process_changes_nothing(robot, tmp_path):
    base, port = source("a", "synthetic:"), tmp_path / "tty"
    daemon, _ = robot(base, locks=Locks())
    other = Locks()
    other.hold([f"device {port}"])
    with pytest.raises(AlreadyRunning):
        daemon.reload(configured(tmp_path, base + source("b", f"serial:{port}?codec=bota")))
    assert [s.part.name for s in daemon.snapshot().sources] == ["source.a"]
    with pytest.raises(AlreadyRunning, match="configuration"):
        other.hold([f"configuration {tmp_path}/robot.toml"])
    other.close()


def test_closing_drains_what_waits(robot, tmp_path):
    daemon, spy = robot(source("a", "synthetic:35x6"))
    until(lambda: len(spy.of(SourceChunk)) > 3)
    hold = threading.Event()
    spy.handling = lambda: hold.wait(0.3)
    until(lambda: daemon._consumers["publisher.spy"][1].box.state.waiting["samples"] > 20)
    assert daemon.stop() == []
    queue = daemon.snapshot().consumers[1].queue
    assert queue.waiting["samples"] == queue.dropped["samples"] == 0
    assert len(seqs(spy, "a")) == daemon.snapshot().sources[0].samples
    log = (tmp_path / "log").read_text()
    assert log.index("daemon stopping") < log.index("source.a stopped")


def test_what_hangs_at_the_end_is_named_and_left_behind(tmp_path, spy):
    hangs = threading.Event()
    daemon = Daemon(configured(tmp_path, source("a", "synthetic:"), stop_s=1))
    daemon.start()
    until(lambda: spy[-1].items)
    inside = threading.Event()
    spy[-1].handling = lambda: inside.set() or hangs.wait(PATIENCE_S)
    assert inside.wait(PATIENCE_S)
    assert daemon.stop() == ["publisher.spy"]
    assert "publisher.spy abandoned: it did not end in time" in (tmp_path / "log").read_text()
    hangs.set()
    assert daemon._consumers["publisher.spy"][1].join(time.monotonic() + PATIENCE_S)


def test_a_recording_is_measured_and_its_rate_is_no_fault(robot):
    daemon, _ = robot(source("a", "replay:demo?speed=0.5"))
    until(lambda: daemon.snapshot().sources[0].measured_hz)
    found = daemon.snapshot().sources[0]
    assert 100 < found.measured_hz < 900 and not found.slow


class SteppedClock(Clock):
    by = 0

    def utc_ns(self):
        return time.time_ns() + self.by


def test_a_step_of_the_wall_clock_is_seen_once():
    clock = SteppedClock()
    assert clock.stepped_ns() == 0
    clock.by = -3600 * 10**9
    assert abs(clock.stepped_ns() + 3600 * 10**9) < 10**8
    assert clock.stepped_ns() == 0


def test_the_wall_clock_may_jump(robot):
    clock = SteppedClock()
    daemon, spy = robot(source("a", "synthetic:"), clock=clock)
    until(lambda: len(spy.of(SourceChunk)) > 3)
    clock.by, first = 3600 * 10**9, spy.of(SourceChunk)[0]
    until(lambda: spy.told("daemon", "clock"))
    assert spy.told("daemon", "clock")[0].reason.startswith("the wall clock jumped by +3600.")
    until(lambda: spy.of(SourceChunk)[-1].utc_offset_ns - first.utc_offset_ns > 3599e9)
    assert daemon.snapshot().clock_steps == 1
    t_ns = np.concatenate([s.chunk.t_ns for s in spy.of(SourceChunk)])
    assert (np.diff(t_ns) > 0).all()


def test_a_consumer_can_ask_something_of_another(robot, spy):
    daemon, _ = robot(source("a", "synthetic:"))
    assert daemon.send("publisher.spy", Control("rotate"))
    assert not daemon.send("recorder", Control("rotate"))
    assert not daemon.send("log", Control("rotate"))
    until(lambda: spy[-1].of(Control))
    assert "synthetic:" in daemon.config_text() and "a" in daemon.streams()
