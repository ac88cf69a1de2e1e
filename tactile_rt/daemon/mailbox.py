"""A bounded queue between two parts: whoever puts never waits, the oldest goes, all is counted."""

import threading
from collections import deque
from collections.abc import Iterable

from tactile_rt.daemon.health import QueueState
from tactile_rt.daemon.items import Decision, Item, Packet, SourceChunk

__all__ = ["Mailbox"]

CLASSES = ("samples", "packets", "decisions", "events")
AROUND_BYTES = 500  # what Python needs around an item
FRAME_BYTES = 200  # and around a CAN frame
LOOK_S = 0.2  # how long to wait for the counts


class Mailbox:
    """Items for one part.

    Args:
        wants: classes of items that it takes; the others are left out uncounted.
        items, size: how many items, and of how many bytes, may wait.
        gather_s: how long samples and packets may wait for more of them; all else is urgent.
        source: only items of this source; empty: of all.
    """

    def __init__(
        self,
        wants: Iterable[type],
        items: int,
        size: int,
        gather_s: float = 0.0,
        source: str = "",
    ) -> None:
        self.wants, self.gather_s, self._source = frozenset(wants), gather_s, source
        self._items, self._size = items, size
        self._queue: deque[tuple[Item, str, int, int]] = deque()  # item, class, count, bytes
        self._bytes = self._urgent = 0
        self._changed = threading.Condition()
        self._closed = False
        self._seen = QueueState()
        self.taking = False  # whether anyone is there to wait for
        self._put = dict.fromkeys(CLASSES, 0)
        self._taken = dict.fromkeys(CLASSES, 0)
        self._dropped = dict.fromkeys(CLASSES, 0)

    def put(self, item: Item) -> None:
        """Add an item; the oldest are dropped for it if need be."""
        if type(item) not in self.wants:
            return
        if self._source and getattr(item, "source", self._source) != self._source:
            return
        kind, n, size = _measure(item)
        with self._changed:
            self._put[kind] += n
            if self._closed:
                self._dropped[kind] += n
                return
            empty = not self._queue
            self._queue.append((item, kind, n, size))
            self._bytes += size
            urgent = kind in ("decisions", "events")
            self._urgent += urgent
            while len(self._queue) > self._items or (
                self._bytes > self._size and len(self._queue) > 1
            ):
                _, old, lost, freed = self._queue.popleft()
                self._dropped[old] += lost
                self._bytes -= freed
                self._urgent -= old in ("decisions", "events")
            if empty or urgent or len(self._queue) >= self._items // 2:
                self._changed.notify_all()

    def wait_for_room(self, timeout: float) -> None:
        """Wait until at most half of it is full, nobody takes from it, or the time is over."""
        with self._changed:
            self._changed.wait_for(
                lambda: (
                    self._closed
                    or not self.taking
                    or (len(self._queue) <= self._items // 2 and self._bytes <= self._size // 2)
                ),
                timeout,
            )

    def take(self, timeout: float | None = None) -> list[Item]:
        """All that waits, as soon as there is anything; empty when the time is over, or closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._closed, timeout)
            if self.gather_s and self._queue:
                self._changed.wait_for(
                    lambda: self._urgent or self._closed or len(self._queue) >= self._items // 2,
                    self.gather_s,
                )
            for _, kind, n, _ in self._queue:
                self._taken[kind] += n
            items = [entry[0] for entry in self._queue]
            self._queue.clear()
            self._bytes = self._urgent = 0
            self._changed.notify_all()
            return items

    def close(self) -> None:
        """Take no more; what waits can still be taken, and `take` waits no more."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        """Whether it takes no more."""
        return self._closed

    @property
    def state(self) -> QueueState:
        """Counts now; those of the last look if it hangs, so that this can still be told."""
        if not self._changed.acquire(timeout=LOOK_S):
            return self._seen
        try:
            waiting = dict.fromkeys(CLASSES, 0)
            for _, kind, n, _ in self._queue:
                waiting[kind] += n
            self._seen = QueueState(
                waiting, dict(self._put), dict(self._taken), dict(self._dropped), self._bytes
            )
            return self._seen
        finally:
            self._changed.release()


def _measure(item: Item) -> tuple[str, int, int]:
    """Class, count and bytes of an item."""
    if isinstance(item, SourceChunk):
        chunk = item.chunk
        size = chunk.values.nbytes + chunk.valid.nbytes + 16 * len(chunk)
        return "samples", len(chunk), size + AROUND_BYTES
    if isinstance(item, Packet):
        packet = item.packet
        each = 1 if isinstance(packet, bytes | bytearray) else FRAME_BYTES
        return "packets", 1, AROUND_BYTES + each * len(packet or ())
    return ("decisions" if isinstance(item, Decision) else "events"), 1, AROUND_BYTES
