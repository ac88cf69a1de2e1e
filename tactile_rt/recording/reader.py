"""Read a recording back. What is damaged is named, never misread."""

from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar

import msgspec

from tactile_rt.core.errors import ConfigError, RecordingError, explain_errors
from tactile_rt.core.files import open_regular
from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.recording import layout
from tactile_rt.recording.description import METADATA, RECOVERED, SESSION, Description
from tactile_rt.recording.records import MAGIC, read_records
from tactile_rt.recording.ros2_form import is_in_file_form, name_channel, plain

if TYPE_CHECKING:
    from tactile_rt.recording.records import Record

FOOTER = b"\x02" + (20).to_bytes(8, "little")  # its opcode and length
FOOTER_BYTES = len(FOOTER) + 20 + len(MAGIC)

T = TypeVar("T")


class Recording:
    """A recording, read from its file: what it is of, and all that is in it.

        recording = Recording("run.mcap")
        for chunk in recording: ...

    Every iteration opens the file, and reads it from its beginning. Where damage is met, what comes
    before it has been given out.

    Raises:
        ConfigError: there is no such file, or the extra is not installed.
        RecordingError: it is no recording, unfinished, damaged, or of another version. All that
            iterates raises it, too.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with _opened(self.path) as file:
            self.description = _described(self.path, read_records(file))[0]

    @property
    def spec(self) -> ArraySpec:
        """The array of the samples."""
        return self.description.spec

    def __iter__(self) -> Iterator[Chunk]:
        return self.chunks()

    def chunks(self) -> Generator[Chunk, None, None]:
        """The chunks, as they were recorded."""
        shape = self.spec.shape
        return self._decoded(layout.SAMPLES, lambda raw: layout.decode_samples(raw.data, shape))

    def packets(self) -> Iterator[tuple[layout.Packet, int]]:
        """The raw packets and their arrival, host time in ns; None where the line was opened."""
        wire = self.description.wire
        decode = layout.decode_packet
        return self._decoded(layout.WIRE, lambda raw: (decode(raw.data, wire), raw.t_ns))

    def health(self) -> Iterator[dict[str, Any]]:
        """How source and recorder were, whenever it changed.

        The fields are those of docs/reference/recording.md.
        """
        return self._decoded(layout.HEALTH, _fields)

    def decisions(self) -> Iterator[dict[str, Any]]:
        """What the daemon's models decided, as it published it."""
        return self._decoded(layout.DECISIONS, _fields)

    def events(self) -> Iterator[dict[str, Any]]:
        """What changed in the daemon meanwhile: contacts, and states of its parts."""
        return self._decoded(layout.EVENTS, _fields)

    def skips(self, model: str) -> list[dict[str, Any]]:
        """The stretches that a model skipped as it was behind.

        The fields are those of docs/reference/messages.md.
        """
        return [e for e in self.events() if e.get("type") == "skip" and e.get("model") == model]

    def raw(self, *topics: str) -> Generator[layout.Raw, None, None]:
        """The messages of these channels, undecoded; of none, the file is only checked."""
        from mcap.records import Channel, Message

        path = self.path
        with _opened(path) as file, _naming(path):
            records = read_records(file)
            about, record = _described(path, records)
            names: dict[int, str] = {}
            due: dict[int, int] = {}
            while record is not None:
                if isinstance(record, Channel):
                    names[record.id] = name_channel(record.topic)
                elif isinstance(record, Message):
                    if record.channel_id not in names:
                        raise ValueError(f"a message of no known channel, {record.channel_id}")
                    name = names[record.channel_id]
                    expected = due.get(record.channel_id, 0)
                    if record.sequence != expected:
                        raise RecordingError(
                            f"{path} is damaged: message {expected} of {name} is missing; "
                            "`tactile-rt recover` keeps what is whole"
                        )
                    due[record.channel_id] = (expected + 1) % (1 << 32)
                    if not is_in_file_form(name, record.data, about.spec.shape):
                        raise ValueError(f"message {expected} of {name} is none")
                    if name in topics:
                        t_ns = record.log_time - about.utc_offset_ns
                        yield layout.Raw(name, t_ns, plain(name, record.data))
                record = next(records, None)

    def _decoded(self, topic: str, decode: Callable[[layout.Raw], T]) -> Generator[T, None, None]:
        for raw in self.raw(topic):
            with _naming(self.path):
                decoded = decode(raw)
            yield decoded


def _fields(raw: layout.Raw) -> dict[str, Any]:
    return msgspec.json.decode(raw.data, type=dict[str, Any])


def _described(path: Path, records: "Iterator[Record]") -> "tuple[Description, Record | None]":
    """What the recording is of, and the record after that."""
    from mcap.records import Metadata

    found: dict[str, dict[str, str]] = {}
    with _naming(path):
        record = next(records, None)
        while isinstance(record, Metadata):
            found.setdefault(record.name, record.metadata)
            record = next(records, None)
    if METADATA not in found:
        raise RecordingError(f"{path} is an MCAP file, but no recording of tactile-rt")
    about = Description.from_metadata(
        str(path), found[METADATA], found.get(SESSION, {}), RECOVERED in found
    )
    return about, record


@contextmanager
def _opened(path: Path) -> Iterator[BinaryIO]:
    """A recording that has been written to its end."""
    try:
        file = open_regular(path)
    except FileNotFoundError:
        raise ConfigError(f"no recording {path}") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from None
    with file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(f"{path} is not an MCAP file")
        if not _has_end(file):
            raise RecordingError(
                f"{path} is cut short, or still being written: "
                f"`tactile-rt recover {path}` makes a whole one of it"
            )
        file.seek(0)
        yield file


def is_finished(path: Path) -> bool:
    """Whether the file has the end that is written last; nothing else of it is looked at."""
    try:
        with open_regular(path) as file:
            return _has_end(file)
    except (OSError, ConfigError):
        return False


def _has_end(file: BinaryIO) -> bool:
    end = file.seek(0, 2)
    file.seek(max(0, end - FOOTER_BYTES))
    tail = file.read()
    return tail.startswith(FOOTER) and tail.endswith(MAGIC)


def _naming(path: Path) -> AbstractContextManager[None]:
    """Name the file where its damage makes the MCAP library raise anything."""
    hint = "); `tactile-rt recover` keeps what is whole"
    return explain_errors(RecordingError, f"{path} is damaged (", hint)
