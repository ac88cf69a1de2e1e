"""The whole daemon under way with faults every few seconds, for the soak.

An array of 35 x 6 at 1 kHz over a pty and one of 30 x 6 at 110 Hz over slcan, a model on each, the
recorder, three publishers with their peers, the page with somebody who looks at it.
"""

import http.client
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.daemon.accounts import RecordedSamples, recorded
from bench.daemon.models import finger_array, whisker_array, write_wide_model
from bench.daemon.peers import Heard, Listening, Ping, listen
from bench.daemon.process import DaemonProcess, Usage, free_port, until
from bench.emulated import ArrayScript, Played, fault_beat, play
from bench.processes import Helper
from tactile_rt.recording.reader import is_finished

QUICK_S, WHOLE_S = 20.0, 600.0
FIRST_FAULT_S, EVERY_S, APART_S = 4.0, 3.0, 0.4  # the two arrays' faults do not fall together
LOOK_S, ASK_S = 1.0, 10.0
DISTURBED_S = 600.0  # a soak of this length is flooded and overloaded, too
FLOOD, FLOODED_S = 1000, 5.0  # connections to each port, and how long they are held
HOGS_PER_CORE, OVERLOADED_S = 3, 60.0
GRACE_S, SILENT_S = 5.0, 240.0  # beyond the arrays' streams: to end them, to give up
WIRES = {"whiskers": "serial", "finger": "slcan"}


@dataclass(frozen=True)
class Soak:
    """What a soak showed.

    Attributes:
        seconds: Length of the arrays' streams, s.
        played: What each array did, by the array's name.
        state: The daemon's last snapshot.
        recorded: The samples in the recordings of each array.
        unfinished: Number of recordings that were not closed.
        heard: What each peer heard, by the peer's name.
        ping: The delay that the machine itself added meanwhile.
        usage: Processor time and memory of the daemon's process.
        disturbed: What was done to the daemon beside the arrays' faults: (what, from, to), in s of
            CLOCK_MONOTONIC.
        waiting: Most bytes seen waiting in each mailbox: (first half, second half).
        code: The daemon's exit code.
        stop_s: Time that the daemon took to stop, s.
        log: The text that the daemon logged.
    """

    seconds: float
    played: dict[str, Played]
    state: dict[str, Any]
    recorded: dict[str, RecordedSamples]
    unfinished: int
    heard: dict[str, Heard]
    ping: Ping
    usage: Usage
    disturbed: list[tuple[str, float, float]]
    waiting: dict[str, tuple[int, int]]
    code: int
    stop_s: float
    log: str


def configuration(urls: dict[str, str], ports: dict[str, int], further: str = "") -> str:
    """TOML of a daemon on these sources, with everything in it."""
    sources = "".join(f'[[source]]\nname = "{n}"\nurl = "{u}"\n' for n, u in urls.items())
    return f"""version = 1
{sources}[[model]]
source = "whiskers"
file = "wide.onnx"
[[model]]
source = "finger"
[[publisher]]
kind = "jsonl"
[[publisher]]
kind = "zmq"
options = {{ bind = "tcp://127.0.0.1:{ports["zmq"]}" }}
[[publisher]]
kind = "zenoh"
options = {{ listen = ["tcp/127.0.0.1:{ports["zenoh"]}"] }}
[recorder]
folder = "recordings"
min_free_mb = 64
rotate_s = 300
[page]
port = {ports["page"]}
[metrics]
port = {ports["metrics"]}
{further}"""


