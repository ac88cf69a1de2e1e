"""A source in a thread of its own: opened, read, closed, and opened again when it broke."""

import dataclasses
import time
from typing import Any

from tactile_rt.calibration import CalibratedSource, load_calibration
from tactile_rt.daemon.clock import Clock
from tactile_rt.daemon.config import LimitsConfig, SourceConfig
from tactile_rt.daemon.hub import Hub
from tactile_rt.daemon.items import Closed, Opened, Packet, Samples
from tactile_rt.daemon.part import Part, Report
from tactile_rt.daemon.snapshot import SourceState
from tactile_rt.drivers.device_source import DeviceSource
from tactile_rt.drivers.health import Health, State
from tactile_rt.sources import open_source
from tactile_rt.stream import ArraySpec, EndOfStream, Source, SourceStats

__all__ = ["SourcePart", "device_of"]

POLL_S = 0.1  # how soon it notices that it should stop
LOOK_NS = 50_000_000  # between two looks at a device's health


class SourcePart(Part):
    """Posts `Opened`, `Packet`, `Samples` and `Closed` of one source."""

    def __init__(
        self, config: SourceConfig, hub: Hub, report: Report, limits: LimitsConfig, clock: Clock
    ) -> None:
        super().__init__(f"source.{config.name}", report, limits)
        self.config = config
        self._hub, self._clock = hub, clock
        self._stream: Source | None = None
        self._device: DeviceSource | None = None
        self._spec: ArraySpec | None = None
        self._before = SourceStats()  # of all streams before this one
        self._samples, self._newest_ns = 0, 0
        self._offset_ns = 0
        self._look_ns = 0
        self._told: tuple[Any, ...] = ()

    @property
    def source_state(self) -> SourceState:
        """For the snapshot."""
        spec, stream, device = self._spec, self._stream, self._device
        stats = self._before if stream is None else _sum(self._before, stream.stats)
        about = SourceState(
            self.state, self.config.url, device=device.health if device else None, stats=stats,
            samples=self._samples, newest_ns=self._newest_ns,
        )  # fmt: skip
        if spec is None:
            return about
        return dataclasses.replace(
            about, array=spec.name, frame=spec.frame, rate_hz=spec.rate_hz,
            elements=spec.elements, channels=spec.channels, units=spec.units,
        )  # fmt: skip

    def _work(self) -> None:
        stream = open_source(self.config.url)
        if self.config.calibration:
            try:
                stream = CalibratedSource(stream, load_calibration(self.config.calibration))
            except BaseException:
                stream.close()
                raise
        self._stream, self._spec, self._device = stream, stream.spec, device_of(stream)
        if self._stop.is_set():
            return
        self._announce(stream)
        self._up()
        while not self._stop.is_set():
            self._busy_ns = time.monotonic_ns()
            try:
                chunk = stream.read(POLL_S)
            except EndOfStream:
                break
            finally:
                self._busy_ns = 0
            now = time.monotonic_ns()
            if now >= self._look_ns:
                self._look(now)
            if chunk is None:
                continue
            self._samples += len(chunk)
            self._newest_ns = now
            self._hub.post(Samples(self.config.name, stream.spec, chunk, now, self._offset_ns))
            if not stream.live:
                self._await_room()

    def _release(self) -> None:
        stream, self._stream, self._device = self._stream, None, None
        if stream is None:
            return
        try:
            stream.close()
        finally:
            self._before = _sum(self._before, stream.stats)
            self._told = ()
            self._hub.post(Closed(self.config.name, "", time.monotonic_ns()))

    def _announce(self, stream: Source) -> None:
        prelude: list[tuple[Any, int]] = []
        if self._device is not None:
            self._device.tap(lambda packet, t_ns: prelude.append((packet, t_ns)))
        now = time.monotonic_ns()
        self._offset_ns = self._clock.utc_offset_ns()
        self._hub.post(
            Opened(
                self.config.name, stream.spec, self.config.url, stream, now, self._offset_ns,
                tuple(prelude),
            )
        )  # fmt: skip
        if self._device is not None:
            for packet, t_ns in prelude:
                self._packet(packet, t_ns)
            self._device.tap(self._packet)

    def _packet(self, packet: Any, t_ns: int) -> None:
        if self._hub.wanted(Packet):
            self._hub.post(Packet(self.config.name, packet, t_ns))

    def _look(self, now: int) -> None:
        """Tell what has changed about the device."""
        self._look_ns = now + LOOK_NS
        self._offset_ns = self._clock.utc_offset_ns()
        if self._device is None:
            return
        health = self._device.health
        told = (health.state, health.connections, health.clock_steps, health.counter_resets,
                health.status)  # fmt: skip
        if told == self._told:
            return
        before, self._told = self._told, told
        level = "info" if health.state in (State.STREAMING, State.CONNECTING) else "warning"
        self._report(self.name, f"device:{health.state}", _told(health, before), level)

    def _await_room(self) -> None:
        """A source that waits for its reader is read no faster than all can take."""
        for box in self._hub.wanted(Samples):
            box.wait_for_room(1.0)


def device_of(source: Source) -> DeviceSource | None:
    """The device behind a source, if there is one."""
    while isinstance(source, CalibratedSource):
        source = source.source
    return source if isinstance(source, DeviceSource) else None


def _told(health: Health, before: tuple[Any, ...]) -> str:
    said = [health.reason] if health.reason else []
    if before and health.connections != before[1]:
        said.append(f"connected for the {health.connections}. time")
    if before and health.clock_steps != before[2]:
        said.append("its clock jumped")
    if before and health.counter_resets != before[3]:
        said.append("its counter began anew")
    if health.status:
        said.append(f"it says: {', '.join(health.status)}")
    return "; ".join(said)


def _sum(a: SourceStats, b: SourceStats) -> SourceStats:
    return SourceStats(*(getattr(a, f.name) + getattr(b, f.name) for f in dataclasses.fields(a)))
