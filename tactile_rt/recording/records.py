"""Reader of the records of an MCAP file, in file order, within bounds of memory and time.

A file may come from anywhere, so every field is checked before it is used: a few bytes can claim to
unpack to gigabytes, or announce a million channels.

The file is read once, from its beginning. Its index is not used, so a wrong index does no harm. A
record's length is checked against the bytes left in the file. Only the records that make up a
recording are parsed: metadata, channels, messages, and chunks of these; all others are skipped. A
chunk unpacks to the size that it declares and to `MOST_UNPACKED` at most, the whole file to
`MOST_RATIO` times its size, plus `FREE`.
"""

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from typing import TYPE_CHECKING, Any, BinaryIO, Final

if TYPE_CHECKING:
    from mcap.records import Channel, Message, Metadata

    Record = Channel | Message | Metadata

MAGIC: Final = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 1, 2, 3, 4, 5, 6, 12, 15

MOST_UNPACKED: Final = 32 << 20  # bytes of a chunk; ours have one MiB plus one message at most
MOST_RATIO: Final = (
    2000  # unpacked chunks to file size; a large array that measures 0 reaches 1500 ...
)
FREE: Final = 256 << 20  # bytes that may be unpacked beyond that ratio
MOST_METADATA: Final = 4 << 20  # bytes of all metadata records together
MOST_OTHERS: Final = 10_000  # records other than chunks, messages and their indexes
PIECE: Final = 1 << 20  # bytes of a skipped record that are read at once
INDEXES: Final = (7, 8)  # message index and chunk index: one or more per chunk

_FRAME = struct.Struct("<BQ")  # opcode and length
_MESSAGE = struct.Struct("<HIQQ")
MOST_LOOKS: Final = 4  # times the file's size that may be read as candidate chunks
ENDS: Final = (CHUNK, DATA_END, FOOTER)
MARK: Final = struct.pack("<I4s", 4, b"zstd")  # name of the compression of our chunks
MARK_AT: Final = _FRAME.size + 8 + 8 + 8 + 4  # its offset: after times, size and checksum
_CHUNK = struct.Struct("<QQQII")  # then the name of the compression, the data's length, the data


def read_records(file: BinaryIO) -> "Iterator[Record]":
    """Yield the records of a finished file, up to the first damage.

    Raises:
        ValueError: the file is damaged, or exceeds the limits of a recording.
    """
    return _Reader(file).records()


def read_whole_records(file: BinaryIO) -> "Iterator[Record]":
    """Yield the intact records of a truncated or damaged file, also those after a hole.

    Raises:
        ValueError: the file exceeds the limits of a recording.
    """
    return _Reader(file).whole_records()


class _LimitExceeded(ValueError):
    """Error: the file exceeds a limit of recordings, so nothing is salvaged from it."""


