"""The folder of the recordings: its existence and its free space."""

import os
import shutil
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from tactile_rt.core.files import sync_folder
from tactile_rt.recording.reader import is_finished
from tactile_rt.recording.writer import PART

STALE_S = 3600.0  # a file that is being begun gets its name long before
MB = 1e6
EVERY_S, POINTS, LEAST_S = 5.0, 120, 60.0  # the rate of filling, over ten minutes at most
HOURS = (0.25, 0.5, 1, 2, 3, 6, 12, 24)


class RecordingsFolder:
    """The folder of the recordings, created if missing, and again if deleted.

    Args:
        min_free_mb: The room that its disk must have, MB.
        later: Runs a job in the background.
        tell: Called at every change with the state, the reason in words, and the level.

    Attributes:
        state: The folder's state: ``on``, ``no folder`` or ``disk full``.
        why: The reason why nothing can be recorded, with present numbers, or an empty string.
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
        self.state, self.why, self._room_mb, self._disk = "on", "", 0.0, 0
        self._written: deque[tuple[float, float]] = deque(maxlen=POINTS)  # s, MB

    @property
    def full(self) -> bool:
        """True if the disk had too little room at the last check."""
        return self.state == "disk full"

    def open(self) -> list[str]:
        """Create the folder; return the names of recordings that were cut short.

        Raises:
            OSError: The folder cannot be created or read.
        """
        self._create(parents=True)
        self._disk = self.path.stat().st_dev
        with os.scandir(self.path) as found:  # a pipe or a dead mount is not even looked at
            files = sorted(f.name for f in found if f.is_file(follow_symlinks=False))
        for name in files:  # left by a process that was killed as it began a file
            left = self.path / name
            with suppress(OSError):
                if not (name.startswith(".") and name.endswith(PART)):
                    continue
                if time.time() - left.stat().st_mtime > STALE_S:  # else it may be just being begun
                    left.unlink()
        return [f for f in files if f.endswith(".mcap") and not is_finished(self.path / f)]

    def has_room(self) -> bool:
        """Return whether the folder exists and has room; report a change."""
        state, why = "on", ""
        try:
            # It may be deleted. If its parent is gone, too, a removable medium may be missing.
            self._create(parents=False)
            disk = self.path.stat().st_dev
            if self._disk not in (0, disk) and disk == os.stat("/").st_dev:
                raise OSError(
                    "its disk is not mounted, and this is the system disk: mount it again"
                )
            free = shutil.disk_usage(self.path).free / MB
        except OSError as error:
            state, why = "no folder", words(self.path, error)
        else:
            self._room_mb = free - self._min_free_mb
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

    def foresee(self, written_mb: float) -> str:
        """Describe within how many hours the disk will be full; empty if over a day.

        Args:
            written_mb: The total that has been written so far, MB.
        """
        now = time.monotonic()
        if not self._written or now - self._written[-1][0] >= EVERY_S:
            self._written.append((now, written_mb))
        first, before = self._written[0]
        if now - first < LEAST_S or self.why:
            return ""
        an_hour = 3600 * (written_mb - before) / (now - first)
        hours = next((step for step in HOURS if self._room_mb <= step * an_hour), 0)
        within = f"it is full within {hours:g} h at the rate of now, unless files are deleted"
        return within if hours else ""

    def _create(self, parents: bool) -> None:
        made = [f for f in (self.path, *self.path.parents) if not f.exists()]
        self.path.mkdir(parents=parents, exist_ok=True)
        for folder in made:
            self._later(partial(_sync_name, folder))  # so that a power cut does not remove it


def _sync_name(folder: Path) -> None:
    with suppress(OSError):  # its files will report what is wrong with the disk
        sync_folder(folder.parent)


def words(path: Path, error: OSError) -> str:
    """Describe a file's error in one line of text."""
    return f"{path}: {error.strerror or error}"
