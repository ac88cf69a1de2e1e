"""The daemon with a wall clock that can be stepped from outside, and the hand on it."""

import mmap
import os
import struct
import time
from pathlib import Path

from tactile_rt.daemon.clock import Clock

PATH = "TACTILE_RT_STEPPED_CLOCK"  # environment variable: the file that says how far it is off
MAIN = "from bench.daemon.stepped import follow; follow()\nfrom tactile_rt.cli import main; main()"


class WallClock:
    """How far a daemon's wall clock is off, in a file of eight bytes.

    Args:
        path: of the file; made if it is not there.
    """

    def __init__(self, path: Path) -> None:
        if not path.exists():
            path.write_bytes(struct.pack("<q", 0))
        with path.open("r+b") as file:
            self._map = mmap.mmap(file.fileno(), 8)

    @property
    def off_ns(self) -> int:
        """UTC as the daemon sees it, less UTC."""
        off: int = struct.unpack("<q", self._map[:])[0]
        return off

    @off_ns.setter
    def off_ns(self, value: int) -> None:
        self._map[:] = struct.pack("<q", value)


def follow() -> None:
    """From now on this process has the wall clock of the file that `PATH` names."""
    clock = WallClock(Path(os.environ[PATH]))

    def utc_ns(self: Clock) -> int:
        return time.time_ns() + clock.off_ns

    Clock.utc_ns = utc_ns  # type: ignore[method-assign]
