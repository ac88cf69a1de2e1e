"""The power fails while the daemon's process records; how much is lost, `bench daemon` measures."""

import os

import numpy as np
import pytest

from tests.helpers.waiting import until

power = pytest.importorskip("bench.daemon.power")
kills = pytest.importorskip("bench.daemon.kills")


@pytest.fixture
def library(tmp_path):
    made = power.preloaded(tmp_path)
    if made is None:
        pytest.skip("no C compiler")
    return made


def journal(folder, *lines):
    path = folder / "journal"
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def test_a_disk_keeps_what_was_synced_and_perhaps_more(tmp_path):
    folder = tmp_path / "recordings"
    folder.mkdir()
    names = [folder / n for n in ("a", "b")]
    data = np.random.default_rng(0).integers(1, 256, 20_000, np.uint8).tobytes()
    inodes = []
    for name in names:
        name.write_bytes(data)
        inodes.append(name.stat().st_ino)
    a, b = inodes
    noted = journal(
        tmp_path, f"n {folder.stat().st_ino} {folder}", f"n {a} {names[0]}", f"w {a} 0 9000",
        f"s {a}", f"w {a} 9000 15000", f"S {a}", "d", f"n {b} {names[1]}", f"w {b} 0 20000", "D",
        f"s {b}", f"w {a} 15000 20000", f"s {a}",
    )  # fmt: skip
    found = []
    for seed in range(100):
        after = tmp_path / str(seed)
        after.mkdir()
        left = power._left(noted, folder, after, np.random.default_rng(seed))
        kept = (after / "a").read_bytes()
        assert left[after / "a"] == 9000  # what was written after the sync began is not promised
        assert kept[:9000] == data[:9000]
        assert all(x in (0, y) for x, y in zip(kept, data, strict=False))
        found.append((len(kept), 0 in kept, (after / "b").exists()))
    for k in range(3):  # the disks are of all kinds
        assert len({f[k] for f in found}) > 1


@pytest.mark.parametrize("rotate_s", [0, 1])
def test_after_a_power_cut_what_was_synced_is_recovered(rotate_s, library, tmp_path):
    folder, noted = tmp_path / "recordings", tmp_path / "journal"
    bare = []

    def moment(daemon):
        """Samples that came, and after that three syncs that began and ended."""

        def recorder():
            return next(c for c in daemon.state()["consumers"] if c["kind"] == "recorder")

        until(lambda: recorder()["queue"]["taken"]["samples"] > 700)
        before = noted.read_text().count("\nS ")
        until(lambda: noted.read_text().count("\nS ") > before + 3)

    def left(recordings):
        after = tmp_path / "after"
        after.mkdir()
        draw = np.random.default_rng(1)
        for path, safe in power._left(noted, recordings, after, draw).items():
            bare.append(safe == 0 and power._is_bare(path))
        return after

    environment = {
        "LD_PRELOAD": str(library), "POWER_FOLDER": str(folder), "POWER_JOURNAL": str(noted),
    }  # fmt: skip
    killed = kills.killed_once(tmp_path, moment, rotate_s, environment, left)
    assert (killed.unreadable, killed.wrong) == (0, 0)
    assert killed.samples > 700


@pytest.mark.skipif(os.geteuid() != 0, reason="only the superuser may mount")
def test_after_a_power_cut_of_a_real_file_system_what_was_synced_is_recovered(tmp_path):
    if not power.can_mount():
        pytest.skip("no ext4 file system can be made or mounted here")
    killed, _ = power._shut_down(tmp_path, 3.0, 1, 0)
    assert (killed.unreadable, killed.wrong) == (0, 0)
    assert killed.samples > 0
