"""Make a whole recording of one that was cut short or damaged."""

import os
import struct
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from tactile_rt.files import open_regular, sync_folder, write_whole
from tactile_rt.recording.description import METADATA, RECOVERED, SESSION, Description
from tactile_rt.recording.layout import CHANNELS, need_mcap
from tactile_rt.recording.reader import MAGIC, Recording
from tactile_rt.recording.writer import McapFile
from tactile_rt.stream import ConfigError, RecordingError

if TYPE_CHECKING:
    from mcap.records import Chunk, McapRecord, Message

__all__ = ["recover"]

HEAD = struct.Struct("<BQ")  # of a record: its opcode and length
MARK = struct.pack("<I4s", 4, b"zstd")  # how a chunk is compressed
MARK_AT = HEAD.size + 8 + 8 + 8 + 4  # after times, size and checksum
MOST = 1 << 30  # bytes of a chunk
BLOCK = 1 << 18


def recover(path: str | Path, output: str | Path | None = None, force: bool = False) -> Path:
    """Write all that is whole in a recording into a new one; the old one stays.

    Args:
        path: of a recording that was cut short (a killed process, a full disk) or damaged.
        output: where to; None: beside it, as ``NAME.recovered.mcap``.
        force: whether to replace a file that is there.

    Returns:
        The new file; `path` itself if it is whole.

    Raises:
        ConfigError: there is no such file, the output is there already, or the extra is not
            installed.
        RecordingError: it is no recording, or nothing in it is whole.
    """
    need_mcap()
    path = Path(path)
    whole = _is_whole(path)
    if whole and output is None:
        return path
    output = path.with_name(f"{path.stem}.recovered.mcap") if output is None else Path(output)
    if output.exists() and not force:
        raise ConfigError(f"{output} is there already: name another file, or force it")
    if output.resolve() == path.resolve():
        raise ConfigError(f"{output} is the damaged file itself: name another")
    with open_regular(path) as file:
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(f"{path} is not an MCAP file, or was cut before it began")
        file.seek(0)
        about = _begun(path, file)
        write_whole(output, lambda new: _copy(_whole_records(file), new, about))
    sync_folder(output.parent)
    return output


def _is_whole(path: Path) -> bool:
    try:
        for _ in Recording(path).raw():
            pass
    except RecordingError:
        return False
    return True


def _begun(path: Path, file: BinaryIO) -> Description:
    """What the recording is of."""
    from mcap.records import Header, Metadata
    from mcap.stream_reader import StreamReader

    found: dict[str, dict[str, str]] = {}
    records = StreamReader(file, emit_chunks=True, record_size_limit=1 << 30).records
    with suppress(Exception):  # cut off here; a damaged length reads as anything
        for record in records:
            if isinstance(record, Metadata):
                found.setdefault(record.name, record.metadata)
            elif not isinstance(record, Header):
                break
    if METADATA not in found:
        raise RecordingError(f"{path}: nothing in it is whole, or it is no recording of tactile-rt")
    return Description.from_metadata(str(path), found[METADATA], found.get(SESSION, {}), True)


def _whole_records(file: BinaryIO) -> "Iterator[McapRecord]":
    """What is in the chunks that are whole, wherever they are.

    A power cut leaves any page of what was not synced yet, and zeros for the others. So nothing
    that says how long it is leads on to what follows: chunks are looked for, and their checksums
    say whether they are.
    """
    from mcap.stream_reader import breakup_chunk

    at = 0
    while (found := _find(file, MARK, at)) >= 0:
        chunk = _chunk_at(file, found - MARK_AT) if found >= MARK_AT else None
        try:
            inside = breakup_chunk(chunk, validate_crc=True) if chunk is not None else None
        except Exception:  # damaged: what follows may be whole
            inside = None
        if chunk is None or inside is None:
            at = found + 1
        else:
            at = found + len(MARK) + len(chunk.data)
            yield from inside


def _find(file: BinaryIO, mark: bytes, at: int) -> int:
    """Where these bytes are next; -1: nowhere."""
    end = file.seek(0, os.SEEK_END)
    while at < end:
        if (found := _read(file, at, BLOCK).find(mark)) >= 0:
            return at + found
        at += BLOCK - len(mark) + 1
    return -1


def _read(file: BinaryIO, at: int, size: int) -> bytes:
    """So many bytes, or fewer; none where the medium is damaged."""
    try:
        file.seek(at)
        return file.read(size)
    except OSError:
        return b""


def _chunk_at(file: BinaryIO, at: int) -> "Chunk | None":
    """The chunk that begins here, if one does."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Chunk

    head = _read(file, at, HEAD.size)
    opcode, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
    if opcode != Opcode.CHUNK or length > MOST:
        return None
    data = _read(file, at + HEAD.size, length)
    if len(data) < length:
        return None
    try:
        chunk = Chunk.read(ReadDataStream(BytesIO(data)))
    except Exception:  # a dozen unrelated types, as for any parser of damaged bytes
        return None
    own = MARK_AT - HEAD.size + len(MARK) + 8 + len(chunk.data)
    checked = own == length and chunk.uncompressed_crc and chunk.uncompressed_size <= MOST
    return chunk if checked else None


def _copy(records: "Iterator[McapRecord]", new: BinaryIO, about: Description) -> None:
    from mcap.records import Channel, Message

    file = McapFile(new, about)
    file.note(RECOVERED, {"by": "tactile_rt"})
    # A damaged first chunk takes the names of the channels with it, but we number them alike.
    numbered = (topic for topic, wire in CHANNELS if wire in ("", about.wire))
    names = dict(enumerate(numbered, 1))
    for record in records:
        if isinstance(record, Channel):
            names[record.id] = record.topic
        elif isinstance(record, Message) and record.channel_id in names:
            file.add(names[record.channel_id], record.data, _host_ns(record, about))
    file.finish()
    os.fsync(new.fileno())


def _host_ns(message: "Message", about: Description) -> int:
    return message.log_time - about.utc_offset_ns
