"""Reader of recordings, which reports damage and never returns wrong data."""

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

FOOTER = b"\x02" + (20).to_bytes(8, "little")  # opcode and length of the footer
FOOTER_BYTES = len(FOOTER) + 20 + len(MAGIC)

T = TypeVar("T")


class Recording:
    """Reader of a recording: its description, samples, packets, decisions and events.

        recording = Recording("run.mcap")
        for chunk in recording: ...

    Every iteration opens the file and reads it from its beginning. If the file is damaged, all
    data before the damage is delivered first.

    Raises:
        ConfigError: no such file exists, or the extra is not installed.
        RecordingError: the file is no recording, unfinished, damaged, or of another version. All
            iterators raise it, too.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with _open_finished(self.path) as file:
            self.description = _read_head(self.path, read_records(file))[0]

    @property
    def spec(self) -> ArraySpec:
        """Array of the samples."""
        return self.description.spec

    def __iter__(self) -> Iterator[Chunk]:
        return self.chunks()

    def chunks(self) -> Generator[Chunk, None, None]:
        """Yield the chunks as they were recorded."""
        shape = self.spec.shape
        return self._decode(layout.SAMPLES, lambda raw: layout.decode_samples(raw.data, shape))

    def packets(self) -> Iterator[tuple[layout.Packet, int]]:
        """Yield (packet, host time of arrival in ns); None marks an opened line."""
        wire = self.description.wire
        decode = layout.decode_packet
        return self._decode(layout.WIRE, lambda raw: (decode(raw.data, wire), raw.t_ns))

    def health(self) -> Iterator[dict[str, Any]]:
        """Yield the state of source and recorder at each change.

        The fields are described in docs/reference/recording.md.
        """
        return self._decode(layout.HEALTH, _parse_json)

    def decisions(self) -> Iterator[dict[str, Any]]:
        """Yield the decisions of the daemon's models, as they were published."""
        return self._decode(layout.DECISIONS, _parse_json)

    def events(self) -> Iterator[dict[str, Any]]:
        """Yield the daemon's events: contacts, and changes of state of its parts."""
        return self._decode(layout.EVENTS, _parse_json)

    def skips(self, model: str) -> list[dict[str, Any]]:
        """Return the stretches of samples that a model skipped because it was too slow.

        The fields are described in docs/reference/messages.md.
        """
        return [e for e in self.events() if e.get("type") == "skip" and e.get("model") == model]

    def raw(self, *topics: str) -> Generator[layout.Raw, None, None]:
        """Yield undecoded messages of these channels; without channels, only check the file."""
        from mcap.records import Channel, Message

        path = self.path
        with _open_finished(path) as file, _explain_damage(path):
            records = read_records(file)
            about, record = _read_head(path, records)
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
                        raise ValueError(f"message {expected} of {name} cannot be decoded")
                    if name in topics:
                        t_ns = record.log_time - about.utc_offset_ns
                        yield layout.Raw(name, t_ns, plain(name, record.data))
                record = next(records, None)

    def _decode(self, topic: str, decode: Callable[[layout.Raw], T]) -> Generator[T, None, None]:
        for raw in self.raw(topic):
            with _explain_damage(self.path):
                decoded = decode(raw)
            yield decoded


def _parse_json(raw: layout.Raw) -> dict[str, Any]:
    return msgspec.json.decode(raw.data, type=dict[str, Any])


def _read_head(path: Path, records: "Iterator[Record]") -> "tuple[Description, Record | None]":
    """Return the description of a recording, and the first record after it."""
    from mcap.records import Metadata

    found: dict[str, dict[str, str]] = {}
    with _explain_damage(path):
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
def _open_finished(path: Path) -> Iterator[BinaryIO]:
    """Open a recording; refuse one that has not been written to its end."""
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
    """Return whether a file has the end of a finished recording; check nothing else."""
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


def _explain_damage(path: Path) -> AbstractContextManager[None]:
    """Return a context that turns errors into a RecordingError that names the file."""
    hint = "); `tactile-rt recover` keeps what is whole"
    return explain_errors(RecordingError, f"{path} is damaged (", hint)
