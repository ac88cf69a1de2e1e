import fcntl
import os
import resource
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.sim_backend.datasets.journal import Journal, SweepRecord, remove_leftovers


def record(k: int) -> SweepRecord:
    rng = np.random.default_rng(k)
    values = rng.normal(size=(5, 3, 2)).astype(np.float32)
    return SweepRecord(values, {"yaw_deg": rng.uniform(), "touches": 1.0})


def fill(folder: Path, indices: list[int]) -> None:
    with Journal(folder, "mug-0") as journal:
        for k in indices:
            journal.append(k, record(k))


def same(a: SweepRecord, b: SweepRecord) -> bool:
    return a.parameters == b.parameters and a.values.tobytes() == b.values.tobytes()


def read(folder: Path) -> dict[int, SweepRecord]:
    with Journal(folder, "mug-0") as journal:
        return dict(journal.records)


def test_what_was_appended_is_there_at_the_next_opening(tmp_path: Path) -> None:
    assert read(tmp_path) == {}
    fill(tmp_path, [0, 2])
    fill(tmp_path, [1])
    found = read(tmp_path)
    assert list(found) == [0, 2, 1]
    assert all(same(found[k], record(k)) for k in found)


def test_a_sweep_is_on_its_way_to_the_disk_before_append_returns(tmp_path: Path) -> None:
    with Journal(tmp_path, "mug-0") as journal:
        journal.append(0, record(0))
        copy = tmp_path / "bowl-0.part"
        copy.write_bytes(journal.path.read_bytes())  # what a kill at this moment leaves
    with Journal(tmp_path, "bowl-0") as journal:
        assert same(journal.records[0], record(0))


def test_a_journal_cut_anywhere_keeps_its_whole_records(tmp_path: Path) -> None:
    fill(tmp_path, [0, 1, 2])
    path = tmp_path / "mug-0.part"
    whole = path.read_bytes()
    size = len(whole) // 3
    for cut in range(0, len(whole) + 1, 7):
        path.write_bytes(whole[:cut])
        assert list(read(tmp_path)) == list(range(cut // size))
        assert path.stat().st_size == cut // size * size, "the torn tail is cut off"
        fill(tmp_path, [7])
        assert list(read(tmp_path)) == [*range(cut // size), 7]


def test_a_full_disk_is_told_with_the_name_of_the_journal(tmp_path: Path) -> None:
    fill(tmp_path, [0])
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, ((tmp_path / "mug-0.part").stat().st_size, before[1]))
    try:
        with pytest.raises(OSError, match="File too large") as failed:
            fill(tmp_path, [1])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert failed.value.filename == str(tmp_path / "mug-0.part")
    assert list(read(tmp_path)) == [0]


@given(st.integers(0, 10_000), st.integers(1, 255))
def test_no_flipped_byte_is_read_as_another_sweep(tmp_path_factory, at: int, mask: int) -> None:
    folder = tmp_path_factory.mktemp("flipped")
    fill(folder, [0, 1, 2])
    path = folder / "mug-0.part"
    content = bytearray(path.read_bytes())
    at %= len(content)
    content[at] ^= mask
    path.write_bytes(content)
    found = read(folder)
    assert all(same(found[k], record(k)) for k in found)
    assert list(found) == list(range(at * 3 // len(content)))


@pytest.mark.parametrize("tail", [b"\0" * 12, b"\0" * 4096, b"\xff" * 100])
def test_what_a_crash_of_the_machine_may_leave_is_dropped(tmp_path: Path, tail: bytes) -> None:
    fill(tmp_path, [0])
    with (tmp_path / "mug-0.part").open("ab") as file:
        file.write(tail)
    assert list(read(tmp_path)) == [0]


def test_a_second_writer_waits_for_the_first(tmp_path: Path) -> None:
    order = []

    def second() -> None:
        with Journal(tmp_path, "mug-0") as journal:
            order.append(("second", list(journal.records)))

    with Journal(tmp_path, "mug-0") as journal:
        thread = threading.Thread(target=second)
        thread.start()
        while not waiting_for_lock(os.getpid()):
            time.sleep(0.01)
        journal.append(0, record(0))
        order.append(("first", [0]))
    thread.join()
    assert order == [("first", [0]), ("second", [0])]


def waiting_for_lock(process: int) -> bool:
    """Whether the kernel lists a blocked flock of this process."""
    waiting = [line for line in Path("/proc/locks").read_text().splitlines() if "->" in line]
    return any("FLOCK" in line and f" {process} " in line for line in waiting)


def test_leftovers_are_removed_unless_someone_is_at_them(tmp_path: Path) -> None:
    idle, live, stale, fresh = (
        tmp_path / name
        for name in (".mug-0.npz.ab12", ".bowl-0.npz.cd34", ".manifest.json.ef", ".SHA256SUMS.gh")
    )
    kept = [tmp_path / name for name in ("mug-1.npz", "bowl-0.part", "mug-0.part", ".hidden")]
    for path in (idle, live, stale, fresh, *kept):
        path.touch()
    os.utime(stale, (0, 0))
    with (tmp_path / "bowl-0.part").open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        remove_leftovers(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {p.name for p in (live, fresh, *kept)}
    remove_leftovers(tmp_path)
    assert not live.exists()
