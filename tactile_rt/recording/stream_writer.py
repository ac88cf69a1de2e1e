"""Record a stream while it runs, without ever holding it up.

source --> push ----+
                    +--> bounded queue --(thread)--> RecordingWriter --> FILE.mcap
device --> tap -----+                                (or one after another)
"""

import errno
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from tactile_rt.core.bounded_queue import BoundedQueue
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.core.stream import Chunk, Source
from tactile_rt.drivers.device_source import device_of
from tactile_rt.recording.description import describe
from tactile_rt.recording.layout import SAMPLES, WIRE, Packet, encode_packet, encode_samples
from tactile_rt.recording.rotation import Rotation
from tactile_rt.recording.syncing import Syncer
from tactile_rt.recording.writer import RecordingWriter, WriterStats

WAKE_S = 0.05  # how often the thread looks: what a recording is late by, at most
SYNC_S = 1.0
FLUSH_S = 0.5  # with the wake and a slow write still well under the second that may be lost
QUEUE_BYTES = 64 << 20
ITEM_BYTES, FRAME_BYTES = 500, 200  # what Python needs around the bytes

Entry = tuple[str, Any, int, int]  # topic, chunk or packet, host time in ns, bytes


class StreamWriter:
    """Record a source. Make it before the first read, and `push` every chunk that is read.

    A thread of its own writes, at least every half second, so that a killed process leaves a file
    from which `recover` takes all but the last moment; another puts the file on the medium every
    second, for a power cut. What waits for a slow disk is bounded: the
    oldest is dropped then, and counted. Of a device, the raw packets and its health are recorded
    without further ado.

    Args:
        path: of the file, as a rule ``.mcap``.
        source: what is recorded; stays its owner's.
        url: where the source is, for the record.
        session: what else to note: who, where, why.
        force: whether to replace a file that is there.
        flush_s: between two writes to the file.
        sync_s: between two syncs, which put the file on the medium; 0: only at its end.
        queue_bytes: that may wait for the disk.
        rotate_mb: begin a new file beyond so many MB; 0: never. Files that are rotated are named by
            their beginning, too: ``run-20261121T170512Z.mcap`` for ``run.mcap``.
        rotate_s: begin a new file after so many seconds; 0: never.

    Attributes:
        path: The path of the file that is being written, or was last.

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
        sync_s: float = SYNC_S,
        queue_bytes: int = QUEUE_BYTES,
        rotate_mb: float = 0.0,
        rotate_s: float = 0.0,
    ) -> None:
        self.path, self.files = Path(path), 0
        self._source, self._device = source, device_of(source)
        self._url, self._session = url, dict(session or {})
        rotation = Rotation(self.path.parent, self.path.stem, rotate_mb, rotate_s)
        self._rotation = rotation if rotate_mb or rotate_s else None
        self._flush_s, self._sync_s, self._sync_at = flush_s, sync_s, 0.0
        self._past: list[RecordingWriter] = []  # closed, and perhaps not on the medium yet
        self._syncer = Syncer()
        self._queue = BoundedQueue[Entry](size=queue_bytes, measure=_measure, kinds=(SAMPLES, WIRE))
        self._stop, self._asked, self._flushed = (threading.Event() for _ in range(3))
        self._error: Exception | None = None
        self._closed = False
        self._prelude: list[tuple[Packet, int]] = []
        try:
            with _explained(self.path):
                self._now = (WriterStats(), self._begin(force))  # of finished files; the open one
        except BaseException:
            self._syncer.close()
            raise
        self._thread = threading.Thread(target=self._run, name="tactile-rt-recorder", daemon=True)
        self._thread.start()
        if self._device is not None:
            self._device.tap(lambda packet, t_ns: self._prelude.append((packet, t_ns)))
            for packet, t_ns in self._prelude:
                self._packet(packet, t_ns)
            self._device.tap(self._packet)

    @property
    def stats(self) -> WriterStats:
        """What became of what was to be recorded, over all files; from any thread."""
        (past, writer), dropped = self._now, self._queue.dropped
        done = writer.stats
        return WriterStats(
            past.samples + done.samples, past.packets + done.packets,
            dropped[SAMPLES], dropped[WIRE], past.bytes + done.bytes,
        )  # fmt: skip

    def push(self, chunk: Chunk) -> None:
        """Record a chunk; returns at once, but lets a source that is not live wait for the disk.

        Raises:
            RecordingError: the file cannot be written any more (a full disk).
        """
        if self._error is not None:
            raise self._broken()
        size = chunk.values.nbytes + chunk.valid.nbytes + 16 * len(chunk) + ITEM_BYTES
        if not self._source.live:
            self._queue.wait_for_room()
        # Times of a device's own clock would put the samples far from all else in the file.
        own = self.about.clock == "device"
        self._queue.put((SAMPLES, chunk, time.monotonic_ns() if own else int(chunk.t_ns[-1]), size))

    def flush(self) -> None:
        """Wait until the system has all that was pushed: whatever becomes of us, it is kept.

        Raises:
            RecordingError: the file cannot be written any more.
        """
        self._flushed.clear()
        self._asked.set()
        while not self._flushed.wait(WAKE_S) and self._thread.is_alive():
            pass
        if self._error is not None:
            raise self._broken()

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
        self._queue.close()
        writer = self._counted()
        try:
            if self._error is None:
                _check_there(writer)
        except OSError as error:
            self._error = error
        try:
            writer.close(finish=self._error is None)
        except OSError as error:  # also what is still buffered may find no room
            self._error = self._error or error
        self._syncer.close()
        for file in (*self._past, writer):
            self._error = self._error or file.failed
        if self._error is not None:
            raise self._broken()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
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

    def _packet(self, packet: Packet, t_ns: int) -> None:
        each = 1 if isinstance(packet, bytes) else FRAME_BYTES
        self._queue.put((WIRE, packet, t_ns, ITEM_BYTES + each * len(packet or ())))

    def _begin(self, force: bool) -> RecordingWriter:
        """Begin the first file, or the next; it is described as the source is now."""
        self.about = describe(self._source, self._url, self._session)
        if self._rotation is None:
            writer = RecordingWriter(
                self.path, self._source, self.about, force=force, syncer=self._syncer
            )
        else:
            writer = self._rotation.begin(
                self._source, self.about, prelude=self._prelude, syncer=self._syncer
            )
        self._sync_at = 0.0  # so a power cut hardly ever leaves a name without a description
        self.path, self.files = writer.path, self.files + 1
        return writer

    # in the thread

    def _run(self) -> None:
        flush_at = time.monotonic() + self._flush_s
        while True:
            stopping = self._stop.wait(WAKE_S)
            asked = self._asked.is_set()  # before all that waits is written, so that none is left
            try:
                while (entry := self._queue.get(0)) is not None:
                    self._write(*entry)
                    if time.monotonic() >= flush_at or self._is_sync_due():
                        flush_at = self._flush()
                if asked or time.monotonic() >= flush_at or self._is_sync_due():
                    flush_at = self._flush()
                if asked:
                    self._asked.clear()
                    self._flushed.set()
                self._counted().tell()
            except Exception as error:  # whatever it is, it belongs to the user's thread
                self._error = error
                self._queue.close(drop=True)
                return
            if stopping:
                return

    def _write(self, topic: str, what: Any, t_ns: int, size: int) -> None:
        encoded = encode_samples(what) if topic == SAMPLES else encode_packet(what, self.about.wire)
        self._now[1].add(topic, encoded, t_ns)

    def _flush(self) -> float:
        writer = self._counted()
        if self._is_sync_due():
            self._sync_at = time.monotonic() + self._sync_s
            writer.sync()
        else:
            writer.flush()
        _check_there(writer)
        for file in (*self._past, writer):
            if file.failed is not None:
                raise file.failed
        self._past = [file for file in self._past if not file.done]
        if self._rotation is not None and self._rotation.is_due(writer):
            writer.close()
            self._past.append(writer)
            past = self.stats
            self._now = past, self._begin(False)
        return time.monotonic() + self._flush_s

    def _is_sync_due(self) -> bool:
        return self._sync_s > 0 and time.monotonic() >= self._sync_at

    def _counted(self) -> RecordingWriter:
        """The open file, told what was dropped since it was begun."""
        (past, writer), dropped = self._now, self._queue.dropped
        writer.stats.dropped_samples = dropped[SAMPLES] - past.dropped_samples
        writer.stats.dropped_packets = dropped[WIRE] - past.dropped_packets
        return writer


def _check_there(writer: RecordingWriter) -> None:
    if (where := writer.whereabouts()) in ("deleted", "emptied"):
        raise OSError(errno.ENOENT, f"{where} while it was written")


def _measure(entry: Entry) -> tuple[str, int, int]:
    topic, what, _, size = entry
    return topic, len(what) if topic == SAMPLES else 1, size


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Why a file cannot be begun, in one line."""
    try:
        yield
    except FileExistsError:
        raise ConfigError(f"{path} is there already: name another file, or force it") from None
    except IsADirectoryError:
        raise ConfigError(f"{path} is a folder: name a file to write") from None
    except FileNotFoundError:
        raise ConfigError(f"no folder {path.parent} to write {path.name} in") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror or error}") from None
