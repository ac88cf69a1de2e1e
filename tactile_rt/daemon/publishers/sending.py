"""What publishers over a network share: which messages go out, and how often."""

import abc
import time
from typing import Annotated

import msgspec

from tactile_rt.daemon.config import is_loopback
from tactile_rt.daemon.consumer import TAKEN, Consumer, View
from tactile_rt.daemon.items import Contact, Decision, Event, Item, Opened, Skipped, SourceChunk
from tactile_rt.daemon.messages import Message, message_of, state_message
from tactile_rt.daemon.publishers.connections import ConnectionLimit

__all__ = [
    "Connections",
    "Due",
    "ListenerOptions",
    "Prefix",
    "Repeated",
    "Sender",
    "SenderOptions",
    "is_port",
    "tell_exposed",
]

Prefix = Annotated[
    str,
    msgspec.Meta(
        pattern=r"^[A-Za-z0-9_.-]{1,64}(/[A-Za-z0-9_.-]{1,64}){0,7}\Z",
        description="prefix: one to eight words of letters, digits, ., - and _, with / between",
    ),
]
Connections = Annotated[int, msgspec.Meta(ge=1, le=1000)]
StateSeconds = Annotated[float, msgspec.Meta(ge=0, le=86400)]


class SenderOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options that all of them have.

    Attributes:
        state_s: The time after which ``state`` and all ``array`` messages are repeated, for those
            that come late, s; 0: never.
    """

    prefix: Prefix = "tactile"
    samples: bool = False
    state_s: StateSeconds = 1.0


class ListenerOptions(SenderOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of those that others connect to."""

    connections: Connections = 32  # at a time; more are shut down


class Due:
    """Tells when something is due that is done every so many seconds; 0: never."""

    def __init__(self, every_s: float) -> None:
        self._every_s, self._at = every_s, 0.0

    def now(self) -> bool:
        """Whether it is; then it is done, and due again later."""
        now = time.monotonic()
        if not self._every_s or now < self._at:
            return False
        self._at = now + self._every_s
        return True


class Repeated:
    """Messages that are sent again and again: the state and the arrays that are open."""

    def __init__(self, every_s: float) -> None:
        self._due = Due(every_s)

    def messages(self, view: View) -> list[Message]:
        """Those that are due."""
        if not self._due.now():
            return []
        arrays = [m for m in map(message_of, view.streams().values()) if m is not None]
        return [*arrays, state_message(view.snapshot())]


class Sender(Consumer):
    """Sends each message as it is; `_send` does it."""

    def __init__(self, name: str, options: SenderOptions) -> None:
        self.name = name
        wants = {Opened, Decision, Contact, Skipped, Event}
        self.wants = frozenset(wants | {SourceChunk} if options.samples else wants)
        self.tick_s = options.state_s
        self._repeated = Repeated(options.state_s)
        self._view: View | None = None
        self._messages = self._bytes = 0
        self._limit: ConnectionLimit | None = None

    def open(self, view: View) -> None:
        self._view = view
        self._connect(view)

    def handle(self, items: list[Item]) -> None:
        messages: list[Message] = [m for m in map(message_of, items) if m is not None]
        if self._view is not None:
            messages += self._repeated.messages(self._view)
        for message in messages:
            self._bytes += self._send(message)
            self._messages += 1

    def trouble(self) -> str:
        limit = self._limit
        return TAKEN if limit is not None and limit.full else ""

    @abc.abstractmethod
    def _connect(self, view: View) -> None:
        """Begin; may raise."""

    @abc.abstractmethod
    def _send(self, message: Message) -> int:
        """Hand a message over without waiting for anyone; its size in bytes."""


def is_port(text: str) -> bool:
    """Whether it is the number of a TCP port."""
    return text.isdecimal() and len(text) < 6 and 1 <= int(text) <= 65535


def tell_exposed(view: View, name: str, host: str) -> None:
    """Warn where others than this computer's own programs can read along."""
    if not is_loopback(host):
        view.report(
            f"publisher.{name}", "exposed",
            f"whoever can reach {host or 'this computer'} can read what is published", "warning",
        )  # fmt: skip