class _Reader:
    def __init__(self, file: BinaryIO) -> None:
        from mcap.records import Message

        self._file, self._new_message = file, Message
        self._size = file.seek(0, 2)
        file.seek(0)
        self._at = self._crc = 0
        self._unpacked = self._metadata = self._others = self._looked = 0

    def records(self) -> "Iterator[Record]":
        self._check_magic()
        while (frame := self._next_frame()) is not None:
            opcode, length = frame
            if opcode == CHUNK:
                yield from self._split_chunk(self._unpack_chunk(self._read(length)))
            elif opcode == DATA_END:
                self._check_sum(length)
            elif opcode == FOOTER:
                self._read(length)
                if self._read(len(MAGIC)) != MAGIC:
                    raise ValueError("it does not end like an MCAP file")
                return
            else:
                yield from self._read_single(opcode, length)
        raise ValueError("it ends before its end is written")

    def whole_records(self) -> "Iterator[Record]":
        """Yield the records at the beginning of the file, then those of every intact chunk.

        After a power cut, unsynced pages may be on the medium or be zeros. So a record's length
        does not lead to the next record: chunks are searched for by their mark, and confirmed by
        their checksums.
        """
        try:
            self._check_magic()
            while (frame := self._next_frame()) is not None and frame[0] not in ENDS:
                yield from self._read_single(*frame)
        except _LimitExceeded:
            raise
        except Exception:  # truncated here; a damaged length can have any value
            pass
        at = 0
        while (found := self._find(MARK, at)) >= 0:
            at, data = self._read_chunk_at(found)
            if data is not None:
                yield from self._split_chunk(data)

    def _read_chunk_at(self, mark: int) -> tuple[int, bytes | None]:
        """Return (where to search next, data of the chunk with this mark, None if damaged)."""
        begin = mark - MARK_AT
        head = self._peek(begin, MARK_AT + len(MARK) + 8) if begin >= 0 else b""
        if len(head) < MARK_AT + len(MARK) + 8:
            return mark + 1, None
        opcode, length = _FRAME.unpack_from(head)
        (packed,) = struct.unpack_from("<Q", head, MARK_AT + len(MARK))
        own = len(head) - _FRAME.size + packed
        if opcode != CHUNK or own != length or length > MOST_UNPACKED:
            return mark + 1, None
        record = self._peek(begin + _FRAME.size, length)
        self._looked += length
        if self._looked > FREE + MOST_LOOKS * self._size:
            raise _LimitExceeded("too many places look like a chunk")
        self._at = begin + _FRAME.size + length
        try:
            if len(record) < length or not _CHUNK.unpack_from(record)[3]:  # no checksum
                return mark + 1, None
            data = self._unpack_chunk(record)
            others = self._others
            for _ in self._split_chunk(data):  # check all records: a broken chunk yields none
                pass
            self._others = others  # they are counted when they are yielded
        except _LimitExceeded:
            raise
        except Exception:  # damaged: later chunks may be intact
            return mark + 1, None
        return self._at, data

    def _find(self, mark: bytes, at: int) -> int:
        """Return the next position of these bytes from `at` on; -1 if not found."""
        while at < self._size:
            if (found := self._peek(at, PIECE).find(mark)) >= 0:
                return at + found
            at += PIECE - len(mark) + 1
        return -1

    def _peek(self, at: int, size: int) -> bytes:
        """Return up to `size` bytes at a position; empty if the medium cannot be read."""
        try:
            self._file.seek(at)
            return self._file.read(size)
        except OSError:
            return b""

    def _check_magic(self) -> None:
        if self._read(len(MAGIC)) != MAGIC:
            raise ValueError("it is no MCAP file")

    def _next_frame(self) -> tuple[int, int] | None:
        """Read opcode and length of the next record; return None at the file's end."""
        if self._at == self._size:
            return None
        self._crc_before = self._crc
        opcode, length = _FRAME.unpack(self._read(_FRAME.size))
        if length > self._size - self._at:
            raise ValueError(f"a record of {length} bytes where {self._size - self._at} are left")
        if opcode == CHUNK and length > MOST_UNPACKED:
            raise ValueError(f"a chunk of {length >> 20} MiB; {MOST_UNPACKED >> 20} are read")
        return opcode, length

    def _read(self, length: int) -> bytes:
        data = self._file.read(length)
        if len(data) < length:
            raise ValueError("it is cut short")
        self._at += length
        self._crc = zlib.crc32(data, self._crc)
        return data

    def _read_single(self, opcode: int, length: int) -> "Iterator[Record]":
        """Yield the next record, outside chunks, if recordings use its kind; else skip it."""
        if opcode == MESSAGE and length <= MOST_UNPACKED:
            yield self._parse_message(self._read(length))
            return
        if opcode == METADATA:
            self._metadata += length
            if self._metadata > MOST_METADATA:
                raise _LimitExceeded(f"metadata of more than {MOST_METADATA >> 20} MiB")
        if opcode not in INDEXES:
            self._count_other()
        if opcode in (METADATA, CHANNEL) and length <= MOST_METADATA:
            yield self._parse(opcode, self._read(length))
            return
        while length:
            length -= len(self._read(min(length, PIECE)))

    def _check_sum(self, length: int) -> None:
        before = self._crc_before
        (stored,) = struct.unpack_from("<I", self._read(length))
        if stored not in (0, before):
            raise ValueError("its checksum is wrong")

    def _unpack_chunk(self, record: bytes) -> bytes:
        _, _, size, crc, name_length = _CHUNK.unpack_from(record)
        at = _CHUNK.size + name_length
        name = record[_CHUNK.size : at]
        (length,) = struct.unpack_from("<Q", record, at)
        packed = memoryview(record)[at + 8 : at + 8 + length]
        if len(packed) != length:
            raise ValueError("a chunk is cut short")
        if size > MOST_UNPACKED:
            raise ValueError(
                f"a chunk of {length} bytes says that it unpacks to {size >> 20} MiB; "
                f"{MOST_UNPACKED >> 20} are read"
            )
        self._unpacked += size
        if self._unpacked > FREE + MOST_RATIO * self._at:
            raise _LimitExceeded(f"chunks that unpack to more than {MOST_RATIO} times the file")
        data: bytes = _decompress(name.decode(errors="replace"), packed, size)
        if len(data) != size:
            raise ValueError(f"a chunk does not unpack to the {size} bytes that it says")
        if crc and zlib.crc32(data) != crc:
            raise ValueError("the checksum of a chunk is wrong")
        return data

    def _split_chunk(self, data: bytes) -> "Iterator[Record]":
        at, end, unpack = 0, len(data), _FRAME.unpack_from
        while at < end:
            opcode, length = unpack(data, at)
            begin = at + _FRAME.size
            at = begin + length
            if at > end:
                raise ValueError("a record is longer than its chunk")
            if opcode == MESSAGE:
                yield self._parse_message(data[begin:at])
                continue
            self._count_other()
            if opcode == CHANNEL:
                yield self._parse(opcode, data[begin:at])
            elif opcode != SCHEMA:
                raise ValueError(f"a record of kind {opcode} in a chunk")

    def _count_other(self) -> None:
        self._others += 1
        if self._others > MOST_OTHERS:
            raise _LimitExceeded(f"more than {MOST_OTHERS} records besides messages")

    def _parse_message(self, data: bytes) -> "Message":
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data)
        return self._new_message(channel, log_time, data[_MESSAGE.size :], publish_time, sequence)

    @staticmethod
    def _parse(opcode: int, data: bytes) -> "Channel | Metadata":
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel, Metadata

        kind: Any = Channel if opcode == CHANNEL else Metadata
        parsed: Channel | Metadata = kind.read(ReadDataStream(BytesIO(data)))
        return parsed


def _decompress(compression: str, packed: memoryview, size: int) -> Any:
    """Decompress data to at most `size` + 1 bytes, regardless of its declared size."""
    if not compression:
        return bytes(packed)
    if compression == "zstd":
        import zstandard

        declared = zstandard.get_frame_parameters(packed).content_size
        if declared not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError(f"a chunk says that it unpacks to {size} bytes and to {declared}")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    raise ValueError(f"a chunk is compressed by {compression[:20]!r}, which is not known")
