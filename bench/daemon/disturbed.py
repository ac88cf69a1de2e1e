"""A daemon under way with two arrays, to be disturbed: what it tells, and when samples come."""

import os
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec

from bench.daemon.models import finger_array, whisker_array, write_wide_model
from bench.daemon.process import DaemonProcess, free_port, until
from bench.daemon.stepped import MAIN, PATH, WallClock
from bench.emulated import ArrayScript, Played, play
from bench.processes import Helper

LONGEST_S = 3600.0
SETTLED_S, SETTLED_MOST_S = 1.0, 5.0  # nothing told for so long; but a busy machine tells much
CONFIGURATION = """version = 1
[[source]]
name = "whiskers"
url = "{whiskers}"
[[source]]
name = "finger"
url = "{finger}"
[[model]]
source = "whiskers"
file = "wide.onnx"
[[model]]
source = "finger"
[[publisher]]
kind = "jsonl"
options = {{ state_s = 0.05 }}
[[publisher]]
kind = "zmq"
options = {{ bind = "tcp://127.0.0.1:{zmq}", state_s = 0.25 }}
[recorder]
folder = "recordings"
min_free_mb = 0
[page]
port = {page}
[metrics]
port = {metrics}
[log]
format = "json"
repeat_s = 3600
[limits]
stall_s = 0.5
"""


@dataclass(frozen=True)
class DaemonEvent:
    """An event that the daemon told: of which part, which state, why, when (CLOCK_MONOTONIC)."""

    part: str
    state: str
    reason: str
    t_ns: int


class DisturbedDaemon:
    """A context manager; when it is left, all is over.

    Args:
        before: called in the daemon's process before it becomes the daemon.
        prepare: called with the path of the model of ``whiskers`` before the daemon is started.
        configuration: TOML, with the URLs and ports in braces.

    Attributes:
        folder: The folder of the daemon's files.
        arrays: ``whiskers`` at 1 kHz on a serial line, ``finger`` at 110 Hz behind slcan.
        daemon: The process that the daemon runs in.
        clock: The hand on the daemon's wall clock.
        ports: TCP ports by what listens on them: ``zmq``, ``page``, ``metrics``.
        pipe: Descriptor from which the lines of the jsonl publisher can be read, some 200 kB/s.
    """

    def __init__(
        self,
        before: Any = None,
        prepare: Callable[[Path], None] = lambda path: None,
        configuration: str = CONFIGURATION,
    ) -> None:
        self._before, self._prepare, self._text = before, prepare, configuration
        self._stack = ExitStack()
        self._told: list[DaemonEvent] = []
        self._over = threading.Event()
        self._reading = threading.Event()
        self._paused = threading.Event()
        self._connected = False

    def __enter__(self) -> Self:
        try:
            self._begin(self._stack)
        except BaseException:
            self._stack.close()
            raise
        return self

    def _begin(self, stack: ExitStack) -> None:
        self.folder = Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-disturbed-"))
        )
        specs = {"whiskers": whisker_array(), "finger": finger_array()}
        self.model = self.folder / "wide.onnx"
        write_wide_model(self.model, specs["whiskers"])
        self._prepare(self.model)
        self.arrays = {
            name: stack.enter_context(
                Helper(play, ArrayScript(
                    "serial" if name == "whiskers" else "slcan", spec,
                    round(LONGEST_S * spec.rate_hz), str(self.folder / name),
                    options={"serial_number": "A"},
                ))
            )
            for name, spec in specs.items()
        }  # fmt: skip
        urls = {name: helper.hear() for name, helper in self.arrays.items()}
        self.ports = {kind: free_port() for kind in ("zmq", "page", "metrics")}
        self.configuration = self._text.format(**urls, **self.ports)
        self.clock = WallClock(self.folder / "clock")
        self.pipe, out = os.pipe()
        for work in (self._listen, self._drain):
            thread = threading.Thread(target=work, daemon=True)
            thread.start()
            stack.callback(thread.join, 5.0)
        stack.callback(self._over.set)
        self._reading.set()
        self.daemon = stack.enter_context(
            DaemonProcess(
                self.folder, self.configuration, self.ports["metrics"],
                out, {PATH: str(self.folder / "clock")}, self._before, MAIN,
            )
        )  # fmt: skip
        os.close(out)
        # A scene may be disturbed from its first second on.
        self.daemon.await_state(lambda s: s["state"] in ("running", "degraded"))
        until(lambda: self._connected)
        end, count = time.monotonic() + SETTLED_MOST_S, -1
        while count < len(self._told) and time.monotonic() < end:
            count = len(self._told)
            time.sleep(SETTLED_S)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._reading.set()
        self._stack.close()

    # what it tells

    def mark(self) -> int:
        """Where what is told from now on begins."""
        return len(self._told)

    def told(self, since: int, part: str, state: str) -> list[DaemonEvent]:
        """All such events since then."""
        return [t for t in self._told[since:] if (t.part, t.state) == (part, state)]

    def await_told(self, since: int, part: str, state: str, seconds: float = 20.0) -> DaemonEvent:
        """The first such event.

        Raises:
            TimeoutError: it does not come.
        """
        if not until(lambda: bool(self.told(since, part, state)), seconds, 0.002):
            raise TimeoutError(f"{part} {state} was not told within {seconds:g} s")
        return self.told(since, part, state)[0]

    def read_pipe(self, reading: bool) -> None:
        """Go on reading what its jsonl publisher writes, or let it wait."""
        if reading:
            self._reading.set()
        else:
            self._reading.clear()
            self._paused.wait(2.0)

    # the end

    def finish(self) -> tuple[dict[str, Any], dict[str, Played], int]:
        """(last snapshot, what the arrays did, exit code)."""
        for helper in self.arrays.values():
            helper.ask("end")
        until(lambda: all(helper.ask("done") for helper in self.arrays.values()))
        time.sleep(0.5)
        state = self.daemon.await_state(
            lambda s: not any(c["queue"]["waiting_bytes"] for c in s["consumers"])
        )
        code, _ = self.daemon.stop()
        return state, {name: h.ask("played", 60) for name, h in self.arrays.items()}, code

    # threads

    def _listen(self) -> None:
        import zmq

        context: Any = zmq.Context()
        with context, context.socket(zmq.SUB) as socket:
            socket.setsockopt(zmq.RCVTIMEO, 100)
            socket.setsockopt(zmq.RCVHWM, 0)
            for topic in (b"tactile/health", b"tactile/state"):
                socket.setsockopt(zmq.SUBSCRIBE, topic)
            socket.connect(f"tcp://127.0.0.1:{self.ports['zmq']}")
            while not self._over.is_set():
                try:
                    topic, line = socket.recv_multipart()
                except zmq.Again:
                    continue
                self._connected = True
                if topic.endswith(b"health"):
                    m = msgspec.json.decode(line)
                    self._told.append(DaemonEvent(m["part"], m["state"], m["reason"], m["t_ns"]))
            socket.setsockopt(zmq.LINGER, 0)

    def _drain(self) -> None:
        while not self._over.is_set():
            if not self._reading.is_set():
                self._paused.set()
                self._reading.wait(0.1)
                continue
            self._paused.clear()
            if not os.read(self.pipe, 1 << 16):
                break
        os.close(self.pipe)
