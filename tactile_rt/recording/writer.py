"""Writer of one recording file, in one thread.

    RecordingWriter    a file in a folder, with counts, health and summary
    McapFile           the channels of a recording in any binary file object

After a kill of the process, `recover` can restore all that had been flushed; after a power cut, all
that had been synced. This needs a file that begins with its description. Writing that takes several
steps, so the file gets its name only afterwards. Until then it is hidden in the same folder, as
``.NAME.XXXXXXXX.mcap.part``.

`tactile_rt.recording.rotation` starts one file after another. `tactile_rt.recording.stream_writer`
and the daemon's recorder record a stream while the program does other work.
"""

import errno
import fcntl
import io
import os
import secrets
import time
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import Syncer, sync_folder
from tactile_rt.core.stream import Source
from tactile_rt.drivers.device_source import device_of
from tactile_rt.drivers.health import Health
from tactile_rt.recording.description import (
    METADATA,
    SESSION,
    SUMMARY,
    Description,
    seal,
    utc_offset_ns,
)
from tactile_rt.recording.layout import HEALTH, SAMPLES, WIRE, Packet, encode_packet, samples_in
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2.cdr import schema_text, token
from tactile_rt.recording.ros2_form import ARRAY, CHANNELS, PREFIX, put_in_form

SEQUENCES = 1 << 32
PART = ".mcap.part"  # ending of the name of a file without a complete description


class Extent(NamedTuple):
    """Numbers of samples and packets in a recording up to some moment."""

    samples: int = 0
    packets: int = 0
    newest_ns: int = 0  # host monotonic time of the newest sample, ns; 0 without a sample


class McapFile:
    """Writer of an MCAP file with a recording's channels; `RecordingWriter` adds name and health.

    Args:
        file: the file to write; the caller closes it.
        further: additional channels, and the ROS 2 message type of each.
    """

    def __init__(
        self, file: BinaryIO, about: Description, further: Mapping[str, str] | None = None
    ) -> None:
        import mcap.writer

        self.about, self._file = about, file
        # Checksums over the whole file, too, so that the loss of a whole record is noticed.
        self._writer: Any = mcap.writer.Writer(file, enable_data_crcs=True)
        self._writer.start(profile="ros2", library="tactile_rt")
        # In this order, so that a truncated file with a description has the notes, too.
        if about.session:
            self._writer.add_metadata(SESSION, seal(about.session))
        self._writer.add_metadata(METADATA, about.to_metadata())
        self._array = about.session.get("daemon_source") or about.spec.name
        self.topics: dict[str, tuple[str, str]] = {}  # (topic, message type) of each channel
        self._channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        kinds = {name: kind for (name, wire), kind in CHANNELS.items() if wire in ("", about.wire)}
        for name, kind in (*kinds.items(), *(further or {}).items()):
            if kind not in schemas:
                text = schema_text(kind).encode()
                schemas[kind] = self._writer.register_schema(kind, "ros2msg", text)
            topic = f"/{PREFIX}/{token(self._array)}/{name}"
            self.topics[name] = topic, kind
            self._channels[name] = self._writer.register_channel(topic, "cdr", schemas[kind])
        self.counts = dict.fromkeys(self._channels, 0)

    def add(self, name: str, data: bytes, t_ns: int) -> None:
        """Add a message that `layout` encoded, with its host time, ns."""
        spec, offset_ns = self.about.spec, self.about.utc_offset_ns
        if not self.counts[ARRAY]:
            self.put(ARRAY, messages.array_message(spec, self._array, t_ns + offset_ns), t_ns)
        self.put(name, put_in_form(name, data, offset_ns, spec.frame), t_ns)

    def put(self, name: str, data: bytes, t_ns: int) -> None:
        """Add an already encoded message, with a sequence number that shows losses."""
        utc = max(0, t_ns + self.about.utc_offset_ns)
        count = self.counts[name]
        self._writer.add_message(self._channels[name], utc, data, utc, count % SEQUENCES)
        self.counts[name] = count + 1

    def note(self, name: str, fields: Mapping[str, str]) -> None:
        """Add a metadata record, sealed by a checksum."""
        self._writer.add_metadata(name, seal(fields))

    def flush(self) -> int:
        """Write buffered messages to the operating system; return the size of the file, bytes."""
        self._writer.flush()
        return self._file.tell()

    def finish(self) -> int:
        """Write the index and end of the file; return its size, bytes."""
        self._writer.finish()
        self._file.flush()
        return self._file.tell()


@dataclass
class WriterStats:
    """Counts of recorded and dropped samples, packets and bytes."""

    samples: int = 0
    packets: int = 0
    dropped_samples: int = 0  # number of samples not written because the disk was slow or full
    dropped_packets: int = 0  # number of raw packets not written for the same reason
    bytes: int = 0


