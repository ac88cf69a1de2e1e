"""Emulator of a device: sends any source's samples, encoded by any codec, over a real line.

source --> [fit] --> device's counter and clock --> Codec.encode --> [faults] --> endpoint
                                 host's commands --> Codec.respond --> endpoint
"""

import threading
import time
from collections.abc import Iterator
from typing import Any, Final, Self

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import NS_PER_S, Chunk, EndOfStream, Source
from tactile_rt.drivers.codec import Codec
from tactile_rt.drivers.emulation.endpoints import Endpoint
from tactile_rt.drivers.emulation.faults import QUIET_S, DeviceLog, FaultSchedule
from tactile_rt.drivers.emulation.transmitter import EmulatedClock, RateConverter, Transmitter, fit

PACES = ("realtime", "fast")
SETTLE_S: Final = 0.2  # delay of unrequested samples: a host that opens a port discards old input
SLICE_S: Final = 0.05  # longest time until a wait notices that the emulator is closed
YIELD_S: Final = 1e-5  # so that a source that never waits does not delay the host's commands
PIECE: Final = 16  # samples encoded at a time if not paced by the clock
AHEAD_BYTES: Final = 65_536  # longest queue when the host sets the pace


class Emulator:
    """Emulated device that sends a source's samples. A context manager; runs in two threads.

    The source is first read when a host is connected and, if the codec requires it, has requested
    samples. With a source that is not live and pace ``fast``, the emulator always waits for its
    host and loses nothing. Samples that the source delivers while the device is stopped are not
    numbered. A polled device sends the newest sample. The caller closes the source.

    Args:
        codec: The codec that the device speaks. If its `spec` is None, it is set to the source's;
            else see `fit`. It also stores the hosts' commands.
        faults: The schedule of faults, which cannot be reused.
        log: Whether to record the fate of each sample (17 bytes each); if not, only counts are
            kept.
        pace: ``realtime`` sends samples when they are due (a live source has its own pace);
            ``fast`` as soon as the host takes them. In real time a device sends at its own rate or
            at the rate that a host has commanded, not the source's.
        seconds: Time after which to stop, s of the source's time; None to stop at its end. No fault
            happens just before the end, which for a live source must be given here.
        start_count: First value of the device's counter, e.g. just before it wraps.
        start_tick: First value of the device's clock, in ticks.
        drift_ppm: Excess speed of the device's clock, parts per million.

    Raises:
        ConfigError: codec and endpoint are of different wires, or a fault is impossible there.
    """

    def __init__(
        self,
        codec: Codec[Any],
        source: Source,
        endpoint: Endpoint[Any],
        faults: FaultSchedule | None = None,
        log: bool = True,
        *,
        pace: str = "realtime",
        seconds: float | None = None,
        start_count: int = 0,
        start_tick: int = 0,
        drift_ppm: float = 0.0,
    ) -> None:
        if codec.wire != endpoint.wire:
            raise ConfigError(f"a {codec.wire} codec cannot speak over a {endpoint.wire} endpoint")
        if pace not in PACES:
            raise ConfigError(f"pace must be one of {', '.join(PACES)}, not {pace!r}")
        if faults and codec.wire == "serial" and any(f.kind == "can_error" for f in faults.faults):
            raise ConfigError("fault can_error: a serial line has no error frames")
        if codec.spec is None:
            codec.spec = source.spec
        self.codec, self.source, self.endpoint = codec, source, endpoint
        if hasattr(codec, "may_whisk") and hasattr(source, "may_whisk"):
            codec.may_whisk = source.may_whisk  # impossible commands are not acknowledged
        self.log = DeviceLog(log)
        self._fit = fit(source.spec, codec.spec)
        self._rate = RateConverter(source.spec.rate_hz, codec) if pace == "realtime" else None
        self._seconds = seconds
        self._ahead_ns = QUIET_S * NS_PER_S if faults and not source.live else 0.0
        self._host_paces = pace == "fast" and not source.live
        self._streams_at_power_on = codec.streaming
        tick_ns = codec.tick_ns or 1.0
        wrap_ns = round(2**codec.tick_bits * tick_ns)
        clock = EmulatedClock(round(start_tick * tick_ns), drift_ppm, wrap_ns)
        self._sender = Transmitter(codec, endpoint, faults, self.log, clock, start_count)
        self._first_ns: int | None = None  # of the source's time
        self._began_ns = 0  # host time of the first sample
        self._newest: Chunk | None = None
        self._whisking: Any = None
        self._state = threading.Condition(threading.RLock())
        self._connected_at: float | None = None
        self._stopping = self._done = False
        self._failure: BaseException | None = None
        self._threads: list[threading.Thread] = []

    # public methods

    @property
    def address(self) -> str:
        """Part of the URL that a host opens, without its options."""
        return self.endpoint.address

    @property
    def done(self) -> bool:
        """Whether the source has ended, and no packets are left to send."""
        return self._done and (not self.endpoint.backlog or not self.endpoint.heard)

    def start(self) -> None:
        """Plug the device in and start its threads."""
        self.endpoint.plug()
        for work in (self._listen, self._measure):
            thread = threading.Thread(target=work, name=f"emulator-{work.__name__[1:]}")
            thread.start()
            self._threads.append(thread)

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until the emulator is `done`; return False after the timeout.

        Raises:
            TactileError: the source failed.
        """
        end = None if timeout is None else time.monotonic() + timeout
        while not self.done and self._failure is None:
            left = SLICE_S if end is None else min(SLICE_S, end - time.monotonic())
            if left <= 0:
                return False
            with self._state:
                if self._done:
                    left = min(left, 0.005)  # the end of the backlog gives no notification
                self._state.wait(left)
        if self._failure is not None:
            raise self._failure
        return True

    def close(self) -> None:
        """Stop the threads and remove the device; safe to call twice."""
        with self._state:
            self._stopping = True
            self._state.notify_all()
        self.endpoint.wake()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        self.endpoint.close()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def unplug(self) -> None:
        """Pull the device out; unsent packets and later samples are lost."""
        with self._state:
            self.endpoint.pull()
            self._connected_at = None

    def replug(self, restart: bool = False) -> None:
        """Plug the device in again, under the same link.

        Args:
            restart: Whether the device had lost power: its counter and clock then restart at 0, and
                it is in its state at power-on.
        """
        with self._state:
            self.endpoint.plug()
            if restart:
                self._sender.restart()
                self.codec.forget()
                self.codec.streaming, self.codec.polled = self._streams_at_power_on, 0
        self.endpoint.wake()

    # the host's commands

    def _listen(self) -> None:
        try:
            while not self._stopping:
                packet = self.endpoint.receive(SLICE_S)
                with self._state:
                    heard = self.endpoint.heard
                    if heard != (self._connected_at is not None):
                        self._connected_at = time.monotonic() if heard else None
                        if heard and self.codec.greeting:
                            self.endpoint.send(self.codec.greeting, answer=True)
                    elif not packet:
                        continue
                    if packet:
                        self._execute(packet)
                    self._state.notify_all()
        except BaseException as error:  # `wait` raises it
            self._failure = error

    def _execute(self, packet: Any) -> None:
        answer = self.codec.respond(packet)
        if answer:
            self.endpoint.send(answer, answer=True)
        if not self._host_paces and not self.codec.streaming and self._newest is not None:
            self._answer_polls(self._newest)

    # the samples

    def _measure(self) -> None:
        try:
            if self._wait_for_host():
                for chunk in self._read_chunks():
                    sampled = chunk if self._rate is None else self._rate.at_rate(chunk)
                    if sampled is not None:
                        self._send_when_due(self._fit(sampled))
            with self._state:
                self._sender.finish()
        except BaseException as error:
            self._failure = error
        with self._state:
            self._done = True
            self._state.notify_all()

    def _read_chunks(self) -> Iterator[Chunk]:
        """Yield the source's chunks, delayed so that the end is known before the last ones."""
        ahead: list[Chunk] = []
        while not self._stopping:
            self._pass_on_whisking()
            try:
                chunk = self.source.read(SLICE_S)
            except EndOfStream:
                if ahead:
                    self._sender.end_ns = min(self._sender.end_ns, int(ahead[-1].t_ns[-1]))
                break
            if chunk is None:
                continue
            if self._first_ns is None:
                self._first_ns, self._began_ns = int(chunk.t_ns[0]), time.monotonic_ns()
                self._sender.begin(self._first_ns)
                if self._seconds is not None:
                    self._sender.end_ns = self._first_ns + self._seconds * NS_PER_S
            n = int(np.searchsorted(chunk.t_ns, self._sender.end_ns))
            if n:
                ahead.append(chunk.select(slice(n)))
            while ahead and ahead[-1].t_ns[-1] - ahead[0].t_ns[-1] >= self._ahead_ns:
                yield ahead.pop(0)
                if not self._ahead_ns:
                    break
            if n < len(chunk):
                break
        for chunk in ahead:
            if not self._stopping:
                yield chunk

    def _send_when_due(self, chunk: Chunk) -> None:
        """Send each of a chunk's samples when it is due."""
        at = 0
        while at < len(chunk) and not self._stopping:
            if self._host_paces:
                time.sleep(YIELD_S)
                with self._state:  # so that no STOP comes between the wait and the sending
                    if not self._wait_for_host():
                        return
                    stop = at + (PIECE if self.codec.streaming else 1)
                    self._send_or_keep(chunk.select(slice(at, stop)))
            else:
                if self.source.live:
                    time.sleep(YIELD_S)
                    stop = at + PIECE
                else:
                    stop = self._wait_until_due(chunk, at)
                self._send_or_keep(chunk.select(slice(at, stop)))
            at = min(stop, len(chunk))

    def _wait_until_due(self, chunk: Chunk, at: int) -> int:
        """Wait until sample `at` is due; return the first index not yet due."""
        assert self._first_ns is not None
        while True:
            now = time.monotonic_ns() - self._began_ns + self._first_ns
            wait_s = (int(chunk.t_ns[at]) - now) / NS_PER_S
            if wait_s <= 0 or self._stopping:
                return max(at + 1, int(np.searchsorted(chunk.t_ns, now, "right")))
            time.sleep(min(wait_s, SLICE_S))

    def _wait_for_host(self) -> bool:
        """Wait until a host requests samples and the queue has room; return False when closing."""
        with self._state:
            while not self._stopping:
                measures = self.codec.measures and not self._host_paces
                active = self.codec.streaming or self.codec.polled > 0 or measures
                left = SLICE_S
                if self._connected_at is not None and self.endpoint.heard and active:
                    settled = self._connected_at + (SETTLE_S if self._streams_at_power_on else 0.0)
                    left = min(left, settled - time.monotonic())
                    if left <= 0:
                        if self.endpoint.backlog < AHEAD_BYTES:
                            return True
                        left = 0.001
                elif self._sender.away:  # only later samples plug the device in again
                    return True
                self._state.wait(left)
        return False

    def _send_or_keep(self, piece: Chunk) -> None:
        with self._state:
            if self.codec.streaming:
                self._sender.send(piece)
            else:
                self._newest = self.codec.newest = piece.select(slice(-1, None))
                if self._sender.away:  # no host can poll; time must advance to plug it in again
                    self._sender.look(int(self._newest.t_ns[0]))
                self._answer_polls(self._newest)

    def _answer_polls(self, sample: Chunk) -> None:
        while self.codec.polled > 0 and not self._stopping:
            self.codec.polled -= 1
            self._sender.send(sample)
            if self._host_paces:
                return

    def _pass_on_whisking(self) -> None:
        """Pass a host's whisking command on to a simulated array."""
        command = getattr(self.codec, "whisking", None)
        if command is not None and command != self._whisking:
            self._whisking = command
            move = getattr(self.source, "set_whisking", None)
            if move is not None:
                move(*command)
