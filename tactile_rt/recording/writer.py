"""Write a recording: one file, in one thread.

    RecordingWriter    a file in a folder, with counts, health and summary
    McapFile           the channels of a recording in whatever is written to

What is killed while it writes leaves a file from which `recover` takes all that had been flushed,
and a power cut one from which it takes all that had been synced. For that the file must say what it
is of, which takes several steps; so it gets its name only when it does. Until then it is hidden in
the same folder, as ``.NAME.XXXXXXXX.mcap.part``.

When one file follows another is the matter of `tactile_rt.recording.rotation`; how a stream is
recorded beside what else is done with it, that of `tactile_rt.recording.stream_writer` and of the
daemon's recorder.
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
from typing import Any, BinaryIO, Literal

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import sync_folder
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
from tactile_rt.recording.syncing import Extent, Syncer

SEQUENCES = 1 << 32
PART = ".mcap.part"  # ends the name of a file until it says what it is of


class McapFile:
    """The channels of a recording in an MCAP file; knows nothing of names, counts or health.

    Args:
        file: to write; not closed with this.
        further: channels besides those of a recording, and the ROS 2 message of each.
    """

    def __init__(
        self, file: BinaryIO, about: Description, further: Mapping[str, str] | None = None
    ) -> None:
        import mcap.writer

        self.about, self._file = about, file
        # Checksums over the whole file, too: a record that is lost altogether must be noticed.
        self._writer: Any = mcap.writer.Writer(file, enable_data_crcs=True)
        self._writer.start(profile="ros2", library="tactile_rt")
        # In this order: a file that says what it is of has the notes, too, wherever it is cut.
        if about.session:
            self._writer.add_metadata(SESSION, seal(about.session))
        self._writer.add_metadata(METADATA, about.to_metadata())
        self._array = about.session.get("daemon_source") or about.spec.name
        self.topics: dict[str, tuple[str, str]] = {}  # of each channel, and its message
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
        """Add a message, as `layout` has it, of this host time, ns."""
        spec, offset_ns = self.about.spec, self.about.utc_offset_ns
        if not self.counts[ARRAY]:
            self.put(ARRAY, messages.array_message(spec, self._array, t_ns + offset_ns), t_ns)
        self.put(name, put_in_form(name, data, offset_ns, spec.frame), t_ns)

    def put(self, name: str, data: bytes, t_ns: int) -> None:
        """Add a message as it is to stand in the file; messages are numbered so that none gets
        lost."""
        utc = max(0, t_ns + self.about.utc_offset_ns)
        count = self.counts[name]
        self._writer.add_message(self._channels[name], utc, data, utc, count % SEQUENCES)
        self.counts[name] = count + 1

    def note(self, name: str, fields: Mapping[str, str]) -> None:
        """Add metadata."""
        self._writer.add_metadata(name, seal(fields))

    def flush(self) -> int:
        """Let the system have all that was added; the size of the file."""
        self._writer.flush()
        return self._file.tell()

    def finish(self) -> int:
        """Write the index; the size of the file."""
        self._writer.finish()
        self._file.flush()
        return self._file.tell()


@dataclass
class WriterStats:
    """What became of what was to be recorded."""

    samples: int = 0
    packets: int = 0
    dropped_samples: int = 0  # number of samples that were not written: the disk was slow or full
    dropped_packets: int = 0  # number of raw packets that were not written, for the same reason
    bytes: int = 0


class RecordingWriter:
    """A recording of a source, written by the thread that calls.

    Args:
        source: what is recorded, for its health and losses; it is not read here.
        prelude: packets in which a device described itself, and their arrivals, ns: it must be
            understood from every file.
        dropped: samples and packets that could not be recorded before.
        syncer: what syncs the file; None: the thread that calls.

    Raises:
        FileExistsError: there is such a file.
        ConfigError: it is to be replaced, and is being recorded right now.
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
        # of which `dropped_samples` and `dropped_packets` are the caller's to keep
        self.stats = WriterStats(dropped_samples=dropped[0], dropped_packets=dropped[1])
        self._source, self._device = source, device_of(source)
        self._told: tuple[Any, ...] = ()  # the health that was last written
        self.flushed = Extent()  # what the operating system has, which a kill of the process leaves
        self._synced, self._newest_ns = Extent(), 0
        self.unsynced_ns = 0  # host time since which something waits for the medium; 0: nothing
        self.failed: OSError | None = None  # of a sync
        self.done = False  # whether it is closed, and its last sync has ended
        self._syncer, self._waiting, self._name_synced = syncer, False, False
        target = path.resolve() if force else path  # a link is followed, not replaced
        special = force and target.exists() and not target.is_file()  # a pipe, /dev/null
        if force:
            check_not_recorded(path)
        hidden = target if special else _hidden(target, force)
        self._raw = _create(hidden, special)
        if not special:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self._handle = -1
        try:
            # Beforehand: by the time of a sync descriptors may be out.
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
        """What is on the medium, which a power cut leaves; from any thread."""
        return min(self._synced, self.flushed)

    def add(self, topic: str, data: bytes, t_ns: int) -> None:
        """Add an encoded message of this host time, ns."""
        self._file.add(topic, data, t_ns)
        if topic == SAMPLES:
            self.stats.samples += samples_in(data)
            self._newest_ns = t_ns
        elif topic == WIRE:
            self.stats.packets += 1

    def tell(self, always: bool = False, closed: bool = False) -> None:
        """Add how source and recorder are, if that has changed, or `always`."""
        health, mine = self._device.health if self._device is not None else None, self.stats
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
        self._file.add(HEALTH, msgspec.json.encode(fields), now)

    def flush(self) -> int:
        """Let the system have all of it; the file's size."""
        self.tell()
        self.stats.bytes = self._file.flush()
        self._flushed()
        return self.stats.bytes

    def sync(self) -> None:
        """Let the system have all of it, and the medium as soon as it can; `synced` says when it
        has, `failed` that it could not."""
        self.flush()
        if not self._waiting:  # one that waits will take all that has been flushed until it begins
            self._sync_soon()

    def disown(self, since: Extent) -> tuple[int, int]:
        """Samples and packets that were added after `since`, and are not in the file or may not be,
        because writing failed; they no longer count as written."""
        stats = self.stats
        samples, packets = stats.samples - since.samples, stats.packets - since.packets
        stats.samples, stats.packets, self.flushed = since.samples, since.packets, since
        return samples, packets

    def whereabouts(self) -> Literal["there", "moved", "deleted", "emptied"]:
        """Look at what others did with the file.

        ``moved`` means that another or none has its name, ``emptied`` that it is shorter than what
        was written, as a log rotator leaves it.
        """
        if self._special:
            return "there"
        mine = os.fstat(self._raw.fileno())
        if mine.st_nlink == 0:
            return "deleted"
        if isinstance(self._raw.raw, _Growing) and mine.st_size < self._raw.raw.written:
            return "emptied"
        try:
            named = os.lstat(self._target)
        except (FileNotFoundError, NotADirectoryError):
            return "moved"
        except OSError:  # one may not look
            return "there"
        return "there" if os.path.samestat(mine, named) else "moved"

    def close(self, finish: bool = True) -> None:
        """Write the index and close. Also when that fails the file is closed: it can be recovered.

        Args:
            finish: whether to write the index; not, where writing has failed before.

        Raises:
            OSError: no room for the index.
        """
        try:
            if finish:
                self.tell(always=True, closed=True)
                told = {k: str(v) for k, v in asdict(self.stats).items() if k != "bytes"}
                self._file.note(SUMMARY, told)
                self.stats.bytes = self._file.finish()
                self._flushed()
        finally:
            try:
                self._sync_soon(last=True)
            finally:
                with suppress(OSError):  # the syncer holds its duplicate for some time yet
                    fcntl.flock(self._raw, fcntl.LOCK_UN)
                self._raw.close()
        if self._syncer is None and self.failed is not None:
            raise self.failed

    def _flushed(self) -> None:
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
        """In the syncer's thread; its handle stays open when the file is closed meanwhile."""
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
            # The system has given up what it could not write; a later sync would not tell. But
            # for want of a descriptor the name alone is not synced: the next one does that.
            if last or error.errno not in (errno.EMFILE, errno.ENFILE):
                self.failed = self.failed or error
        finally:
            if last:
                os.close(self._handle)
            self.done = last


