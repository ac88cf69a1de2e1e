"""Recordings: the same decisions at every pace, and what is left of a recorder that was killed."""

import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from bench.emulated import LoopedSource
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.emulation.device import EmulatedSerial
from tactile_rt.drivers.emulation.faults import Fault, FaultSchedule
from tactile_rt.models.evaluation.records import Record
from tactile_rt.recording import Recording, StreamWriter, recover
from tactile_rt.sources.opening import open_source

SPEEDS = (1, 10, 0)
QUICK_RUNS, RUNS = 1, 3  # at each speed
QUICK, WHOLE = 4, 20  # recorders killed
TOUCHED = slice(800, 2200)  # samples at 1 kHz, of SAMPLES
SAMPLES = 2600
FAULTS = (Fault("bit_flip", rate=5.0, amount=3), Fault("drop", rate=5.0, amount=3))
COMMAND = "from tactile_rt.cli import main; main()"

Replayed = list[tuple[bytes, ...]]


def recordings(quick: bool) -> list[Record]:
    """Replays of a faulty device's recording; recorders ended by SIGKILL and by SIGTERM."""
    with tempfile.TemporaryDirectory() as folder:
        replays = _replays(Path(folder), QUICK_RUNS if quick else RUNS)
        return [*replays, *_ended(Path(folder), QUICK if quick else WHOLE)]


def _replays(folder: Path, times: int) -> list[Record]:
    path = folder / "touch.mcap"
    card = load_model(shipped_model())[1]
    spec = replace(card.array, rate_hz=1000.0)
    force = np.array([3e-4 if unit == "N" else 3e-6 for unit in spec.units])
    draw = np.random.default_rng(0)
    values = draw.normal(size=(SAMPLES, *spec.shape)) * 1e-2 * force
    values[TOUCHED] += force * draw.uniform(-1, 1, (1, *spec.shape))
    live: Replayed = []
    device = EmulatedSerial(LoopedSource(spec, values), faults=FaultSchedule(FAULTS, 0))
    with device, open_source(device.url) as source, StreamWriter(path, source) as writer:
        while not device.done:
            if (chunk := source.read(0.3)) is not None:
                writer.push(chunk)
                live.append(_bytes_of(chunk))
    records = []
    for channel in ("samples", "wire"):
        runs = [_replay(path, channel, speed) for speed in SPEEDS for _ in range(times)]
        chunks, decisions = runs[0]
        different = sum(run != runs[0] for run in runs) + (chunks != live[: len(chunks)])
        different += len(chunks) != len(live)
        records.append(
            Record(
                f"drivers.replay.{channel}_different",
                different,
                "runs",
                "== 0",
                "chunks and decisions, byte for byte, but for how long each took",
                f"{times} at each of {', '.join(f'{s}x' if s else 'full speed' for s in SPEEDS)}: "
                f"{len(chunks)} chunks, as live, {len(decisions)} decisions; native over a pty, "
                "with damaged and lost samples",
            )
        )  # fmt: skip
    return records


def _replay(path: Path, channel: str, speed: int) -> tuple[Replayed, Replayed]:
    with open_source(f"replay:{path}?from={channel}&speed={speed}") as source:
        classifier = Classifier(shipped_model(), source.spec)
        chunks: Replayed = []
        decisions: Replayed = []
        for chunk in source:
            chunks.append(_bytes_of(chunk))
            for d in classifier.push(chunk):
                when = f"{d.onset_ns} {d.t_ns} {d.step} {d.final} {d.label}"
                decisions.append((when.encode(), d.probabilities.tobytes()))
    return chunks, decisions


def _bytes_of(chunk: Chunk) -> tuple[bytes, ...]:
    return tuple(a.tobytes() for a in (chunk.seq, chunk.t_ns, chunk.values, chunk.valid))


def _ended(folder: Path, times: int) -> list[Record]:
    draw, lost_s, bad = np.random.default_rng(0), [], 0
    for i in range(times):
        path = folder / f"killed-{i}.mcap"
        with _recorder(path) as process:
            time.sleep(draw.uniform(0, 2))
            killed = time.monotonic_ns()
            process.kill()
        last, whole = 0, True
        expected = 0
        for chunk in Recording(recover(path)):
            whole &= chunk.seq[0] == expected
            expected, last = int(chunk.seq[-1]) + 1, int(chunk.t_ns[-1])
        lost_s.append((killed - last) / 1e9)
        bad += not whole
    with _recorder(folder / "ended.mcap") as process:
        time.sleep(0.5)
        began = time.monotonic()
        process.send_signal(signal.SIGTERM)
        code = process.wait()
        took = time.monotonic() - began
    bad += code != 0 or not list(Recording(folder / "ended.mcap"))
    how = f"{times} recorders of 35 x 6 at 1 kHz, killed within 2 s of their first second"
    return [
        Record("drivers.record.killed_lost", max(lost_s), "s", "<= 1",
               f"median {np.median(lost_s):.2f}; from the last sample recovered to the kill", how),
        Record("drivers.record.bad", bad, "recordings", "== 0", "gaps in what was recovered", how),
        Record("drivers.record.sigterm", took, "s", "<= 2", "until the process was gone",
               "the recording then is whole"),
    ]  # fmt: skip


def _recorder(path: Path) -> "subprocess.Popen[str]":
    """`tactile-rt record`, which has written its first second."""
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND, "record", "synthetic:35x6", str(path)],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stderr is not None
    process.stderr.readline()
    return process
