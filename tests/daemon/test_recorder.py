"""The daemon's recorder, driven by hand: what it is given is in its files, whatever happens."""

import os
import time
from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classification
from tactile_rt.daemon.items import Closed, Contact, Control, Decision, Event, Packet, SourceChunk
from tactile_rt.recording import Recording, recover
from tactile_rt.recording.reader import is_finished
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import FakeSerial, cut_chunks
from tests.helpers.recorder_by_hand import SPEC, UTC, View, begun, files, look, opened, samples

VALUES = np.random.default_rng(0).normal(size=(90, *SPEC.shape)).astype(np.float32)


@pytest.fixture
def daemon():
    return View()


def decision(step=1):
    now = time.monotonic_ns()
    made = Classification(
        5, 9, step, False, "mug", ("mug", "car"), np.array([0.75, 0.25], np.float32), 0.001
    )
    return Decision("whiskers", "best", "mount", made, now, now, UTC)


def event(level="info", part="source.whiskers"):
    return Event(part, "waiting", "unplugged", level, time.monotonic_ns(), UTC)


def same(path, chunks):
    back = list(Recording(path))
    assert len(back) == len(chunks)
    for a, b in zip(back, chunks, strict=True):
        assert a.values.tobytes() == b.values.tobytes()
        assert a.seq.tolist() == b.seq.tolist()
        assert a.t_ns.tolist() == b.t_ns.tolist()


def test_all_that_happens_is_in_the_file(daemon, tmp_path):
    made, chunks = begun(daemon, tmp_path / "new", min_free_mb=0), cut_chunks(VALUES, 1000.0)
    made.handle([opened()])
    made.handle([samples(c) for c in chunks[:5]] + [decision(), event()])
    made.handle([samples(c) for c in chunks[5:]])
    made.close()
    (path,) = files(tmp_path / "new")
    assert path.name.startswith("whiskers-20")
    same(path, chunks)
    (told,) = Recording(path).decisions()
    assert (told["label"], told["step"], told["probabilities"]["mug"]) == ("mug", 1, 0.75)
    (state,) = Recording(path).events()
    assert (state["part"], state["reason"]) == ("source.whiskers", "unplugged")
    about = Recording(path).description
    assert about.session["config"] == "version = 1\n"
    assert about.source == "synthetic:whiskers"


def test_a_decision_about_the_last_samples_comes_after_the_end(daemon, tmp_path, monkeypatch):
    monkeypatch.setattr("tactile_rt.daemon.recorder.LINGER_NS", 10**15)
    made = begun(daemon, tmp_path, min_free_mb=0, rotate_s=1e-3)
    made.handle([opened(), samples(cut_chunks(VALUES, 1000.0)[0]), Closed("whiskers", 0)])
    look(made)  # no next file would ever begin
    made.handle([decision()])
    (path,) = files(tmp_path)
    assert not is_finished(path)
    monkeypatch.setattr("tactile_rt.daemon.recorder.LINGER_NS", 0)
    look(made)
    assert is_finished(path)
    assert len(list(Recording(path).decisions())) == 1
    made.close()


def test_each_source_has_its_own_file(daemon, tmp_path):
    made, chunks = begun(daemon, tmp_path, min_free_mb=0), cut_chunks(VALUES, 1000.0)
    made.handle([opened("left"), opened("right")])
    made.handle([samples(chunks[0], "left"), samples(chunks[1], "right"), samples(chunks[2], "no")])
    made.handle([Closed("left", 0)])
    made.handle([samples(chunks[3], "right")])
    made.close()
    left, right = files(tmp_path)
    same(left, chunks[:1])
    same(right, [chunks[1], chunks[3]])


def test_a_device_s_packets_decode_again_from_every_rotated_file(daemon, tmp_path):
    values = np.random.default_rng(1).normal(size=(600, 2, 6)).astype(np.float32) * 1e-3
    heard, got, items = [], [], []
    with FakeSerial(values) as fake, open_source(fake.url) as source:
        source.tap(lambda packet, t_ns: heard.append((packet, t_ns)))
        prelude = tuple(heard)
        first = replace(opened(stream=source), prelude=prelude, url=fake.url)
        items += [Packet("whiskers", *p) for p in prelude]
        made = begun(daemon, tmp_path, min_free_mb=0)
        made.handle([first, *items])
        while sum(map(len, got)) < 600:
            heard.clear()
            chunk = source.read(1.0)
            if chunk is None:
                continue
            got.append(chunk)
            came = SourceChunk("whiskers", source.spec, chunk, time.monotonic_ns(), UTC)
            made.handle([*(Packet("whiskers", *p) for p in heard), came])
            if len(got) == 3:
                made.handle([Control("rotate")])
        made.close()
    paths = sorted(files(tmp_path), key=os.path.getmtime)
    assert len(paths) == 2
    for path, expected in zip(paths, (got[:3], got[3:]), strict=True):
        same(path, expected)
        with open_source(f"replay:{path}?from=wire&speed=0") as again:
            back = np.concatenate([c.values for c in again])
        expected = np.concatenate([c.values for c in expected])
        # samples that came with the description stand before, in every file
        assert back[-len(expected) :].tobytes() == expected.tobytes()
        assert len(back) < len(expected) + 100
        assert any(packet for packet, _ in Recording(path).packets())


@pytest.mark.parametrize("config", [{"rotate_mb": 0.001}, {"rotate_s": 0.02}])
def test_files_are_rotated_by_size_and_time_and_nothing_is_lost_between(config, daemon, tmp_path):
    made = begun(daemon, tmp_path, min_free_mb=0, **config)
    chunks = cut_chunks(VALUES, 1000.0)
    made.handle([opened()])
    for chunk in chunks:
        made.handle([samples(chunk)])
        time.sleep(0.005)
        look(made)
    made.close()
    paths = sorted(files(tmp_path), key=lambda p: (p.stat().st_mtime_ns, p.name))
    assert len(paths) > 1
    back = sorted((c for path in paths for c in Recording(path)), key=lambda c: c.seq[0])
    assert np.concatenate([c.seq for c in back]).tolist() == list(range(90))


