"""The power fails while the daemon records: what a disk may keep of it, and who can read that.

Two disks:

    made up    a library that is preloaded notes every write, name and sync (`power.c`); of what was
               not synced when the daemon was killed, any page, sector and name is there or is not
    ext4       a file system of its own, shut down by the kernel as if the power had failed, and
               mounted anew; for who may mount
"""

import fcntl
import os
import shutil
import subprocess
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from bench.daemon.kills import Killed, killed_once
from bench.daemon.process import DaemonProcess
from tactile_rt.core.errors import RecordingError
from tactile_rt.models.evaluation.records import Record
from tactile_rt.recording import recover

QUICK, WHOLE = 3, 50
LONGEST_S = 4.0  # from the first sample to the cut
LOST_S = 1.5
SLOW_MS, SLOWEST_MS = 100, 3000  # that a sync takes
SLOW_S = 12.0
SECTOR, PAGE = 512, 4096
IMAGE_BYTES = 256 << 20
SHUTDOWN, NO_FLUSH = 0x8004587D, b"\x02\0\0\0"  # FS_IOC_SHUTDOWN, as if the power had failed


def power_cuts(quick: bool) -> list[Record]:
    """Daemons that record 30 x 6 at 1 kHz; the power fails at random."""
    times = QUICK if quick else WHOLE
    records = []
    with tempfile.TemporaryDirectory() as folder:
        library = preloaded(Path(folder))
        if library is not None:
            found, bare = _each(times, Path(folder) / "made-up", partial(power_noted, library))
            how = f"any page and name that is not synced; every third one's syncs take {SLOW_MS} ms"
            records += _records("power", found, bare, how)
            records.append(_slow_medium(library, Path(folder)))
        if can_mount():
            found, bare = _each(times, Path(folder) / "ext4", _shut_down)
            records += _records("power_ext4", found, bare, "FS_IOC_SHUTDOWN, mounted anew")
    return records


def _each(
    times: int, folder: Path, cut: Callable[[Path, float, float, int], tuple[Killed, int]]
) -> tuple[list[Killed], int]:
    draw, found, bare = np.random.default_rng(2), [], 0
    for k in range(times):
        each = folder / str(k)
        each.mkdir(parents=True)
        killed, begun = cut(each, draw.uniform(0, LONGEST_S), k % 2, k)
        found.append(killed)
        bare += begun
    return found, bare


def _records(what: str, found: list[Killed], bare: int, how: str) -> list[Record]:
    lost = np.array([k.lost_s for k in found])
    files, samples = sum(k.files for k in found), sum(k.samples for k in found)
    return [
        Record(
            f"daemon.{what}.lost", float(lost.max()), "s", f"<= {LOST_S:g}",
            f"median {np.median(lost):.2f}; age of the first sample that is lost, at the cut",
            f"{len(found)} power cuts, {how}; every other daemon rotates every second",
        ),
        Record(
            f"daemon.{what}.unreadable", sum(k.unreadable for k in found), "files", "== 0",
            f"of {files}, {sum(k.cut for k in found)} of which had no end: read by mcap.reader; "
            f"{bare} more had been begun just then, with nothing in them",
            "after `tactile-rt recover`",
        ),
        Record(
            f"daemon.{what}.wrong", sum(k.wrong for k in found), "samples", "== 0",
            f"of {samples}: not as the device sent them, or not as their packets decode again", how,
        ),
    ]  # fmt: skip


def _wait(seconds: float, daemon: DaemonProcess) -> None:
    time.sleep(seconds)


# a disk that is made up


