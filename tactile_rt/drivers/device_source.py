"""A device as a source: its line, codec, sample counter, clock and reconnection.

    link --> codec --> sequence --> clock --> Chunk

No thread is used: `read` does everything, so there is no hidden buffer. If the line is lost, `read`
opens it again; the stream goes on with the next sample that the device sends.
"""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from tactile_rt.calibration import CalibratedSource
from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source
from tactile_rt.drivers.clocks import DeviceTime, Stamper
from tactile_rt.drivers.codec import Codec, Command, Samples, Step
from tactile_rt.drivers.health import Health, Identity, State
from tactile_rt.drivers.links import Link

# Called with each raw packet and its arrival (host time, ns), and with None whenever the line has
# been opened. It must be quick: the device is not read while it runs.
Tap = Callable[[Any, int], None]

SLICE_S = 0.1  # longest time until a waiting read notices that the source was closed
FIRST_RETRY_S, LAST_RETRY_S = 0.02, 0.1  # short, since checking for a path is cheap
ATTEMPTS = 3  # at a step of the start that gets no answer
ASK_NS = NS_PER_S  # time without a sample, after which a description is requested again
DESCRIBED_S = 0.5  # longest wait for a description after a reconnection


class ArrayChanged(SourceError):
    """Raised when the array at the port is not that at the stream's start."""


@dataclass(frozen=True)
class DeviceOptions:
    """Options of every device.

    Attributes:
        codec: Name of the codec that the device speaks, from the list of `tactile-rt codecs`.
        start_s: Longest time that the first sample may take, s; 0 does not wait for it.
        stale_s: Time without a sample after which the stream counts as stale, s; 0 stands for ten
            sample periods, at least 0.1 s.
        reconnect: Whether to reopen a lost line until it works; if not, reading raises a
            `SourceError`.
        calibration: A calibration file, or the id of a device calibrated before; empty for none.
        clock: ``host`` stamps samples with the host's time, ``device`` with the time of the
            device's own clock, which is synchronised with no other clock.
    """

    codec: str
    start_s: float = 3.0
    stale_s: float = 0.0
    reconnect: bool = True
    calibration: str = ""
    clock: str = "host"

    def __post_init__(self) -> None:
        for name in ("start_s", "stale_s"):
            if getattr(self, name) < 0:
                raise ConfigError(f"{name} must be 0 or more, not {getattr(self, name):g}")
        if self.clock not in ("host", "device"):
            raise ConfigError(f"clock must be host or device, not {self.clock!r}")


