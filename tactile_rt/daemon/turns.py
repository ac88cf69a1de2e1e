"""Whether the threads of the process get their turns: it may be stopped, or starved."""

import time
from collections.abc import Mapping
from pathlib import Path

from tactile_rt.daemon.troubles import LossWindow

__all__ = ["Turns"]

STARVED_S = 1.0  # a watch that has no turn for so long: neither has anybody else
WAITED_S = 0.25  # for a processor, of the newest second: others take it, or a quota
LATELY_NS = 1_000_000_000  # how long it is told that it was so


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
        """How long the current turn of each of them has taken, s."""
        now = time.monotonic_ns()
        return {name: (now - turned) / 1e9 for name, turned in self._turns.copy().items()}

    def watch(self, thread_id: int | None) -> float:
        """The watch has its turn; how long it had none before, s, if that is too long, else 0."""
        now = time.monotonic_ns()
        lasted_s = (now - self._turns.get("watch", now)) / 1e9
        self._waited_s(thread_id)  # so that what it waits from now on is known
        if lasted_s <= STARVED_S:
            return 0.0
        self._ended_ns, self._lasted_s = now, lasted_s
        return lasted_s

    def starved_s(self, thread_id: int | None) -> float:
        """How long the whole process had no turn, lately, s.

        Args:
            thread_id: that the system has for the thread of the watch.
        """
        now = time.monotonic_ns()
        since = self._turns.get("watch")
        waiting = (now - since) / 1e9 if since else 0.0
        if waiting > STARVED_S:
            return waiting
        if (waited_s := self._waited_s(thread_id)) > WAITED_S:
            return waited_s
        return self._lasted_s if self._ended_ns and now - self._ended_ns < LATELY_NS else 0.0

    def _waited_s(self, thread_id: int | None) -> float:
        """How long the watch has waited for a processor within the newest second, s; 0 where the
        system does not tell."""
        try:
            told = Path(f"/proc/self/task/{thread_id}/schedstat").read_text()
            return self._waits.add(int(told.split()[1])).second / 1e9
        except (OSError, IndexError, ValueError):
            return 0.0
