"""Result of an import, as a recording and as a report in text."""

from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Final

import numpy as np

from tactile_rt.core.errors import RecordingError
from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import NS_PER_S, Chunk, concatenate
from tactile_rt.recording.description import SUMMARY, Description
from tactile_rt.recording.layout import SAMPLES, encode_samples
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.writer import McapFile

BLOCK: Final = 4096  # chunks that are measured together
CHUNK_S: Final = 0.01  # length of a chunk, as of live sources
FEWEST: Final = 100_000  # most chunks of that length; for more samples, chunks are longer
UTC_FROM_NS: Final = 10**17  # larger times count from 1970
SHOWN: Final = 8  # most channels in the text


@dataclass
class Import:
    """Result of an import: counts of data read, lost and left out, and of samples."""

    samples: int = 0
    intact: int = 0
    corrupt: int = 0
    missing: int = 0  # number of samples that never came, by the device's counter
    seconds: float = 0.0
    rate_hz: float = 0.0
    notes: list[str] = field(default_factory=list)
    # what `total`, `read` and `passed_over` count: bytes, lines, frames, messages or rows
    unit: str = "rows"
    total: int = 0
    read: int = 0
    passed_over: int = 0
    out_of_order: int | None = None  # number of times that go back; None if not counted
    first: str = ""
    last: str = ""
    found_hz: float | None = None  # rate by the times in the file; None if it has no times
    # rate by the codec or the user; None if only the times give a rate
    said_hz: float | None = None
    first_missing: int | None = None  # number of the sample before the first missing one
    invalid: int = 0  # number of samples with an invalid element
    units: dict[str, str] = field(default_factory=dict)  # SI unit of each channel
    # smallest and largest valid value of each column, SI, by ELEMENT.CHANNEL
    ranges: dict[str, tuple[float, float] | None] = field(default_factory=dict)


def measure_samples(account: Import, path: Path) -> None:
    """Read a recording; fill in number, times, gaps and ranges of its samples."""
    stored = Recording(path)
    spec, offset, chunks = stored.spec, stored.description.utc_offset_ns, iter(stored)
    low = high = np.full(spec.shape, np.nan, np.float32)
    n, seq, times = 0, 0, [0, 0]
    while parts := list(islice(chunks, BLOCK)):
        chunk = concatenate(parts)
        values = np.where(chunk.valid[..., None], chunk.values, np.nan)
        low, high = np.fmin(low, np.fmin.reduce(values)), np.fmax(high, np.fmax.reduce(values))
        account.invalid += int((~chunk.valid.all(axis=1)).sum())
        seq = seq if n else int(chunk.seq[0]) - 1
        gaps = np.flatnonzero(np.diff(chunk.seq, prepend=seq) > 1)
        if len(gaps) and account.first_missing is None:
            account.first_missing = n + int(gaps[0])
        times = [times[0] if n else int(chunk.t_ns[0]), int(chunk.t_ns[-1])]
        n, seq = n + len(chunk), int(chunk.seq[-1])
    account.samples, account.seconds = n, (times[1] - times[0]) / NS_PER_S
    account.rate_hz = spec.rate_hz
    account.first, account.last = (show_time(t + offset) for t in times)
    account.units = dict(zip(spec.channels, spec.units, strict=True))
    names = [f"{e}.{c}" for e in spec.elements for c in spec.channels]
    pairs = zip(low.ravel().tolist(), high.ravel().tolist(), strict=True)
    account.ranges = {
        name: None if np.isnan(pair[0]) else pair for name, pair in zip(names, pairs, strict=True)
    }


def show_time(t_ns: int) -> str:
    """Format a time, ns, as UTC if it counts from 1970, else in seconds."""
    if t_ns < UTC_FROM_NS:
        return f"{round(t_ns / NS_PER_S, 6):.12g} s"
    return datetime.fromtimestamp(t_ns // NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S") + (
        f".{t_ns % NS_PER_S // 1000:06d} UTC"
    )


def report_lines(report: Import) -> list[str]:
    """Return a report as lines of text: counts, times, and the range of each channel."""
    hz = [
        f"{rate:.6g} Hz {what}"
        for rate, what in ((report.found_hz, "by its times"), (report.said_hz, "said"))
        if rate
    ]
    order = "" if report.out_of_order is None else f", {report.out_of_order} out of order"
    lines = [
        f"{report.samples} samples in, {report.intact} intact, {report.corrupt} corrupt, "
        f"{report.missing} missing; {report.seconds:.6g} s at {report.rate_hz:.6g} Hz",
        f"{report.total} {report.unit}: {report.read} read, {report.passed_over} passed over{order}"
        f"; {report.invalid} samples have an invalid element",
        f"from {report.first} to {report.last}{''.join(f'; {x}' for x in hz)}",
    ]
    if report.first_missing is not None:
        lines.append(f"the first that is missing is after sample {report.first_missing}")
    of: dict[str, list[tuple[float, float]]] = {channel: [] for channel in report.units}
    for name, found in report.ranges.items():
        of[name.rpartition(".")[2]] += [found] if found else []
    for channel, pairs in list(of.items())[:SHOWN]:
        lows, highs = zip(*pairs, strict=True) if pairs else ([np.nan], [np.nan])
        lines.append(f"{channel} {min(lows):.6g}..{max(highs):.6g} {report.units[channel]}")
    if len(of) > SHOWN:
        lines.append(f"and {len(of) - SHOWN} channels more")
    return lines


def clock_of(first_ns: int) -> int:
    """Return the offset to subtract from a file's times, ns. 0 unless they count from 1970."""
    return first_ns if first_ns >= UTC_FROM_NS else 0


def write_chunks(
    output: Path, about: Description, chunk: Chunk, account: Import, what: str
) -> Import:
    """Write samples as a recording, in chunks as long as those of a live source.

    Args:
        output: the file to write, whole or not at all.
        account: result of the import; samples, seconds, rate and the like are filled in.

    Raises:
        RecordingError: no sample is valid.
    """
    if not chunk.valid.any():
        raise RecordingError(f"{what}: no measured number in {len(chunk)} lines")
    n, rate = len(chunk), about.spec.rate_hz
    span_s = int(chunk.t_ns[-1] - chunk.t_ns[0]) / NS_PER_S
    account.total, account.read = account.intact + account.corrupt, account.intact
    account.passed_over = account.corrupt
    account.found_hz = int(chunk.seq[-1] - chunk.seq[0]) / span_s if span_s else None
    size = max(1, round(CHUNK_S * rate), n // FEWEST)

    def fill(file: BinaryIO) -> None:
        made = McapFile(file, about)
        for at in range(0, n, size):
            part = chunk.select(slice(at, at + size))
            made.add(SAMPLES, encode_samples(part), int(part.t_ns[-1]))
        made.note(SUMMARY, {"samples": str(n), "packets": "0"})
        made.finish()

    write_whole(output, fill)
    measure_samples(account, output)
    return account