class DeviceSource(Source):
    """Source of samples from a device on a serial line or a CAN bus.

    Args:
        connect: Opens the line; called again after the line was lost.
        codec_options: Options of the codec as the user wrote them, to store with a recording.

    Raises:
        SourceError: it cannot be opened, does not answer, or sends nothing that the codec decodes.
    """

    def __init__(
        self,
        connect: Callable[[], Link[Any]],
        codec: Codec[Any],
        options: DeviceOptions,
        name: str,
        codec_options: Mapping[str, str] | None = None,
    ) -> None:
        if options.clock == "device" and codec.tick_ns is None:
            raise ConfigError(f"codec {options.codec} sends no time: it needs clock=host")
        self.codec, self.options, self.name = codec, options, name
        self.codec_options = dict(codec_options or {})
        self._connect = connect
        self._link: Link[Any] | None = None
        self._closed = False
        self._state, self._since, self._reason = State.CONNECTING, time.monotonic_ns(), ""
        self._connections = self._can_errors = 0
        self._stamper: Stamper | None = None
        self._first: list[tuple[Any, int]] | None = []  # packets before the first read
        self._tap: Tap | None = None
        self._retry_at, self._retry_s = 0.0, FIRST_RETRY_S
        self._poll_at = 0.0
        self._found_empty_ns = 0  # time of the last read that found nothing
        self._noise_ns = 0  # time since which no input was a sample; 0 if the last input was
        self._asked_ns, self._resets = 0, 0  # last request for a description; counter resets then
        self.describes = codec.describes and codec.spec is None
        self._early: list[Samples] = []  # received while the device was being started
        try:
            self._open()
            self._await_first()
        except BaseException:
            self._drop()
            raise
        assert codec.spec is not None
        super().__init__(codec.spec)
        self._last_spec: ArraySpec | None = codec.spec  # each description gives a new object
        self._identity = self._known_identity = self.identity  # now, and last with a serial number
        self._stamper = Stamper(codec, self.spec, self.stats)
        if options.clock == "device" and codec.tick_ns is not None:
            self._stamper.clock = DeviceTime(codec.tick_ns, codec.tick_bits)
        self._period_ns = round(NS_PER_S / self.spec.rate_hz)
        self._stale_ns = round(1e9 * (options.stale_s or max(0.1, 10 / self.spec.rate_hz)))

    # reading

    def read(self, timeout: float | None = None) -> Chunk | None:
        end = None if timeout is None else time.monotonic() + timeout
        self._first = None
        while not self._closed:
            chunk = self._make_chunk(self._early.pop(0)) if self._early else self._receive(end)
            if chunk is not None:
                return chunk
            if not self._early and end is not None and time.monotonic() >= end:
                return None
        raise EndOfStream

    def close(self) -> None:
        self._closed = True
        self._early.clear()
        if self._link is not None:
            try:
                for step in self.codec.commands(Command.STOP):
                    self._link.send(step.send)
            except SourceError:
                pass  # the line is gone, as intended
        self._drop()

    def fileno(self) -> int:
        link = self._link
        # A polled device must be read without waiting: `read` requests its samples.
        return -1 if link is None or self._early or self.codec.polls else link.fileno()

    def tap(self, on_packet: Tap | None) -> None:
        """Pass every raw packet to `on_packet` before it is decoded; stop if it is None.

        Packets received while the device was started are passed at once, if nothing has been
        read yet: without them, a replay could not decode a device that describes itself.
        """
        first, self._first = self._first, None
        if on_packet is not None:
            for packet, t_ns in first or ():
                on_packet(packet, t_ns)
        self._tap = on_packet

    @property
    def health(self) -> Health:
        """State of the device as of the last read; available from any thread."""
        stamper, link = self._stamper, self._link
        assert stamper is not None
        clock, newest, status = stamper.clock, stamper.newest_ns, stamper.status
        state, since, reason = self._state, self._since, self._reason
        # Up to the last look at an empty line: unread data in the line is no silence.
        silent = self._found_empty_ns - newest
        if state == State.STREAMING and silent > self._stale_ns:
            state, since = State.STALE, newest + self._stale_ns
            reason = f"no sample for {silent / 1e9:.1f} s"
        bits, set_ns = self.codec.status_bits.items(), stamper.told_ns
        recent = {bit for bit, at in set_ns.items() if newest - at < NS_PER_S}
        faults = recent - self.codec.harmless_bits
        return Health(
            state, since, reason, self._connections, newest,
            clock.drift_ppm if clock and self.codec.tick_ns else 0.0,
            clock.steps if clock else 0,
            stamper.sequencer.known_resets,
            tuple(meaning for bit, meaning in bits if status >> bit & 1),
            self._can_errors + (link.can_errors if link else 0),
            self.codec.stats,
            tuple(meaning for bit, meaning in bits if bit in faults),
            self._identity.serial_number or self._identity.usb_number or "unknown",
            not stamper.sequencer.useless,
        )  # fmt: skip

    @property
    def identity(self) -> Identity:
        """Identity of the array, as last reported by the device."""
        assert self.codec.spec is not None
        usb_number = self._link.usb_number if self._link else ""
        return Identity(self.codec.spec, self.codec.serial_number, usb_number)

    @property
    def measured(self) -> tuple[int, int]:
        """Number of samples that the device has measured, and the time of the newest, ns.

        Both are by the device's counter and clock if it has them, so independent of the host.
        """
        stamper = self._stamper
        assert stamper is not None
        damaged = self.stats.corrupt if self.codec.count_bits is None else 0
        return stamper.sequencer.numbered + damaged, stamper.elapsed_ns

    def set_whisking(self, frequency_hz: float, amplitude_rad: float, offset_rad: float) -> None:
        """Command an active array's protraction: offset + amplitude sin(2 pi f t), rad.

        Raises:
            SourceError: the device has no such command, or is not connected.
        """
        whisk = getattr(self.codec, "whisk", None)
        if whisk is None:
            raise SourceError(f"{self.name}: codec {self.options.codec} has no whisking command")
        if self._link is None:
            raise SourceError(f"{self.name}: not connected")
        self._link.send(whisk(frequency_hz, amplitude_rad, offset_rad).send)

    def _receive(self, end: float | None) -> Chunk | None:
        """Receive one packet within `SLICE_S`; return the chunk that it completes, or None."""
        now = time.monotonic()
        left = SLICE_S if end is None else min(SLICE_S, max(0.0, end - now))
        if self._link is None:
            if now < self._retry_at:
                time.sleep(min(left, self._retry_at - now))
                return None
            try:
                self._open()
            except ArrayChanged:
                raise
            except SourceError as error:
                self._lose(str(error))
            return None
        link = self._link
        if self.codec.polls:
            left = self._poll(link, now, left)
            if self._link is None:  # lost as it was polled
                return None
        try:
            found = link.receive(left)
        except SourceError as error:
            if not self._closed:  # otherwise `close` ended the wait
                self._lose(str(error))
            return None
        if found is None:
            now_ns = self._found_empty_ns = time.monotonic_ns()
            if self.describes and self._stamper is not None:
                self._ask_again(now_ns, now_ns - self._stamper.newest_ns)
            return None
        packet, t_ns = found
        samples = self._feed(packet, t_ns)
        if self.describes:
            # A backlog is old, but no silence of the device: it may end in half a frame.
            self._noise_ns = 0 if samples is not None else self._noise_ns or t_ns
            self._ask_again(t_ns, t_ns - self._noise_ns if self._noise_ns else 0)
            if self.codec.spec is not self._last_spec:
                self._check_identity()
        return None if samples is None else self._make_chunk(samples)

    def _feed(self, packet: Any, t_ns: int) -> Samples | None:
        self._record_packet(packet, t_ns)
        return self.codec.feed(packet, t_ns)

    def _record_packet(self, packet: Any, t_ns: int) -> None:
        if self._tap is not None:
            self._tap(packet, t_ns)
        elif self._first is not None:
            self._first.append((packet, t_ns))

    def _poll(self, link: Link[Any], now: float, left: float) -> float:
        if now >= self._poll_at:
            try:
                for step in self.codec.commands(Command.POLL):
                    link.send(step.send)
            except SourceError as error:
                self._lose(str(error))
            period = self._period_ns / NS_PER_S
            self._poll_at = max(self._poll_at + period, now)
        return min(left, max(0.0, self._poll_at - now))

    def _make_chunk(self, samples: Samples) -> Chunk | None:
        assert self._stamper is not None
        chunk = self._stamper.chunk(samples)
        if chunk is not None:
            if self._state != State.STREAMING:
                self._set_state(State.STREAMING, "")
            self.stats.delivered += len(chunk)
        return chunk

    # identity

    def _check_identity(self) -> None:
        """Raise an `ArrayChanged` if the device cannot be the same array."""
        self._last_spec, found = self.codec.spec, self.identity
        if why := found.difference(self._known_identity):
            self._closed = True
            self._drop()
            raise ArrayChanged(f"{self.name}: another array is at the port: {why}")
        self._identity = found
        if found.serial_number:
            self._known_identity = found

    def _ask_again(self, now_ns: int, silent_ns: int) -> None:
        """Request a description again if the device is silent or its counter was reset."""
        assert self._stamper is not None
        resets = self._stamper.sequencer.known_resets
        well = silent_ns < max(ASK_NS, self._stale_ns) and resets == self._resets
        if well or now_ns - self._asked_ns < ASK_NS or self._link is None:
            return
        self._asked_ns, self._resets = now_ns, resets
        if silent_ns > ASK_NS:
            self.codec.forget()  # within a stream, a codec rejects another array's description
        try:
            for step in self.codec.commands(Command.START):
                self._link.send(step.send)
        except SourceError as error:
            self._lose(str(error))

    # connecting

    def _open(self) -> None:
        self._link = self._connect()
        self._connections += 1
        self._record_packet(None, time.monotonic_ns())
        self.codec.forget()
        if self._stamper is not None:
            self._stamper.resume()
        self._set_state(State.CONNECTING, "")
        for step in self.codec.commands(Command.START):
            self._run_step(step)
        if self._stamper is not None:  # this is a reconnection
            end = time.monotonic() + DESCRIBED_S
            while self.describes and self.codec.spec is self._last_spec and time.monotonic() < end:
                self._listen(0.01, None)
            self._check_identity()

    def _run_step(self, step: Step[Any]) -> None:
        link = self._link
        assert link is not None
        for _ in range(ATTEMPTS):
            if step.send:
                link.send(step.send)
            answered = self._listen(step.timeout_s, step.expect) if step.expect else True
            if answered:
                if step.pause_s:
                    self._listen(step.pause_s, None)
                return
        raise SourceError(
            f"{self.name}: no answer to {step.what or 'the start command'}: is it a "
            f"{self.options.codec} device, switched on, at the right baud or bit rate?"
        )

    def _listen(self, seconds: float, expect: bytes | int | None) -> bool:
        """Feed input to the codec; return whether the expected answer came in time."""
        assert self._link is not None
        end = time.monotonic() + seconds
        tail: Any = None
        while (left := end - time.monotonic()) > 0:
            found = self._link.receive(left)
            if found is None:
                continue
            packet, t_ns = found
            samples = self._feed(packet, t_ns)
            if samples is not None:
                self._early.append(samples)
            if isinstance(expect, bytes):
                tail = (tail or b"") + packet
                if expect in tail:
                    return True
                tail = tail[-len(expect) :]
            elif expect is not None and any(frame.id == expect for frame in packet):
                return True
        return False

    def _await_first(self) -> None:
        """Wait until the device has described itself and sent a sample."""
        assert self._link is not None
        before = time.monotonic()
        end = before + self.options.start_s
        came = 0
        while not (self._early and self.codec.spec) and time.monotonic() < end:
            if self.codec.polls:
                for step in self.codec.commands(Command.POLL):
                    self._link.send(step.send)
            found = self._link.receive(min(SLICE_S, max(0.0, end - time.monotonic())))
            if found is None:
                continue
            came += len(found[0])
            samples = self._feed(*found)
            if samples is not None:
                self._early.append(samples)
        if self.codec.spec is None or (self.options.start_s and not self._early):
            raise SourceError(f"{self.name}: {self._explain_silence(came)}")

    def _explain_silence(self, came: int) -> str:
        stats = self.codec.stats
        seconds = f"{self.options.start_s:g} s"
        things = "bytes" if self.codec.wire == "serial" else "frames"
        if not came and not stats.intact:
            return f"nothing came for {seconds}: is the device on, and this its line?"
        if stats.intact and self.codec.spec is None:
            return (
                "the device sends samples but does not describe its array: give array=FILE.json, "
                "as `tactile-rt describe` writes it"
            )
        rate = "baud rate" if self.codec.wire == "serial" else "bit rate or identifier"
        guess = (
            f"wrong codec, or wrong {rate}? ({stats.corrupt} damaged frames, {stats.skipped} "
            f"{things} beside frames)"
        )
        return (
            f"{came} {things} came in {seconds}, and no whole {self.options.codec} sample: "
            f"{self.codec.complaint or guess}; `tactile-rt dump` shows what comes"
        )

    def _lose(self, why: str) -> None:
        self._drop()
        if not self.options.reconnect:
            self._closed = True
            raise SourceError(why)
        if self._state != State.LOST:
            self._retry_s = FIRST_RETRY_S
        self._set_state(State.LOST, why)
        self._retry_at = time.monotonic() + self._retry_s
        self._retry_s = min(LAST_RETRY_S, 2 * self._retry_s)

    def _drop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            self._can_errors += link.can_errors
            link.close()

    def _set_state(self, state: State, reason: str) -> None:
        if state != self._state:
            self._since = time.monotonic_ns()
        self._state, self._reason = state, reason


def device_of(source: Source) -> DeviceSource | None:
    """Return the `DeviceSource` under a source's calibrations; None if it reads no device."""
    while isinstance(source, CalibratedSource):
        source = source.source
    return source if isinstance(source, DeviceSource) else None


def share_of_changes(source: Source) -> float:
    """Return the share of readings that changed during the source's tare; 0 if unknown."""
    return source.calibration.changes if isinstance(source, CalibratedSource) else 0.0
