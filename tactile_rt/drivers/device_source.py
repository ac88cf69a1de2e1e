"""A device as a source: a line, a codec, the device's counter and clock, and its ups and downs.

    link --> codec --> sequence --> clock --> Chunk

There is no thread here: `read` does it all, so that nothing is buffered out of sight. A device that
goes away is tried again inside `read`; the stream goes on with the next sample it sends.
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

# Called with each packet as it came and its arrival (host time, ns), and with None whenever the
# line has been opened. It must be quick: the device is not read meanwhile.
Tap = Callable[[Any, int], None]

SLICE_S = 0.1  # how soon a waiting read notices that the source was closed
FIRST_RETRY_S, LAST_RETRY_S = 0.02, 0.1  # a path is looked for cheaply and often
ATTEMPTS = 3  # at a step of the start that gets no answer
ASK_NS = NS_PER_S  # without a sample, after which a device that describes itself is asked again
DESCRIBED_S = 0.5  # for a description of which the beginning has come


class ArrayChanged(SourceError):
    """Another array is at the port than the one that the stream is of."""


@dataclass(frozen=True)
class DeviceOptions:
    """Options of every device.

    Attributes:
        codec: Name of the codec that the device speaks, one of those that `tactile-rt codecs`
            lists.
        start_s: Longest time that the first sample may take, s; with 0 nobody waits for it.
        stale_s: Time without a sample after which the stream counts as stale, s; 0 stands for ten
            periods, at least 0.1 s.
        reconnect: Whether a lost line is opened again and again; without, reading breaks with a
            `SourceError`.
        calibration: A calibration file, or the id of a device calibrated before; empty for none.
        clock: ``host`` gives samples the host's time; ``device`` that of the device's own clock,
            which depends on the device alone, and agrees with nothing else's.
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
    """Samples from a device on a serial line or a CAN bus.

    Args:
        connect: Opens the line; called again after the line was lost.
        codec_options: Options of the codec as the user wrote them, for a recording to tell.

    Raises:
        SourceError: it cannot be opened, does not answer, or nothing that comes is of its codec.
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
        self._looked_ns = 0  # when nothing had come
        self._noise_ns = 0  # since when what comes is no sample; 0: it is
        self._asked_ns, self._resets = 0, 0  # when it was last asked again; its counter's then
        self.describes = codec.describes and codec.spec is None
        self._early: list[Samples] = []  # that came while the device was being started
        try:
            self._open()
            self._await_first()
        except BaseException:
            self._drop()
            raise
        assert codec.spec is not None
        super().__init__(codec.spec)
        self._described: ArraySpec | None = codec.spec  # another object with every description
        self._identity = self._known = self.identity  # now, and the last one that was known
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
            chunk = self._chunk(self._early.pop(0)) if self._early else self._receive(end)
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
                pass  # it is gone, which is what we want
        self._drop()

    def fileno(self) -> int:
        link = self._link
        # One that is asked for each sample must be read to be asked.
        return -1 if link is None or self._early or self.codec.polls else link.fileno()

    def tap(self, on_packet: Tap | None) -> None:
        """Pass every packet on as it came, before it is decoded; None: no longer.

        Those that came while the device was started are passed on at once, if nothing has been
        read yet: without them a device that describes itself cannot be decoded again.
        """
        first, self._first = self._first, None
        if on_packet is not None:
            for packet, t_ns in first or ():
                on_packet(packet, t_ns)
        self._tap = on_packet

    @property
    def health(self) -> Health:
        """How the device is doing, by what was found when it was last read; from any thread."""
        stamper, link = self._stamper, self._link
        assert stamper is not None
        clock, newest, status = stamper.clock, stamper.newest_ns, stamper.status
        state, since, reason = self._state, self._since, self._reason
        # Since then nobody may have looked: what waits in the line is no silence of the device.
        silent = self._looked_ns - newest
        if state == State.STREAMING and silent > self._stale_ns:
            state, since = State.STALE, newest + self._stale_ns
            reason = f"no sample for {silent / 1e9:.1f} s"
        bits, told = self.codec.status_bits.items(), stamper.told_ns
        recent = {bit for bit, at in told.items() if newest - at < NS_PER_S}
        faults = recent - self.codec.harmless_bits
        return Health(
            state, since, reason, self._connections, newest,
            clock.drift_ppm if clock and self.codec.tick_ns else 0.0,
            clock.steps if clock else 0,
            stamper.sequencer.resets,
            tuple(meaning for bit, meaning in bits if status >> bit & 1),
            self._can_errors + (link.can_errors if link else 0),
            self.codec.stats,
            tuple(meaning for bit, meaning in bits if bit in faults),
            self._identity.serial_number or self._identity.usb_number or "unknown",
            not stamper.sequencer.useless,
        )  # fmt: skip

    @property
    def identity(self) -> Identity:
        """Which array it is, by what it last told."""
        assert self.codec.spec is not None
        usb_number = self._link.usb_number if self._link else ""
        return Identity(self.codec.spec, self.codec.serial_number, usb_number)

    @property
    def measured(self) -> tuple[int, int]:
        """How many samples the device has measured, and by when, ns.

        By its own counter and clock if it has them, so that neither a loss nor the host matters.
        """
        stamper = self._stamper
        assert stamper is not None
        damaged = self.stats.corrupt if self.codec.count_bits is None else 0
        return stamper.sequencer.numbered + damaged, stamper.elapsed_ns

    def set_whisking(self, frequency_hz: float, amplitude_rad: float, offset_rad: float) -> None:
        """Move the whiskers of an active array: protraction = offset + amplitude sin(2 pi f t).

        Raises:
            SourceError: this device takes no such command, or is away.
        """
        whisk = getattr(self.codec, "whisk", None)
        if whisk is None:
            raise SourceError(f"{self.name}: codec {self.options.codec} has no whisking command")
        if self._link is None:
            raise SourceError(f"{self.name}: not connected")
        self._link.send(whisk(frequency_hz, amplitude_rad, offset_rad).send)

    def _receive(self, end: float | None) -> Chunk | None:
        """Wait for one packet, a slice of time at most."""
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
        try:
            found = link.receive(left)
        except SourceError as error:
            if not self._closed:  # else closing it is what ended the wait
                self._lose(str(error))
            return None
        if found is None:
            now_ns = self._looked_ns = time.monotonic_ns()
            if self.describes and self._stamper is not None:
                self._ask_again(now_ns, now_ns - self._stamper.newest_ns)
            return None
        packet, t_ns = found
        samples = self._feed(packet, t_ns)
        if self.describes:
            # What waited while nobody read is old, but no silence: its end may be half a frame.
            self._noise_ns = 0 if samples is not None else self._noise_ns or t_ns
            self._ask_again(t_ns, t_ns - self._noise_ns if self._noise_ns else 0)
            if self.codec.spec is not self._described:
                self._compare()
        return None if samples is None else self._chunk(samples)

    def _feed(self, packet: Any, t_ns: int) -> Samples | None:
        self._note(packet, t_ns)
        return self.codec.feed(packet, t_ns)

    def _note(self, packet: Any, t_ns: int) -> None:
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

    def _chunk(self, samples: Samples) -> Chunk | None:
        assert self._stamper is not None
        chunk = self._stamper.chunk(samples)
        if chunk is not None:
            if self._state != State.STREAMING:
                self._turn(State.STREAMING, "")
            self.stats.delivered += len(chunk)
        return chunk

    # identity

    def _compare(self) -> None:
        """Go on if this can be the same array; else raise an `ArrayChanged`."""
        self._described, found = self.codec.spec, self.identity
        if why := found.difference(self._known):
            self._closed = True
            self._drop()
            raise ArrayChanged(f"{self.name}: another array is at the port: {why}")
        self._identity = found
        if found.serial_number:
            self._known = found

    def _ask_again(self, now_ns: int, silent_ns: int) -> None:
        """Ask a device that is silent, or counts anew, what it is."""
        assert self._stamper is not None
        resets = self._stamper.sequencer.resets
        well = silent_ns < max(ASK_NS, self._stale_ns) and resets == self._resets
        if well or now_ns - self._asked_ns < ASK_NS or self._link is None:
            return
        self._asked_ns, self._resets = now_ns, resets
        if silent_ns > ASK_NS:
            self.codec.forget()  # among samples no other array is believed
        try:
            for step in self.codec.commands(Command.START):
                self._link.send(step.send)
        except SourceError as error:
            self._lose(str(error))

    # connecting

    def _open(self) -> None:
        self._link = self._connect()
        self._connections += 1
        self._note(None, time.monotonic_ns())
        self.codec.forget()
        if self._stamper is not None:
            self._stamper.resume()
        self._turn(State.CONNECTING, "")
        for step in self.codec.commands(Command.START):
            self._do(step)
        if self._stamper is not None:  # it was there before
            end = time.monotonic() + DESCRIBED_S
            while self.describes and self.codec.spec is self._described and time.monotonic() < end:
                self._listen(0.01, None)
            self._compare()

    def _do(self, step: Step[Any]) -> None:
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
        """Take what comes for so long, or until this answer has; whether it has."""
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
        """Wait for the device to describe itself and to send."""
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
            raise SourceError(f"{self.name}: {self._silence(came)}")

    def _silence(self, came: int) -> str:
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
        self._turn(State.LOST, why)
        self._retry_at = time.monotonic() + self._retry_s
        self._retry_s = min(LAST_RETRY_S, 2 * self._retry_s)

    def _drop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            self._can_errors += link.can_errors
            link.close()

    def _turn(self, state: State, reason: str) -> None:
        if state != self._state:
            self._since = time.monotonic_ns()
        self._state, self._reason = state, reason


def device_of(source: Source) -> DeviceSource | None:
    """The device behind a source, if there is one."""
    while isinstance(source, CalibratedSource):
        source = source.source
    return source if isinstance(source, DeviceSource) else None


def share_of_changes(source: Source) -> float:
    """Return the share of readings that changed while its tare was taken; 0: unknown."""
    return source.calibration.changes if isinstance(source, CalibratedSource) else 0.0