def _changing(health: Health | None) -> tuple[Any, ...]:
    """Of a device's health, what is told at once when it changes."""
    if health is None:
        return ()
    return (
        health.state, health.connections, health.clock_steps, health.counter_resets, health.status,
        health.can_errors,
    )  # fmt: skip


def check_not_recorded(path: Path) -> None:
    """Refuse to replace a file that a `RecordingWriter` of any process has open.

    It is told by the lock that the writer has on the file itself, which ends with the writer,
    however it ends, and goes where the file is moved to.

    Raises:
        ConfigError: it is being recorded.
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


def _hidden(path: Path, force: bool) -> Path:
    """What the file is called until it says what it is of."""
    if not force and os.path.lexists(path):
        raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path))
    return path.with_name(f".{path.stem[:50]}.{secrets.token_hex(4)}{PART}")


class _Growing(io.FileIO):
    """A new file that counts what was written, always at its end."""

    written = 0

    def write(self, data: Any) -> int:
        size = super().write(data)
        self.written += size
        return size


def _create(path: Path, special: bool) -> io.BufferedWriter:
    if special:
        return path.open("wb")
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND, 0o666)
    return io.BufferedWriter(_Growing(handle, "ab"))


def _reveal(hidden: Path, path: Path, force: bool) -> None:
    """Give the file its name; unless forced, never that of another one."""
    if force:
        hidden.replace(path)
        return
    try:
        path.hardlink_to(hidden)  # unlike renaming, fails if there is such a file by now
    except FileExistsError:
        raise
    except OSError:  # a file system without links, as on a memory card
        if os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        hidden.rename(path)
    else:
        hidden.unlink()
