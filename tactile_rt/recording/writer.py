"""Write a stream while it runs, without ever holding it up."""

import threading
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

import msgspec

from tactile_rt.calibration import CalibratedSource, Calibration
from tactile_rt.drivers.device_source import DeviceSource
from tactile_rt.drivers.health import Health
from tactile_rt.recording.description import SUMMARY, Description
from tactile_rt.recording.layout import (
    HEALTH,
    SAMPLES,
    WIRE,
    encode_packet,
    encode_samples,
    need_mcap,
)
from tactile_rt.recording.mcap_file import McapFile
from tactile_rt.stream import Chunk, ConfigError, RecordingError, Source

__all__ = ["HealthTeller", "StreamWriter", "WriterStats", "describe", "utc_offset_ns"]

WAKE_S = 0.05  # how often the thread looks: what a recording is late by, at most
FLUSH_S = 0.5  # with the wake and a slow write still well under the second that may be lost
QUEUE_BYTES = 64 << 20
ITEM_BYTES, FRAME_BYTES = 500, 200  # what Python needs around the bytes


@dataclass
class WriterStats:
    """What became of what was to be recorded.

    Attributes:
        samples, packets: written.
        dropped_samples, dropped_packets: not written, because the disk was too slow or full.
        bytes: of the file.
    """

    samples: int = 0
    packets: int = 0
    dropped_samples: int = 0
    dropped_packets: int = 0
    bytes: int = 0


class StreamWriter:
    """Record a source. Make it before the first read, and `push` every chunk that is read.

    A thread of its own writes, at least every half second, so that a killed process leaves a file
    from which `recover` takes all but the last moment. What waits for a slow disk is bounded: the
    oldest is dropped then, and counted. Of a device, the raw packets and its health are recorded
    without further ado.

    Args:
        path: of the file, as a rule ``.mcap``.
        source: what is recorded; stays its owner's.
        url: where the source is, for the record.
        session: what else to note: who, where, why.
        force: whether to replace a file that is there.
        flush_s: between two writes to the file.
        queue_bytes: that may wait for the disk.

    Attributes:
        path: of the file.
        stats: what became of what was to be recorded.

    Raises:
        ConfigError: the file is there already, its folder is not, or the extra is not installed.
    """

    def __init__(
        self,
        path: str | Path,
        source: Source,
        *,
        url: str = "",
        session: Mapping[str, str] | None = None,
        force: bool = False,
        flush_s: float = FLUSH_S,
        queue_bytes: int = QUEUE_BYTES,
    ) -> None:
        need_mcap()
        self.path, self.stats = Path(path), WriterStats()
        self._source = source
        self._device = _device_of(source)[0]
        self.about = describe(source, url, session or {})
        self._flush_s, self._limit = flush_s, queue_bytes
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, Any, int, int]] = deque()  # topic, what, time, size
        self._queued = 0
        self._stop = threading.Event()
        self._error: Exception | None = None
        self._closed = False
        self._health = HealthTeller(source)
        self._raw = _create(self.path, force)
        try:
            self._file = McapFile(self._raw, self.about)
            self._health.tell(self._file, self.stats, always=True)
            self.stats.bytes = self._file.flush()  # whatever happens now, it can be recovered
        except BaseException:
            self._raw.close()
            self.path.unlink(missing_ok=True)
            raise
        self._thread = threading.Thread(target=self._run, name="tactile-rt-recorder", daemon=True)
        self._thread.start()
        if self._device is not None:
            self._device.tap(self._packet)

    def push(self, chunk: Chunk) -> None:
        """Record a chunk; returns at once, but lets a source that is not live wait for the disk.

        Raises:
            RecordingError: the file cannot be written any more (a full disk).
        """
        if self._error is not None:
            raise self._broken()
        size = chunk.values.nbytes + chunk.valid.nbytes + 16 * len(chunk) + ITEM_BYTES
        while not self._source.live and self._queued > self._limit // 2 and self._error is None:
            time.sleep(WAKE_S / 10)
        # Times of a device's own clock would put the samples far from all else in the file.
        own = self.about.clock == "device"
        self._put(SAMPLES, chunk, time.monotonic_ns() if own else int(chunk.t_ns[-1]), size)

    def close(self) -> None:
        """Write what waits, and the index; safe to call twice.

        Raises:
            RecordingError: the file could not be written to its end.
        """
        if self._closed:
            return
        self._closed = True
        if self._device is not None:
            self._device.tap(None)
        self._stop.set()
        self._thread.join()
        try:
            if self._error is None:
                self._health.tell(self._file, self.stats, always=True, closed=True)
                summary = {k: str(v) for k, v in asdict(self.stats).items() if k != "bytes"}
                self._file.note(SUMMARY, summary)
                self.stats.bytes = self._file.finish()
        except OSError as error:
            self._error = error
        finally:
            try:
                self._raw.close()
            except OSError as error:  # what is still buffered finds no room either
                self._error = self._error or error
        if self._error is not None:
            raise self._broken()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.close()
        except RecordingError:
            if error is None:
                raise

    def _broken(self) -> RecordingError:
        assert self._error is not None
        why = getattr(self._error, "strerror", None) or repr(self._error)
        return RecordingError(
            f"{self.path} cannot be written any more ({why}); `tactile-rt recover` keeps what is "
            "in it"
        )

    def _packet(self, packet: Any, t_ns: int) -> None:
        each = 1 if isinstance(packet, bytes) else FRAME_BYTES
        self._put(WIRE, packet, t_ns, ITEM_BYTES + each * len(packet or ()))

    def _put(self, topic: str, what: Any, t_ns: int, size: int) -> None:
        with self._lock:
            self._queue.append((topic, what, t_ns, size))
            self._queued += size
            while self._queued > self._limit and self._queue:
                self._drop(self._queue.popleft())

    def _drop(self, item: tuple[str, Any, int, int]) -> None:
        topic, what, _, size = item
        self._queued -= size
        if topic == SAMPLES:
            self.stats.dropped_samples += len(what)
        else:
            self.stats.dropped_packets += 1

    # in the thread

    def _run(self) -> None:
        flush_at = time.monotonic() + self._flush_s
        while True:
            stopping = self._stop.wait(WAKE_S)
            try:
                while (item := self._take()) is not None:
                    self._write(*item)
                    if time.monotonic() >= flush_at:
                        flush_at = self._flush()
                if time.monotonic() >= flush_at:
                    flush_at = self._flush()
                self._health.tell(self._file, self.stats)
            except Exception as error:  # whatever it is, it belongs to the user's thread
                self._error = error
                with self._lock:
                    while self._queue:
                        self._drop(self._queue.popleft())
                    self._limit = -1
                return
            if stopping:
                return

    def _take(self) -> tuple[str, Any, int] | None:
        with self._lock:
            if not self._queue:
                return None
            topic, what, t_ns, size = self._queue.popleft()
            self._queued -= size
            return topic, what, t_ns

    def _write(self, topic: str, what: Any, t_ns: int) -> None:
        if topic == SAMPLES:
            self._file.add(SAMPLES, encode_samples(what), t_ns)
            self.stats.samples += len(what)
        else:
            self._file.add(WIRE, encode_packet(what, self.about.wire), t_ns)
            self.stats.packets += 1

    def _flush(self) -> float:
        self.stats.bytes = self._file.flush()
        return time.monotonic() + self._flush_s


