"""`kill -9` of the daemon while it records: what is left, and who can read it."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.daemon.process import DaemonProcess, free_port
from bench.emulated import ArrayScript, EmulatedArray
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.stream import Chunk, concatenate
from tactile_rt.drivers.emulation.faults import Fate
from tactile_rt.models.evaluation.records import Record
from tactile_rt.recording import Recording, recover
from tactile_rt.recording.checking import compare_decoding

QUICK, WHOLE = 5, 50
LONGEST_S = 4.0  # from the first sample to the kill
SAMPLES = 30_000  # at 1 kHz, more than any of it takes
LOST_S = 1.0
CONFIGURATION = """version = 1
[[source]]
name = "whiskers"
url = "{url}"
[[model]]
source = "whiskers"
[recorder]
folder = "recordings"
rotate_s = {rotate_s}
min_free_mb = 0
[metrics]
port = {port}
"""


@dataclass(frozen=True)
class Killed:
    """What was left of one recording.

    Attributes:
        after_s: Time from the first sample that the device sent to the kill, s.
        lost_s: Age at the kill of the first sample that is lost, wherever it is, s; 0: none is.
        files: Number of files that the recording has.
        cut: Number of files that had no end.
        unreadable: Files that, recovered, the MCAP library's own reader does not read to their end.
        samples: Number of samples that were recovered.
        missing: Samples that the device sent before the last that is there, and that are not there.
        wrong: Samples that are not as the device sent them, or not as their packets decode again.
        decisions: Number of the model's decisions that were recovered.
    """

    after_s: float
    lost_s: float
    files: int
    cut: int
    unreadable: int
    samples: int
    missing: int
    wrong: int
    decisions: int


def kill_nine(quick: bool) -> list[Record]:
    """Daemons that record 30 x 6 at 1 kHz, packets and a model's decisions, killed at random."""
    draw = np.random.default_rng(0)
    times = QUICK if quick else WHOLE
    with tempfile.TemporaryDirectory() as folder:
        found = []
        for k in range(times):
            # One that rotates may also be killed as one file follows the other.
            each = Path(folder) / str(k)
            each.mkdir()
            wait_s = draw.uniform(0, LONGEST_S)
            found.append(killed_once(each, partial(_wait, wait_s), k % 2))
    return records_of(found)


def _wait(seconds: float, daemon: DaemonProcess) -> None:
    time.sleep(seconds)


def records_of(found: Sequence[Killed]) -> list[Record]:
    """The figures of these kills."""
    lost = np.array([k.lost_s for k in found])
    after = [k.after_s for k in found]
    how = (
        f"{len(found)} daemons of 30 x 6 at 1 kHz over a pty with a model, killed "
        f"{min(after):.2f} to {max(after):.2f} s after their first sample; every other one "
        "rotates every second"
    )
    files, cut = sum(k.files for k in found), sum(k.cut for k in found)
    return [
        Record(
            "daemon.kill.lost", float(lost.max()), "s", f"<= {LOST_S:g}",
            f"median {np.median(lost):.2f}; age of the first sample that is lost, at the kill", how,
        ),
        Record(
            "daemon.kill.unreadable", sum(k.unreadable for k in found), "files", "== 0",
            f"of {files}, {cut} of which had no end: read by mcap.reader, checksums and all",
            "after `tactile-rt recover`",
        ),
        Record(
            "daemon.kill.missing", sum(k.missing for k in found), "samples", "== 0",
            f"of {sum(k.samples for k in found)}: sent before the last that is there", how,
        ),
        Record(
            "daemon.kill.wrong", sum(k.wrong for k in found), "samples", "== 0",
            "not as the device sent them, or not as their packets decode again",
            f"{sum(k.decisions for k in found)} decisions are there, too",
        ),
    ]  # fmt: skip


