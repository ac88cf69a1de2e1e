"""Who listens to the daemon, in a process of its own: a pipe, ZeroMQ, Zenoh, a browser's stream."""

import http.client
import json
import os
import pty
import struct
import threading
import time
import tty
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

WAIT_MS = 200
PING_S = 0.01
AGAIN_S, RETRY_S = 0.2, 0.1


@dataclass(frozen=True)
class Listening:
    """Whom to listen to; what is empty is left out.

    Attributes:
        pipe: Path of the pipe that the lines of JSON come through.
        zmq: Endpoint of the ZeroMQ publisher.
        zenoh: Endpoint of the Zenoh publisher.
        page: TCP port of the daemon's page; 0: nobody looks at the page.
        source: Name of the source whose samples the page shows.
    """

    pipe: str = ""
    zmq: str = ""
    zenoh: str = ""
    page: int = 0
    source: str = ""


@dataclass(frozen=True)
class Heard:
    """What one of them has heard.

    Attributes:
        messages: Number of messages of all kinds.
        frames: Number of messages of the page that say what to draw.
        sources: Names of the sources, by the number in `source`.
        source: (n,) source of each decision, an index into `sources`.
        t_ns: (n,) stream time of each decision's last sample, ns.
        at_ns: (n,) host time at which each decision was in hand, ns.
        connections: Number of connections that were made.
        longest_s: Longest time from a message to the next, s.
    """

    messages: int
    frames: int
    sources: tuple[str, ...]
    source: NDArray[np.int8]
    t_ns: NDArray[np.int64]
    at_ns: NDArray[np.int64]
    connections: int
    longest_s: float


@dataclass(frozen=True)
class Ping:
    """What the machine adds to all that is measured here: eight bytes every ten milliseconds over
    a pty of their own, from one thread to another that does nothing else.

    Attributes:
        at_ns: (n,) host time at which each ping was written, ns.
        took_ms: (n,) time from each ping's writing to its reader, ms.
    """

    at_ns: NDArray[np.int64]
    took_ms: NDArray[np.float64]


class _Decision(msgspec.Struct):
    source: str
    t_ns: int


class _Ear:
    """Notes what comes."""

    def __init__(self) -> None:
        self.messages = self.frames = self.connections = 0
        self._names: list[str] = []
        self._source, self._t_ns, self._at_ns = array("b"), array("q"), array("q")
        self._decoder = msgspec.json.Decoder(_Decision)
        self._last, self._longest = 0, 0

    def note(self, line: bytes) -> None:
        """A message as JSON."""
        now = time.monotonic_ns()
        self.messages += 1
        if self._last:
            self._longest = max(self._longest, now - self._last)
        self._last = now
        self.frames += line.startswith(b'{"type":"frame"')
        if line.startswith(b'{"type":"decision"'):
            decision = self._decoder.decode(line)
            if decision.source not in self._names:
                self._names.append(decision.source)
            self._source.append(self._names.index(decision.source))
            self._t_ns.append(decision.t_ns)
            self._at_ns.append(now)

    def heard(self) -> Heard:
        return Heard(
            self.messages, self.frames, tuple(self._names), np.array(self._source, np.int8),
            np.array(self._t_ns, np.int64), np.array(self._at_ns, np.int64), self.connections,
            self._longest / 1e9,
        )  # fmt: skip


def listen(pipe: Connection, whom: Listening) -> None:
    """Say when all listen; then obey ``stop``: say {name: `Heard`}, and a `Ping`."""
    over = threading.Event()
    work: dict[str, Callable[[_Ear, threading.Event], None]] = {}
    if whom.pipe:
        work["jsonl"] = lambda ear, over: _read_pipe(whom.pipe, ear)
    if whom.zmq:
        work["zmq"] = lambda ear, over: _read_zmq(whom.zmq, ear, over)
    if whom.zenoh:
        work["zenoh"] = lambda ear, over: _read_zenoh(whom.zenoh, ear, over)
    if whom.page:
        work["page"] = lambda ear, over: _read_page(whom.page, whom.source, ear, over)
    ears = {name: _Ear() for name in work}
    pings = array("q"), array("q")
    threads = [
        threading.Thread(target=work[name], args=(ear, over), daemon=True)
        for name, ear in ears.items()
    ]
    master, slave = pty.openpty()
    tty.setraw(slave)
    threads.append(threading.Thread(target=_ping, args=(master, over), daemon=True))
    threads.append(threading.Thread(target=_pong, args=(slave, pings, over), daemon=True))
    for thread in threads:
        thread.start()
    while not all(ear.connections for ear in ears.values()):
        time.sleep(0.01)
    pipe.send("listening")
    try:
        pipe.recv()
    except EOFError:
        return
    over.set()
    for thread in threads:
        thread.join(3.0)
    at_ns, took_ns = (np.array(p, np.int64) for p in pings)
    pipe.send(({name: ear.heard() for name, ear in ears.items()}, Ping(at_ns, took_ns / 1e6)))


def _ping(master: int, over: threading.Event) -> None:
    while not over.is_set():
        time.sleep(PING_S)
        os.write(master, struct.pack("<q", time.monotonic_ns()))
    os.write(master, struct.pack("<q", 0))


def _pong(slave: int, pings: "tuple[array[int], array[int]]", over: threading.Event) -> None:
    data = b""
    while True:
        data += os.read(slave, 4096)
        now = time.monotonic_ns()
        while len(data) >= 8:
            (sent,), data = struct.unpack("<q", data[:8]), data[8:]
            if not sent:
                return
            pings[0].append(sent)
            pings[1].append(now - sent)


def _read_pipe(path: str, ear: _Ear) -> None:
    with open(path, "rb") as lines:
        ear.connections += 1
        for line in lines:
            ear.note(line)


def _read_zmq(endpoint: str, ear: _Ear, over: threading.Event) -> None:
    import zmq

    context: Any = zmq.Context()
    with context, context.socket(zmq.SUB) as socket:
        socket.setsockopt(zmq.RCVTIMEO, WAIT_MS)
        socket.setsockopt(zmq.SUBSCRIBE, b"")
        socket.connect(endpoint)
        ear.connections += 1
        while not over.is_set():
            try:
                ear.note(socket.recv_multipart()[1])
            except zmq.Again:
                continue
        socket.setsockopt(zmq.LINGER, 0)


def _read_zenoh(endpoint: str, ear: _Ear, over: threading.Event) -> None:
    import zenoh

    config = zenoh.Config()
    for key, value in (
        ("mode", "client"), ("scouting/multicast/enabled", False),
        ("connect/endpoints", [endpoint]),
    ):  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    session = None
    while session is None and not over.is_set():
        try:
            session = zenoh.open(config)
        except zenoh.ZError:  # the daemon does not listen yet
            over.wait(RETRY_S)
    if session is None:
        return
    with session:
        session.declare_subscriber("tactile/**", lambda sample: ear.note(sample.payload.to_bytes()))
        ear.connections += 1
        over.wait()


def _read_page(port: int, source: str, ear: _Ear, over: threading.Event) -> None:
    """As a browser's page: one endless answer, asked for again when it ends."""
    while not over.is_set():
        line = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
        try:
            line.request("GET", f"/live?source={source}")
            answer = line.getresponse()
            ear.connections += 1
            while not over.is_set() and (told := answer.readline()):
                ear.note(told)
        except (OSError, http.client.HTTPException):
            pass
        finally:
            line.close()
        over.wait(AGAIN_S)