def test_a_trigger_keeps_what_came_before_it_and_after(daemon, tmp_path):
    made = begun(daemon, tmp_path, min_free_mb=0, mode="trigger", before_s=100, after_s=1000)
    chunks = cut_chunks(VALUES, 1000.0)
    made.handle([opened()])
    now = time.monotonic_ns()
    early = [samples(c, at=now - 10**12) for c in chunks[:2]]  # too long before
    made.handle([*early, samples(chunks[2], at=now - 10**7)])
    look(made)
    assert files(tmp_path) == []
    made.handle([Contact("whiskers", "best", "mount", True, time.monotonic_ns(), UTC)])
    made.handle([samples(chunks[3])])
    made._tracks["whiskers"].until_ns = 1  # it is over
    look(made)
    made.handle([samples(chunks[4])])
    (path,) = files(tmp_path)
    same(path, chunks[2:4])
    assert [e["type"] for e in Recording(path).events()] == ["contact"]
    made.handle([event("warning")])  # a fault is a trigger, too
    made.close()
    assert len(files(tmp_path)) == 2


def test_stop_and_start_by_hand(daemon, tmp_path):
    made, chunks = begun(daemon, tmp_path, min_free_mb=0), cut_chunks(VALUES, 1000.0)
    made.handle([opened(), samples(chunks[0]), Control("stop"), samples(chunks[1])])
    look(made)
    assert made.details()["state"] == "off"
    made.handle([Control("start"), samples(chunks[2])])
    made.close()
    paths = files(tmp_path)
    assert [len(list(Recording(p))) for p in paths] == [1, 1]


def test_without_room_it_says_so_counts_and_goes_on_when_there_is(daemon, tmp_path, monkeypatch):
    made, chunks = begun(daemon, tmp_path, min_free_mb=100), cut_chunks(VALUES, 1000.0)
    free = [10e9]
    usage = type("usage", (), {"free": property(lambda _: free[0])})
    monkeypatch.setattr("tactile_rt.daemon.recordings_folder.shutil.disk_usage", lambda _: usage())
    made.handle([opened(), samples(chunks[0])])
    free[0] = 50e6
    look(made)
    made.handle([samples(chunks[1])])
    look(made)
    (full,) = (t for t in daemon.told if t[0] == "disk full")
    assert full[2] == "warning"
    assert made.details()["lost_samples"] == 9
    free[0] = 10e9
    look(made)
    made.handle([samples(chunks[2])])
    made.close()
    paths = sorted(files(tmp_path), key=lambda p: (p.stat().st_mtime_ns, p.name))
    assert [c.seq[0] for p in paths for c in Recording(p)] == [0, 18]


def test_what_a_killed_recorder_left_is_named_and_can_be_recovered(daemon, tmp_path):
    made, chunks = begun(daemon, tmp_path, min_free_mb=0), cut_chunks(VALUES, 1000.0)
    made.handle([opened(), *(samples(c) for c in chunks)])
    look(made)
    (path,) = files(tmp_path)
    kept = path.read_bytes()
    made.close()
    path.write_bytes(kept)  # as it was before its end
    begun(daemon, tmp_path, min_free_mb=0).close()
    ((_, reason, level),) = daemon.told
    assert path.name in reason
    assert "tactile-rt recover" in reason
    assert level == "warning"
    same(recover(path), chunks)


def test_what_one_left_who_was_killed_as_it_began_a_file_is_cleared_away(daemon, tmp_path):
    old, new, other = (tmp_path / n for n in (".a.1.mcap.part", ".b.2.mcap.part", ".c.part"))
    for path in (old, new, other):
        path.write_bytes(b"")
    for path in (old, other):
        os.utime(path, (1e9, 1e9))
    begun(daemon, tmp_path, min_free_mb=0).close()
    assert sorted(tmp_path.iterdir()) == [new, other]
    assert daemon.told == []


@pytest.mark.parametrize("mode", ["always", "trigger"])
def test_a_source_that_fails_before_its_first_sample_leaves_no_file(daemon, tmp_path, mode):
    made = begun(daemon, tmp_path, mode=mode)
    for _ in range(3):
        made.handle([opened()])
        made.handle([event("error"), Closed("whiskers", time.monotonic_ns())])
        look(made)
    assert not list(tmp_path.iterdir())
    assert (made.details()["files"], made.details()["lost_samples"]) == (0, 0)
    made.close()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("mode", ["always", "trigger"])
def test_what_was_told_before_the_first_sample_is_in_the_file(daemon, tmp_path, mode):
    made = begun(daemon, tmp_path, mode=mode)
    made.handle([opened(), event("warning"), event("error")])
    look(made)
    assert not list(tmp_path.iterdir())
    (chunk,) = cut_chunks(VALUES[:9], 1000.0)
    made.handle([samples(chunk)])
    made.close()
    (path,) = files(tmp_path)
    same(path, [chunk])
    assert [e["level"] for e in Recording(path).events()] == ["warning", "error"]


def test_a_device_that_sends_packets_and_no_sample_is_recorded(daemon, tmp_path):
    with FakeSerial(np.zeros((600, 2, 6))) as fake, open_source(fake.url) as source:
        made = begun(daemon, tmp_path)
        made.handle([opened(stream=source), Packet("whiskers", b"noise", time.monotonic_ns())])
        made.close()
    (path,) = files(tmp_path)
    assert [p for p, _ in Recording(path).packets()] == [b"noise"]
