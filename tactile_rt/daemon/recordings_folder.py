"""The folder that recordings are written to: whether it is there, with room."""

import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from tactile_rt.core.files import sync_folder
from tactile_rt.recording.reader import is_finished
from tactile_rt.recording.writer import PART

__all__ = ["RecordingsFolder", "words"]

STALE_S = 3600.0  # a file that is begun has its name long before
MB = 1e6


class RecordingsFolder:
    """Made where it is not there, and again when it is deleted.

    Args:
        min_free_mb: The room that its disk must have, MB.
        later: does something without being waited for.
        tell: is told of every change: state, words and level.

    Attributes:
        state: What can be said of it: ``on``, ``no folder`` or ``disk full``.
        why: Why nothing can be recorded, with the figures of now; empty if it can.
        room_mb: The room for recordings at the newest look, MB.
    """

    def __init__(
        self,
        path: Path,
        min_free_mb: float,
        later: Callable[[Callable[[], object]], None],
        tell: Callable[[str, str, str], None],
    ) -> None:
        self.path, self._min_free_mb = path, min_free_mb
        self._later, self._tell = later, tell
        self.state, self.why, self.room_mb = "on", "", 0.0

    @property
    def full(self) -> bool:
        """Whether it has no room."""
        return self.state == "disk full"

    def open(self) -> list[str]:
        """Make it; the names of files that were cut short.

        Raises:
            OSError: it cannot be made or read.
        """
        self._make(parents=True)
        with os.scandir(self.path) as found:  # a pipe or a dead mount is not even looked at
            files = sorted(f.name for f in found if f.is_file(follow_symlinks=False))
        for name in files:  # of one who was killed as it began a file
            left = self.path / name
            with suppress(OSError):
                if not (name.startswith(".") and name.endswith(PART)):
                    continue
                if time.time() - left.stat().st_mtime > STALE_S:  # else it is just being begun
                    left.unlink()
        return [f for f in files if f.endswith(".mcap") and not is_finished(self.path / f)]

    def has_room(self) -> bool:
        """Whether it is there, with room; told when that changes."""
        state, why = "on", ""
        try:
            # Deleted, perhaps; a parent that is gone, too, may be the place of a medium that is.
            self._make(parents=False)
            free = shutil.disk_usage(self.path).free / MB
        except OSError as error:
            state, why = "no folder", words(self.path, error)
        else:
            self.room_mb = max(0.0, free - self._min_free_mb)
            if free < self._min_free_mb:
                least = f"min_free_mb = {self._min_free_mb:g}"
                state = "disk full"
                why = f"{self.path}: {free:.0f} MB free, less than {least}"
        if state != self.state:
            if why:
                self._tell(state, f"{why}: not recording", "warning")
            else:
                self._tell("running", f"{free:.0f} MB free: recording again", "info")
        self.state, self.why = state, why
        return not why

    def _make(self, parents: bool) -> None:
        made = [f for f in (self.path, *self.path.parents) if not f.exists()]
        self.path.mkdir(parents=parents, exist_ok=True)
        for folder in made:
            self._later(partial(_sync_name, folder))  # a power cut does not take it then


def _sync_name(folder: Path) -> None:
    with suppress(OSError):  # what is wrong with the disk, its files will tell
        sync_folder(folder.parent)


def words(path: Path, error: OSError) -> str:
    """An error of a file, in a line."""
    return f"{path}: {error.strerror or error}"