def soak(
    seconds: float,
    every_s: float = EVERY_S,
    first_s: float = FIRST_FAULT_S,
    enough: threading.Event | None = None,
) -> Soak:
    """Run the daemon for so long.

    Args:
        seconds: of the arrays' streams.
        every_s: from one fault of an array to its next.
        first_s: when its first one comes.
        enough: ends it earlier.
    """
    specs = {"whiskers": whisker_array(), "finger": finger_array()}
    with tempfile.TemporaryDirectory(prefix="tactile-soak-") as temporary, ExitStack() as stack:
        folder = Path(temporary)
        write_wide_model(folder / "wide.onnx", specs["whiskers"])
        arrays = {}
        for n, (name, spec) in enumerate(specs.items()):
            faults = fault_beat(WIRES[name], seconds, first_s + n * APART_S, every_s)
            script = ArrayScript(
                WIRES[name], spec, round(seconds * spec.rate_hz), str(folder / name), faults=faults
            )
            arrays[name] = stack.enter_context(Helper(play, script))
        urls = {name: helper.hear() for name, helper in arrays.items()}
        ports = {kind: free_port() for kind in ("zmq", "zenoh", "page", "metrics")}
        pipe = folder / "lines"
        os.mkfifo(pipe)
        stdout = os.open(pipe, os.O_RDWR)
        stack.callback(os.close, stdout)
        peers = stack.enter_context(Helper(
            listen, Listening(
                str(pipe), f"tcp://127.0.0.1:{ports['zmq']}", f"tcp/127.0.0.1:{ports['zenoh']}",
                ports["page"], "whiskers",
            ),
        ))  # fmt: skip
        daemon = stack.enter_context(
            DaemonProcess(folder, configuration(urls, ports), ports["metrics"], stdout)
        )
        peers.hear()
        disturbed: list[tuple[str, float, float]] = []
        if seconds >= DISTURBED_S:
            threading.Thread(
                target=_disturb, args=(seconds, ports, disturbed, daemon.process), daemon=True
            ).start()
        seconds, waiting = _watch(daemon, arrays, seconds, enough or threading.Event())
        state = daemon.await_state(lambda s: not any(_queued(s).values()))
        code, stop_s = daemon.stop()
        heard, ping = peers.ask("stop")
        played = {name: helper.ask("played", 60) for name, helper in arrays.items()}
        files = sorted((folder / "recordings").glob("*.mcap"))
        found = {name: recorded(files, name) for name in specs}
        return Soak(
            seconds, played, state, found, sum(not is_finished(f) for f in files), heard,
            ping, daemon.usage, disturbed, waiting, code, stop_s, daemon.log(),
        )  # fmt: skip


def _disturb(
    seconds: float,
    ports: dict[str, int],
    done: list[tuple[str, float, float]],
    process: "subprocess.Popen[bytes]",
) -> None:
    """A flood of connections, and then more to do than the machine can, in the second quarter."""
    began = time.monotonic()
    for share, what, act in ((0.25, "flood", _flood), (0.4, "overload", _overload)):
        time.sleep(max(0.0, share * seconds - (time.monotonic() - began)))
        if process.poll() is not None:
            return
        begin = time.monotonic()
        act(ports)
        done.append((what, begin, time.monotonic()))


def _flood(ports: dict[str, int]) -> None:
    """So many connections to whatever listens, held for a while."""
    for port in ports.values():
        with ExitStack() as stack:
            for _ in range(FLOOD):
                line = socket.socket()
                stack.callback(line.close)
                line.setblocking(False)
                line.connect_ex(("127.0.0.1", port))
            time.sleep(FLOODED_S)


def _overload(ports: dict[str, int]) -> None:
    hogs = [
        subprocess.Popen([sys.executable, "-c", "while True: pass"])
        for _ in range(HOGS_PER_CORE * (os.cpu_count() or 1))
    ]
    try:
        time.sleep(OVERLOADED_S)
    finally:
        for hog in hogs:
            hog.kill()
            hog.wait()


def _watch(
    daemon: DaemonProcess, arrays: dict[str, Helper], seconds: float, enough: threading.Event
) -> tuple[float, dict[str, tuple[int, int]]]:
    """Look until both arrays have fallen silent; (seconds, most that waited in each mailbox)."""
    began, asked, ended = time.monotonic(), 0.0, False
    most: dict[str, list[int]] = {}

    def over() -> bool:
        nonlocal asked, seconds, ended
        daemon.usage.look()
        now = time.monotonic()
        if now - asked > ASK_S:
            asked = now
            try:
                queued = _queued(daemon.state())
            except (OSError, http.client.HTTPException):
                queued = {}  # the machine has been busy for long: the next look will tell
            for name, size in queued.items():
                halves = most.setdefault(name, [0, 0])
                second = now - began > seconds / 2
                halves[second] = max(halves[second], size)
        # A busy machine may have kept the arrays from measuring as fast as they should.
        if not ended and (enough.is_set() or now - began > seconds + GRACE_S):
            seconds, ended = min(seconds, now - began), True
            for helper in arrays.values():
                helper.ask("end")
        return now - began > seconds and all(helper.ask("done") for helper in arrays.values())

    if not until(over, seconds + SILENT_S, LOOK_S):
        where = "; ".join(f"{name}: {helper.ask('where')}" for name, helper in arrays.items())
        raise TimeoutError(f"the arrays have not fallen silent: {where}")
    time.sleep(LOOK_S)
    return seconds, {name: (a, b) for name, (a, b) in most.items()}


def _queued(state: dict[str, Any]) -> dict[str, int]:
    """Bytes that wait for each part."""
    parts = [*state["models"], *state["consumers"]]
    return {part["part"]["name"]: part["queue"]["waiting_bytes"] for part in parts}
