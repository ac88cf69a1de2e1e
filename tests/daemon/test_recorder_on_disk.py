"""What the recorder says is on the disk, whatever disk and folder do; all losses are in it."""

import errno
import os
import resource
import shutil
import socket
import tempfile
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tactile_rt.daemon import recordings_folder
from tactile_rt.daemon.items import Closed, Contact, Control
from tactile_rt.daemon.recordings_folder import RecordingsFolder
from tactile_rt.recording import Recording, recover
from tactile_rt.testing import cut_chunks
from tests.helpers.recorder_by_hand import SPEC, UTC, View, begun, files, look, opened, samples
from tests.helpers.waiting import PATIENCE_S, until

VALUES = np.random.default_rng(0).normal(size=(400, *SPEC.shape)).astype(np.float32)
CHUNKS = cut_chunks(VALUES, 1000.0, samples=10)
NOBODY = 65534


@pytest.fixture
def daemon():
    return View()


@pytest.fixture
def unprivileged():
    """A folder of somebody whom permissions hold, which they do not the superuser."""
    me, folder = os.geteuid(), Path(tempfile.mkdtemp())
    try:
        if me == 0:
            os.chown(folder, NOBODY, -1)
            os.seteuid(NOBODY)
        if not os.access(folder, os.W_OK | os.X_OK, effective_ids=True):
            pytest.skip(f"nobody may not come to {folder}")
        yield folder
    finally:
        os.seteuid(me)
        os.chmod(folder, 0o700)
        shutil.rmtree(folder)


@pytest.fixture
def medium(monkeypatch):
    """Syncs that take as long as it is shut, or fail."""

    class Medium:
        def __init__(self):
            self.open, self.error, self.begun, self.together = threading.Event(), None, 0, 0
            self.most = 0
            self.open.set()

        def sync(self, handle):
            self.begun += 1
            self.together += 1
            self.most = max(self.most, self.together)
            assert self.open.wait(PATIENCE_S)
            self.together -= 1
            if self.error is not None:
                raise self.error
            real(handle)

    made, real = Medium(), os.fdatasync
    monkeypatch.setattr(os, "fdatasync", made.sync)
    return made


def on_disk(made, name="whiskers"):
    return made.on_disk()[name]


def seqs(folder):
    """The numbers of the samples that can be had from all files, recovered if need be."""
    found = []
    for path in files(folder):
        found += [int(n) for c in Recording(recover(path)) for n in c.seq]
    return sorted(found)


def test_what_is_synced_outlives_a_power_cut_and_is_told(daemon, tmp_path):
    made = begun(daemon, tmp_path, min_free_mb=0, sync_s=1e-6)
    assert made.on_disk() == {}
    made.handle([opened()])
    at = time.monotonic_ns()
    made.handle([samples(CHUNKS[0], at=at)])
    until(lambda: on_disk(made).synced_ns == at)
    now = on_disk(made)
    assert (now.samples, now.written_ns, now.lost_samples) == (10, at, 0)
    assert (now.open, now.meant_ns > 0) == (True, True)
    made.handle([Closed("whiskers", 0)])
    assert not on_disk(made).meant_ns
    made.close()
    assert (on_disk(made).samples, on_disk(made).open, on_disk(made).synced_ns) == (10, False, at)


def test_a_medium_that_is_slow_holds_up_nothing(daemon, tmp_path, medium):
    made = begun(daemon, tmp_path, min_free_mb=0, sync_s=1e-6, rotate_s=1e-3)
    made.handle([opened()])
    until(lambda: medium.together == 0)
    before, at = on_disk(made).synced_ns, 0
    medium.open.clear()
    for k, chunk in enumerate(CHUNKS):
        at = time.monotonic_ns()
        made.handle([samples(chunk, at=at)])
        if k == 20:
            until(lambda: medium.together == 1)
    look(made)
    now = on_disk(made)
    assert (now.samples, now.written_ns, now.lost_samples) == (400, at, 0)
    assert now.synced_ns < now.written_ns
    assert now.synced_ns >= before
    assert len(files(tmp_path)) > 1  # rotating did not wait for it either
    medium.open.set()
    until(lambda: (look(made), on_disk(made).synced_ns == at)[1])
    made.close()
    assert medium.most == 1  # never two at a time
    assert seqs(tmp_path) == list(range(400))


