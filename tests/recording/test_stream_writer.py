"""A stream is recorded while it runs, whatever disk and process do."""

import errno
import os
import threading
import time

import numpy as np
import pytest

from tactile_rt.core.errors import RecordingError
from tactile_rt.recording import Recording, StreamWriter, recover, writer
from tactile_rt.sources.opening import open_source
from tactile_rt.testing import ArraySource, FakeSerial, cut_chunks
from tests.helpers.processes import start_program
from tests.helpers.recordings import SPEC, all_parts, noise, parts, record_device
from tests.helpers.waiting import PATIENCE_S, until


def test_health_is_told_when_it_changes(path, tmp_path):
    fake = FakeSerial(noise(9000, (4, 6)), link=str(tmp_path / "whisker"))
    away = []

    def during(n):
        if n > 100 and not away:
            away.append(time.monotonic())
            fake.unplug()
        if away and not fake.endpoint.heard and time.monotonic() > away[0] + 0.3:
            fake.replug()
            away[0] = float("inf")

    record_device(fake, path, 400, during)
    told = list(Recording(path).health())
    states = [h["state"] for h in told]
    assert states[0] == "connecting"
    assert states[-1] == "closed"
    assert states.index("streaming") < states.index("lost")
    assert told[-1]["device"]["connections"] == 2
    assert told[-1]["stats"]["delivered"] >= 400
    assert told[-1]["recorder"]["samples"] >= 400
    assert sorted(told, key=lambda h: h["t_ns"]) == told


def test_a_tap_hears_what_came_before_it_but_not_what_was_read():
    with FakeSerial(noise(200, (4, 6))) as fake, open_source(fake.url) as source:
        heard, late = [], []
        source.tap(lambda packet, t_ns: heard.append(packet))
        assert heard[0] is None
        assert sum(map(len, heard[1:])) > 0
        before = len(heard)
        while len(heard) < before + 3:
            source.read(0.1)
        source.tap(lambda packet, t_ns: late.append(packet))
        assert not late
        source.tap(None)
        count = len(heard)
        source.read(0.1)
        assert len(heard) == count


class Slow:
    """A file whose disk takes nothing for a while, or no more than so many bytes."""

    def __init__(self, file, most=None):
        self.file, self.most, self.open = file, most, threading.Event()
        self.open.set()

    def write(self, data):
        assert self.open.wait(PATIENCE_S)
        if self.most is not None and self.file.tell() + len(data) > self.most:
            raise OSError(errno.ENOSPC, "No space left on device")
        return self.file.write(data)

    def __getattr__(self, name):
        return getattr(self.file, name)


@pytest.fixture
def disk(monkeypatch):
    made = []
    create = writer._create

    def slow(*arguments):
        made.append(Slow(create(*arguments)))
        return made[-1]

    monkeypatch.setattr(writer, "_create", slow)
    return made


def test_what_a_slow_disk_has_no_room_for_is_counted_and_told(path, disk, no_thread_left):
    chunks = cut_chunks(noise(3000), 1000.0, samples=10)
    source = ArraySource(SPEC, chunks, live=True)
    with StreamWriter(path, source, queue_bytes=20_000, flush_s=0.0) as recorder:
        disk[0].open.clear()
        began = time.monotonic()
        for chunk in chunks:
            recorder.push(chunk)
        assert time.monotonic() - began < 5  # a stuck disk holds nobody up
        assert recorder.stats.dropped_samples > 2000
        disk[0].open.set()
    stats, back = recorder.stats, list(Recording(path))
    assert sum(map(len, back)) == stats.samples
    assert stats.samples + stats.dropped_samples == 3000
    assert parts(back[-1]) == parts(chunks[-1])  # the oldest went
    told = list(Recording(path).health())[-1]["recorder"]
    assert told["dropped_samples"] == stats.dropped_samples
    kept = {parts(c) for c in chunks}
    assert all(parts(c) in kept for c in back)


def test_a_source_that_can_wait_waits_for_a_slow_disk(path, disk):
    chunks = cut_chunks(noise(3000), 1000.0, samples=10)
    with StreamWriter(path, ArraySource(SPEC, chunks), queue_bytes=20_000) as recorder:
        for chunk in chunks:
            recorder.push(chunk)
    assert recorder.stats.dropped_samples == 0
    assert all_parts(Recording(path)) == all_parts(chunks)


