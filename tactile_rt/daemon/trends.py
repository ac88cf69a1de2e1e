"""Trends of memory and delays, from which diagnostics predict what will soon stop working."""

import os
from collections import deque
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from statistics import median

from tactile_rt.daemon.states import Diagnostic

EVERY_S, KEPT, FEWEST = 20.0, 90, 10  # per value; for half an hour; in a third of it
SOON_H = 24.0
LATER, LATE_MS = 3.0, 5.0  # times the earlier delay, and least delay
MB = 1e6


class Trend:
    """Half an hour's history of a quantity: its largest value of every 20 s."""

    def __init__(self) -> None:
        self._kept: deque[tuple[float, float]] = deque(maxlen=KEPT + 1)

    def add(self, at_s: float, value: float) -> None:
        """Add a value measured at a time, s; keep the largest of every 20 s."""
        if not self._kept or at_s - self._kept[-1][0] >= EVERY_S:
            self._kept.append((at_s, value))
        else:
            began_s, largest = self._kept[-1]
            self._kept[-1] = (began_s, max(largest, value))

    def growth(self) -> tuple[float, float, float] | None:
        """Return the medians of the first and the last third, and the time between, s.

        Return None unless all values of each third exceed all of the third before.
        """
        kept = list(self._kept)[:-1]  # the last one is not complete
        n = len(kept) // 3
        if n < FEWEST:
            return None
        thirds = [[value for _, value in kept[k * n : (k + 1) * n]] for k in range(3)]
        if any(max(a) >= min(b) for a, b in pairwise(thirds)):
            return None
        return median(thirds[0]), median(thirds[2]), kept[2 * n][0] - kept[0][0]


def read_resident_bytes() -> int | None:
    """Return the resident memory of this process, bytes, or None if unknown."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return None  # not Linux


def read_free_bytes() -> float:
    """Return the available memory of the host, bytes, or infinity if unknown."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return float("inf")
    free = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return 1024.0 * float(free[0]) if free else float("inf")


class Trends:
    """The trends of a daemon: its memory, and the delay of each source's samples."""

    def __init__(self, free_bytes: Callable[[], float] = read_free_bytes) -> None:
        self._free_bytes = free_bytes
        self._memory, self._late = Trend(), dict[str, Trend]()

    def look(self, at_s: float, resident_bytes: int, late_s: Mapping[str, float]) -> None:
        """Add measurements at a time, s; forget sources that are not in `late_s`."""
        self._memory.add(at_s, resident_bytes / MB)
        self._late = {name: self._late.get(name, Trend()) for name in late_s}
        for name, seconds in late_s.items():
            self._late[name].add(at_s, 1e3 * seconds)

    def foresee(self) -> list[Diagnostic]:
        """Return diagnostics of what will soon stop working if the trends continue."""
        found = []
        if growth := self._memory.growth():
            free_mb = self._free_bytes() / MB
            an_hour = 3600 * (growth[1] - growth[0]) / growth[2]
            if free_mb < SOON_H * an_hour:
                why = f"it grows by {an_hour:.0f} MB an hour, and {free_mb:.0f} MB are free"
                found.append(Diagnostic("daemon", "memory full soon", why))
        for name, trend in self._late.copy().items():
            growth = trend.growth()
            if growth and growth[1] > max(LATER * growth[0], LATE_MS):
                why = f"its samples come {growth[1]:.0f} ms late, and came {growth[0]:.0f} ms late"
                found.append(Diagnostic(name, "jitter grows", why))
        return found
