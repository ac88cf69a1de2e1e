"""Transmitter of an emulated device: numbers, time-stamps and encodes samples, with faults."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk
from tactile_rt.drivers.codec import Codec
from tactile_rt.drivers.emulation.endpoints import Endpoint
from tactile_rt.drivers.emulation.faults import (
    QUIET_S,
    DeviceLog,
    Fate,
    Fault,
    FaultSchedule,
    damage_packet,
)

SAME = 1e-3  # relative difference below which rates count as equal


class Transmitter:
    """Encoder and sender of samples, with faults; for one thread at a time.

    Attributes:
        end_ns: Time at which the stream ends, on the source's clock, ns; no fault happens just
            before.
    """

    def __init__(
        self,
        codec: Codec[Any],
        endpoint: Endpoint[Any],
        faults: FaultSchedule | None,
        log: DeviceLog,
        clock: "EmulatedClock",
        start_count: int = 0,
    ) -> None:
        self._codec, self._endpoint = codec, endpoint
        self._faults, self._log, self._clock = faults, log, clock
        self._count = start_count
        self._first_ns = 0
        self.end_ns: float = np.inf
        self._gathers_until_ns: float = np.inf
        self.away = False
        self._stalled: list[tuple[int, Any, Fate]] = []  # packets held back during a stall

    def begin(self, t_ns: int) -> None:
        """Set the time of the first sample, on the source's clock."""
        self._first_ns = t_ns
        self._clock.begin(t_ns)

    def finish(self) -> None:
        """End the stream: plug the device in if away, and send the packets held back."""
        self._set_away(False)
        self._release()

    def restart(self, t_ns: int | None = None) -> None:
        """Reset the counter to zero, and the clock to zero at source time `t_ns`."""
        self._count = 0
        self._clock.restart(t_ns)

    def look(self, t_ns: int) -> None:
        """Advance to a source time without sending, and apply the faults due then."""
        hit = self._apply_fault(t_ns)
        self._set_away(hit is not None and hit.kind == "unplug")

    def send(self, piece: Chunk) -> None:
        """Number, time-stamp, encode and send these samples."""
        n = len(piece)
        hits: list[Fault | None] = [None] * n
        if self._faults is None:
            seq = np.arange(self._count, self._count + n, dtype=np.int64)
            t_ns = self._clock.at(piece.t_ns)
            self._count += n
        else:
            seq, t_ns = np.empty(n, np.int64), np.empty(n, np.int64)
            for i in range(n):
                hits[i] = self._apply_fault(int(piece.t_ns[i]))
                seq[i] = self._count
                t_ns[i] = self._clock.at(piece.t_ns[i : i + 1])[0]
                self._count += 1
        packets = self._codec.encode(Chunk(seq, t_ns, piece.values, piece.valid))
        for number, now, packet, hit in zip(
            seq.tolist(), t_ns.tolist(), packets, hits, strict=True
        ):
            self._emit(number, now, packet, hit)

    def _apply_fault(self, t_ns: int) -> Fault | None:
        """Return the fault at this time; apply it to clock, counter and adapter."""
        assert self._faults is not None
        elapsed_s = (t_ns - self._first_ns) / NS_PER_S
        quiet = t_ns > self.end_ns - QUIET_S * NS_PER_S
        fault = self._faults.at(elapsed_s, quiet)
        self._clock.look(t_ns)
        if t_ns >= self._gathers_until_ns:
            self._endpoint.gather(0.0)
            self._gathers_until_ns = np.inf
        if fault is None:
            return None
        if fault.kind == "clock_drift":
            self._clock.drift(t_ns, fault.size, fault.duration_s)
        elif fault.kind == "clock_jump":
            self._clock.jump(t_ns, round(fault.size * NS_PER_S))
        elif fault.kind == "sequence_reset":
            self.restart(t_ns)
        elif fault.kind == "gather":
            self._endpoint.gather(1e-3 * fault.size)
            self._gathers_until_ns = (
                t_ns + fault.duration_s * NS_PER_S if fault.duration_s else np.inf
            )
        return fault

    def _emit(self, seq: int, t_ns: int, packet: Any, hit: Fault | None) -> None:
        kind = "" if hit is None else hit.kind
        if kind != "stall" and self._stalled:
            self._release()
        self._set_away(kind == "unplug")
        if hit is None:
            self._log.add(seq, t_ns, self._send_packet(packet, Fate.SENT))
        elif kind in ("bit_flip", "truncate"):
            assert self._faults is not None
            packet, fate = damage_packet(packet, hit, self._faults.random)
            self._log.add(seq, t_ns, self._send_packet(packet, fate))
        elif kind == "duplicate":
            fate = self._send_packet(packet, Fate.SENT)
            for _ in range(int(hit.size) if fate == Fate.SENT else 0):
                if self._send_packet(packet, Fate.DUPLICATED) == Fate.DUPLICATED:
                    fate = Fate.DUPLICATED
                    self._log.duplicated += 1
            self._log.add(seq, t_ns, fate)
        elif kind in ("drop", "unplug"):
            self._log.add(seq, t_ns, Fate.DROPPED if kind == "drop" else Fate.UNHEARD)
        elif kind == "stall":
            self._stalled.append((self._log.add(seq, t_ns, Fate.SENT), packet, Fate.SENT))
        else:
            if kind == "burst":
                assert self._faults is not None
                self._endpoint.disturb(int(hit.size), self._faults.random)
            elif kind == "can_error":
                self._endpoint.error(int(hit.size))
            self._log.add(seq, t_ns, self._send_packet(packet, Fate.SENT))

    def _set_away(self, away: bool) -> None:
        """Unplug the device or plug it in, unless it already is."""
        if away == self.away:
            return
        self.away = away
        if away:
            self._endpoint.pull()
        else:
            self._endpoint.plug()
            self._endpoint.wake()

    def _send_packet(self, packet: Any, fate: Fate) -> Fate:
        if self._endpoint.send(packet):
            return fate
        return Fate.OVERFLOWED if self._endpoint.heard else Fate.UNHEARD

    def _release(self) -> None:
        """Send the packets that a stall held back."""
        for at, packet, fate in self._stalled:
            actual = self._send_packet(packet, fate)
            if actual != fate:
                self._log.change(at, fate, actual)
        self._stalled.clear()


