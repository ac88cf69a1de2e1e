"""A queue between two parts: whoever puts never waits, the oldest goes, all is counted.

    put  -->  | oldest ... newest |  -->  get, take
                  |
                  v dropped: when there are too many items, or too many bytes

The goal is a stream that stays recent behind a slow reader, and an account of it that adds up. Each
item is of a kind and counts for so many, e.g. 9 samples; at every moment, for each kind,

    put = taken + dropped + waiting

One lock guards all of it. Nothing that takes long is done under it, so that whoever puts is held up
by no reader. A reader takes one item (`get`) or all that wait (`take`). To be woken for every item
costs more than the item where many come; so `take` may gather for a while, unless something urgent
comes. Whoever must lose nothing waits for room before it puts.

Many threads may put; one reads. In an event loop the loop's own thread may do both, and wakes its
reader by itself.
"""

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

LOOK_S = 0.2  # how long to wait for the counts

T = TypeVar("T")


@dataclass(frozen=True)
class QueueState:
    """What became of all that was put into a queue, by kind: put = taken + dropped + waiting.

    Attributes:
        oldest_s: The time that the oldest of all that waits has waited, s; 0 if nothing waits.
    """

    waiting: dict[str, int] = field(default_factory=dict)
    put: dict[str, int] = field(default_factory=dict)
    taken: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    waiting_bytes: int = 0
    oldest_s: float = 0.0


def _one(item: Any) -> tuple[str, int, int]:
    return "items", 1, 0


class BoundedQueue(Generic[T]):
    """Items that wait for one reader.

    Args:
        size: how many bytes may wait; a single item may be larger.
        measure: gives kind, count and bytes of an item, or None: it is left out, uncounted. By
            default all are ``items`` of no size.
        kinds: all that `measure` gives.
        urgent: kinds that `take` does not gather for.
        gather_s: how long `take` lets items that are not urgent come together, s.

    Attributes:
        taking: Whether there is a reader to wait for; `wait_for_room` returns at once if not.
    """

    def __init__(
        self,
        items: int = sys.maxsize,
        size: int = sys.maxsize,
        *,
        measure: Callable[[T], tuple[str, int, int] | None] = _one,
        kinds: Sequence[str] = ("items",),
        urgent: Collection[str] = (),
        gather_s: float = 0.0,
    ) -> None:
        self._items, self._half, self._size = items, items // 2, size
        self._measured = measure
        self._urgent, self._gather_s = frozenset(urgent), gather_s
        # item, kind, count, bytes, since when
        self._queue: deque[tuple[T, str, int, int, float]] = deque()
        self._bytes = self._urgent_ones = 0
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._waiting = 0  # threads
        self._closed = False
        self.taking = True
        self._put, self._taken, self._dropped = (dict.fromkeys(kinds, 0) for _ in range(3))
        self._seen = self._counts()

    def put(self, item: T) -> None:
        """Add an item; the oldest are dropped for it if need be."""
        found = self._measured(item)
        if found is None:
            return
        kind, n, size = found
        queue = self._queue
        with self._lock:
            self._put[kind] += n
            if self._closed:
                self._dropped[kind] += n
                return
            queue.append((item, kind, n, size, time.monotonic()))
            self._bytes += size
            urgent = kind in self._urgent
            if urgent:
                self._urgent_ones += 1
            while len(queue) > self._items or (self._bytes > self._size and len(queue) > 1):
                self._drop()
            # To tell nobody costs as much as all else here.
            if self._waiting and (urgent or len(queue) == 1 or len(queue) >= self._half):
                self._changed.notify_all()

    def get(self, timeout: float | None = None) -> T | None:
        """The oldest item, as soon as there is one; None when the time is over, or closed."""
        with self._lock:
            if not self._queue:
                self._wait(lambda: self._queue or self._closed, timeout)
                if not self._queue:
                    return None
            item, kind, n, size, _ = self._queue.popleft()
            self._taken[kind] += n
            self._bytes -= size
            if kind in self._urgent:
                self._urgent_ones -= 1
            if self._waiting:
                self._changed.notify_all()
            return item

    def take(self, timeout: float | None = None) -> list[T]:
        """All that wait, as soon as there are any; empty when the time is over, or closed."""
        with self._lock:
            if not self._queue:
                self._wait(lambda: self._queue or self._closed, timeout)
            if self._gather_s and self._queue:
                self._wait(
                    lambda: self._urgent_ones or self._closed or len(self._queue) >= self._half,
                    self._gather_s,
                )
            items = []
            for item, kind, n, *_ in self._queue:
                self._taken[kind] += n
                items.append(item)
            self._queue.clear()
            self._bytes = self._urgent_ones = 0
            if self._waiting:
                self._changed.notify_all()
            return items

    def wait_for_room(self, timeout: float | None = None) -> None:
        """Wait until at most half of it is full, nobody takes from it, or the time is over."""
        if not self._has_room():  # a look without the lock: who puts much is not held up by it
            with self._lock:
                self._wait(self._has_room, timeout)

    def close(self, drop: bool = False) -> None:
        """Let nothing more in; `get` and `take` wait no more.

        Args:
            drop: whether what waits is dropped, too; else it can still be taken.
        """
        with self._lock:
            self._closed = True
            while drop and self._queue:
                self._drop()
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """Whether it takes no more."""
        return self._closed

    @property
    def dropped(self) -> dict[str, int]:
        """How many of each kind were dropped so far."""
        with self._lock:
            return dict(self._dropped)

    @property
    def state(self) -> QueueState:
        """Counts now; those of the last look if a thread hangs in here, so that it can be told."""
        if self._lock.acquire(timeout=LOOK_S):
            try:
                self._seen = self._counts()
            finally:
                self._lock.release()
        return self._seen

    def _counts(self) -> QueueState:
        waiting = dict.fromkeys(self._put, 0)
        for _, kind, n, *_ in self._queue:
            waiting[kind] += n
        oldest = time.monotonic() - self._queue[0][-1] if self._queue else 0.0
        return QueueState(
            waiting, dict(self._put), dict(self._taken), dict(self._dropped), self._bytes, oldest
        )

    def _wait(self, until: Callable[[], object], timeout: float | None) -> None:
        """Wait, and be known to: nobody else is told of a change."""
        self._waiting += 1
        try:
            self._changed.wait_for(until, timeout)
        finally:
            self._waiting -= 1

    def _drop(self) -> None:
        """Let the oldest go."""
        _, kind, n, size, _ = self._queue.popleft()
        self._dropped[kind] += n
        self._bytes -= size
        if kind in self._urgent:
            self._urgent_ones -= 1

    def _has_room(self) -> bool:
        return (
            self._closed
            or not self.taking
            or (len(self._queue) <= self._half and self._bytes <= self._size // 2)
        )
