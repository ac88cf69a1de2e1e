"""Pulled out and plugged in again: how soon that is known, how soon data comes, what is left."""

import os
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from bench.emulated import ArrayScript, play
from bench.processes import Helper
from tactile_rt.drivers.device_source import DeviceSource
from tactile_rt.drivers.health import State
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sources.opening import open_source
from tactile_rt.sources.synthetic import synthetic_spec

QUICK, WHOLE = 25, 100  # cycles
BETWEEN_S = 0.05
PATIENCE_S = 5.0
LOST_MS, DATA_MS = 50, 250
SPEC = synthetic_spec(10, 6, 1000.0)


def unplugging(quick: bool) -> list[Record]:
    """Cycles on a device that sends at 1 kHz over a pty under a fixed name."""
    cycles = QUICK if quick else WHOLE
    lost_ms, data_ms, stale = [], [], 0
    with tempfile.TemporaryDirectory() as folder:
        script = ArrayScript("serial", SPEC, 400_000, str(Path(folder) / "device"), "noise")
        with Helper(play, script) as device, open_source(device.hear()) as source:
            assert isinstance(source, DeviceSource)
            _read_for(source, BETWEEN_S)
            before = _held()
            for _ in range(cycles):
                pulled = device.ask("unplug")
                end = time.monotonic() + PATIENCE_S
                while source.health.state != State.LOST and time.monotonic() < end:
                    source.read(0.005)
                lost_ms.append((source.health.since_ns - pulled) / 1e6)
                # nothing may come while it is away
                stale += _read_for(source, BETWEEN_S)
                stale += source.health.state == State.STREAMING
                plugged = device.ask("replug")
                end, chunk = time.monotonic() + PATIENCE_S, None
                while chunk is None and time.monotonic() < end:
                    stale += source.health.state == State.STREAMING
                    chunk = source.read(0.005)
                data_ms.append((time.monotonic_ns() - plugged) / 1e6)
                if chunk is None or chunk.t_ns[0] < pulled:  # older than the unplugging
                    stale += 1
                _read_for(source, BETWEEN_S)
            after = _held()
    good = sum(a <= LOST_MS and b <= DATA_MS for a, b in zip(lost_ms, data_ms, strict=True))
    how = f"{cycles} cycles, native over a pty at 1 kHz, {BETWEEN_S:g} s between"
    return [
        Record("drivers.unplug.late", cycles - good, "cycles", "== 0", "state or data", how),
        Record(
            "drivers.unplug.state_worst", max(lost_ms), "ms", f"<= {LOST_MS}",
            f"median {np.median(lost_ms):.2f}", f"plug pulled to state `lost`; {how}",
        ),
        Record(
            "drivers.unplug.data_worst", max(data_ms), "ms", f"<= {DATA_MS}",
            f"median {np.median(data_ms):.0f}", f"plugged in to the first sample; {how}",
        ),
        Record(
            "drivers.unplug.stale", stale, "times", "== 0",
            "old samples, or `streaming` while away", how,
        ),
        Record(
            "drivers.unplug.left_over", max(0, after[0] - before[0]) + max(0, after[1] - before[1]),
            "threads and descriptors", "== 0", "", how,
        ),
    ]  # fmt: skip


def _read_for(source: DeviceSource, seconds: float) -> int:
    """Chunks that came in this time."""
    came, end = 0, time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        came += source.read(left) is not None
    return came


def _held() -> tuple[int, int]:
    return threading.active_count(), len(os.listdir("/proc/self/fd"))
