"""Each component killed or stalled again and again while acquisition goes on."""

import http.client
import socket
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

import numpy as np

from bench.daemon.accounts import account, recorded
from bench.daemon.disk import disk_full
from bench.daemon.disturbed import DisturbedDaemon
from tactile_rt.evidence.records import Record
from tactile_rt.stream import NS_PER_S

__all__ = ["chaos"]

QUICK, WHOLE = 2, 100
FLOOD = 200  # connections
STEP_S = 3600.0  # of the wall clock, forth and back
PAUSE_S = 0.2  # between two disturbances
GARBAGE = b"no model\n" * 1000
# (part, state): how often it may be told of one disturbance, at least and at most
Expected = Mapping[tuple[str, str], tuple[int, int]]
ONCE, PERHAPS = (1, 1), (0, 1)
DAEMON = {("daemon", "degraded"): PERHAPS, ("daemon", "running"): PERHAPS}


def _unplug(scene: DisturbedDaemon, n: int) -> float:
    array, since = scene.arrays["whiskers"], scene.mark()
    array.ask("unplug")
    scene.await_told(since, "source.whiskers", "device:lost")
    time.sleep(PAUSE_S)
    plugged: int = array.ask("replug")
    told = scene.await_told(since, "source.whiskers", "device:streaming")
    return (told.t_ns - plugged) / NS_PER_S


def _replace_model(scene: DisturbedDaemon, n: int) -> float:
    """By what is no model, which is refused; then by a good one, which is taken."""
    good, since, new = scene.model.read_bytes(), scene.mark(), scene.model.with_suffix(".new")
    new.write_bytes(GARBAGE)
    new.replace(scene.model)
    scene.daemon.reload()
    scene.await_told(since, "daemon", "refused")
    new.write_bytes(good)
    new.replace(scene.model)
    back = time.monotonic_ns()
    scene.daemon.reload()
    told = scene.await_told(since, "model.whiskers", "admitted")
    return (told.t_ns - back) / NS_PER_S


def _stop_reading(scene: DisturbedDaemon, n: int) -> float:
    since = scene.mark()
    scene.read_pipe(False)
    scene.await_told(since, "publisher.jsonl", "stalled")
    again = time.monotonic_ns()
    scene.read_pipe(True)
    told = scene.await_told(since, "publisher.jsonl", "running")
    return (told.t_ns - again) / NS_PER_S


def _lose_peer(scene: DisturbedDaemon, n: int) -> float:
    """A subscriber that is gone without a word, and the next one."""
    import zmq

    context: Any = zmq.Context()
    took = 0.0
    for _ in range(2):
        with context.socket(zmq.SUB) as peer:
            peer.setsockopt(zmq.LINGER, 0)
            peer.setsockopt(zmq.RCVTIMEO, 10_000)
            peer.setsockopt(zmq.SUBSCRIBE, b"")
            began = time.monotonic()
            peer.connect(f"tcp://127.0.0.1:{scene.ports['zmq']}")
            peer.recv_multipart()
            took = time.monotonic() - began
    context.destroy(0)
    return took


def _step_clock(scene: DisturbedDaemon, n: int) -> float:
    since, now = scene.mark(), time.monotonic_ns()
    scene.clock.off_ns = 0 if n % 2 else round(STEP_S * NS_PER_S)
    return (scene.await_told(since, "daemon", "clock").t_ns - now) / NS_PER_S


def _flood(scene: DisturbedDaemon, n: int) -> float:
    """More connections than the page takes; then one that asks for it."""
    port = scene.ports["page"]
    with ExitStack() as stack:
        for _ in range(FLOOD):
            line = socket.socket()
            stack.callback(line.close)
            line.setblocking(False)
            line.connect_ex(("127.0.0.1", port))
        time.sleep(PAUSE_S)
    began = time.monotonic()
    while True:
        page = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
        try:
            page.request("GET", "/")
            if page.getresponse().status == 200:
                return time.monotonic() - began
        except (OSError, http.client.HTTPException):
            time.sleep(0.005)
        finally:
            page.close()