def test_since_when_something_waits_for_the_medium_is_known(daemon, tmp_path, medium):
    made = begun(daemon, tmp_path, min_free_mb=0, sync_s=1e-6)
    made.handle([opened(), samples(CHUNKS[0], at=time.monotonic_ns() - 60 * 10**9)])
    until(lambda: (look(made), on_disk(made).waits_ns == 0)[1])
    medium.open.clear()
    at = time.monotonic_ns()
    made.handle([samples(CHUNKS[1])])  # a minute after the last one
    look(made)
    until(lambda: medium.together == 1)
    # Since about then, or since a sync of the first that had begun just before.
    until(lambda: at - 30 * 10**9 < on_disk(made).waits_ns < time.monotonic_ns())
    assert on_disk(made).slow_s == pytest.approx(2.0, abs=0.01)
    medium.open.set()
    until(lambda: (look(made), on_disk(made).waits_ns == 0)[1])
    made.close()
    assert on_disk(made).waits_ns == 0


def test_without_syncs_the_file_is_synced_at_its_end_alone(daemon, tmp_path, medium):
    made = begun(daemon, tmp_path, min_free_mb=0, sync_s=0)
    at = time.monotonic_ns()
    made.handle([opened(), samples(CHUNKS[0], at=at)])
    look(made)
    assert (on_disk(made).written_ns, on_disk(made).synced_ns, medium.begun) == (at, 0, 0)
    made.close()
    assert (on_disk(made).synced_ns, medium.begun) == (at, 1)


@pytest.mark.parametrize("closed", [False, True])
def test_what_a_sync_that_failed_may_have_lost_is_counted(closed, daemon, tmp_path, medium):
    made = begun(daemon, tmp_path, min_free_mb=0, sync_s=1e-6)
    at = time.monotonic_ns()
    made.handle([opened(), samples(CHUNKS[0], at=at)])
    until(lambda: on_disk(made).synced_ns == at)
    medium.error = OSError(errno.EIO, "Input/output error")
    made.handle([samples(CHUNKS[1]), samples(CHUNKS[2])])
    if closed:
        made.handle([Control("stop")])
    until(lambda: (look(made), on_disk(made).lost_samples)[1])
    now = on_disk(made)
    assert (now.samples, now.lost_samples, now.synced_ns, now.written_ns) == (10, 20, at, at)
    assert "Input/output error" in now.lost_why
    assert at < now.lost_ns <= time.monotonic_ns()
    assert "Input/output error" in daemon.told[-1][1]
    medium.error = None
    if not closed:
        until(lambda: (look(made), on_disk(made).open)[1])
        later = time.monotonic_ns()
        made.handle([samples(CHUNKS[3], at=later)])
        until(lambda: (look(made), on_disk(made).synced_ns == later)[1])
        assert on_disk(made).samples == 20
    made.close()
    assert made.details()["lost_samples"] == 20


def test_what_no_file_could_grow_by_is_counted_and_told_once(daemon, tmp_path):
    made = begun(daemon, tmp_path, min_free_mb=0)
    made.handle([opened(), *(samples(c) for c in CHUNKS[:10])])
    look(made)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    (path,) = files(tmp_path)
    resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size, hard))
    try:
        for _ in range(20):
            made.handle([samples(c) for c in CHUNKS[10:30]])
            look(made)
            assert on_disk(made).lost_why == f"{tmp_path}: File too large"
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (on_disk(made).samples, on_disk(made).lost_samples, len(daemon.told)) == (100, 4000, 1)
    assert len(files(tmp_path)) <= 3  # with pauses
    until(lambda: (look(made), on_disk(made).open)[1])
    made.handle([samples(c) for c in CHUNKS[30:]])
    made.close()
    assert seqs(tmp_path) == [*range(100), *range(300, 400)]


