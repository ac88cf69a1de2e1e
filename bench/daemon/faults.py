"""Is every fault told, rightly, soon, and no longer than it lasts; and nothing else?

tactile-rt bench faults [--resume faults.json]
python -m bench.daemon.faults [--times 40] [--only NAME ...] [--resume faults.json]

Each fault is caused by real means in a daemon under way with two arrays. Another thread asks
`/health` and `/metrics` all the while. Of each repetition it is measured when the right diagnostic
was told, what else was, and when nothing was told any more.
"""

import argparse
import http.client
import json
import os
import re
import signal
import sys
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from rich.console import Console

from bench.daemon.fault_kinds import KINDS, FaultKind, FaultScene, Named, may_mount
from tactile_rt.models.evaluation.records import Record, show, write

TIMES = 40
ASK_S = 0.04
SEEN_S, GONE_S = 1.0, 2.0  # stated
HOLD_S = 1.2  # that a fault lasts after it is seen, for what else might be told
PATIENCE_S = 12.0
# Two looks further apart, or a thread (of the daemon, an array or this process) that waited longer
# for a processor, beside what every turn takes: the machine has other things to do. As late as that
# a model skips.
BUSY_S, WAITED_S, TURN_NS = 0.15, 0.15, 150_000
RETRIES = 3
DEGRADED = re.compile(rb"^tactile_degraded_parts (\d+)", re.M)
DIAGNOSTIC = re.compile(rb"^tactile_diagnostic\{.*\} 1$", re.M)
BATCH = 8  # of each fault, in one daemon


@dataclass(frozen=True)
class Repetition:
    """One fault, once.

    Attributes:
        seen_s: Time from the effect until the fault was told, s; infinite: never.
        gone_s: Time from the end of the fault until nothing was told any more, s.
        wrong: What was told and is not true: ``part: what: why``.
        disagreed: Number of looks, two running, at which the metric was another than what health
            told: health may change between the requests for the two.
        retried: Number of times that it was repeated as the machine was busy with others.
    """

    seen_s: float
    gone_s: float
    wrong: tuple[str, ...]
    disagreed: int
    retried: int = 0


@dataclass(frozen=True)
class _Look:
    at: float
    diagnostics: dict[Named, str]
    lines: tuple[str, ...]


class _Watcher:
    """Asks again and again; a context manager."""

    def __init__(self, port: int) -> None:
        self._port = port
        self.looks: list[_Look] = []
        self.disagreed, self._differs = 0, False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(15)

    def since(self, at: float) -> list[_Look]:
        """Looks from then on."""
        return [look for look in self.looks[-2000:] if look.at >= at]

    def wait(self, true: Any, after: float, seconds: float) -> float:
        """When a look after this time was so; infinite: none within so many seconds."""
        end = time.monotonic() + seconds
        while True:
            for look in self.since(after):
                if true(look):
                    return look.at
            if time.monotonic() > end:
                return np.inf
            time.sleep(ASK_S / 2)

    def _run(self) -> None:
        while not self._over.is_set():
            began = time.monotonic()
            try:
                health = json.loads(self._ask("/health"))
                metrics = self._ask("/metrics")
            except (OSError, http.client.HTTPException, ValueError):
                time.sleep(ASK_S)
                continue
            named = {(t["part"], t["what"]): t["why"] for t in health["diagnostics"]}
            at = time.monotonic()
            self.looks.append(_Look(at, named, tuple(health["degraded"])))
            found = DEGRADED.search(metrics)
            if found is not None:
                # Before, after, and what changes between is between.
                both = len(named), len(json.loads(self._ask("/health"))["diagnostics"])
                listed = len(DIAGNOSTIC.findall(metrics))
                # A daemon that is kept short answers seconds later.
                slow = time.monotonic() - began > BUSY_S
                right = slow or min(both) <= int(found[1]) <= max(both)
                before, self._differs = self._differs, not (right and int(found[1]) == listed)
                self.disagreed += before and self._differs
            time.sleep(max(0.0, ASK_S - (time.monotonic() - began)))

    def _ask(self, path: str) -> bytes:
        line = http.client.HTTPConnection("127.0.0.1", self._port, timeout=10)
        try:
            line.request("GET", path)
            return line.getresponse().read()
        finally:
            line.close()


def repeat(scene: FaultScene, watcher: _Watcher, kind: FaultKind) -> Repetition:
    """Cause a fault once, and see what is told of it."""
    retried = 0
    while True:
        made, busy = _once(scene, watcher, kind)
        if not busy or retried == RETRIES:
            return Repetition(**{**asdict(made), "retried": retried})
        retried += 1


