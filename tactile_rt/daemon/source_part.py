"""The part of a source: opened, read, closed, and opened again after a failure.

    lines --> Acquisition (one thread) --> SourcePart --> hub

A source's own thread opens it, reads it if it has no line, and opens a lost line again. While there
is a line, this thread lends the source to the single thread that reads all lines, and waits.
"""

import dataclasses
import math
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Any

from tactile_rt.classifier.classifier import without_bad_samples
from tactile_rt.core.errors import SourceError, SpecMismatch
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, EndOfStream, Source, SourceStats
from tactile_rt.core.stream.sensor_spec import SensorSpec
from tactile_rt.daemon.clock import Clock
from tactile_rt.daemon.config import LimitsConfig, SourceConfig
from tactile_rt.daemon.diagnostics import LossWindow, oldest_s
from tactile_rt.daemon.items import Closed, Opened, Packet, SourceChunk
from tactile_rt.daemon.mailbox import Hub
from tactile_rt.daemon.part import Part, Report
from tactile_rt.daemon.rate_meter import RateMeter
from tactile_rt.daemon.states import SourceState
from tactile_rt.daemon.stuck_at import StuckAtDetector
from tactile_rt.drivers.device_source import (
    ArrayChanged,
    DeviceSource,
    device_of,
    share_of_changes,
)
from tactile_rt.drivers.health import Health, Identity, State
from tactile_rt.drivers.reader import Reader
from tactile_rt.sources.opening import open_source

POLL_S = 0.1  # how soon it notices that it should stop
LOOK_NS = 50_000_000  # between two looks at a device's health
CLOCK_NS, CLOCK_OFF = 5 * NS_PER_S, 0.02  # stretches of a device's clock; of its speed
AWAY_S = 0.3  # how long a source whose device is away may take to end


@dataclasses.dataclass(eq=False)
class _Lent:
    source: Source
    take: Callable[[Chunk | None], None]
    wanted: Callable[[], bool]
    over: threading.Event = dataclasses.field(default_factory=threading.Event)
    error: Exception | None = None


class Acquisition:
    """The thread that reads all sources lent by `attend`; it runs while it has any."""

    def __init__(self) -> None:
        self._reader = Reader()
        self._new: deque[_Lent] = deque()
        self._lent: dict[Source, _Lent] = {}
        self._lock = threading.Lock()  # guards the thread's beginning and end
        self._running = False

    def attend(
        self, source: Source, take: Callable[[Chunk | None], None], wanted: Callable[[], bool]
    ) -> None:
        """Lend a source to the reading thread, and wait until that stops reading it.

        Args:
            take: Called in the reading thread with each chunk; several times a second with None,
                if none comes.
            wanted: Returns whether to go on; reading also ends when the line is lost.
        """
        lent = _Lent(source, take, wanted)
        with self._lock:
            if not self._running:  # a start that fails is retried with the source
                threading.Thread(target=self._run, name="tactile-rt lines", daemon=True).start()
                self._running = True
            self._new.append(lent)
        self._reader.wake()
        lent.over.wait()
        if lent.error is not None:
            raise lent.error

    def _run(self) -> None:
        while True:
            with self._lock:
                while self._new:
                    lent = self._new.popleft()
                    self._lent[lent.source] = lent
                    self._reader.add(lent.source)
                if not self._lent:
                    self._running = False
                    return
            for source in self._reader.wait():
                self._read_lent(self._lent[source])

    def _read_lent(self, lent: _Lent) -> None:
        try:
            if lent.wanted():
                lent.take(lent.source.read(0.0))
                if lent.source.fileno() >= 0:
                    return
        except Exception as error:
            lent.error = error
        del self._lent[lent.source]
        self._reader.remove(lent.source)
        lent.over.set()


