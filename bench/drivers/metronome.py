"""Devices that send on the beat and write down when: one thread for all, so that none waits."""

import time
from array import array
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S, Chunk
from tactile_rt.drivers.emulation.endpoints import Endpoint, SerialEndpoint, SlcanEndpoint
from tactile_rt.drivers.emulation.transmitter import EmulatedClock
from tactile_rt.drivers.opening import make_codec
from tactile_rt.sources.synthetic import synthetic_spec

ROOM = 32_768  # bytes waiting for a host that sets the pace
LISTEN_S = 0.02  # how often the host's commands are looked for
DIFFERENT = 64  # samples before values come again
NEVER = 1 << 62


@dataclass(frozen=True)
class Beat:
    """What is played.

    Attributes:
        wire: The line that each device is on, ``serial`` or ``slcan``.
        drifts_ppm: Drift of each device's clock, ppm too fast; one device for each.
        elements: Number of elements of a device, with six channels each.
        rate_hz: Sample rate of each device, Hz.
        seconds: Length of each device's stream, s.
        fast: Whether samples go out as fast as the host reads, not on the beat.
        twins: Whether each device has a twin that sends the same bytes at the same moment to a
            reader that only reads.
        options: Options of the native codec, as in a URL.
        phase: When devices send beside each other: ``together``, ``apart`` by equal parts of a
            period, or ``any``: as they were started.
    """

    wire: str
    drifts_ppm: tuple[float, ...]
    elements: int
    rate_hz: float
    seconds: float
    fast: bool = False
    twins: bool = False
    options: dict[str, str] = field(default_factory=dict)
    phase: str = "any"

    @property
    def samples(self) -> int:
        """Number of samples that each device sends."""
        return round(self.seconds * self.rate_hz)


@dataclass(frozen=True)
class Sent:
    """What a device has sent.

    Attributes:
        due_ns: (n,) host time that each sample is of.
        at_ns: (n,) host time just before it was handed to the line.
        twin_ns: (n,) the same of its twin; empty without one.
        refused: Number of samples for which the line had no room.
        packet: Number of bytes or frames of a sample.
    """

    due_ns: NDArray[np.int64]
    at_ns: NDArray[np.int64]
    twin_ns: NDArray[np.int64]
    refused: int
    packet: int


class _Device:
    """One device, and its twin."""

    def __init__(self, beat: Beat, drift_ppm: float, share: float = 0.0) -> None:
        self.beat, self._share = beat, share
        self.codec = make_codec(
            "serial" if beat.wire == "serial" else "can", "native", beat.options
        )
        spec = synthetic_spec(beat.elements, 6, beat.rate_hz)
        self.codec.spec = spec
        self.endpoint: Endpoint[Any] = (
            SerialEndpoint() if beat.wire == "serial" else SlcanEndpoint()
        )
        self.endpoint.plug()
        self.twin = SerialEndpoint() if beat.twins else None
        if self.twin is not None:
            self.twin.plug()
        draw = np.random.default_rng(0)
        self._values = draw.normal(0, 1e-3, (DIFFERENT, 1, *spec.shape)).astype(np.float32)
        self._valid = np.ones((1, beat.elements), np.bool_)
        self._clock = EmulatedClock(0, drift_ppm, 1 << 62)
        self._period_ns = NS_PER_S / beat.rate_hz
        self._begun_ns, self.count, self.refused, self.size = 0, 0, 0, 0
        self.due_ns = NEVER
        self._packet: Any = None
        self._due, self._at, self._twin_at = array("q"), array("q"), array("q")

    @property
    def over(self) -> bool:
        return self.count >= self.beat.samples

    def listen(self) -> None:
        """Hear the host; begin when it says so."""
        if self.twin is not None:
            self.twin.receive(0.0)
        heard = self.endpoint.receive(0.0)
        if not heard:
            return
        answer = self.codec.respond(heard)
        if answer:
            self.endpoint.send(answer, answer=True)
        if self.codec.streaming and not self._begun_ns:
            self._begun_ns = time.monotonic_ns() + round(LISTEN_S * NS_PER_S)
            if self.beat.phase != "any":
                share = self._share if self.beat.phase == "apart" else 0.0
                periods = self._begun_ns // self._period_ns + share
                self._begun_ns = round(periods * self._period_ns)
            self._clock.begin(self._begun_ns)
            self.prepare()

    def prepare(self) -> None:
        """Encode the next sample, before it is due."""
        if self.over:
            self.due_ns = NEVER
            return
        self.due_ns = self._begun_ns + round(self.count * self._period_ns)
        chunk = Chunk(
            np.array([self.count], np.int64),
            self._clock.at(np.array([self.due_ns], np.int64)),
            self._values[self.count % DIFFERENT],
            self._valid,
        )
        (self._packet,) = self.codec.encode(chunk)
        self.size = len(self._packet)

    def send(self, twin_first: bool) -> None:
        """Hand the sample to the line, and to the twin's."""
        twin = self.twin
        if twin is not None and twin_first:
            self._twin_at.append(time.monotonic_ns())
            twin.send(self._packet)
        self._at.append(time.monotonic_ns())
        if not self.endpoint.send(self._packet):
            self.refused += 1
        if twin is not None and not twin_first:
            self._twin_at.append(time.monotonic_ns())
            twin.send(self._packet)
        self._due.append(self.due_ns)
        self.count += 1

    def sent(self) -> Sent:
        due, at, twin_at = (np.array(a, np.int64) for a in (self._due, self._at, self._twin_at))
        return Sent(due, at, twin_at, self.refused, self.size)


def play(pipe: Connection, beat: Beat) -> None:
    """Say [(address, the twin's path)], play, say [`Sent`]; stay until the pipe is closed."""
    n = len(beat.drifts_ppm)
    devices = [_Device(beat, drift, k / n) for k, drift in enumerate(beat.drifts_ppm)]
    pipe.send([(d.endpoint.address, d.twin.pty.path if d.twin else "") for d in devices])
    listened, turn = 0.0, False
    while not all(device.over for device in devices) and not pipe.poll(0):
        if beat.fast:
            for device in devices:
                device.listen()
                while device.due_ns < NEVER and device.endpoint.backlog < ROOM:
                    device.send(False)
                    device.prepare()
            time.sleep(0.0002)
            continue
        now = time.monotonic()
        if now - listened > LISTEN_S:
            listened = now
            for device in devices:
                device.listen()
        wait_s = (min(d.due_ns for d in devices) - time.monotonic_ns()) / NS_PER_S
        if wait_s > 0:
            time.sleep(min(wait_s, LISTEN_S))
            continue
        turn = not turn
        now_ns = time.monotonic_ns()
        beaten = [device for device in devices if device.due_ns <= now_ns]
        for device in beaten:
            device.send(turn)
        for device in beaten:
            device.prepare()
            if device.endpoint.backlog:  # what a host was late for goes out when it is listened to
                device.listen()
    pipe.send([device.sent() for device in devices])
    try:
        while not pipe.poll(LISTEN_S):  # what is queued still goes out
            for device in devices:
                device.endpoint.receive(0.0)
                if device.twin is not None:
                    device.twin.receive(0.0)
    finally:
        for device in devices:
            device.endpoint.close()
            if device.twin is not None:
                device.twin.close()