def _once(scene: FaultScene, watcher: _Watcher, kind: FaultKind) -> tuple[Repetition, bool]:
    named, allowed = frozenset(kind.named), frozenset(kind.named + kind.also)
    began, disagreed = time.monotonic(), watcher.disagreed
    waited = _waited(scene)
    with contextmanager(kind.cause)(scene) as effect:  # type: ignore[arg-type]
        if named:
            seen = watcher.wait(lambda look: named <= look.diagnostics.keys(), began, PATIENCE_S)
        else:
            seen = effect
        if kind.lasts:
            time.sleep(HOLD_S)
    moment = max(effect, seen) if np.isfinite(seen) else effect
    ended = time.monotonic() if kind.lasts else moment
    gone = watcher.wait(lambda look: not look.diagnostics, max(ended, effect), PATIENCE_S)
    time.sleep(0.3)
    looks = watcher.since(began)
    wrong = sorted(
        {
            f"{part}: {what}: {why}"
            for look in looks
            for (part, what), why in look.diagnostics.items()
            if (part, what) not in allowed
        }
    )
    gaps = np.diff([look.at for look in looks]) if len(looks) > 1 else np.zeros(1)
    more = _waited(scene)
    longest_s = max(ns - waited.get(task, 0) for task, ns in more.items()) / 1e9
    # while a process is stopped nobody answers
    busy = (gaps.max() > BUSY_S or longest_s > WAITED_S) and not kind.blind
    scene.tidy()
    return Repetition(
        max(0.0, seen - effect), max(0.0, gone - ended), tuple(wrong), watcher.disagreed - disagreed
    ), busy  # fmt: skip


def _waited(scene: FaultScene) -> dict[str, int]:
    """How long each thread has waited for a processor so far, by the kernel's account and beyond
    what every turn takes, ns."""
    found = {}
    arrays = (array.pid for array in scene.arrays.values())
    for pid in (scene.daemon.process.pid, *arrays, os.getpid()):
        for task in Path(f"/proc/{pid}/task").iterdir():
            with suppress(OSError):  # it has just ended
                _, waited, turns = map(int, (task / "schedstat").read_text().split())
                found[task.name] = waited - TURN_NS * turns
    return found


def faults(times: int, only: tuple[str, ...] = (), resume: Path | None = None) -> list[Record]:
    """Every fault so many times; what a file holds of them already is not repeated.

    Args:
        times: how often each.
        only: names of faults; none: all.
        resume: file that keeps the repetitions.
    """
    done: dict[str, list[dict[str, Any]]] = {}
    if resume is not None and resume.exists():
        done = json.loads(resume.read_text())
    names = [n for n in (only or tuple(KINDS)) if may_mount() or not KINDS[n].root]
    while open_names := [n for n in names if len(done.get(n, ())) < times]:
        with FaultScene() as scene, _Watcher(scene.ports["metrics"]) as watcher:
            time.sleep(0.5)
            for name in open_names:
                for _ in range(min(BATCH, times - len(done.get(name, ())))):
                    done.setdefault(name, []).append(asdict(repeat(scene, watcher, KINDS[name])))
                if resume is not None:
                    resume.write_text(json.dumps(done))
    return [r for n in names for r in _records(n, [Repetition(**d) for d in done[n]])]


def _records(name: str, found: list[Repetition]) -> list[Record]:
    kind, n = KINDS[name], len(found)
    told = ", ".join(f"{part}: {what}" for part, what in kind.named) or "nothing is told"
    seen, gone = np.array([r.seen_s for r in found]), np.array([r.gone_s for r in found])
    times = [
        f"{what} after {np.median(of_all):.2f}, at most {of_all.max():.2f} s"
        for what, of_all in (("told", seen), ("gone", gone))
    ]
    notes = [told, *(times if kind.named else ())]
    if wrong := sorted({w for r in found for w in r.wrong}):
        notes.append(f"told wrongly: {', '.join(wrong)}")
    if disagreed := sum(r.disagreed for r in found):
        notes.append(f"{disagreed} times tactile_degraded_parts was another number")
    if retried := sum(r.retried for r in found):
        notes.append(f"{retried} repeated: the machine was busy with others")
    right = sum(_right(r) for r in found)
    return [Record(f"daemon.faults.{name}", right, f"of {n}", f"== {n}", "; ".join(notes))]


def _right(one: Repetition) -> bool:
    return one.seen_s <= SEEN_S and one.gone_s <= GONE_S and not one.wrong and not one.disagreed


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=TIMES)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--resume", type=Path)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the daemon and its disk are put away
    records = faults(given.times, tuple(given.only), given.resume)
    show(records, Console())
    if given.json:
        write(records, given.json)


if __name__ == "__main__":
    main()
