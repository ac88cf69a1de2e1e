"""The two clocks of a host, in one place, so that a test can step them."""

import time

__all__ = ["Clock"]

STEP_NS = 100_000_000  # what neither slewing nor a busy host makes between two looks


class Clock:
    """CLOCK_MONOTONIC and UTC."""

    def __init__(self) -> None:
        self._offset_ns = self.utc_offset_ns()

    def utc_ns(self) -> int:
        """UTC, ns since 1970."""
        return time.time_ns()

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC, ns."""
        return time.monotonic_ns()

    def utc_offset_ns(self) -> int:
        """UTC less monotonic time, now."""
        before = self.monotonic_ns()
        utc = self.utc_ns()
        return utc - (before + self.monotonic_ns()) // 2

    def stepped_ns(self) -> int:
        """By how much the wall clock jumped since the last look; 0: it did not."""
        now = self.utc_offset_ns()
        change, self._offset_ns = now - self._offset_ns, now
        return change if abs(change) > STEP_NS else 0
