"""Recording of a running stream, without delaying it.

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
from tactile_rt.core.files import Syncer
from tactile_rt.core.stream import Chunk, Source
from tactile_rt.drivers.device_source import device_of
from tactile_rt.recording.description import describe
from tactile_rt.recording.layout import SAMPLES, WIRE, Packet, encode_packet, encode_samples
from tactile_rt.recording.rotation import Rotation
from tactile_rt.recording.writer import RecordingWriter, WriterStats

WAKE_S = 0.05  # period of the thread, and so the largest delay of writing
SYNC_S = 1.0
FLUSH_S = 0.5  # with the wake and a slow write, well under the second that may be lost
QUEUE_BYTES = 64 << 20
ITEM_BYTES, FRAME_BYTES = 500, 200  # memory that Python needs in addition to the data

Entry = tuple[str, Any, int, int]  # topic, chunk or packet, host time in ns, bytes


class StreamWriter:
    """Recorder of a source. Make it before the first read, and `push` every chunk that is read.

    A separate thread writes at least every half second, so that `recover` restores all earlier
    data after a kill. Another thread syncs the file to the medium every second, for a power cut.
    The queue for a slow disk is bounded: when it is full, the oldest data are dropped and counted.
    Raw packets and health of a device are recorded automatically.

    Args:
        path: path of the file, usually ``.mcap``.
        source: the recorded source; the caller closes it.
        url: URL of the source, for the recording's description.
        session: further notes: who, where, why.
        force: whether to replace an existing file.
        flush_s: time between two writes to the file, s.
        sync_s: time between two syncs to the medium, s; 0 to sync only at the end.
        queue_bytes: largest size of the data that wait for the disk, bytes.
        rotate_mb: size after which a new file begins, MB; 0 for no limit. Rotated files have
            the time of their beginning in the name: ``run-20261121T170512Z.mcap``.
        rotate_s: time after which a new file begins, s; 0 for no limit.

    Attributes:
        path: The path of the file that is being written, or was written last.

    Raises:
        ConfigError: the file exists already, its folder does not, or the extra is not installed.
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
        self._past: list[RecordingWriter] = []  # closed files, perhaps not synced yet
        self._syncer = Syncer()
        self._queue = BoundedQueue[Entry](size=queue_bytes, measure=_measure, kinds=(SAMPLES, WIRE))
        self._stop, self._asked, self._flushed = (threading.Event() for _ in range(3))
        self._error: Exception | None = None
        self._closed = False
        self._prelude: list[tuple[Packet, int]] = []
        try:
            with _explain_errors(self.path):
                self._now = (WriterStats(), self._begin(force))  # (of finished files, open file)
        except BaseException:
            self._syncer.close()
            raise
        self._thread = threading.Thread(target=self._run, name="tactile-rt-recorder", daemon=True)
        self._thread.start()
        if self._device is not None:
            self._device.tap(lambda packet, t_ns: self._prelude.append((packet, t_ns)))
            for packet, t_ns in self._prelude:
                self._add_packet(packet, t_ns)
            self._device.tap(self._add_packet)

    @property
    def stats(self) -> WriterStats:
        """Counts of samples, packets and bytes recorded or dropped in all files; thread-safe."""
        (past, writer), dropped = self._now, self._queue.dropped
        done = writer.stats
        return WriterStats(
            past.samples + done.samples, past.packets + done.packets,
            dropped[SAMPLES], dropped[WIRE], past.bytes + done.bytes,
        )  # fmt: skip

    def push(self, chunk: Chunk) -> None:
        """Queue a chunk for recording. Only a source that is not live waits for the disk.

        Raises:
            RecordingError: the file cannot be written any more (a full disk).
        """
        if self._error is not None:
            raise self._make_error()
        size = chunk.values.nbytes + chunk.valid.nbytes + 16 * len(chunk) + ITEM_BYTES
        if not self._source.live:
            self._queue.wait_for_room()
        # The times of a device's own clock would separate the samples from the other messages.
        own = self.about.clock == "device"
        self._queue.put((SAMPLES, chunk, time.monotonic_ns() if own else int(chunk.t_ns[-1]), size))

    def flush(self) -> None:
        """Wait until the operating system holds all pushed chunks, so they survive a kill.

        Raises:
            RecordingError: the file cannot be written any more.
        """
        self._flushed.clear()
        self._asked.set()
        while not self._flushed.wait(WAKE_S) and self._thread.is_alive():
            pass
        if self._error is not None:
            raise self._make_error()

    def close(self) -> None:
        """Write all queued data and the index; safe to call twice.

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
        writer = self._update_dropped()
        try:
            if self._error is None:
                _check_there(writer)
        except OSError as error:
            self._error = error
        try:
            writer.close(finish=self._error is None)
        except OSError as error:  # the disk may be full for buffered data, too
            self._error = self._error or error
        self._syncer.close()
        for file in (*self._past, writer):
            self._error = self._error or file.failed
        if self._error is not None:
            raise self._make_error()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, error: object, trace: object) -> None:
        try:
            self.close()
        except RecordingError:
            if error is None:
                raise

    def _make_error(self) -> RecordingError:
        assert self._error is not None
        why = getattr(self._error, "strerror", None) or repr(self._error)
        return RecordingError(
            f"{self.path} cannot be written any more ({why}); `tactile-rt recover` keeps what is "
            "in it"
        )

    def _add_packet(self, packet: Packet, t_ns: int) -> None:
        each = 1 if isinstance(packet, bytes) else FRAME_BYTES
        self._queue.put((WIRE, packet, t_ns, ITEM_BYTES + each * len(packet or ())))

    def _begin(self, force: bool) -> RecordingWriter:
        """Begin the first or next file, with the present description of the source."""
        self.about = describe(self._source, self._url, self._session)
        if self._rotation is None:
            writer = RecordingWriter(
                self.path, self._source, self.about, force=force, syncer=self._syncer
            )
        else:
            writer = self._rotation.begin(
                self._source, self.about, prelude=self._prelude, syncer=self._syncer
            )
        self._sync_at = 0.0  # at once: a power cut then rarely leaves a name without description
        self.path, self.files = writer.path, self.files + 1
        return writer

    # in the thread

    def _run(self) -> None:
        flush_at = time.monotonic() + self._flush_s
        while True:
            stopping = self._stop.wait(WAKE_S)
            asked = self._asked.is_set()  # read first, so that all data queued before are written
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
                self._update_dropped().tell()
            except Exception as error:  # any error is raised in the user's thread
                self._error = error
                self._queue.close(drop=True)
                return
            if stopping:
                return

    def _write(self, topic: str, what: Any, t_ns: int, size: int) -> None:
        encoded = encode_samples(what) if topic == SAMPLES else encode_packet(what, self.about.wire)
        self._now[1].add(topic, encoded, t_ns)

    def _flush(self) -> float:
        writer = self._update_dropped()
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

    def _update_dropped(self) -> RecordingWriter:
        """Update the open file's counts of dropped data; return its writer."""
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
def _explain_errors(path: Path) -> Iterator[None]:
    """Turn an error on opening a file into a `ConfigError` with one line of text."""
    try:
        yield
    except FileExistsError:
        raise ConfigError(f"{path} already exists: name another file, or force it") from None
    except IsADirectoryError:
        raise ConfigError(f"{path} is a folder: name a file to write") from None
    except FileNotFoundError:
        raise ConfigError(f"no folder {path.parent} to write {path.name} in") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror or error}") from None