class SourcePart(Part):
    """The part that reads one source and posts its `Opened`, `Packet`, `SourceChunk`, `Closed`."""

    def __init__(
        self,
        config: SourceConfig,
        hub: Hub,
        report: Report,
        limits: LimitsConfig,
        clock: Clock,
        lines: Acquisition,
    ) -> None:
        super().__init__(f"source.{config.name}", report, limits)
        self._lines = lines
        self.config = config
        self._hub, self._clock = hub, clock
        self._stream: Source | None = None
        self._device: DeviceSource | None = None
        self._spec: ArraySpec | None = None
        self._before = SourceStats()  # of all streams before this one
        self._samples = self._newest_ns = self._read_ns = self._flowing_ns = self._bad = 0
        self._stuck_at, self._tared_changes = StuckAtDetector(), 0.0
        self._losses, self._bads = LossWindow(), LossWindow()
        self._repeats, self._restarts, self._restarted = LossWindow(), LossWindow(), 0
        self._rate, self._clock_rate = RateMeter(), RateMeter(CLOCK_NS)
        self.accepted: Identity | None = None  # the array that it began with
        self.another = ""  # how the present array differs from that one
        self._offset_ns = 0
        self._look_ns = self._pause_ns = 0
        self._reported: tuple[Any, ...] = ()
        self._opening = self._announced = self._left = False
        self._closing = threading.Lock()  # guards the report of the stream's end
        self._stopped_s = 0.0  # CLOCK_MONOTONIC

    @property
    def source_state(self) -> SourceState:
        """Present state of the source, for the snapshot."""
        spec, stream, device = self._spec, self._stream, self._device
        stats = self._before if stream is None else _add_stats(self._before, stream.stats)
        about = SourceState(
            self.state, self.config.url, device=device.health if device else None, stats=stats,
            samples=self._samples, newest_ns=self._newest_ns, read_ns=self._read_ns,
            flowing_ns=self._flowing_ns,
            live=stream is not None and stream.live,
            losses=self._losses.add(stats.corrupt + stats.missing + stats.dropped),
            repeats=self._repeats.add(stats.duplicates),
            restarts=self._restarts.add(self._restarted),
            bad_samples=self._bad, bad=self._bads.add(self._bad), stuck_at_s=self._stuck_at.seconds,
            zeros=self._stuck_at.zeros, another=self.another,
        )  # fmt: skip
        if spec is None:
            return about
        silent_s = (time.monotonic_ns() - self._read_ns) / NS_PER_S
        measured_hz, slow = self._rate.judge(spec.rate_hz, silent_s)
        speed = self._clock_rate.typical_hz / NS_PER_S
        return dataclasses.replace(
            about, array=spec.name, frame=spec.frame, rate_hz=spec.rate_hz,
            elements=spec.elements, channels=spec.channels, units=spec.units,
            stuck=tuple(spec.elements[k] for k in self._stuck_at.elements),
            measured_hz=measured_hz, slow=slow and self._device is not None,
            clock_off=speed > 0 and abs(speed - 1) > CLOCK_OFF,
        )  # fmt: skip

    @property
    def late_s(self) -> float:
        """Age of the newest sample when it was read, s; 0 if unknown."""
        return max(0, self._read_ns - self._newest_ns) / NS_PER_S

    @property
    def silent_s(self) -> float:
        """Time since the part began its work, s; 0 while it waits or is `_away`."""
        return 0.0 if self._away else super().silent_s

    def expect(self, sensor: SensorSpec | None, changes: float) -> None:
        """Set the limits of stuck-at faults, see `StuckAtDetector.expect`."""
        judge, given_s = self._stuck_at, self.config.stuck_at_s
        if self._spec is None or self._device is None:
            judge.after_s, judge.each_after_s = given_s or math.inf, math.inf
        else:
            judge.expect(self._spec, sensor, max(changes, self._tared_changes), given_s)

    def stop(self) -> None:
        self._stopped_s = self._stopped_s or time.monotonic()
        super().stop()

    def join(self, until: float) -> bool:
        """Wait for the part to end, briefly if its device is away; return whether done. While
        the device is away, nothing is lost; the thread ends after the device's time to answer."""
        if super().join(min(until, self._stopped_s + AWAY_S) if self._stopped_s else until):
            return True
        if self._away:
            if not self._left:
                self._change_state("stopped", "while it waited for its device")
                self._left = True  # what its thread still does is no longer reported
                self._post_closed()
            return True
        return super().join(until)

    @property
    def _away(self) -> bool:
        """True while the source is being opened, or its device is connecting or lost."""
        device = self._device
        return self._opening or (
            device is not None and device.health.state in (State.CONNECTING, State.LOST)
        )

    def _work(self) -> None:
        while self._should_run():
            try:
                self._serve()
            except ArrayChanged as error:
                self._report(self.name, "another array", str(error), "warning")
                self._release()
            else:
                return

    def _serve(self) -> None:
        """Open the source, and read and post its chunks until it ends."""
        try:
            stream = self._open()
        except SpecMismatch as error:
            if self._spec is None:
                raise
            raise SourceError(str(error)) from None  # the array may be exchanged again
        self._stream, self._spec, self._device = stream, stream.spec, device_of(stream)
        if self._device is not None:
            found = self._device.identity
            known = self.accepted or found
            if not self._device.describes:  # its array is from a file, which may have changed
                known = dataclasses.replace(known, spec=found.spec)
            self.another = found.difference(known)
            self.accepted = found if found.serial_number and not self.another else known
        if self._stop.is_set():
            return
        self._tared_changes = share_of_changes(stream)
        self._stuck_at, self._held = StuckAtDetector(stream.spec.rate_hz), list[Chunk]()
        self._announced = True
        self._busy_ns = time.monotonic_ns()
        self._announce(stream)
        self._report_running()
        self._pause_ns = round(NS_PER_S * oldest_s(self.limits, stream.spec.rate_hz))
        take = partial(self._take_chunk, stream)
        with suppress(EndOfStream):
            while self._should_run():
                self._busy_ns = time.monotonic_ns()
                if stream.fileno() >= 0:
                    self._lines.attend(stream, take, self._should_run)
                else:
                    take(stream.read(POLL_S))

    def _should_run(self) -> bool:
        return not (self._stop.is_set() or self._left)

    def _take_chunk(self, stream: Source, chunk: Chunk | None) -> None:
        """Post a chunk in the thread that has read it; check the device when due."""
        now = self._busy_ns = time.monotonic_ns()
        if now >= self._look_ns:
            self._check_device(now)
        if chunk is None or self._left:
            return
        self._samples += len(chunk)
        if now - self._read_ns > self._pause_ns:
            self._flowing_ns = now
        # A sample time ahead of the host's clock would hide a silence.
        self._read_ns, taken = now, int(chunk.t_ns[-1])
        self._newest_ns = min(now, taken) if stream.live and keeps_host_time(stream) else now
        good, bad = without_bad_samples(chunk)
        useless = ~chunk.valid.any(axis=1)  # as the device or its codec reports
        self._bad += bad + int(useless.sum()) * chunk.valid.shape[1]
        self._held.append(good)
        count, t_ns = self._device.measured if self._device else (self._samples, now)
        self._rate.add(count, t_ns)
        self._clock_rate.add(t_ns, now)
        spec, accepted = stream.spec, not self.another
        item = SourceChunk(self.config.name, spec, chunk, now, self._offset_ns, accepted)
        self._hub.post(item)
        if not stream.live:
            self._await_room()

    def _release(self) -> None:
        stream, self._stream, self._device = self._stream, None, None
        if stream is None:
            return
        try:
            stream.close()
        finally:
            self._before = _add_stats(self._before, stream.stats)
            self._reported = ()
            self._rate, self._clock_rate = RateMeter(), RateMeter(CLOCK_NS)
            self._post_closed()

    def _post_closed(self) -> None:
        """Post `Closed` only once: another part may have opened that source since."""
        with self._closing:
            if self._announced:
                self._announced = False
                self._hub.post(Closed(self.config.name, time.monotonic_ns()))

    def _change_state(self, state: str, reason: str) -> None:
        if not self._left:  # else its end has been reported
            super()._change_state(state, reason)

    def _open(self) -> Source:
        self._opening = True
        try:
            config = self.config
            return open_source(config.url, calibration=config.calibration, array=config.array)
        finally:
            self._opening = False

    def _announce(self, stream: Source) -> None:
        prelude: list[tuple[Any, int]] = []
        if self._device is not None:
            self._device.tap(lambda packet, t_ns: prelude.append((packet, t_ns)))
        now = time.monotonic_ns()
        self._offset_ns = self._clock.utc_offset_ns()
        self._hub.post(
            Opened(
                self.config.name, stream.spec, self.config.url, stream, now, self._offset_ns,
                tuple(prelude), not self.another,
            )
        )  # fmt: skip
        if self._device is not None:
            for packet, t_ns in prelude:
                self._post_packet(packet, t_ns)
            self._device.tap(self._post_packet)

    def _post_packet(self, packet: Any, t_ns: int) -> None:
        if self._hub.list_mailboxes(Packet) and not self._left:
            self._hub.post(Packet(self.config.name, packet, t_ns))

    def _check_device(self, now: int) -> None:
        """Check for stuck-at faults, and report changes of the device."""
        self._look_ns = now + LOOK_NS
        if self._held:
            self._stuck_at.add(*self._held)
            self._held = []
        self._offset_ns = self._clock.utc_offset_ns()
        if self._device is None:
            return
        health = self._device.health
        facts = (health.state, health.connections, health.clock_steps, health.counter_resets,
                 health.status, health.faults)  # fmt: skip
        if facts == self._reported:
            return
        before, self._reported = self._reported, facts
        # a counter that begins anew after a reconnection is no silent restart
        if before and facts[1] == before[1] and now - self._flowing_ns > NS_PER_S:
            self._restarted += facts[3] != before[3]
        well = health.state in (State.STREAMING, State.CONNECTING) and not health.faults
        level = "info" if well else "warning"
        self._report(self.name, f"device:{health.state}", _describe_changes(health, before), level)

    def _await_room(self) -> None:
        """Wait for room in all mailboxes for samples, when the source is not live."""
        for box in self._hub.list_mailboxes(SourceChunk):
            self._busy_ns = time.monotonic_ns()
            box.wait_for_room(min(1.0, self.limits.stall_s / 2))


def keeps_host_time(stream: Source) -> bool:
    """Return whether a stream's times are host CLOCK_MONOTONIC, not a device's own clock."""
    device = device_of(stream)
    return device is None or device.options.clock == "host"


def _describe_changes(health: Health, before: tuple[Any, ...]) -> str:
    texts = [health.reason] if health.reason else []
    if before and health.connections != before[1]:
        texts.append(f"connected for the {health.connections}. time")
    if before and health.clock_steps != before[2]:
        texts.append("its clock jumped")
    if before and health.counter_resets != before[3]:
        texts.append("its counter began anew")
    if words := tuple(dict.fromkeys((*health.faults, *health.status))):
        texts.append(f"it says: {', '.join(words)}")
    return "; ".join(texts)


def _add_stats(a: SourceStats, b: SourceStats) -> SourceStats:
    return SourceStats(*(getattr(a, f.name) + getattr(b, f.name) for f in dataclasses.fields(a)))
