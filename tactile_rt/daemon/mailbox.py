"""Mailboxes of the daemon's parts, and the hub that distributes items to them."""

import threading
from collections.abc import Iterable, Mapping

from tactile_rt.core.bounded_queue import BoundedQueue
from tactile_rt.daemon.items import Closed, Decision, Item, Opened, Packet, SourceChunk

AROUND_BYTES = 500  # Python's overhead for an item
FRAME_BYTES = 200  # and for a CAN frame


class Mailbox(BoundedQueue[Item]):
    """A part's bounded queue of items, counted as samples, packets, decisions and events.

    Args:
        wants: The classes of items to queue; other items are ignored and not counted.
        gather_s: How long samples and packets may wait for more, s; other items are urgent.
        source: The only source whose items are queued, from its accepted array; empty for all.
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
        self.taking = False  # until its part runs

    def _measure(self, item: Item) -> tuple[str, int, int] | None:
        """Return the kind, count and bytes of an item, or None to ignore it."""
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
    """The distributor of items to mailboxes; any thread may post. Posting needs only the locks of
    the mailboxes, except for `Opened` and `Closed`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._boxes: dict[str, Mailbox] = {}
        self._by_type: Mapping[type, tuple[Mailbox, ...]] = {}
        self._streams: dict[str, Opened] = {}

    def join(self, name: str, box: Mailbox) -> None:
        """Add a named mailbox, and put the `Opened` of each open source into it."""
        with self._lock:
            for opened in self._streams.values():
                box.put(opened)
            self._set_boxes({**self._boxes, name: box})

    def leave(self, name: str, box: Mailbox) -> None:
        """Remove a mailbox, unless another mailbox has its name by now."""
        with self._lock:
            if self._boxes.get(name) is box:
                self._set_boxes({k: b for k, b in self._boxes.items() if k != name})

    def post(self, item: Item) -> None:
        """Put an item into all mailboxes that want its class."""
        kind = type(item)
        if kind is Opened or kind is Closed:
            with self._lock:  # else a mailbox that joins now might get it twice, or never
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
        """Return the mailbox of this name, or None."""
        return self._boxes.get(name)

    def list_mailboxes(self, kind: type) -> tuple[Mailbox, ...]:
        """Return the mailboxes that want items of a class."""
        return self._by_type.get(kind, ())

    def streams(self) -> Mapping[str, Opened]:
        """Return the `Opened` item of each source that is open now, by source name."""
        return self._streams

    def _set_boxes(self, boxes: dict[str, Mailbox]) -> None:
        kinds = {kind for box in boxes.values() for kind in box.wants}
        # New objects, so that a thread that posts now goes on with the old.
        self._by_type = {
            kind: tuple(b for b in boxes.values() if kind in b.wants) for kind in kinds
        }
        self._boxes = boxes
