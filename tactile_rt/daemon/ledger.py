"""Counts of a source's samples that are recorded, at risk in a power cut, or lost, over all files
and all times that the source was open."""

import time

from tactile_rt.daemon.states import OnDisk
from tactile_rt.recording.writer import RecordingWriter

Sums = tuple[int, int, int]  # samples, written_ns, synced_ns


class Ledger:
    """Counts of a source's recorded and lost samples; only the recorder's thread updates them."""

    def __init__(self) -> None:
        self._now: tuple[Sums, tuple[RecordingWriter, ...]] = (0, 0, 0), ()  # finished; open files
        self._lost = (0, 0, "")

    def begin(self, file: RecordingWriter) -> None:
        """Add a file that was just opened to the counts."""
        past, files = self._now
        self._now = past, (*files, file)

    def lose(self, samples: int, why: str) -> None:
        """Add a number of samples to the lost ones, and store the reason."""
        if samples:
            self._lost = self._lost[0] + samples, time.monotonic_ns(), why

    def settle(self) -> list[tuple[RecordingWriter, int, int]]:
        """Add finished files to the totals; return the files whose last sync failed. Each comes
        with the samples and packets that it lost, which the caller counts."""
        past, files = self._now
        done = tuple(file for file in files if file.done)
        failed = [(f, *f.disown(f.synced)) for f in done if f.failed is not None]
        if done:
            self._now = _add_files(past, done), tuple(file for file in files if file not in done)
        return failed

    def on_disk(self, open: bool, meant_ns: int, slow_s: float) -> OnDisk:
        """Return the counts and times of all files; safe from any thread."""
        past, files = self._now
        samples, written_ns, synced_ns = _add_files(past, files)
        waits_ns = min((ns for file in files if (ns := file.unsynced_ns)), default=0)
        return OnDisk(written_ns, synced_ns, samples, *self._lost, open, meant_ns, waits_ns, slow_s)


def _add_files(past: Sums, files: tuple[RecordingWriter, ...]) -> Sums:
    """Return earlier totals with the sample counts and newest times of files added."""
    samples, written_ns, synced_ns = past
    return (
        samples + sum(file.stats.samples for file in files),
        max([written_ns, *(file.flushed.newest_ns for file in files)]),
        max([synced_ns, *(file.synced.newest_ns for file in files)]),
    )