def test_a_full_disk_is_told_and_what_is_written_can_be_recovered(path, disk, no_thread_left):
    chunks = cut_chunks(noise(4000), 1000.0, samples=10)
    recorder = StreamWriter(path, ArraySource(SPEC, chunks, live=True), flush_s=0.0)
    disk[0].most = 40_000
    end = time.monotonic() + PATIENCE_S
    with pytest.raises(RecordingError, match=r"run.mcap cannot be written any more \(No space"):
        while time.monotonic() < end:
            for chunk in chunks:
                recorder.push(chunk)
                time.sleep(0.001)
    with pytest.raises(RecordingError, match="No space left"):
        recorder.close()
    recorder.close()
    back = list(Recording(recover(path)))
    assert 0 < len(back)
    assert all_parts(back) == all_parts(chunks[: len(back)])


def test_what_is_flushed_is_there_whatever_happens_next(path, tmp_path, disk, no_thread_left):
    chunks, now = cut_chunks(noise(300), 1000.0, samples=10), tmp_path / "now.mcap"
    recorder = StreamWriter(path, ArraySource(SPEC, chunks, live=True), flush_s=1e9)
    for k, chunk in enumerate(chunks):
        recorder.push(chunk)
        if k % 10 == 9:
            recorder.flush()
            now.write_bytes(path.read_bytes())  # what a kill would leave
            assert all_parts(Recording(recover(now, force=True))) == all_parts(chunks[: k + 1])
    disk[0].most = 0
    recorder.push(chunks[0])
    with pytest.raises(RecordingError, match="No space left"):
        recorder.flush()
    with pytest.raises(RecordingError):
        recorder.close()


def test_what_is_recorded_is_on_the_medium_soon_and_a_slow_one_is_not_waited_for(
    path, monkeypatch, no_thread_left
):
    shut, begun, real = threading.Event(), threading.Event(), os.fdatasync
    synced = []

    def slow(handle):
        begun.set()
        assert shut.wait(PATIENCE_S)
        real(handle)
        synced.append(os.fstat(handle).st_size)

    monkeypatch.setattr(os, "fdatasync", slow)
    chunks = cut_chunks(noise(300), 1000.0, samples=10)
    with StreamWriter(path, ArraySource(SPEC, chunks, live=True), sync_s=0.01) as recorder:
        for chunk in chunks[:20]:
            recorder.push(chunk)
        assert begun.wait(PATIENCE_S)
        recorder.flush()  # which the system takes meanwhile
        assert recorder.stats.samples == 200
        shut.set()
        until(lambda: len(synced) > 1)
        for chunk in chunks[20:]:
            recorder.push(chunk)
    assert synced[-1] == path.stat().st_size
    assert all_parts(Recording(path)) == all_parts(chunks)


def test_a_medium_that_fails_is_told_at_the_end_too(path, monkeypatch, no_thread_left):
    def fail(handle):
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", fail)
    recorder = StreamWriter(path, ArraySource(SPEC, []), sync_s=0)
    with pytest.raises(RecordingError, match="Input/output error"):
        recorder.close()


def test_a_file_that_is_deleted_is_told(path, no_thread_left):
    recorder = StreamWriter(path, ArraySource(SPEC, []))
    path.unlink()
    with pytest.raises(RecordingError, match="deleted while it was written"):
        recorder.flush()
    with pytest.raises(RecordingError, match="deleted"):
        recorder.close()


PROGRAM = """
import sys
from tactile_rt.sources.opening import open_source
from tactile_rt.recording import StreamWriter
with open_source("synthetic:4x6") as source, StreamWriter(sys.argv[1], source) as recorder:
    for chunk in source:
        recorder.push(chunk)
        print(chunk.seq[-1], flush=True)
"""


@pytest.mark.parametrize("seconds", np.random.default_rng(5).uniform(0, 1.6, 4).round(3))
def test_of_a_killed_recorder_all_but_the_last_second_is_recovered(seconds, path):
    with start_program(path, program=PROGRAM, stderr=None) as process:
        process.stdout.readline()
        time.sleep(seconds)
        process.kill()
        last = int((process.stdout.read().splitlines() or ["0"])[-1].split()[0])
    with pytest.raises(RecordingError, match="cut short"):
        list(Recording(path))
    back = recover(path)
    assert back.name == "run.recovered.mcap"
    chunks = list(Recording(back))
    seq = np.concatenate([[-1], *(c.seq for c in chunks)])
    assert np.array_equal(seq, np.arange(-1, len(seq) - 1))
    assert seq[-1] >= last - 1000  # at 1 kHz
    assert Recording(back).description.recovered
