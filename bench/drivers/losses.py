"""Whether every sample that a faulty line took is counted for what it was."""

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.emulated import ArrayScript, Played, noise, play
from bench.processes import Helper
from tactile_rt.core.stream import SourceStats, concatenate
from tactile_rt.drivers.emulation.faults import Fate, Fault
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sources.opening import open_source
from tactile_rt.sources.synthetic import synthetic_spec

QUICK, WHOLE = 12_000, 600_000  # samples of each run
SILENCE_S = 0.5
SPEC = synthetic_spec(10, 6, 1000.0)
# Often, so that a short run has each; they strike one sample at most each.
FAULTS = (
    Fault("bit_flip", rate=4.0, amount=3),
    Fault("truncate", rate=3.0, amount=40),
    Fault("duplicate", rate=4.0, amount=2),
    Fault("burst", rate=3.0, amount=30),
    Fault("stall", rate=0.5, duration_s=0.05),
    Fault("drop", rate=3.0, amount=4),
    Fault("clock_drift", rate=0.3, amount=150, duration_s=1.0),
    Fault("clock_jump", rate=0.2, amount=0.5),
    Fault("sequence_reset", rate=0.5),
)
CAN_FAULTS = (*(replace(f, amount=1) if f.kind == "truncate" else f for f in FAULTS),
              Fault("can_error", rate=1.0))  # fmt: skip
# Of what is on its way when the plug is pulled, nobody can know that it was a copy; noise before
# a sample that is lost so looks as if it had been damaged: neither here.
UNPLUGS = (
    *(f for f in FAULTS if f.kind in ("bit_flip", "truncate", "drop")),
    Fault("unplug", rate=0.3, duration_s=0.3),
)
RUNS = {
    "serial_float32": ("serial", {"format": "float32"}, FAULTS),
    "serial_int16": ("serial", {"format": "int16"}, FAULTS),
    "slcan_int16": ("slcan", {"format": "int16"}, CAN_FAULTS),
    "serial_unplugged": ("serial", {"format": "float32"}, UNPLUGS),
}
GONE = (Fate.DROPPED, Fate.OVERFLOWED, Fate.UNHEARD)
HURT = (Fate.CORRUPTED, Fate.TRUNCATED)


@dataclass(frozen=True)
class _Received:
    seq: NDArray[np.int64]
    values: NDArray[np.float32]
    valid: NDArray[np.bool_]
    stats: SourceStats


def losses(quick: bool) -> list[Record]:
    """All kinds of faults on three lines; unplugging on one."""
    records = []
    for seed, (name, (wire, options, faults)) in enumerate(RUNS.items()):
        with tempfile.TemporaryDirectory() as folder:
            script = ArrayScript(
                wire, SPEC, QUICK if quick else WHOLE, str(Path(folder) / "device"), "noise",
                "fast", faults, seed, options,
            )  # fmt: skip
            with Helper(play, script) as device:
                got = _receive(device, device.hear())
                played: Played = device.ask("played")
        records.append(_compare(name, script, got, played))
    return records


def _receive(device: Helper, url: str) -> _Received:
    chunks, last = [], time.monotonic()
    with open_source(url) as source:
        while True:
            chunk = source.read(0.1)
            if chunk is not None:
                chunks.append(chunk)
                last = time.monotonic()
            elif time.monotonic() - last > SILENCE_S and device.ask("done"):
                break
        stats = replace(source.stats)
    whole = concatenate(chunks)
    return _Received(whole.seq, whole.values, whole.valid, stats)


def _compare(name: str, script: ArrayScript, got: _Received, log: Played) -> Record:
    """What does not add up, and samples of which the receiver says other than the sender."""
    fate, stats, n = log.fate, got.stats, len(log.fate)
    counted = stats.delivered + stats.corrupt + stats.missing + stats.dropped + stats.duplicates
    wrong = abs(n + log.duplicated - counted) + abs(stats.duplicates - log.duplicated)
    wrong += len(got.seq) - len(np.unique(got.seq))  # delivered twice
    wrong += int((got.seq >= n).sum())
    known = got.seq[got.seq < n]
    came = np.zeros(n, np.bool_)
    came[known] = True
    hurt, gone = np.isin(fate, HURT), np.isin(fate, GONE)
    on_the_way = _around_unplugging(fate, came)
    wrong += int((~came & ~hurt & ~gone & ~on_the_way).sum()) + int((came & gone).sum())
    if script.wire == "serial":
        wrong += int((came & hurt).sum())
        # of a damaged one on its way when the plug was pulled or put in, some may have come; and
        # one that was cut by that is damaged, too
        pulled = int((np.diff((fate == Fate.UNHEARD).astype(np.int8)) == 1).sum())
        least, most = int((hurt & ~on_the_way).sum()), int(hurt.sum()) + pulled
        wrong += max(0, least - stats.corrupt, stats.corrupt - most)
        wrong += abs(stats.corrupt + stats.missing - int((~came).sum()))
    else:  # what is left of a sample is delivered; what was in the lost frames is marked
        partly = hurt[got.seq]
        wrong += int((got.valid.all(axis=1) & partly).sum())
        wrong += int((~got.valid.all(axis=1) & ~partly).sum())
    wrong += _altered(script, got)
    kinds = {f.name.lower(): int((fate == f).sum()) for f in Fate if (fate == f).any()}
    happened = ", ".join(f"{count} {kind}" for kind, count in kinds.items())
    return Record(
        f"drivers.loss.{name}", wrong, "samples", "== 0",
        "sent + duplicated = delivered + corrupt + missing + dropped + duplicates, each term by "
        "itself and each sample beside the emulator's log",
        f"{n} samples, {log.duplicated} copies: {happened}; received: {stats.delivered} "
        f"delivered, {stats.corrupt} corrupt, {stats.missing} missing, {stats.duplicates} "
        f"duplicates; {', '.join(fault.kind for fault in script.faults)}",
    )  # fmt: skip


def _around_unplugging(fate: NDArray[np.uint8], came: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """(n,) sent, and lost on the way: nothing came between them and the plug being pulled or put
    in; what waits in a port when it is opened, the driver throws away as old."""
    lost = np.zeros(len(fate), np.bool_)
    unheard, arrived = fate == Fate.UNHEARD, np.flatnonzero(came)
    edges = np.diff(unheard.astype(np.int8))
    for at in (np.flatnonzero(edges == 1) + 1).tolist():  # pulled
        before = arrived[arrived < at]
        lost[int(before[-1]) + 1 if len(before) else 0 : at] = True
    for at in (np.flatnonzero(edges == -1) + 1).tolist():  # put in
        after = arrived[arrived >= at]
        lost[at : int(after[0]) if len(after) else len(fate)] = True
    lost[np.isin(fate, GONE)] = False
    return lost


def _altered(script: ArrayScript, got: _Received) -> int:
    """Delivered samples that are not what was measured."""
    sent = noise(script)[np.minimum(got.seq, script.samples - 1)]
    if script.options["format"] == "float32":
        same = (got.values == sent).all(axis=2)
    else:  # to half a count
        half = np.array([0.1] * 3 + [1e-3] * 3) / 32767 / 2
        same = (np.abs(got.values - sent) <= 1.001 * half).all(axis=2)
    return int((~same & got.valid).any(axis=1).sum())