class EmulatedClock:
    """Emulated clock of a device: converts source time to device time, with drift and jumps.

    Args:
        start_ns: Device time of the first sample, ns.
        drift_ppm: Excess speed of the clock, parts per million.
        wrap_ns: Device time at which the clock wraps on the wire, ns.
    """

    def __init__(self, start_ns: int, drift_ppm: float, wrap_ns: int) -> None:
        self._source_ns, self._device_ns = 0, start_ns  # the same moment on both clocks
        self._base_ppm = self._ppm = drift_ppm
        self._wrap_ns = wrap_ns
        self._drift_ends: float = np.inf

    def begin(self, t_ns: int) -> None:
        """Set the source time of the first sample."""
        self._source_ns = t_ns

    def at(self, t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert source times, (n,) ns, to device times, (n,) ns, not wrapped."""
        passed = t_ns - self._source_ns
        if self._ppm == 0.0:
            return self._device_ns + passed
        return self._device_ns + passed + np.round(passed * (self._ppm * 1e-6)).astype(np.int64)

    def look(self, t_ns: int) -> None:
        """End a temporary drift that is over at this source time."""
        if t_ns >= self._drift_ends:
            self._anchor(t_ns)
            self._ppm, self._drift_ends = self._base_ppm, np.inf

    def drift(self, t_ns: int, ppm: float, duration_s: float) -> None:
        """Set the drift, ppm, from `t_ns` on for a duration, s; 0 for no end."""
        self._anchor(t_ns)
        self._ppm = ppm
        self._drift_ends = t_ns + duration_s * NS_PER_S if duration_s else np.inf

    def jump(self, t_ns: int, by_ns: int) -> None:
        """Step the clock at source time `t_ns`, forward or back by `by_ns`."""
        self._anchor(t_ns)
        self._device_ns += by_ns
        while self._device_ns < 0:
            self._device_ns += self._wrap_ns  # which is the same on the wire

    def restart(self, t_ns: int | None) -> None:
        """Reset the clock to zero at this source time; if None, the last known."""
        if t_ns is not None:
            self._source_ns = t_ns
        self._device_ns = 0

    def _anchor(self, t_ns: int) -> None:
        self._device_ns = int(self.at(np.array([t_ns]))[0])
        self._source_ns = t_ns


class RateConverter:
    """Converter of a source's rate to the device's: repeats or drops samples.

    Args:
        source_hz: rate of the source, Hz.
    """

    def __init__(self, source_hz: float, codec: Codec[Any]) -> None:
        self._source_hz, self._codec = source_hz, codec
        self._next_ns: float | None = None
        self._seq = 0
        self._last: Chunk | None = None

    def at_rate(self, chunk: Chunk) -> Chunk | None:
        """Resample a chunk to the device's rate; return None if no sample is due."""
        spec = self._codec.spec
        assert spec is not None
        rate_hz = self._codec.commanded_hz or spec.rate_hz
        if abs(rate_hz / self._source_hz - 1) < SAME:
            self._next_ns = None
            return chunk
        if self._next_ns is None:
            self._next_ns = float(chunk.t_ns[0])
        period_ns, end_ns = NS_PER_S / rate_hz, int(chunk.t_ns[-1])
        n = int(np.floor((end_ns - self._next_ns) / period_ns)) + 1
        if n <= 0:
            self._last = chunk
            return None
        at = self._next_ns + np.arange(n) * period_ns
        self._next_ns = float(at[-1] + period_ns)
        t_ns = np.round(at).astype(np.int64)
        before = self._last
        if before is not None:  # the last sample of the previous chunk may still be the newest
            chunk = Chunk(
                np.append(before.seq[-1:], chunk.seq), np.append(before.t_ns[-1:], chunk.t_ns),
                np.append(before.values[-1:], chunk.values, 0),
                np.append(before.valid[-1:], chunk.valid, 0),
            )  # fmt: skip
        self._last = chunk
        newest = np.maximum(np.searchsorted(chunk.t_ns, t_ns, "right") - 1, 0)
        self._seq += n
        seq = np.arange(self._seq - n, self._seq, dtype=np.int64)
        return Chunk(seq, t_ns, chunk.values[newest], chunk.valid[newest])


def fit(source: ArraySpec, device: ArraySpec) -> Callable[[Chunk], Chunk]:
    """Return a function that converts a source's chunks to a device's spec.

    The device's elements are the first elements of the source, in order; further ones are invalid.
    Its channels are those of the same name, or, if no name matches, those of the same index;
    others are 0. Units are not converted.
    """
    if source.shape == device.shape and source.channels == device.channels:
        return lambda chunk: chunk
    columns = [source.channels.index(c) if c in source.channels else -1 for c in device.channels]
    if max(columns) < 0:
        columns = [i if i < len(source.channels) else -1 for i in range(len(device.channels))]
    into = [i for i, column in enumerate(columns) if column >= 0]
    taken = [columns[i] for i in into]
    n = min(len(source.elements), len(device.elements))

    def fit_chunk(chunk: Chunk) -> Chunk:
        values = np.zeros((len(chunk), *device.shape), np.float32)
        values[:, :n, into] = chunk.values[:, :n, taken]
        valid = np.zeros(values.shape[:2], np.bool_)
        valid[:, :n] = chunk.valid[:, :n]
        return Chunk(chunk.seq, chunk.t_ns, values, valid)

    return fit_chunk
