"""Read a recording back. What is damaged is named, never misread."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import msgspec

from tactile_rt.recording.description import METADATA, RECOVERED, SESSION, Description
from tactile_rt.recording.layout import (
    DECISIONS,
    EVENTS,
    HEALTH,
    SAMPLES,
    WIRE,
    Packet,
    decode_packet,
    decode_samples,
    need_mcap,
)
from tactile_rt.stream import Chunk, ConfigError, RecordingError, TactileError

if TYPE_CHECKING:
    from mcap.records import McapRecord

__all__ = [
    "Raw",
    "is_finished",
    "read_decisions",
    "read_description",
    "read_events",
    "read_health",
    "read_packets",
    "read_raw",
    "read_stream",
]

MAGIC = b"\x89MCAP0\r\n"
FOOTER = b"\x02" + (20).to_bytes(8, "little")  # its opcode and length
FOOTER_BYTES = len(FOOTER) + 20 + len(MAGIC)


@dataclass(frozen=True)
class Raw:
    """One message: of which channel, host time in ns, bytes."""

    topic: str
    t_ns: int
    data: bytes


def read_description(path: str | Path) -> Description:
    """What a recording is of.

    Raises:
        ConfigError: there is no such file, or the extra is not installed.
        RecordingError: it is no recording, unfinished, damaged, or of another version.
    """
    with _opened(Path(path)) as file:
        return _described(Path(path), _records(file))[0]


def read_stream(path: str | Path) -> Iterator[Chunk]:
    """The chunks of a recording, as they were pushed.

    Raises:
        ConfigError, RecordingError: as `read_description`; where damage is met, what comes before
            it has been given out.
    """
    for about, raw in read_raw(path, SAMPLES):
        with _naming(Path(path)):
            chunk = decode_samples(raw.data, about.spec.shape)
        yield chunk


def read_packets(path: str | Path) -> Iterator[tuple[Packet, int]]:
    """The raw packets of a recording and their arrival, host time in ns.

    A packet of None stands where the line was opened.

    Raises:
        ConfigError, RecordingError: as `read_stream`.
    """
    for about, raw in read_raw(path, WIRE):
        with _naming(Path(path)):
            packet = decode_packet(raw.data, about.wire)
        yield packet, raw.t_ns


def read_health(path: str | Path) -> Iterator[dict[str, Any]]:
    """How source and recorder were, whenever that changed; fields as in docs/recording.md.

    Raises:
        ConfigError, RecordingError: as `read_stream`.
    """
    return _read_json(path, HEALTH)


def read_decisions(path: str | Path) -> Iterator[dict[str, Any]]:
    """What the daemon's models decided, as it published it.

    Raises:
        ConfigError, RecordingError: as `read_stream`.
    """
    return _read_json(path, DECISIONS)


def read_events(path: str | Path) -> Iterator[dict[str, Any]]:
    """What changed in the daemon while it recorded: contacts, and states of its parts.

    Raises:
        ConfigError, RecordingError: as `read_stream`.
    """
    return _read_json(path, EVENTS)


def _read_json(path: str | Path, topic: str) -> Iterator[dict[str, Any]]:
    for _, raw in read_raw(path, topic):
        with _naming(Path(path)):
            fields = msgspec.json.decode(raw.data, type=dict[str, Any])
        yield fields


def read_raw(path: str | Path, *topics: str) -> Iterator[tuple[Description, Raw]]:
    """The messages of these channels, undecoded, with what the recording is of.

    Raises:
        ConfigError, RecordingError: as `read_stream`.
    """
    need_mcap()
    from mcap.records import Channel, Message

    path = Path(path)
    with _opened(path) as file, _naming(path):
        records = _records(file)
        about, record = _described(path, records)
        names: dict[int, str] = {}
        due: dict[int, int] = {}
        while record is not None:
            if isinstance(record, Channel):
                names[record.id] = record.topic
            elif isinstance(record, Message):
                name = names[record.channel_id]
                expected = due.get(record.channel_id, 0)
                if record.sequence != expected:
                    raise RecordingError(
                        f"{path} is damaged: message {expected} of {name} is missing; "
                        "`tactile-rt recover` keeps what is whole"
                    )
                due[record.channel_id] = (expected + 1) % (1 << 32)
                if name in topics:
                    t_ns = record.log_time - about.utc_offset_ns
                    yield about, Raw(name, t_ns, record.data)
            record = next(records, None)


def _records(file: BinaryIO) -> "Iterator[McapRecord]":
    from mcap.stream_reader import StreamReader

    return iter(StreamReader(file, validate_crcs=True, record_size_limit=1 << 30).records)


def _described(
    path: Path, records: "Iterator[McapRecord]"
) -> "tuple[Description, McapRecord | None]":
    """What the recording is of, and the record after that."""
    from mcap.records import Header, Metadata

    found: dict[str, dict[str, str]] = {}
    with _naming(path):
        record = next(records, None)
        while isinstance(record, Header | Metadata):
            if isinstance(record, Metadata):
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
    need_mcap()
    try:
        file = path.open("rb")
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
        with path.open("rb") as file:
            return _has_end(file)
    except OSError:
        return False


def _has_end(file: BinaryIO) -> bool:
    end = file.seek(0, 2)
    file.seek(max(0, end - FOOTER_BYTES))
    tail = file.read()
    return tail.startswith(FOOTER) and tail.endswith(MAGIC)


@contextmanager
def _naming(path: Path) -> Iterator[None]:
    """Whatever a damaged file makes the MCAP library raise, as one error that names the file."""
    try:
        yield
    except (TactileError, GeneratorExit):
        raise
    except Exception as error:  # a dozen unrelated types, as for any parser of damaged bytes
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(
            f"{path} is damaged ({reason}); `tactile-rt recover` keeps what is whole"
        ) from None
