"""The records of an MCAP file, in their order, within bounds of memory and time.

What is needed: a file may come from elsewhere, so nothing in it is believed before it is checked. A
few bytes can say that they unpack to gigabytes, or that a million channels follow.

The plan. The file is read once, from its beginning; its index is not used, so where that points to
does not matter. A record's length is held against what is left of the file. Only what recordings
are made of is looked into: metadata, channels, messages, and chunks of these; all else is passed
over. A chunk unpacks to the size that it declares and to `MOST_UNPACKED` at most, the whole file to
`MOST_RATIO` times its size.
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

MOST_UNPACKED: Final = 32 << 20  # bytes of a chunk; ours have one MiB and a message more
MOST_RATIO: Final = (
    2000  # of all chunks to the file; a large array that measures 0 reaches 1500 ...
)
FREE: Final = 256 << 20  # bytes ... beyond these
MOST_METADATA: Final = 4 << 20  # bytes, all together
MOST_OTHERS: Final = 10_000  # records that are neither chunks nor messages nor their index
PIECE: Final = 1 << 20  # bytes read at once of what is passed over
INDEXES: Final = (7, 8)  # of a chunk's messages, and of chunks: as many as there are chunks

_FRAME = struct.Struct("<BQ")  # opcode and length
_MESSAGE = struct.Struct("<HIQQ")
MOST_LOOKS: Final = 4  # times the file, at what looks like a chunk
ENDS: Final = (CHUNK, DATA_END, FOOTER)
MARK: Final = struct.pack("<I4s", 4, b"zstd")  # how a chunk of ours is compressed
MARK_AT: Final = _FRAME.size + 8 + 8 + 8 + 4  # after times, size and checksum
_CHUNK = struct.Struct("<QQQII")  # and the name of the compression, the data's length, the data


def read_records(file: BinaryIO) -> "Iterator[Record]":
    """What is in a file that was written to its end, until damage is met.

    Raises:
        ValueError: damage, or more than a recording has.
    """
    return _Reader(file).records()


def read_whole_records(file: BinaryIO) -> "Iterator[Record]":
    """What is whole in a file that was cut off or damaged, also behind a hole.

    Raises:
        ValueError: there is more in it than a recording has.
    """
    return _Reader(file).whole_records()


class _TooMuch(ValueError):
    """More than a recording has: not damage that what is whole can be saved from."""


class _Reader:
    def __init__(self, file: BinaryIO) -> None:
        from mcap.records import Message

        self._file, self._new_message = file, Message
        self._size = file.seek(0, 2)
        file.seek(0)
        self._at = self._crc = 0
        self._unpacked = self._metadata = self._others = self._looked = 0

    def records(self) -> "Iterator[Record]":
        self._begin()
        while (frame := self._next()) is not None:
            opcode, length = frame
            if opcode == CHUNK:
                yield from self._inside(self._unpack(self._read(length)))
            elif opcode == DATA_END:
                self._check_sum(length)
            elif opcode == FOOTER:
                self._read(length)
                if self._read(len(MAGIC)) != MAGIC:
                    raise ValueError("its end is none of an MCAP file")
                return
            else:
                yield from self._single(opcode, length)
        raise ValueError("it ends before its end is written")

    def whole_records(self) -> "Iterator[Record]":
        """What is of the whole file, and then what is in chunks, wherever they are.

        A power cut leaves any page of what was not synced yet, and zeros for the others. So nothing
        that says how long it is leads on to what follows: chunks are looked for, and their
        checksums say whether they are.
        """
        try:
            self._begin()
            while (frame := self._next()) is not None and frame[0] not in ENDS:
                yield from self._single(*frame)
        except _TooMuch:
            raise
        except Exception:  # cut off here; a damaged length reads as anything
            pass
        at = 0
        while (found := self._find(MARK, at)) >= 0:
            at, data = self._chunk_around(found)
            if data is not None:
                yield from self._inside(data)

    def _chunk_around(self, mark: int) -> tuple[int, bytes | None]:
        """The records of the chunk that has the mark here, if one has, and where to look on."""
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
            raise _TooMuch("more that looks like a chunk than there is room for")
        self._at = begin + _FRAME.size + length
        try:
            if len(record) < length or not _CHUNK.unpack_from(record)[3]:  # no checksum
                return mark + 1, None
            data = self._unpack(record)
            others = self._others
            for _ in self._inside(data):  # nothing of a chunk that breaks off
                pass
            self._others = others  # they are counted when they are taken
        except _TooMuch:
            raise
        except Exception:  # damaged: what follows may be whole
            return mark + 1, None
        return self._at, data

    def _find(self, mark: bytes, at: int) -> int:
        """Where these bytes are next; -1: nowhere."""
        while at < self._size:
            if (found := self._peek(at, PIECE).find(mark)) >= 0:
                return at + found
            at += PIECE - len(mark) + 1
        return -1

    def _peek(self, at: int, size: int) -> bytes:
        """So many bytes, or fewer; none where the medium is damaged."""
        try:
            self._file.seek(at)
            return self._file.read(size)
        except OSError:
            return b""

    def _begin(self) -> None:
        if self._read(len(MAGIC)) != MAGIC:
            raise ValueError("it is no MCAP file")

    def _next(self) -> tuple[int, int] | None:
        """Opcode and length of the next record; None at the end."""
        if self._at == self._size:
            return None
        self._before = self._crc
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

    def _single(self, opcode: int, length: int) -> "Iterator[Record]":
        """A record outside chunks, if it is one of ours."""
        if opcode == MESSAGE and length <= MOST_UNPACKED:
            yield self._message(self._read(length))
            return
        if opcode == METADATA:
            self._metadata += length
            if self._metadata > MOST_METADATA:
                raise _TooMuch(f"metadata of more than {MOST_METADATA >> 20} MiB")
        if opcode not in INDEXES:
            self._count_other()
        if opcode in (METADATA, CHANNEL) and length <= MOST_METADATA:
            yield self._parsed(opcode, self._read(length))
            return
        while length:
            length -= len(self._read(min(length, PIECE)))

    def _check_sum(self, length: int) -> None:
        before = self._before
        (told,) = struct.unpack_from("<I", self._read(length))
        if told not in (0, before):
            raise ValueError("its checksum is another")

    def _unpack(self, record: bytes) -> bytes:
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
            raise _TooMuch(f"chunks that unpack to more than {MOST_RATIO} times the file")
        data: bytes = _unpacked(name.decode(errors="replace"), packed, size)
        if len(data) != size:
            raise ValueError(f"a chunk does not unpack to the {size} bytes that it says")
        if crc and zlib.crc32(data) != crc:
            raise ValueError("the checksum of a chunk is another")
        return data

    def _inside(self, data: bytes) -> "Iterator[Record]":
        at, end, unpack = 0, len(data), _FRAME.unpack_from
        while at < end:
            opcode, length = unpack(data, at)
            begin = at + _FRAME.size
            at = begin + length
            if at > end:
                raise ValueError("a record is longer than its chunk")
            if opcode == MESSAGE:
                yield self._message(data[begin:at])
                continue
            self._count_other()
            if opcode == CHANNEL:
                yield self._parsed(opcode, data[begin:at])
            elif opcode != SCHEMA:
                raise ValueError(f"a record of kind {opcode} in a chunk")

    def _count_other(self) -> None:
        self._others += 1
        if self._others > MOST_OTHERS:
            raise _TooMuch(f"more than {MOST_OTHERS} records besides messages")

    def _message(self, data: bytes) -> "Message":
        channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(data)
        return self._new_message(channel, log_time, data[_MESSAGE.size :], publish_time, sequence)

    @staticmethod
    def _parsed(opcode: int, data: bytes) -> "Channel | Metadata":
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel, Metadata

        kind: Any = Channel if opcode == CHANNEL else Metadata
        parsed: Channel | Metadata = kind.read(ReadDataStream(BytesIO(data)))
        return parsed


def _unpacked(compression: str, packed: memoryview, size: int) -> Any:
    """At most one byte more than `size`, whatever the data says of itself."""
    if not compression:
        return bytes(packed)
    if compression == "zstd":
        import zstandard

        told = zstandard.get_frame_parameters(packed).content_size
        if told not in (size, zstandard.CONTENTSIZE_UNKNOWN):
            raise ValueError(f"a chunk says that it unpacks to {size} bytes and to {told}")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    if compression == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    raise ValueError(f"a chunk is compressed by {compression[:20]!r}, which is not known")
