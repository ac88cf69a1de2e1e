"""Tell what will be wrong soon if it goes on so: the disk is full, the memory is used up.

A trend is no fault: it does not make the daemon degraded. It is told only when it has been seen for
some time, and in steps of hours that stay the same for long.
"""

import os
import time
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from tactile_rt.daemon.health import ConsumerState, Diagnostic

__all__ = ["Trends", "read_resident_bytes"]

HOURS = (0.25, 0.5, 1, 2, 3, 6, 12, 24)  # within which something is told to happen
MB = 1e6
DISK_S, DISK_POINTS, DISK_LEAST_S = 5.0, 120, 60.0  # between looks; of the newest ten minutes
MEMORY_S, MEMORY_POINTS, MEMORY_LEAST_S = 60.0, 60, 1800.0
GROWN_MB = 10.0  # from the first to the middle and to the last fifth: what only varies does not


def read_resident_bytes() -> int | None:
    """Read how much memory the process has, bytes; None where that cannot be known."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return None


def _read_available_bytes() -> float:
    """Read how much memory the machine has left, bytes; infinite: that cannot be known."""
    try:
        text = Path("/proc/meminfo").read_text().partition("MemAvailable:")[2]
        return 1024.0 * int(text.split()[0])
    except (OSError, ValueError, IndexError):
        return float("inf")


class _Series:
    """The newest values of a figure, one at most in so many seconds."""

    def __init__(self, every_s: float, points: int, least_s: float) -> None:
        self._every_s, self._least_s = every_s, least_s
        self._points: deque[tuple[float, float]] = deque(maxlen=points)

    def add(self, value: float) -> None:
        now = time.monotonic()
        if not self._points or now - self._points[-1][0] >= self._every_s:
            self._points.append((now, value))

    def rate(self) -> float:
        """Return how fast it has grown from the oldest to the newest value, 1/s; 0: not known."""
        if len(self._points) < 2:
            return 0.0
        (first, before), (last, now) = self._points[0], self._points[-1]
        return (now - before) / (last - first) if last - first >= self._least_s else 0.0

    def fifths(self) -> list[list[float]]:
        """Return the values of every other fifth of the time; none before there are enough."""
        if len(self._points) < 2 or self._points[-1][0] - self._points[0][0] < self._least_s:
            return []
        values, n = [value for _, value in self._points], len(self._points) // 5
        return [values[:n], values[2 * n : 3 * n], values[-n:]]


class Trends:
    """Looks at figures of the daemon now and then, in one thread, and says where they lead."""

    def __init__(self) -> None:
        self._written = _Series(DISK_S, DISK_POINTS, DISK_LEAST_S)
        self._memory = _Series(MEMORY_S, MEMORY_POINTS, MEMORY_LEAST_S)

    def look(self, consumers: Sequence[ConsumerState]) -> tuple[Diagnostic, ...]:
        """Return what will be wrong within a day if it goes on as in the newest time."""
        found = []
        for one in (c for c in consumers if c.kind == "recorder" and "room_mb" in c.details):
            self._written.add(float(one.details["megabytes"]))
            rate, room_mb = self._written.rate(), float(one.details["room_mb"])
            within = _within(room_mb, rate)
            if within and one.part.state == "running" and not one.diagnostic:
                why = f"it is full {within} at the rate of now, unless files are deleted"
                found.append(Diagnostic(one.part.name, "disk full soon", why))
        self._memory.add((read_resident_bytes() or 0) / MB)
        fifths = self._memory.fifths()
        if fifths and all(min(b) - max(a) >= GROWN_MB for a, b in pairwise(fifths)):
            within = _within(_read_available_bytes() / MB, self._memory.rate())
            if within:
                found.append(Diagnostic("daemon", "memory grows", f"none is left {within}"))
        return tuple(found)


def _within(left: float, rate: float) -> str:
    """Return in words within how many hours nothing is left; empty: not within a day."""
    hours = left / rate / 3600 if rate > 0 else float("inf")
    step = next((step for step in HOURS if hours <= step), None)
    if step is None:
        return ""
    return f"within {step:g} h" if step >= 1 else f"within {60 * step:g} min"