class RecordingWriter:
    """Writer of one file of a recording, in the calling thread.

    Args:
        source: the recorded source, for its health and losses; it is not read here.
        prelude: packets in which a device described itself, and their arrivals, ns, so that every
            file can be decoded by itself.
        dropped: numbers of samples and packets that were dropped before this file.
        syncer: syncs the file in its thread; if None, the calling thread syncs.

    Raises:
        FileExistsError: the file exists already.
        ConfigError: the file to replace is being recorded right now.
    """

    def __init__(
        self,
        path: Path,
        source: Source,
        about: Description,
        *,
        prelude: Iterable[tuple[Packet, int]] = (),
        dropped: tuple[int, int] = (0, 0),
        force: bool = False,
        syncer: Syncer | None = None,
    ) -> None:
        self.path, self.begun_ns = path, time.monotonic_ns()
        # the caller updates `dropped_samples` and `dropped_packets`
        self.stats = WriterStats(dropped_samples=dropped[0], dropped_packets=dropped[1])
        self._source, self._device = source, device_of(source)
        self._written_state: tuple[Any, ...] = ()  # health and losses that were last written
        self.flushed = Extent()  # held by the operating system, so it survives a kill
        self._synced, self._newest_ns = Extent(), 0
        self.unsynced_ns = 0  # host time since which data wait for a sync; 0 if none wait
        self.failed: OSError | None = None  # error of a sync
        self.done = False  # whether the file is closed, and its last sync has ended
        self._syncer, self._waiting, self._name_synced = syncer, False, False
        target = path.resolve() if force else path  # a link is followed, not replaced
        special = force and target.exists() and not target.is_file()  # a pipe, /dev/null
        if force:
            check_not_recorded(path)
        hidden = target if special else _hide_name(target, force)
        self._raw = _create(hidden, special)
        if not special:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._handle = -1
        try:
            # Duplicated now: no descriptor may be left at the time of a sync.
            self._handle = os.dup(self._raw.fileno())
            self._file = McapFile(self._raw, about)
            for packet, t_ns in prelude if about.wire else ():
                self.add(WIRE, encode_packet(packet, about.wire), t_ns)
            self.tell(always=True)
            self.flush()
            if not special:
                _reveal(hidden, target, force)
        except BaseException:
            with suppress(OSError):
                os.close(self._handle)
            with suppress(OSError):
                self._raw.close()
            if not special:
                hidden.unlink(missing_ok=True)
            raise
        self._special, self._target = special, target

    @property
    def synced(self) -> Extent:
        """Extent that is on the medium and survives a power cut; thread-safe."""
        return min(self._synced, self.flushed)

    def add(self, topic: str, data: bytes, t_ns: int) -> None:
        """Add an encoded message with its host time, ns."""
        self._file.add(topic, data, t_ns)
        if topic == SAMPLES:
            self.stats.samples += samples_in(data)
            self._newest_ns = t_ns
        elif topic == WIRE:
            self.stats.packets += 1

    def tell(self, always: bool = False, closed: bool = False) -> None:
        """Record the state of source and recorder if it has changed, or if `always`."""
        health, mine = self._device.health if self._device is not None else None, self.stats
        state = (_select_state(health), mine.dropped_samples, mine.dropped_packets)
        if state == self._written_state and not always:
            return
        self._written_state = state
        now = time.monotonic_ns()
        name = "streaming" if health is None else str(health.state)
        fields = {
            "t_ns": now,
            "utc_offset_ns": utc_offset_ns(),
            "state": "closed" if closed else name,
            "reason": "" if health is None else health.reason,
            "device": health,
            "stats": asdict(self._source.stats),
            "recorder": mine,
        }
        self._file.add(HEALTH, msgspec.json.encode(fields), now)

    def flush(self) -> int:
        """Write all added messages to the operating system; return the size of the file, bytes."""
        self.tell()
        self.stats.bytes = self._file.flush()
        self._note_flushed()
        return self.stats.bytes

    def sync(self) -> None:
        """Flush, and sync to the medium as soon as possible. Afterwards `synced` is updated, or
        `failed` is set."""
        self.flush()
        if not self._waiting:  # a waiting sync includes all that is flushed before it begins
            self._sync_soon()

    def disown(self, since: Extent) -> tuple[int, int]:
        """Subtract from the counts all data added after `since`, since writing failed. Return the
        subtracted numbers of samples and packets."""
        stats = self.stats
        samples, packets = stats.samples - since.samples, stats.packets - since.packets
        stats.samples, stats.packets, self.flushed = since.samples, since.packets, since
        return samples, packets

    def whereabouts(self) -> Literal["there", "moved", "deleted", "emptied"]:
        """Return ``there``, unless another program has moved, deleted or emptied the file.

        ``moved``: no file or another one has its name; ``emptied``: it is shorter than what was
        written, as after log rotation.
        """
        if self._special:
            return "there"
        mine = os.fstat(self._raw.fileno())
        if mine.st_nlink == 0:
            return "deleted"
        if isinstance(self._raw.raw, _CountingFile) and mine.st_size < self._raw.raw.written:
            return "emptied"
        try:
            named = os.lstat(self._target)
        except (FileNotFoundError, NotADirectoryError):
            return "moved"
        except OSError:  # the folder may not be read
            return "there"
        return "there" if os.path.samestat(mine, named) else "moved"

    def close(self, finish: bool = True) -> None:
        """Write the index and close the file, even if writing fails: it can be recovered.

        Args:
            finish: whether to write the index; False if writing has failed before.

        Raises:
            OSError: no room for the index.
        """
        try:
            if finish:
                self.tell(always=True, closed=True)
                summary = {k: str(v) for k, v in asdict(self.stats).items() if k != "bytes"}
                self._file.note(SUMMARY, summary)
                self.stats.bytes = self._file.finish()
                self._note_flushed()
        finally:
            try:
                self._sync_soon(last=True)
            finally:
                with suppress(OSError):  # the syncer's duplicate would keep the lock for a while
                    fcntl.flock(self._raw, fcntl.LOCK_UN)
                self._raw.close()
        if self._syncer is None and self.failed is not None:
            raise self.failed

    def _note_flushed(self) -> None:
        extent = Extent(self.stats.samples, self.stats.packets, self._newest_ns)
        if extent != self.flushed and not self.unsynced_ns:
            self.unsynced_ns = time.monotonic_ns()
        self.flushed = extent

    def _sync_soon(self, last: bool = False) -> None:
        job = partial(self._sync, last)
        if self._syncer is None:
            job()
        else:
            self._waiting = True
            self._syncer.add(job)

    def _sync(self, last: bool) -> None:
        """Sync in the syncer's thread. The handle stays open after the file is closed."""
        self._waiting = False
        extent, began_ns = self.flushed, time.monotonic_ns()
        try:
            if not self._special:
                os.fdatasync(self._handle)
                if not self._name_synced:
                    with suppress(FileNotFoundError, NotADirectoryError):  # see `whereabouts`
                        sync_folder(self._target.parent)
                    self._name_synced = True
            self._synced = extent
            self.unsynced_ns = began_ns if self.flushed != extent else 0
        except OSError as error:
            # The system has discarded what it could not write; a later sync would not fail. But
            # without a free descriptor only the name is not synced: the next sync does that.
            if last or error.errno not in (errno.EMFILE, errno.ENFILE):
                self.failed = self.failed or error
        finally:
            if last:
                os.close(self._handle)
            self.done = last


