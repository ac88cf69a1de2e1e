"""What an import could not read, and a bag of ROS 2 that was cut short, as far as it is whole.

An MCAP file that has lost its end has no index, which every library reads first. Its records are
still there one after the other, also those of a chunk that is cut short.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, Final

from tactile_rt.core.errors import RecordingError
from tactile_rt.core.files import open_regular, write_whole
from tactile_rt.core.stream import NS_PER_S, Chunk
from tactile_rt.recording.description import SUMMARY, Description
from tactile_rt.recording.importing.report import ImportReport, Measurer
from tactile_rt.recording.layout import SAMPLES, encode_samples
from tactile_rt.recording.records import MAGIC
from tactile_rt.recording.writer import McapFile

__all__ = ["Import", "clock_of", "mend_bag", "write_chunks"]

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


CHUNK_S = 0.01  # of a chunk, as live sources have it
FEWEST = 100_000  # chunks beyond which they are longer
UTC_FROM_NS = 10**17  # a time that is larger counts from 1970


@dataclass
class Import:
    """What became of a file that was imported.

    Attributes:
        missing: The number of samples that never came, by the device's counter.
    """

    samples: int = 0
    intact: int = 0
    corrupt: int = 0
    missing: int = 0
    seconds: float = 0.0
    rate_hz: float = 0.0
    notes: list[str] = field(default_factory=list)
    report: ImportReport = field(default_factory=ImportReport)

    def line(self) -> str:
        """It in one line."""
        return (
            f"{self.samples} samples in, {self.intact} intact, {self.corrupt} corrupt, "
            f"{self.missing} missing; {self.seconds:.6g} s at {self.rate_hz:.6g} Hz"
        )


def clock_of(first_ns: int) -> int:
    """What is taken off the times of a file, ns: all of them if they count from 1970."""
    return first_ns if first_ns >= UTC_FROM_NS else 0


def write_chunks(
    output: Path, about: Description, chunk: Chunk, account: Import, what: str
) -> Import:
    """Write a recording of these samples, cut as a live source would.

    Args:
        output: the file to write; it is there whole or not at all.
        account: what became of the file; samples, seconds and rate are filled in.

    Raises:
        RecordingError: no sample is valid.
    """
    if not chunk.valid.any():
        raise RecordingError(f"{what}: no number of a measurement in {len(chunk)} lines")
    n, rate = len(chunk), about.spec.rate_hz
    span_s = int(chunk.t_ns[-1] - chunk.t_ns[0]) / NS_PER_S
    report = account.report
    report.read, report.passed_over = account.intact, account.corrupt
    report.total = report.read + report.passed_over
    report.found_hz = int(chunk.seq[-1] - chunk.seq[0]) / span_s if span_s else None
    measurer = Measurer(report, about.spec, about.utc_offset_ns)
    measurer.add(chunk)
    measurer.finish()
    size = max(1, round(CHUNK_S * rate), n // FEWEST)

    def fill(file: BinaryIO) -> None:
        made = McapFile(file, about)
        for at in range(0, n, size):
            piece = slice(at, at + size)
            part = Chunk(
                chunk.seq[piece], chunk.t_ns[piece], chunk.values[piece], chunk.valid[piece]
            )
            made.add(SAMPLES, encode_samples(part), int(part.t_ns[-1]))
        made.note(SUMMARY, {"samples": str(n), "packets": "0"})
        made.finish()

    write_whole(output, fill)
    return replace(account, samples=n, seconds=span_s, rate_hz=rate)
