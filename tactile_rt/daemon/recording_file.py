"""One file of the recorder: a source's samples, packets, decisions and what was told meanwhile."""

import os
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tactile_rt.daemon.items import Opened
from tactile_rt.recording.description import SUMMARY
from tactile_rt.recording.layout import WIRE, encode_packet
from tactile_rt.recording.mcap_file import McapFile
from tactile_rt.recording.writer import HealthTeller, WriterStats, describe

__all__ = ["Message", "RecordingFile"]

SUFFIX = ".mcap"


@dataclass(frozen=True)
class Message:
    """What is written: on which channel, host time in ns, encoded, and how many samples it is."""

    topic: str
    t_ns: int
    data: bytes
    samples: int = 0


class RecordingFile:
    """An MCAP file named by source and UTC; an existing one is never written over.

    Args:
        folder: where to.
        opened: the source.
        session: notes for the file's metadata.
        lost: samples and packets that could not be recorded before.

    Raises:
        OSError: it cannot be written.
    """

    def __init__(
        self, folder: Path, opened: Opened, session: Mapping[str, str], lost: WriterStats
    ) -> None:
        about = describe(opened.stream, opened.url, session)
        now = datetime.fromtimestamp((time.monotonic_ns() + about.utc_offset_ns) / 1e9, UTC)
        self.path, self._raw = _create(folder, f"{opened.source}-{now:%Y%m%dT%H%M%S}Z")
        self.begun_ns = time.monotonic_ns()
        self.stats = WriterStats(
            dropped_samples=lost.dropped_samples, dropped_packets=lost.dropped_packets
        )
        self._safe = (0, 0)  # samples and packets that the system has
        self._health = HealthTeller(opened.stream)
        try:
            self._file = McapFile(self._raw, about)
            # a device that describes itself once must be understood from every file
            for packet, t_ns in opened.prelude if about.wire else ():
                self._file.add(WIRE, encode_packet(packet, about.wire), t_ns)
                self.stats.packets += 1
            self._health.tell(self._file, self.stats, always=True)
            self.flush()
        except BaseException:
            self._raw.close()
            self.path.unlink(missing_ok=True)
            raise

    def write(self, messages: Iterable[Message]) -> None:
        """Add messages, in their order."""
        for message in messages:
            self._file.add(message.topic, message.data, message.t_ns)
            self.stats.samples += message.samples
            self.stats.packets += message.topic == WIRE

    def flush(self) -> int:
        """Let the system have all of it; the file's size."""
        self._health.tell(self._file, self.stats)
        self.stats.bytes = self._file.flush()
        self._safe = (self.stats.samples, self.stats.packets)
        return self.stats.bytes

    def unsafe(self) -> tuple[int, int]:
        """Samples and packets that were added and may not be in the file, because writing failed;
        they no longer count as written."""
        stats = self.stats
        samples, packets = stats.samples - self._safe[0], stats.packets - self._safe[1]
        stats.samples, stats.packets = self._safe
        return samples, packets

    def finish(self) -> None:
        """Write the index and close. Also when that fails the file is closed: it can be recovered.

        Raises:
            OSError: no room for the index.
        """
        try:
            self._health.tell(self._file, self.stats, always=True, closed=True)
            told: dict[str, Any] = {k: str(v) for k, v in vars(self.stats).items() if k != "bytes"}
            self._file.note(SUMMARY, told)
            self.stats.bytes = self._file.finish()
            os.fsync(self._raw.fileno())
        finally:
            self._raw.close()


def _create(folder: Path, stem: str) -> tuple[Path, Any]:
    for number in range(1000):  # two files within a second
        path = folder / f"{stem}{f'-{number}' if number else ''}{SUFFIX}"
        try:
            return path, path.open("xb")
        except FileExistsError:
            continue
    raise OSError(f"{folder}: a thousand files of this second")