def _select_state(health: Health | None) -> tuple[Any, ...]:
    """Return the parts of a device's health whose changes are recorded at once."""
    if health is None:
        return ()
    return (
        health.state, health.connections, health.clock_steps, health.counter_resets, health.status,
        health.can_errors,
    )  # fmt: skip


def check_not_recorded(path: Path) -> None:
    """Raise a ConfigError if a `RecordingWriter` of any process has the file open.

    The writer holds a lock on the file itself, which ends with the writer in any case, and follows
    the file when it is moved.

    Raises:
        ConfigError: the file is being recorded.
    """
    if not path.is_file():
        return
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise ConfigError(
            f"{path} is being recorded right now: name another file, or end that first"
        ) from None
    except OSError:  # a file system without locks
        return
    finally:
        os.close(handle)


def _hide_name(path: Path, force: bool) -> Path:
    """Return the hidden name for a file until its description is complete."""
    if not force and os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    return path.with_name(f".{path.stem[:50]}.{secrets.token_hex(4)}{PART}")


class _CountingFile(io.FileIO):
    """File, open for appending, that counts the bytes written to it."""

    written = 0

    def write(self, data: Any) -> int:
        size = super().write(data)
        self.written += size
        return size


def _create(path: Path, special: bool) -> io.BufferedWriter:
    if special:
        return path.open("wb")
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o666)
    return io.BufferedWriter(_CountingFile(handle, "ab"))


def _reveal(hidden: Path, path: Path, force: bool) -> None:
    """Rename the hidden file to its final name; replace an existing file only if `force`."""
    if force:
        hidden.replace(path)
        return
    try:
        path.hardlink_to(hidden)  # unlike renaming, fails if such a file exists by then
    except FileExistsError:
        raise
    except OSError:  # a file system without links, as on a memory card
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        hidden.rename(path)
    else:
        hidden.unlink()
