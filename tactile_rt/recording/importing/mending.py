"""A bag of ROS 2 that was cut short, as far as it is whole.

An MCAP file that has lost its end has no index, which every library reads first. Its records are
still there one after the other, also those of a chunk that is cut short.
"""

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

from tactile_rt.core.files import open_regular
from tactile_rt.recording.records import MAGIC

__all__ = ["mend_bag"]

LARGEST: Final = 1 << 30  # bytes of a record, and of what a chunk unpacks to
MESSAGE, CHUNK, DATA_END, FOOTER = 5, 6, 15, 2
TIMES_AND_SUM: Final = 8 + 8 + 8 + 4  # bytes of a chunk before the name of its compression


def mend_bag(path: Path, new: Path) -> int:
    """Copy the records that are whole, without an index; return the number of messages."""
    n = 0
    with open_regular(path) as file, new.open("wb") as made:
        made.write(file.read(len(MAGIC)))
        try:
            for opcode, data in _split_records(file):
                made.write(struct.pack("<BQ", opcode, len(data)) + data)
                n += opcode == MESSAGE
        except Exception:  # damaged from here on: anything may be raised of such bytes
            pass
        made.write(struct.pack("<BQ4x", DATA_END, 4) + struct.pack("<BQ20x", FOOTER, 20) + MAGIC)
    return n


def _split_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Read (opcode, record) of all records before the summary, also those in chunks."""
    while len(head := file.read(9)) == 9:
        opcode, length = struct.unpack("<BQ", head)
        data = file.read(min(length, LARGEST))
        if opcode == DATA_END:
            return
        if opcode == CHUNK:  # how much it says that it holds is not what is there
            yield from _split_records(BytesIO(_unpack_chunk(data)))
        elif len(data) == length:
            yield opcode, data


def _unpack_chunk(data: bytes) -> bytes:
    """Unpack what is in a chunk, as far as it is there."""
    (n,) = struct.unpack_from("<I", data, TIMES_AND_SUM)
    begin = TIMES_AND_SUM + 4 + n
    kind, packed = data[TIMES_AND_SUM + 4 : begin], data[begin + 8 :]
    if not kind:
        return packed
    if kind == b"zstd":
        import zstandard

        return bytes(zstandard.ZstdDecompressor().stream_reader(packed).read(LARGEST))
    import lz4.frame

    return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, LARGEST))
