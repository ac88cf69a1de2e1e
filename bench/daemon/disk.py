"""A disk that is full, again and again: no file may be longer than so much."""

import os
import resource
import time
from pathlib import Path

import msgspec
import numpy as np

from bench.daemon.accounts import recorded
from bench.daemon.disturbed import DisturbedDaemon
from tactile_rt.evidence.records import Record
from tactile_rt.recording import recover
from tactile_rt.recording.reader import is_finished

__all__ = ["disk_full"]

MOST_BYTES = 1 << 18  # a second of the larger array
LOOK_S = 0.01
PATIENCE_S = 5.0  # for each time
STATED_S = 1.0
FULL = "File too large"


def disk_full(times: int) -> list[Record]:
    """The recorder of a daemon that may write no file longer than 256 KiB."""
    with DisturbedDaemon(before=_limit) as scene:
        since, began = scene.mark(), time.monotonic()
        folder, seen = scene.folder / "recordings", 0
        took: list[float] = []
        while len(took) < times and time.monotonic() - began < PATIENCE_S * times + 10:
            failed = [t for t in scene.all_told(since) if _failed(t.part, t.reason)]
            for event in failed[seen:]:
                seen += 1
                if "/whiskers-" in event.reason:
                    before = _files(folder)
                    end = time.monotonic() + PATIENCE_S
                    while _files(folder) == before and time.monotonic() < end:
                        time.sleep(LOOK_S)
                    took.append((time.monotonic_ns() - event.t_ns) / 1e9)
            time.sleep(LOOK_S)
        state, played, code = scene.finish()
        # In the log: when the last of them is told the publishers have been closed.
        lines = [msgspec.json.decode(line) for line in scene.daemon.log().splitlines()]
        told = [line for line in lines if _failed(line["part"], line["reason"])]
        cut = [f for f in sorted(folder.glob("*.mcap")) if not is_finished(f)]
        whole = scene.folder / "whole"
        whole.mkdir()
        for file in sorted(folder.glob("*.mcap")):
            if file in cut:
                recover(file, whole / file.name)
            else:
                os.link(file, whole / file.name)
        files = sorted(whole.glob("*.mcap"))
        details = next(c["details"] for c in state["consumers"] if c["part"]["name"] == "recorder")
        missed = unbalanced = 0
        for source in state["sources"]:
            name, stats = source["part"]["name"].partition(".")[2], source["stats"]
            seq = recorded(files, name).seq
            missed += stats["delivered"] - len(np.unique(seq))
            unbalanced += abs(len(played[name].fate) - stats["delivered"])
    how = (
        f"{len(took)} times: no file longer than {MOST_BYTES >> 10} KiB (RLIMIT_FSIZE); "
        f"{len(cut)} files of {len(files)} to be recovered"
    )
    counted = int(details["lost_samples"])
    return [
        Record(
            "daemon.chaos.disk_full_recovery", max(took, default=np.inf), "s", f"<= {STATED_S:g}",
            f"median {np.median(took) if took else np.inf:.3f}; the error to the next file", how,
        ),
        Record(
            "daemon.chaos.disk_full_acquisition_lost", unbalanced, "samples", "== 0",
            "measured less delivered", how,
        ),
        Record(
            "daemon.chaos.disk_full_uncounted", max(0, missed - counted), "samples", "== 0",
            f"{missed} delivered and not in the recordings after `recover`, {counted} counted", how,
        ),
        Record(
            "daemon.chaos.disk_full_told_wrongly", abs(len(told) - len(cut)), "events", "== 0",
            f"{len(told)} told, of {len(cut)} files that could not be written on", how,
        ),
        Record("daemon.chaos.disk_full_exit_code", code, "", "== 0", "", how),
    ]  # fmt: skip


def _limit() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (MOST_BYTES, MOST_BYTES))


def _failed(part: str, reason: str) -> bool:
    return part == "recorder" and FULL in reason


def _files(folder: Path) -> set[str]:
    return {name for name in os.listdir(folder) if name.startswith("whiskers-")}