# name: (what to do, what may be told of it, stated time to recover in s, in words)
KINDS: dict[str, tuple[Callable[[DisturbedDaemon, int], float], Expected, float, str]] = {
    "unplugged": (
        _unplug,
        DAEMON | {
            ("source.whiskers", "device:lost"): ONCE,
            ("source.whiskers", "device:connecting"): PERHAPS,
            ("source.whiskers", "device:streaming"): ONCE,
        },
        0.25, "plugged in to its first sample",
    ),
    "model": (
        _replace_model,
        DAEMON | {
            ("daemon", "reloading"): (2, 2),
            ("daemon", "refused"): ONCE,
            ("daemon", "reloaded"): ONCE,
            ("model.whiskers", "admitted"): ONCE,
        },
        2.0, "SIGHUP with the good file to the model deciding",
    ),
    "peer_stalled": (
        _stop_reading,
        DAEMON | {("publisher.jsonl", "stalled"): ONCE, ("publisher.jsonl", "running"): ONCE},
        1.0, "read again to the publisher running",
    ),
    "peer_gone": (_lose_peer, {}, 1.0, "the next subscriber to its first message"),
    "clock": (
        _step_clock, DAEMON | {("daemon", "clock"): ONCE}, 0.5, "stepped by an hour, to told",
    ),
    "page_flooded": (
        _flood, DAEMON, 1.0, f"{FLOOD} connections closed to the page served again",
    ),
}  # fmt: skip


def chaos(quick: bool) -> list[Record]:
    """Every disturbance in turn, then the disk that is full."""
    times = QUICK if quick else WHOLE
    records = []
    with DisturbedDaemon() as scene:
        for name, (disturb, expected, stated, what) in KINDS.items():
            took, wrong, starved = [], [], 0
            for n in range(times):
                since = scene.mark()
                took.append(disturb(scene, n))
                time.sleep(PAUSE_S + (0.3 if expected else 0.0))  # what comes late is of this one
                if _starved(scene, since, expected):
                    starved += 1
                else:
                    wrong += _unexpected(scene, since, expected)
            how = f"{what}; {times} times; in {starved} the machine was too busy for the arrays"
            records += _figures(name, took, wrong, stated, how)
        state, played, code = scene.finish()
        files = sorted((scene.folder / "recordings").glob("*.mcap"))
        for source in state["sources"]:
            name = source["part"]["name"].partition(".")[2]
            wire = "serial" if name == "whiskers" else "slcan"
            found = account(wire, played[name], source["stats"], recorded(files, name).seq)
            records.append(
                Record(
                    f"daemon.chaos.{name}_lost",
                    found.unbalanced + found.unexplained + found.miscounted, "samples", "== 0",
                    "unbalanced, unexplained, miscounted, over all of this", found.told,
                )
            )  # fmt: skip
        records.append(Record("daemon.chaos.exit_code", code, "", "== 0"))
        lines = scene.daemon.log().count("\n")
    records.append(
        Record("daemon.chaos.log_lines", lines, "lines", "", "", "what comes again is counted")
    )
    return [*records, *disk_full(times)]


def _figures(
    name: str, took: list[float], wrong: list[str], stated: float, how: str
) -> list[Record]:
    some = ", ".join(sorted(set(wrong))[:4])
    return [
        Record(
            f"daemon.chaos.{name}_recovery", max(took), "s", f"<= {stated:g}",
            f"median {np.median(took):.3f}", how,
        ),
        Record(f"daemon.chaos.{name}_told_wrongly", len(wrong), "events", "== 0", some, how),
    ]  # fmt: skip


def _starved(scene: DisturbedDaemon, since: int, expected: Expected) -> bool:
    """Whether an array that nobody touched told anything: then more is told, and rightly so."""
    devices = {t.part for t in scene.all_told(since) if t.state.startswith("device:")}
    return bool(devices - {part for part, _ in expected})


def _unexpected(scene: DisturbedDaemon, since: int, expected: Expected) -> list[str]:
    """What was told too often, not at all, or though nothing of it was to be told.

    That the daemon is degraded is told for each reason: lost, then late, then behind.
    """
    counts: dict[tuple[str, str], int] = {}
    reasons: set[str] = set()
    for told in scene.all_told(since):
        key = (told.part, told.state)
        if key == ("daemon", "degraded"):
            if told.reason not in reasons and key in counts:
                counts[key] -= 1
            reasons.add(told.reason)
        counts[key] = counts.get(key, 0) + 1
    wrong = []
    for key in {*counts, *expected}:
        least, most = expected.get(key, (0, 0))
        if not least <= counts.get(key, 0) <= most:
            wrong.append(f"{' '.join(key)} {counts.get(key, 0)}x")
    return wrong
