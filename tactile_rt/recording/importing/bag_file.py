"""Files and folders of ROS bags, opened by the library rosbags, also if they are damaged.

An MCAP file that has lost its end lacks the index, which every library reads first. Its records
can still be read one after another, also those of a chunk that is cut short.
"""

import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from io import BytesIO
from math import inf
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO, Final

from tactile_rt.core.errors import RecordingError, describe_error
from tactile_rt.core.files import open_regular, refuse_lfs_pointer
from tactile_rt.core.packages import require_extra
from tactile_rt.recording.records import MAGIC

SQLITE: Final = b"SQLite format 3\0"
ROS1: Final = b"#ROSBAG V2.0\n"
SIZES: Final = 64  # most message sizes of a topic that are sampled, the largest ones
LARGEST: Final = 1 << 30  # bytes of a record, and of an unpacked chunk
MESSAGE, CHUNK, DATA_END, FOOTER = 5, 6, 15, 2
TIMES_AND_SUM: Final = 8 + 8 + 8 + 4  # bytes of a chunk before the name of its compression


def is_bag(path: Path) -> bool:
    """Return whether a path is a ROS bag or an MCAP file."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    with open_regular(path) as file:
        begins = file.read(len(SQLITE))
    if begins == SQLITE:  # python-can's logger writes such files, too
        return path.suffix == ".db3"
    return begins.startswith((ROS1, MAGIC))


@dataclass
class OpenBag:
    """Open bag, which reads the messages of its topics."""

    reader: Any
    notes: list[str] = field(default_factory=list)
    back: int = 0  # number of times that go back

    def messages(self, topic: str) -> Iterator[tuple[int, bytes, Any]]:
        """Yield (time in ns, bytes, message) of a topic; a damaged message is None."""
        for connection, t_ns, raw in self._read_stored(topic):
            yield t_ns, bytes(raw), self._decode(connection, raw)

    def samples(self, topic: str, most: float = inf) -> list[Any]:
        """Read one message of each size, the largest first; see `SIZES`.

        Args:
            most: number of bytes of the topic to read.
        """
        sizes: dict[int, tuple[Any, bytes]] = {}
        for connection, _, raw in self._read_stored(topic):
            most -= len(raw)
            sizes.setdefault(len(raw), (connection, bytes(raw)))
            if len(sizes) > SIZES:
                del sizes[min(sizes)]
            if most <= 0:
                break
        found = (self._decode(*sizes[size]) for size in sorted(sizes, reverse=True))
        return [message for message in found if message is not None]

    def _read_stored(self, topic: str) -> Iterator[tuple[Any, int, bytes]]:
        which = [c for c in self.reader.connections if c.topic == topic]
        try:
            yield from self.reader.messages(connections=which)
        except Exception as error:  # rosbags raises anything where a chunk is damaged
            note = f"it is damaged, and read up to there ({describe_error(error)})"
            self.notes += [note] if note not in self.notes else []

    def _decode(self, connection: Any, raw: bytes) -> Any:
        try:
            return self.reader.deserialize(raw, connection.msgtype)
        except Exception:  # likewise on bytes that are no such message
            return None


@contextmanager
def open_bag(path: Path) -> Iterator[OpenBag]:
    """Open a bag of ROS 1 or ROS 2.

    Raises:
        RecordingError: the bag is damaged, or has lost its end.
    """
    with require_extra("bags need", "import"):
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    for file in path.iterdir() if path.is_dir() else ():
        refuse_lfs_pointer(file)
    with ExitStack() as stack:
        notes: list[str] = []
        store = get_typestore(Stores.LATEST)
        reader = None
        try:
            reader = stack.enter_context(AnyReader([path], default_typestore=store))
        except Exception as error:  # rosbags and its libraries raise anything on a damaged bag
            why = describe_error(error)
            notes = [f"its end is missing or damaged ({why}): what is whole before it was read"]
            new = Path(stack.enter_context(TemporaryDirectory())) / "mended.mcap"
            if path.suffix == ".mcap" and _mend_bag(path, new):
                with suppress(Exception):  # as above
                    reader = stack.enter_context(AnyReader([new], default_typestore=store))
            if reader is None:
                raise RecordingError(
                    f"{path} cannot be read as a bag: {why:.90}; `rosbag reindex` or "
                    "`ros2 bag reindex` mend one without its end"
                ) from None
        yield OpenBag(reader, notes)


def _mend_bag(path: Path, new: Path) -> int:
    """Copy a bag's intact records to a file without index; return the number of messages."""
    n = 0
    with open_regular(path) as file, new.open("wb") as made:
        made.write(file.read(len(MAGIC)))
        with suppress(Exception):  # damaged bytes may raise anything
            for opcode, data in _split_records(file):
                made.write(struct.pack("<BQ", opcode, len(data)) + data)
                n += opcode == MESSAGE
        made.write(struct.pack("<BQ4x", DATA_END, 4) + struct.pack("<BQ20x", FOOTER, 20) + MAGIC)
    return n


def _split_records(file: BinaryIO) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, record) of all records before the summary, also those in chunks."""
    while len(head := file.read(9)) == 9:
        opcode, length = struct.unpack("<BQ", head)
        data = file.read(min(length, LARGEST))
        if opcode == DATA_END:
            return
        if opcode == CHUNK:  # may hold less than it declares
            yield from _split_records(BytesIO(_unpack_chunk(data)))
        elif len(data) == length:
            yield opcode, data


def _unpack_chunk(data: bytes) -> bytes:
    """Unpack the data of a chunk; if it is cut short, as much as possible."""
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
