"""Files that are made to hang or exhaust who reads them; each is small, or made in a moment."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path

__all__ = ["DBCS", "MCAPS", "MESHES"]

GIB = 1 << 30

# MCAP: a recording's beginning, as ours are written, and then what none has


def _record(opcode: int, data: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(data)) + data


def _string(text: bytes) -> bytes:
    return struct.pack("<I", len(text)) + text


def _message(count: int, data: bytes = b"", channel: int = 1) -> bytes:
    return _record(5, struct.pack("<HIQQ", channel, count, 0, 0) + data)


def _chunk(compression: bytes, packed: bytes, size: int, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 0, size, crc) + _string(compression)
    return _record(6, head + struct.pack("<Q", len(packed)) + packed)


def _recording(*records: bytes) -> bytes:
    from tactile_rt.recording import Description
    from tactile_rt.recording.reader import MAGIC
    from tactile_rt.recording.writer import McapFile
    from tests.helpers.recordings import SPEC

    begun = io.BytesIO()
    McapFile(begun, Description(SPEC, 1_700_000_000 * 10**9)).flush()
    end = _record(15, bytes(4)) + _record(2, bytes(20)) + MAGIC
    return begun.getvalue() + b"".join(records) + end


def _zeros(size: int, piece: int = 1 << 24) -> Iterable[bytes]:
    return (bytes(min(piece, size - at)) for at in range(0, size, piece))


def _zstd(size: int, told: bool = True) -> bytes:
    import zstandard

    packer = zstandard.ZstdCompressor(level=1).compressobj(size=size if told else -1)
    return b"".join([*map(packer.compress, _zeros(size)), packer.flush()])


def _lz4(size: int) -> bytes:
    import lz4.frame

    with lz4.frame.LZ4FrameCompressor() as packer:
        return b"".join([packer.begin(), *map(packer.compress, _zeros(size)), packer.flush()])


def _tiny(number: int) -> bytes:
    data = b"".join(_message(i) for i in range(number))
    return _chunk(b"", data, len(data), zlib.crc32(data))


def _many_bombs() -> bytes:
    size = 32 << 20
    return _chunk(b"zstd", _zstd(size), size) * 300


MCAPS: dict[str, Callable[[], bytes]] = {
    "zstd of 1 GiB": lambda: _recording(_chunk(b"zstd", _zstd(GIB), GIB)),
    "zstd of untold size": lambda: _recording(_chunk(b"zstd", _zstd(GIB, False), 1 << 20)),
    "lz4 of 1 GiB": lambda: _recording(_chunk(b"lz4", _lz4(GIB), GIB)),
    "a size that lies": lambda: _recording(_chunk(b"zstd", _zstd(GIB), 1000)),
    "hundreds of bombs": lambda: _recording(_many_bombs()),
    "a million tiny messages": lambda: _recording(_tiny(1_000_000)),
    "a million schemas": lambda: _recording(_record(3, bytes(14)) * 1_000_000),
    "a million attachments": lambda: _recording(_record(9, bytes(36)) * 1_000_000),
    "a million notes": lambda: _recording(
        _record(12, _string(b"tactile_rt") + _string(b"")) * 1_000_000
    ),
    "a huge length": lambda: _recording(struct.pack("<BQ", 6, 1 << 62), bytes(100)),
    "a chunk in a chunk": lambda: _recording(
        _chunk(b"", inner := _chunk(b"", _message(0), 1 << 40), len(inner))
    ),
    "a huge index": lambda: _recording(
        _record(7, struct.pack("<HI", 1, 60_000_000) + bytes(60_000_000)), _message(7)
    ),
    "an index that points back": lambda: _recording(
        _record(8, struct.pack("<4Q", 0, 0, 8, 1 << 40) + struct.pack("<I", 10) + bytes(10)),
        _chunk(b"zstd", _zstd(GIB), 1 << 35),
    ),
    "cut in a bomb": lambda: _recording(_chunk(b"zstd", _zstd(GIB), GIB))[:20_000],
}
DBCS: dict[str, Callable[[], bytes]] = {}
MESHES: dict[str, Callable[[], tuple[str, bytes]]] = {}


def written(folder: Path, name: str, data: bytes) -> Path:
    """The file in the folder."""
    path = folder / name
    path.write_bytes(data)
    return path


def zipped(members: Iterable[tuple[str, Iterable[bytes]]]) -> bytes:
    """A ZIP archive, deflated."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, parts in members:
            with archive.open(name, "w", force_zip64=True) as member:
                for part in parts:
                    member.write(part)
    return packed.getvalue()