def test_when_the_disk_will_be_full_is_foreseen(tmp_path, monkeypatch):
    now = [1000.0]
    monkeypatch.setattr(recordings_folder, "time", SimpleNamespace(monotonic=lambda: now[0]))
    free_mb = shutil.disk_usage(tmp_path).free / 1e6
    folder = RecordingsFolder(tmp_path, free_mb - 900.0, lambda job: None, lambda *told: None)
    folder.has_room()
    said = {}
    for n in range(40):
        now[0] += 5.0
        said[n] = folder.foresee(0.1 * n if n < 20 else 2.0 + 1.0 * (n - 20))
    assert not said[10] and "within 24 h" in said[19]  # 900 MB at 72 MB/h
    assert "within 3 h" in said[39]


def test_no_descriptor_left_ends_no_file(daemon, tmp_path):
    made = begun(daemon, tmp_path, min_free_mb=0, sync_s=1e-6)
    made.handle([opened(), samples(CHUNKS[0])])
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        for chunk in CHUNKS[1:]:
            made.handle([samples(chunk)])
            look(made)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    until(lambda: (look(made), on_disk(made).waits_ns == 0)[1])
    made.close()
    assert (len(files(tmp_path)), daemon.told) == (1, [])
    assert (on_disk(made).samples, on_disk(made).lost_samples) == (400, 0)


def test_who_is_stopped_or_waits_for_a_trigger_is_not_meant_to_record(daemon, tmp_path):
    made = begun(daemon, tmp_path, min_free_mb=0, mode="trigger")
    made.handle([opened(), samples(CHUNKS[0])])
    assert not on_disk(made).meant_ns
    made.handle([Control("trigger")])
    assert (on_disk(made).meant_ns > 0, on_disk(made).open) == (True, True)
    made.handle([Control("stop"), samples(CHUNKS[1])])
    assert (on_disk(made).meant_ns > 0, on_disk(made).lost_samples) == (False, 0)
    made.close()


def test_a_trigger_outlives_the_next_file_and_the_want_of_one(daemon, tmp_path):
    made = begun(daemon, tmp_path / "a", min_free_mb=0, mode="trigger", after_s=600)
    made.handle([opened(), samples(CHUNKS[0])])
    made.handle([Contact("whiskers", "best", "mount", True, time.monotonic_ns(), UTC)])
    made.handle([Control("rotate"), samples(CHUNKS[1])])
    made._tracks["whiskers"].until_ns = 1
    look(made)
    assert not on_disk(made).open  # also the next file ends with its trigger
    shutil.rmtree(tmp_path / "a")
    (tmp_path / "a").write_text("in the way")
    made.handle([Control("trigger"), samples(CHUNKS[2])])
    look(made)
    assert (on_disk(made).open, on_disk(made).meant_ns > 0) == (False, True)
    made._tracks["whiskers"].until_ns = 1
    look(made)
    assert (on_disk(made).lost_samples, on_disk(made).meant_ns > 0) == (10, False)
    made.close()


def test_a_folder_that_is_deleted_is_made_again_and_what_it_took_is_counted(daemon, tmp_path):
    folder = tmp_path / "rec"
    made = begun(daemon, folder, min_free_mb=0, sync_s=1e-6)
    made.handle([opened(), *(samples(c) for c in CHUNKS[:10])])
    until(lambda: on_disk(made).synced_ns)
    shutil.rmtree(folder)
    made.handle([samples(c) for c in CHUNKS[10:20]])
    now = on_disk(made)
    assert (now.samples, now.lost_samples, now.written_ns, now.open) == (0, 200, 0, True)
    assert "was deleted" in now.lost_why
    assert "200 samples are lost" in daemon.told[-1][1]
    made.handle([samples(c) for c in CHUNKS[20:]])
    made.close()
    assert seqs(folder) == list(range(200, 400))
    assert (on_disk(made).samples, on_disk(made).lost_samples) == (200, 200)