def utc_offset_ns() -> int:
    """UTC less monotonic time, now, ns."""
    before = time.monotonic_ns()
    utc = time.time_ns()
    return utc - (before + time.monotonic_ns()) // 2


def _changing(health: Health | None) -> tuple[Any, ...]:
    """Of a device's health, what is told at once when it changes."""
    if health is None:
        return ()
    return (
        health.state, health.connections, health.clock_steps, health.counter_resets, health.status,
        health.can_errors,
    )  # fmt: skip


def _device_of(source: Source) -> tuple[DeviceSource | None, Calibration | None]:
    if isinstance(source, CalibratedSource):
        return _device_of(source.source)[0], source.calibration
    return (source if isinstance(source, DeviceSource) else None), None


def describe(
    source: Source, url: str = "", session: Mapping[str, str] | None = None
) -> Description:
    """What a recording of this source is of; its UTC offset is that of now."""
    device, calibration = _device_of(source)
    about = Description(source.spec, utc_offset_ns(), url, session=dict(session or {}))
    if device is None:
        return about
    options = {
        # A recording is read elsewhere than where its options were written.
        name: str(Path(value).resolve()) if value and Path(value).is_file() else value
        for name, value in device.codec_options.items()
    }
    return replace(
        about, source=url or device.name, wire=device.codec.wire, codec=device.options.codec,
        codec_options=options, clock=device.options.clock, calibration=calibration,
    )  # fmt: skip


class HealthTeller:
    """Writes into a recording how source and recorder are, when that has changed.

    Args:
        source: the source that is recorded.
    """

    def __init__(self, source: Source) -> None:
        self._source, self._device = source, _device_of(source)[0]
        self._told: tuple[Any, ...] = ()  # what was last written

    def tell(
        self, file: McapFile, mine: WriterStats, always: bool = False, closed: bool = False
    ) -> None:
        """Write it, if it has changed or `always`; `mine` is what the recorder did."""
        health = self._device.health if self._device is not None else None
        told = (_changing(health), mine.dropped_samples, mine.dropped_packets)
        if told == self._told and not always:
            return
        self._told = told
        now = time.monotonic_ns()
        state = "streaming" if health is None else str(health.state)
        fields = {
            "t_ns": now,
            "utc_offset_ns": utc_offset_ns(),
            "state": "closed" if closed else state,
            "reason": "" if health is None else health.reason,
            "device": health,
            "stats": asdict(self._source.stats),
            "recorder": mine,
        }
        file.add(HEALTH, msgspec.json.encode(fields), now)


def _create(path: Path, force: bool) -> BinaryIO:
    try:
        return path.open("wb" if force else "xb")
    except FileExistsError:
        raise ConfigError(f"{path} is there already: name another file, or force it") from None
    except IsADirectoryError:
        raise ConfigError(f"{path} is a folder: name a file to write") from None
    except FileNotFoundError:
        raise ConfigError(f"no folder {path.parent} to write {path.name} in") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}") from None
