"""Bounded queue between two parts: `put` never waits, the oldest items are dropped and counted.

    put  -->  | oldest ... newest |  -->  get, take
                  |
                  v dropped: when there are too many items, or too many bytes

The goal is a stream that stays recent behind a slow reader, and counts that add up. Each item has a
kind and a count, e.g. 9 samples; at every moment, for each kind,

    put = taken + dropped + waiting

One lock guards all. Nothing slow is done under it, so that no reader delays a writer. A reader
removes one item (`get`) or all waiting ones (`take`). If many items come, waking up for each costs
more than the item itself; so `take` may gather items for a while, unless an urgent one comes. A
writer that must not lose anything waits for room before it puts.

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

LOOK_S = 0.2  # longest wait for the lock to read the counts

T = TypeVar("T")


@dataclass(frozen=True)
class QueueState:
    """Counts of a queue's items by kind. For each kind, put = taken + dropped + waiting.

    Attributes:
        oldest_s: The time that the oldest waiting item has waited, s; 0 if none waits.
    """

    waiting: dict[str, int] = field(default_factory=dict)
    put: dict[str, int] = field(default_factory=dict)
    taken: dict[str, int] = field(default_factory=dict)
    dropped: dict[str, int] = field(default_factory=dict)
    waiting_bytes: int = 0
    oldest_s: float = 0.0


def _count_one(item: Any) -> tuple[str, int, int]:
    return "items", 1, 0


class BoundedQueue(Generic[T]):
    """Thread-safe queue of limited length for one reader; a full queue drops its oldest items.

    Args:
        items, size: limits on waiting items and bytes; a single item above `size` is accepted.
        measure: returns kind, count and bytes of an item, or None to ignore it. By default an item
            has the kind ``items``, the count 1 and no bytes.
        kinds: all kinds that `measure` returns.
        urgent: kinds for which `take` returns at once.
        gather_s: time for which `take` gathers items that are not urgent, s.

    Attributes:
        taking: True while a reader takes items; if False, `wait_for_room` returns at once.
    """

    def __init__(
        self,
        items: int = sys.maxsize,
        size: int = sys.maxsize,
        *,
        measure: Callable[[T], tuple[str, int, int] | None] = _count_one,
        kinds: Sequence[str] = ("items",),
        urgent: Collection[str] = (),
        gather_s: float = 0.0,
    ) -> None:
        self._items, self._half, self._size = items, items // 2, size
        self._measure = measure
        self._urgent, self._gather_s = frozenset(urgent), gather_s
        # item, kind, count, bytes, time of `put`
        self._queue: deque[tuple[T, str, int, int, float]] = deque()
        self._bytes = self._urgent_ones = 0
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._waiting = 0  # number of waiting threads
        self._closed = False
        self.taking = True
        self._put, self._taken, self._dropped = (dict.fromkeys(kinds, 0) for _ in range(3))
        self._seen = self._count_items()

    def put(self, item: T) -> None:
        """Append an item; drop the oldest items if the queue is over its limits."""
        found = self._measure(item)
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
            # Notifying without a waiting thread would cost as much as all else here.
            if self._waiting and (urgent or len(queue) == 1 or len(queue) >= self._half):
                self._changed.notify_all()

    def get(self, timeout: float | None = None) -> T | None:
        """Remove and return the oldest item; wait if empty. Return None on timeout or closure."""
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
        """Remove and return all items; wait if empty. Return [] on timeout or closure."""
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
        """Wait until the queue is at most half full, or closed, or has no reader."""
        if not self._has_room():  # checked without the lock, so as not to delay busy writers
            with self._lock:
                self._wait(self._has_room, timeout)

    def close(self, drop: bool = False) -> None:
        """Close the queue: drop all later items, and wake up the reader and the writers.

        Args:
            drop: whether to drop the waiting items, too; otherwise they can still be read.
        """
        with self._lock:
            self._closed = True
            while drop and self._queue:
                self._drop()
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """True if the queue accepts no more items."""
        return self._closed

    @property
    def dropped(self) -> dict[str, int]:
        """Counts of the dropped items so far, by kind."""
        with self._lock:
            return dict(self._dropped)

    @property
    def state(self) -> QueueState:
        """Current counts; the previous ones if another thread holds the lock for `LOOK_S`."""
        if self._lock.acquire(timeout=LOOK_S):
            try:
                self._seen = self._count_items()
            finally:
                self._lock.release()
        return self._seen

    def _count_items(self) -> QueueState:
        waiting = dict.fromkeys(self._put, 0)
        for _, kind, n, *_ in self._queue:
            waiting[kind] += n
        oldest = time.monotonic() - self._queue[0][-1] if self._queue else 0.0
        return QueueState(
            waiting, dict(self._put), dict(self._taken), dict(self._dropped), self._bytes, oldest
        )

    def _wait(self, until: Callable[[], object], timeout: float | None) -> None:
        """Wait until a condition holds; count this thread as waiting, so that `put` notifies it."""
        self._waiting += 1
        try:
            self._changed.wait_for(until, timeout)
        finally:
            self._waiting -= 1

    def _drop(self) -> None:
        """Drop the oldest item."""
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
