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

# DBC: what a sensor's bus looks like, and then what no bus has


def _dbc(text: str, length: str = "8") -> bytes:
    return f'VERSION ""\nBU_: A\nBO_ 1 M: {length} A\n{text}\n'.encode("cp1252")


def _signals(number: int) -> str:
    return "\n".join(f' SG_ S{i} : {i % 64}|1@1+ (1,0) [0|1] "" A' for i in range(number))


def _message_per_line(number: int) -> str:
    return "\n".join(f"BO_ {i + (1 << 31)} M{i}: 64 A" for i in range(number))


def _nested(depth: int) -> str:
    head = ' SG_ S0 M : 0|8@1+ (1,0) [0|1] "" A\n'
    lines = (f' SG_ S{i} m0M : {i % 56}|8@1+ (1,0) [0|1] "" A' for i in range(1, depth))
    ranges = (f"SG_MUL_VAL_ 1 S{i} S{i - 1} 0-0;" for i in range(1, depth))
    return head + "\n".join([*lines, "", *ranges])


MUX = ' SG_ X M : 0|8@1+ (1,0) [0|1] "" A\n SG_ S m0 : 8|8@1+ (1,0) [0|1] "" A\n'
DBCS: dict[str, Callable[[], bytes]] = {
    "a message of 100,000 bytes": lambda: _dbc(_signals(1), "100000"),
    "a length of 10,000 digits": lambda: _dbc(_signals(1), "9" * 10_000),
    "100 MB": lambda: _dbc(_signals(1)) + b" " * 100_000_000,
    "a million signals": lambda: _dbc(_signals(1_000_000)),
    "a signal of 10^9 bits": lambda: _dbc(' SG_ S : 0|1000000000@1+ (1,0) [0|1] "" A'),
    "a signal at bit 10^9": lambda: _dbc(' SG_ S : 1000000000|8@1+ (1,0) [0|1] "" A'),
    "a multiplexer of 10^9 values": lambda: _dbc(MUX + "SG_MUL_VAL_ 1 S X 0-1000000000;"),
    "a thousand multiplexers deep": lambda: _dbc(_nested(1000)),
    "multiplexers in a circle": lambda: _dbc(
        ' SG_ S m0M : 0|8@1+ (1,0) [0|1] "" A\n SG_ T m0M : 8|8@1+ (1,0) [0|1] "" A\n'
        "SG_MUL_VAL_ 1 S T 0-0;\nSG_MUL_VAL_ 1 T S 0-0;"
    ),
    "a string without end": lambda: _dbc(_signals(1) + '\nCM_ "' + '\\"' * 400_000),
    "a million quotes": lambda: _dbc(_signals(1) + "\nCM_ " + '"a"\\' * 200_000),
    "no end of names": lambda: _dbc(" SG_ " + "a " * 500_000),
    "zeroes": lambda: bytes(1 << 20),
    "25,000 messages": lambda: _dbc(_message_per_line(25_000)),
    "a name of 1 MB": lambda: _dbc(f' SG_ {"a" * 1_000_000} : 0|8@1+ (1,0) [0|1] "" A'),
}
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
