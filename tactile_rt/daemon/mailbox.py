"""Who gets what, and where it waits: every item goes into the mailboxes of those who want it."""

import threading
from collections.abc import Iterable, Mapping

from tactile_rt.core.bounded_queue import BoundedQueue
from tactile_rt.daemon.items import Closed, Decision, Item, Opened, Packet, SourceChunk

AROUND_BYTES = 500  # what Python needs around an item
FRAME_BYTES = 200  # and around a CAN frame


class Mailbox(BoundedQueue[Item]):
    """The queue of items for one part, counted as samples, packets, decisions and events.

    Args:
        wants: classes of items that it takes; the others are left out uncounted.
        gather_s: how long samples and packets may wait for more of them; all else is urgent.
        source: only items of this source, and of the array that it began with; empty: of all.
    """

    def __init__(
        self,
        wants: Iterable[type],
        items: int,
        size: int,
        gather_s: float = 0.0,
        source: str = "",
    ) -> None:
        super().__init__(
            items, size, measure=self._measure, gather_s=gather_s, urgent=("decisions", "events"),
            kinds=("samples", "packets", "decisions", "events"),
        )  # fmt: skip
        self.wants, self._source = frozenset(wants), source
        self.taking = False  # until its part is there

    def _measure(self, item: Item) -> tuple[str, int, int] | None:
        """Class, count and bytes of an item that is wanted."""
        if type(item) not in self.wants:
            return None
        if self._source and getattr(item, "source", self._source) != self._source:
            return None
        if self._source and not getattr(item, "accepted", True):
            return None
        if isinstance(item, SourceChunk):
            chunk = item.chunk
            size = chunk.values.nbytes + chunk.valid.nbytes + 16 * len(chunk)
            return "samples", len(chunk), size + AROUND_BYTES
        if isinstance(item, Packet):
            packet = item.packet
            each = 1 if isinstance(packet, bytes | bytearray) else FRAME_BYTES
            return "packets", 1, AROUND_BYTES + each * len(packet or ())
        return ("decisions" if isinstance(item, Decision) else "events"), 1, AROUND_BYTES


class Hub:
    """Fan-out; any thread may post. Posting takes no lock but those of the mailboxes."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._boxes: dict[str, Mailbox] = {}
        self._by_type: Mapping[type, tuple[Mailbox, ...]] = {}
        self._streams: dict[str, Opened] = {}

    def join(self, name: str, box: Mailbox) -> None:
        """From now on this mailbox gets what it wants; first the streams that are open."""
        with self._lock:
            for opened in self._streams.values():
                box.put(opened)
            self._arrange({**self._boxes, name: box})

    def leave(self, name: str, box: Mailbox) -> None:
        """No more for this mailbox; if the name has another one by now, that stays."""
        with self._lock:
            if self._boxes.get(name) is box:
                self._arrange({k: b for k, b in self._boxes.items() if k != name})

    def post(self, item: Item) -> None:
        """To all who want it."""
        kind = type(item)
        if kind is Opened or kind is Closed:
            with self._lock:  # else one who joins just now might hear of it twice, or never
                if isinstance(item, Opened):
                    self._streams = {**self._streams, item.source: item}
                elif isinstance(item, Closed):
                    self._streams = {k: s for k, s in self._streams.items() if k != item.source}
                for box in self._by_type.get(kind, ()):
                    box.put(item)
            return
        for box in self._by_type.get(kind, ()):
            box.put(item)

    def box(self, name: str) -> Mailbox | None:
        """The mailbox of this name."""
        return self._boxes.get(name)

    def wanted(self, kind: type) -> tuple[Mailbox, ...]:
        """Mailboxes that want items of a class."""
        return self._by_type.get(kind, ())

    def streams(self) -> Mapping[str, Opened]:
        """Sources that are open now."""
        return self._streams

    def _arrange(self, boxes: dict[str, Mailbox]) -> None:
        kinds = {kind for box in boxes.values() for kind in box.wants}
        # New objects, so that who posts just now goes through what it has.
        self._by_type = {
            kind: tuple(b for b in boxes.values() if kind in b.wants) for kind in kinds
        }
        self._boxes = boxes
