"""What an import came to."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO

from tactile_rt.core.errors import RecordingError
from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import NS_PER_S, Chunk
from tactile_rt.recording.description import SUMMARY, Description
from tactile_rt.recording.layout import SAMPLES, encode_samples
from tactile_rt.recording.writer import McapFile

__all__ = ["Import", "clock_of", "write_chunks"]

CHUNK_S = 0.01  # of a chunk, as live sources have it
FEWEST = 100_000  # chunks beyond which they are longer
UTC_FROM_NS = 10**17  # a time that is larger counts from 1970


@dataclass
class Import:
    """What became of a file that was imported.

    Attributes:
        missing: The number of samples that never came, by the device's counter.
        seconds: The time from the first sample to the last, s.
        rate_hz: The nominal sample rate of the recording, Hz.
    """

    samples: int = 0
    intact: int = 0
    corrupt: int = 0
    missing: int = 0
    seconds: float = 0.0
    rate_hz: float = 0.0
    notes: list[str] = field(default_factory=list)

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
    seconds = int(chunk.t_ns[-1] - chunk.t_ns[0]) / NS_PER_S
    return replace(account, samples=n, seconds=seconds, rate_hz=rate)
