"""Rotation of the files of a recording: their names, and when the next one begins.

    FOLDER/whiskers-20261121T170512Z.mcap, whiskers-20261121T171512Z.mcap, ...

Each file is complete in itself: it has a description, and begins with the packets in which a device
describes itself. `tactile_rt.recording.writer` writes it; the caller checks after each flush
whether the next file is due.
"""

import os
import time
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from tactile_rt.core.stream import NS_PER_S, Source
from tactile_rt.recording.description import Description
from tactile_rt.recording.writer import RecordingWriter

MB = 1e6
SUFFIX = ".mcap"


@dataclass(frozen=True)
class Rotation:
    """Series of files of one recording, each named by the UTC time of its beginning."""

    folder: Path
    stem: str
    mb: float = 0.0  # size beyond which the next file begins, MB; 0 for no limit
    seconds: float = 0.0  # time after which the next file begins, s; 0 for no limit

    def begin(self, source: Source, about: Description, **further: Any) -> RecordingWriter:
        """Begin the next file; never overwrite an existing one.

        Args:
            source, about, further: as for `RecordingWriter`.

        Raises:
            OSError: the file cannot be written.
        """
        utc = datetime.fromtimestamp((time.monotonic_ns() + about.utc_offset_ns) / NS_PER_S, UTC)
        stem = f"{self.stem}-{utc:%Y%m%dT%H%M%S}Z"
        for number in range(1000):  # two files within a second
            path = self.folder / f"{stem}{f'-{number}' if number else ''}{SUFFIX}"
            if os.path.lexists(path):
                continue
            try:
                return RecordingWriter(path, source, about, **further)
            except FileExistsError:  # another process has made it meanwhile
                continue
        raise OSError(f"{self.folder}: a thousand files already begun in this second")

    def is_due(self, writer: RecordingWriter) -> bool:
        """Return whether the next file is due, by the present file's age and flushed size."""
        age_ns = time.monotonic_ns() - writer.begun_ns
        return bool(
            (self.mb and writer.stats.bytes > self.mb * MB)
            or (self.seconds and age_ns > self.seconds * NS_PER_S)
        )
