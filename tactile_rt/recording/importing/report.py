"""What came of an import: counts that add up, times, rates, ranges, and what is odd."""

from dataclasses import dataclass, field
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk

__all__ = ["ImportReport", "Measurer", "report_lines", "show_time"]

BLOCK = 4096  # samples that are measured together
SHOWN = 8  # channels in text


@dataclass
class ImportReport:
    """What a file held, and what of it became samples.

    Attributes:
        unit: What `total`, `read` and `passed_over` count: bytes, lines, frames, messages or rows.
        out_of_order: How many times go back; None where nobody counted.
        found_hz: Rate by the times of the file; None where it has none.
        said_hz: Rate that the codec or a user says; None where only times tell it.
        first_missing: Number of the sample before the first one that is missing.
        invalid: The number of samples of which an element is invalid.
        units: SI unit of each channel.
        ranges: Smallest and largest valid value of each column, SI, by ELEMENT.CHANNEL.
    """

    unit: str = "rows"
    total: int = 0
    read: int = 0
    passed_over: int = 0
    out_of_order: int | None = None
    first: str = ""
    last: str = ""
    found_hz: float | None = None
    said_hz: float | None = None
    first_missing: int | None = None
    invalid: int = 0
    units: dict[str, str] = field(default_factory=dict)
    ranges: dict[str, tuple[float, float] | None] = field(default_factory=dict)


class Measurer:
    """Takes the samples as they are written, and fills in a `ImportReport`.

    Args:
        utc_offset_ns: What was taken off the times, ns.
    """

    def __init__(self, report: ImportReport, spec: ArraySpec, utc_offset_ns: int) -> None:
        self._report, self._spec, self._offset = report, spec, utc_offset_ns
        self._waiting: list[Chunk] = []
        self._n = 0
        self._low: NDArray[np.float32] = np.full(spec.shape, np.nan, np.float32)
        self._high = self._low
        self._seq: int | None = None
        self._times = [0, 0]

    def add(self, chunk: Chunk) -> None:
        """Take samples."""
        self._waiting.append(chunk)
        if len(self._waiting) >= BLOCK:
            self._measure()

    def finish(self) -> None:
        """Fill in times and ranges."""
        self._measure()
        report, spec = self._report, self._spec
        report.first, report.last = (show_time(t + self._offset) for t in self._times)
        names = [f"{e}.{c}" for e in spec.elements for c in spec.channels]
        pairs = zip(self._low.ravel().tolist(), self._high.ravel().tolist(), strict=True)
        report.units = dict(zip(spec.channels, spec.units, strict=True))
        report.ranges = {
            name: None if low != low else (low, high)
            for name, (low, high) in zip(names, pairs, strict=True)
        }

    def _measure(self) -> None:
        waiting, self._waiting = self._waiting, []
        if not waiting:
            return
        seq = np.concatenate([c.seq for c in waiting])
        valid = np.concatenate([c.valid for c in waiting])
        values = np.where(valid[..., None], np.concatenate([c.values for c in waiting]), np.nan)
        if self._seq is None:
            self._times[0] = int(waiting[0].t_ns[0])
        self._times[1] = int(waiting[-1].t_ns[-1])
        gaps = np.flatnonzero(
            np.diff(seq, prepend=seq[0] - 1 if self._seq is None else self._seq) > 1
        )
        if len(gaps) and self._report.first_missing is None:
            self._report.first_missing = self._n + int(gaps[0])
        self._seq, self._n = int(seq[-1]), self._n + len(seq)
        self._report.invalid += int((~valid.all(axis=1)).sum())
        self._low = np.fmin(self._low, np.fmin.reduce(values))
        self._high = np.fmax(self._high, np.fmax.reduce(values))


def show_time(t_ns: int) -> str:
    """Write a time as UTC where it counts from 1970, else in seconds."""
    if t_ns < 10**17:
        return f"{round(t_ns / NS_PER_S, 6):.12g} s"
    return datetime.fromtimestamp(t_ns // NS_PER_S, UTC).strftime("%Y-%m-%d %H:%M:%S") + (
        f".{t_ns % NS_PER_S // 1000:06d} UTC"
    )


def report_lines(report: ImportReport) -> list[str]:
    """Write a report as lines of text: counts, times, and the range of each channel."""
    hz = [
        f"{rate:.6g} Hz {what}"
        for rate, what in ((report.found_hz, "by its times"), (report.said_hz, "said"))
        if rate
    ]
    order = "" if report.out_of_order is None else f", {report.out_of_order} out of order"
    lines = [
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