@pytest.mark.parametrize("left_bytes", [None, 0, 300])  # deleted; as `copytruncate` leaves it
def test_one_file_that_is_deleted_or_emptied_is_not_written_on(left_bytes, daemon, tmp_path):
    made = begun(daemon, tmp_path, min_free_mb=0)
    made.handle([opened("left"), opened("right")])
    made.handle([samples(CHUNKS[0], "left"), samples(CHUNKS[0], "right")])
    look(made)
    path = next(p for p in files(tmp_path) if p.name.startswith("left"))
    path.unlink() if left_bytes is None else os.truncate(path, left_bytes)
    made.handle([samples(c, "left") for c in CHUNKS[1:21]])
    made._tracks["left"].file.flush()  # a chunk that was full before anybody looked
    look(made)
    if left_bytes is not None:
        path.unlink()
    made.handle([samples(CHUNKS[21], "left"), samples(CHUNKS[1], "right")])
    made.close()
    assert seqs(tmp_path) == sorted([*range(210, 220), *range(20)])
    assert on_disk(made, "left").lost_samples == 210
    assert on_disk(made, "right").lost_samples == 0
    assert "210 samples are lost" in daemon.told[0][1]


def test_what_was_moved_is_whole_where_it_is_and_nothing_is_lost(daemon, tmp_path):
    folder, other = tmp_path / "rec", tmp_path / "other"
    made = begun(daemon, folder, min_free_mb=0)
    made.handle([opened(), samples(CHUNKS[0])])
    folder.rename(other)
    look(made)
    made.handle([samples(CHUNKS[1])])
    made.close()
    assert [list(c.seq) for p in files(other) for c in Recording(p)] == [list(range(10))]
    assert [list(c.seq) for p in files(folder) for c in Recording(p)] == [list(range(10, 20))]
    assert (on_disk(made).samples, on_disk(made).lost_samples) == (20, 0)


def test_a_folder_that_may_not_be_written_is_told_once_counted_and_tried_again(
    daemon, unprivileged
):
    folder = unprivileged / "rec"
    made = begun(daemon, folder, min_free_mb=0)
    made.handle([opened(), samples(CHUNKS[0])])
    folder.chmod(0o500)
    made.handle([Control("rotate")])
    for chunk in CHUNKS[1:4]:
        made.handle([samples(chunk)])
        look(made)
    now = on_disk(made)
    assert (now.samples, now.lost_samples, now.open, now.meant_ns > 0) == (10, 30, False, True)
    assert "Permission denied" in now.lost_why
    assert len(daemon.told) == 1
    folder.chmod(0o700)
    look(made)
    made.handle([samples(CHUNKS[4])])
    made.close()
    assert seqs(folder) == [*range(10), *range(40, 50)]


def test_what_cannot_be_made_anew_is_told_and_awaited(daemon, unprivileged):
    folder = unprivileged / "rec"
    made = begun(daemon, folder, min_free_mb=0)
    made.handle([opened(), samples(CHUNKS[0])])
    shutil.rmtree(folder)
    unprivileged.chmod(0o500)
    look(made)
    made.handle([samples(CHUNKS[1])])
    assert made.details()["state"] == "no folder"
    assert on_disk(made).lost_samples == 20
    unprivileged.chmod(0o700)
    look(made)
    made.handle([samples(CHUNKS[2])])
    made.close()
    assert seqs(folder) == list(range(20, 30))
    assert on_disk(made).lost_samples == 20


def test_what_is_no_file_is_not_waited_for(daemon, tmp_path):
    os.mkfifo(tmp_path / "a.mcap")
    os.mkfifo(tmp_path / ".b.12345678.mcap.part")
    (tmp_path / "link.mcap").symlink_to(tmp_path / "a.mcap")
    (tmp_path / "tty.mcap").symlink_to("/dev/tty")
    (tmp_path / "folder.mcap").mkdir()
    with socket.socket(socket.AF_UNIX) as line:
        line.bind(str(tmp_path / "socket.mcap"))
        made = begun(daemon, tmp_path, min_free_mb=0)
        made.close()
    assert daemon.told == []