def killed_once(
    folder: Path,
    moment: Callable[[DaemonProcess], object],
    rotate_s: float = 0,
    environment: Mapping[str, str] | None = None,
    left: Callable[[Path], Path] | None = None,
) -> Killed:
    """Start a daemon, kill it, and look.

    Args:
        folder: for its files.
        moment: called when the first samples are recorded; returns when it is to be killed.
        rotate_s: when the next file begins; 0: never.
        environment: of the daemon.
        left: makes of the folder of the recordings one of what is left; None: it is that.

    Raises:
        TimeoutError, EOFError: the daemon does not record.
    """
    spec = replace(load_model(shipped_model())[1].array, rate_hz=1000.0)
    signal = _signal(spec.shape, spec.units)
    port = free_port()
    script = ArrayScript("serial", spec, SAMPLES)
    with EmulatedArray(script, signal) as device:
        text = CONFIGURATION.format(url=device.url, rotate_s=rotate_s, port=port)
        with DaemonProcess(folder, text, port, environment=environment) as daemon:
            daemon.await_state(_recording, every_s=0.01)
            moment(daemon)
            killed_ns = time.monotonic_ns()
            daemon.process.kill()
            daemon.process.wait()
        played = device.played()
    sent = np.flatnonzero(
        (played.fate == Fate.SENT) & (played.at_ns > 0) & (played.at_ns < killed_ns)
    )
    recordings = folder / "recordings"
    return _looked_at(
        left(recordings) if left is not None else recordings, killed_ns, signal, sent, played.at_ns
    )


def _recording(state: Mapping[str, Any]) -> bool:
    return any(
        consumer["queue"]["taken"]["samples"]
        for consumer in state["consumers"]
        if consumer["kind"] == "recorder"
    )


def _signal(shape: tuple[int, int], units: tuple[str, ...]) -> NDArray[np.float32]:
    """Noise, unlike at every sample, and a touch every second."""
    force = np.array([3e-4 if unit == "N" else 3e-6 for unit in units])
    draw = np.random.default_rng(1)
    touched = (np.arange(SAMPLES) % 1000 >= 600)[:, None, None]
    values = draw.normal(size=(SAMPLES, *shape)) * 1e-2 * force
    values += touched * force * draw.uniform(-1, 1, (1, *shape))
    made: NDArray[np.float32] = values.astype(np.float32)
    return made


def _looked_at(
    folder: Path,
    killed_ns: int,
    signal: NDArray[np.float32],
    sent: NDArray[np.intp],
    at_ns: NDArray[np.int64],
) -> Killed:
    paths = sorted(folder.glob("*.mcap"))
    chunks: list[Chunk] = []
    cut = unreadable = wrong = decisions = 0
    for path in paths:
        try:
            made = recover(path)
        except (RecordingError, ConfigError):
            unreadable += 1
            continue
        cut += made != path
        unreadable += not _readable(made)
        recording = Recording(made)
        own = list(recording)
        chunks += own
        decisions += sum(1 for _ in recording.decisions())
        if own:
            again = compare_decoding(made)
            wrong += again.differing
    chunks.sort(key=lambda chunk: int(chunk.seq[0]))
    there: NDArray[np.int64] = np.zeros(0, np.int64)
    if chunks:
        whole = concatenate(chunks)
        begin = int(np.flatnonzero((signal == whole.values[0]).all(axis=(1, 2)))[0])
        there = whole.seq - whole.seq[0] + begin
        wrong += int((signal[there] != whole.values).any(axis=(1, 2)).sum())
    end = int(there[-1]) if len(there) else -1
    lost = np.setdiff1d(sent, there)
    return Killed(
        (killed_ns - int(at_ns[sent[0]])) / 1e9,
        (killed_ns - int(at_ns[lost[0]])) / 1e9 if len(lost) else 0.0,
        len(paths), cut, unreadable, len(there), len(np.setdiff1d(sent[sent <= end], there)),
        wrong, decisions,
    )  # fmt: skip


def _readable(path: Path) -> bool:
    """Whether the MCAP library reads all of it by its index, and all of it in its order."""
    from mcap.reader import make_reader

    try:
        with path.open("rb") as file:
            reader = make_reader(file, validate_crcs=True)
            summary = reader.get_summary()
            read = sum(1 for _ in reader.iter_messages())
    except Exception:  # whatever it raises, it could not be read
        return False
    counted = summary.statistics if summary is not None else None
    return counted is not None and counted.message_count == read
