"""When one file of a recording is followed by the next, and what they are called.

    FOLDER/whiskers-20261121T170512Z.mcap, whiskers-20261121T171512Z.mcap, ...

Each file is whole in itself: it says what it is of, and begins with what a device needs to be
understood. Writing is the matter of `tactile_rt.recording.writer`; whoever writes asks after each
flush whether the next file is due.
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
    """The files of one recording, named by the UTC at which each was begun."""

    folder: Path
    stem: str
    mb: float = 0.0  # size beyond which the next file begins, MB; 0: whatever the size
    seconds: float = 0.0  # time after which the next file begins, s; 0: never

    def begin(self, source: Source, about: Description, **further: Any) -> RecordingWriter:
        """Begin the next file; one that is there is never written over.

        Args:
            source, about, further: as for `RecordingWriter`.

        Raises:
            OSError: it cannot be written.
        """
        utc = datetime.fromtimestamp((time.monotonic_ns() + about.utc_offset_ns) / NS_PER_S, UTC)
        stem = f"{self.stem}-{utc:%Y%m%dT%H%M%S}Z"
        for number in range(1000):  # two files within a second
            path = self.folder / f"{stem}{f'-{number}' if number else ''}{SUFFIX}"
            if os.path.lexists(path):
                continue
            try:
                return RecordingWriter(path, source, about, **further)
            except FileExistsError:  # by now
                continue
        raise OSError(f"{self.folder}: a thousand files of this second")

    def is_due(self, writer: RecordingWriter) -> bool:
        """Whether this file, as it was when last flushed, is to be followed by the next."""
        age_ns = time.monotonic_ns() - writer.begun_ns
        return bool(
            (self.mb and writer.stats.bytes > self.mb * MB)
            or (self.seconds and age_ns > self.seconds * NS_PER_S)
        )
