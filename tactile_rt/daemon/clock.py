"""The two clocks of a host, so that a test can step them; whether its threads get their turns."""

import time
from collections.abc import Mapping
from pathlib import Path

from tactile_rt.daemon.diagnostics import LossWindow

STEP_NS = 100_000_000  # what neither slewing nor a busy host makes between two looks
STARVED_S = 1.0  # a watch that has no turn for so long: neither has anybody else
WAITED_S = 0.25  # for a processor, of the newest second: others take it, or a quota
LATELY_NS = 1_000_000_000  # how long it is told that it was so


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


class Turns:
    """When each thread that must go on, and is no part, last had its turn.

    The watch is one of them: it wants few and short turns, so that what keeps it waiting keeps the
    whole process waiting.
    """

    def __init__(self) -> None:
        self._turns: dict[str, int] = {}
        self._ended_ns, self._lasted_s = 0, 0.0  # of when the watch last had none
        self._waits = LossWindow()  # of the watch, for a processor, ns

    def take(self, name: str) -> None:
        """A thread tells that it goes on."""
        self._turns[name] = time.monotonic_ns()

    def silent(self) -> Mapping[str, float]:
        """Return how long the current turn of each of them has taken, s."""
        now = time.monotonic_ns()
        return {name: (now - turned) / 1e9 for name, turned in self._turns.copy().items()}

    def watch(self, thread_id: int | None) -> float:
        """Note a turn of the watch; return how long it had none, s, or 0."""
        now = time.monotonic_ns()
        lasted_s = (now - self._turns.get("watch", now)) / 1e9
        self._waited_s(thread_id)  # so that what it waits from now on is known
        if lasted_s <= STARVED_S:
            return 0.0
        self._ended_ns, self._lasted_s = now, lasted_s
        return lasted_s

    def starved_s(self, thread_id: int | None) -> float:
        """Return how long the whole process had no turn, lately, s."""
        now = time.monotonic_ns()
        since = self._turns.get("watch")
        waiting = (now - since) / 1e9 if since else 0.0
        if waiting > STARVED_S:
            return waiting
        if (waited_s := self._waited_s(thread_id)) > WAITED_S:
            return waited_s
        return self._lasted_s if self._ended_ns and now - self._ended_ns < LATELY_NS else 0.0

    def _waited_s(self, thread_id: int | None) -> float:
        """Return how long the watch waited for a processor, s, within the newest second."""
        try:
            told = Path(f"/proc/self/task/{thread_id}/schedstat").read_text()
            return self._waits.add(int(told.split()[1])).second / 1e9
        except (OSError, IndexError, ValueError):
            return 0.0
