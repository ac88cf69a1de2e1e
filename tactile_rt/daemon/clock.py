"""The host's two clocks, replaceable in tests, and a record of when critical threads last ran."""

import time
from collections.abc import Mapping
from pathlib import Path

from tactile_rt.daemon.diagnostics import LossWindow

STEP_NS = 100_000_000  # more than slewing or a busy host causes between two looks
STARVED_S = 1.0  # if the watch's loop makes no pass for so long, the whole process is starved
WAITED_S = 0.25  # wait for a processor within a second: other programs or a quota take it
LATELY_NS = 1_000_000_000  # how long starvation is reported after its end


class Clock:
    """The host's CLOCK_MONOTONIC and UTC."""

    def __init__(self) -> None:
        self._offset_ns = self.utc_offset_ns()

    def utc_ns(self) -> int:
        """Return UTC, ns since 1970."""
        return time.time_ns()

    def monotonic_ns(self) -> int:
        """Return CLOCK_MONOTONIC, ns."""
        return time.monotonic_ns()

    def utc_offset_ns(self) -> int:
        """Return UTC minus monotonic time at this moment, ns."""
        before = self.monotonic_ns()
        utc = self.utc_ns()
        return utc - (before + self.monotonic_ns()) // 2

    def stepped_ns(self) -> int:
        """Return the jump of the wall clock since the last call, ns, or 0."""
        now = self.utc_offset_ns()
        change, self._offset_ns = now - self._offset_ns, now
        return change if abs(change) > STEP_NS else 0


class Turns:
    """A record of the latest loop pass of each critical thread other than parts.

    The watch is such a thread. Its passes are few and short, so if it has to wait for a processor,
    the whole process has to.
    """

    def __init__(self) -> None:
        self._turns: dict[str, int] = {}
        self._ended_ns, self._lasted_s = 0, 0.0  # of the watch's last starvation
        self._waits = LossWindow()  # the watch's waiting time for a processor, ns

    def take(self, name: str) -> None:
        """Record that the named thread makes a pass of its loop now."""
        self._turns[name] = time.monotonic_ns()

    def silent(self) -> Mapping[str, float]:
        """Return the time since each thread's latest loop pass, s, by thread name."""
        now = time.monotonic_ns()
        return {name: (now - turned) / 1e9 for name, turned in self._turns.copy().items()}

    def watch(self, thread_id: int | None) -> float:
        """Return how long the watch thread just got no processor time, s, or 0."""
        now = time.monotonic_ns()
        lasted_s = (now - self._turns.get("watch", now)) / 1e9
        self._read_waited_s(thread_id)  # count the waiting time from now on
        if lasted_s <= STARVED_S:
            return 0.0
        self._ended_ns, self._lasted_s = now, lasted_s
        return lasted_s

    def starved_s(self, thread_id: int | None) -> float:
        """Return how long the whole process recently got no processor time, s, or 0."""
        now = time.monotonic_ns()
        since = self._turns.get("watch")
        waiting = (now - since) / 1e9 if since else 0.0
        if waiting > STARVED_S:
            return waiting
        if (waited_s := self._read_waited_s(thread_id)) > WAITED_S:
            return waited_s
        return self._lasted_s if self._ended_ns and now - self._ended_ns < LATELY_NS else 0.0

    def _read_waited_s(self, thread_id: int | None) -> float:
        """Return how long the watch waited for a processor within the newest second, s."""
        try:
            text = Path(f"/proc/self/task/{thread_id}/schedstat").read_text()
            return self._waits.add(int(text.split()[1])).second / 1e9
        except (OSError, IndexError, ValueError):
            return 0.0