def preloaded(folder: Path) -> Path | None:
    """The library, compiled; None where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    library, text = folder / "power.so", Path(__file__).with_suffix(".c")
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(text), "-ldl"], check=True
    )
    return library


def power_noted(
    library: Path, folder: Path, wait_s: float, rotate_s: float, seed: int
) -> tuple[Killed, int]:
    """(what is left of one daemon's recording, files that had been begun just then)."""
    journal, bare = folder / "journal", 0

    def left(recordings: Path) -> Path:
        nonlocal bare
        after = folder / "after"
        after.mkdir()
        draw = np.random.default_rng(seed)
        for path, safe in _left(journal, recordings, after, draw).items():
            bare += safe == 0 and _is_bare(path)
        return after

    environment = {
        "LD_PRELOAD": str(library), "POWER_FOLDER": str(folder / "recordings"),
        "POWER_JOURNAL": str(journal), "POWER_SLOW_MS": str(SLOW_MS if seed % 3 == 2 else 0),
    }  # fmt: skip
    killed = killed_once(folder, partial(_wait, wait_s), rotate_s, environment, left)
    return killed, bare


@dataclass
class _Disk:
    """What was done to the files.

    Attributes:
        names: What was done to names, in order: whether one was added, inode, path.
        kept: Number of these that are on the disk.
        written: Size of each inode, bytes.
        safe: Part of it that is on the disk, bytes.
    """

    names: list[tuple[bool, int, str]] = field(default_factory=list)
    kept: int = 0
    written: dict[int, int] = field(default_factory=lambda: defaultdict(int))
    safe: dict[int, int] = field(default_factory=lambda: defaultdict(int))


def _read(journal: Path) -> _Disk:
    disk, pending, names = _Disk(), dict[int, int](), 0
    for line in journal.read_text().splitlines():
        kind, *rest = line.split(" ", 2)
        inode = int(rest[0]) if rest else 0
        if kind == "w":
            begin, end = map(int, rest[1].split())
            if begin != disk.written[inode]:
                raise ValueError(f"{journal}: only what is appended is understood: {line}")
            disk.written[inode] = end
        elif kind == "s":
            pending[inode] = disk.written[inode]
        elif kind == "S":
            disk.safe[inode] = pending[inode]
        elif kind == "d":
            names = len(disk.names)
        elif kind == "D":
            disk.kept = names
        else:
            disk.names.append((kind == "n", inode, rest[1]))
    return disk


def _left(journal: Path, folder: Path, after: Path, draw: np.random.Generator) -> dict[Path, int]:
    """Write what a disk may keep: {file: bytes of it that were synced}."""
    disk = _read(journal)
    contents = {p.stat().st_ino: p.read_bytes() for p in folder.iterdir()}
    share = draw.choice([0.0, 0.5, 1.0])
    there: dict[str, int] = {}
    for k, (added, inode, path) in enumerate(disk.names):
        if k < disk.kept or draw.random() < share:
            if added:
                there[path] = inode
            else:
                there.pop(path, None)
    if str(folder) not in there:
        return {}
    left = {}
    for path, inode in there.items():
        if inode not in contents:  # the folder
            continue
        data, safe = contents[inode][: disk.written[inode]], disk.safe[inode]
        left[after / Path(path).name] = safe
        (after / Path(path).name).write_bytes(_torn(data, safe, draw))
    return left


def _torn(data: bytes, safe: int, draw: np.random.Generator) -> bytes:
    """What was synced, and any pages and parts of pages of the rest; zeros for the others."""
    ends = safe, len(data), int(draw.integers(safe, len(data) + 1))
    end = ends[draw.integers(3)]
    made, share = bytearray(end), draw.choice([0.0, 0.5, 0.9, 1.0])
    for at in range(0, end, PAGE):
        if draw.random() < share:
            size = PAGE if draw.random() < 0.8 else SECTOR * int(draw.integers(PAGE // SECTOR))
            made[at : min(at + size, end)] = data[at : min(at + size, end)]
    made[:safe] = data[:safe]
    return bytes(made)


def _is_bare(path: Path) -> bool:
    """Whether there is nothing whole in it, not even what it is of; it is taken away then."""
    try:
        recover(path, path.with_suffix(".tried"))
    except RecordingError:
        path.unlink()
        return path.suffix == ".mcap"
    path.with_suffix(".tried").unlink()
    return False


def _slow_medium(library: Path, folder: Path) -> Record:
    """A memory card that takes 3 s for each sync."""
    (folder / "slow").mkdir()
    environment = {
        "LD_PRELOAD": str(library), "POWER_FOLDER": str(folder / "slow" / "recordings"),
        "POWER_JOURNAL": str(folder / "slow" / "journal"), "POWER_SLOW_MS": str(SLOWEST_MS),
    }  # fmt: skip
    seen: list[dict[str, Any]] = []

    def moment(daemon: DaemonProcess) -> None:
        time.sleep(SLOW_S)
        seen.extend(c for c in daemon.state()["consumers"] if c["kind"] == "recorder")

    killed = killed_once(folder / "slow", moment, 1, environment)
    queue, details = seen[0]["queue"], seen[0]["details"]
    dropped = sum(queue["dropped"].values()) + details["lost_samples"]
    return Record(
        "daemon.power.slow_medium_dropped", dropped, "samples", "== 0",
        f"of {queue['taken']['samples']}, all that there are, and packets; of what the system had, "
        f"a kill took {killed.lost_s:.2f} s",
        f"a sync takes {SLOWEST_MS / 1000:g} s; 30 x 6 at 1 kHz, rotating every second",
    )  # fmt: skip


# a file system of its own


def can_mount() -> bool:
    """Whether this process may mount a file system that is in a file."""
    with tempfile.TemporaryDirectory() as folder, suppress(OSError, subprocess.SubprocessError):
        where = Path(folder) / "recordings"
        where.mkdir()
        _mount(_image(Path(folder)), where)
        subprocess.run(["umount", str(where)], check=True, capture_output=True)
        return True
    return False


def _shut_down(folder: Path, wait_s: float, rotate_s: float, seed: int) -> tuple[Killed, int]:
    where, image = folder / "recordings", _image(folder)
    where.mkdir()
    _mount(image, where)
    bare = 0

    def cut(daemon: DaemonProcess) -> None:
        handle = os.open(where, os.O_RDONLY)
        try:
            time.sleep(wait_s)
            fcntl.ioctl(handle, SHUTDOWN, NO_FLUSH)
        finally:
            os.close(handle)

    def left(recordings: Path) -> Path:
        nonlocal bare
        _unmount(where)
        _mount(image, where)
        bare += sum(_is_bare(p) for p in where.glob("*.mcap") if p.stat().st_size == 0)
        return recordings

    try:
        return killed_once(folder, cut, rotate_s, left=left), bare
    finally:
        _unmount(where)


def _image(folder: Path) -> Path:
    image = folder / "image"
    with image.open("wb") as file:
        file.truncate(IMAGE_BYTES)
    subprocess.run(["mkfs.ext4", "-q", str(image)], check=True, capture_output=True)
    return image


def _mount(image: Path, where: Path) -> None:
    subprocess.run(["mount", "-o", "loop", str(image), str(where)], check=True, capture_output=True)


def _unmount(where: Path) -> None:
    subprocess.run(["umount", str(where)], check=True, capture_output=True)
