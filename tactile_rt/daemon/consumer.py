"""What publishers, the recorder, the page, metrics and systemd are to the daemon."""

import abc
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from tactile_rt.daemon.items import Closed, Contact, Control, Decision, Event, Item, Opened
from tactile_rt.daemon.snapshot import Snapshot

__all__ = ["Consumer", "View"]


class View(Protocol):
    """The daemon as a consumer sees it; every method from any thread, at once."""

    def snapshot(self) -> Snapshot:
        """All states now."""

    def streams(self) -> Mapping[str, Opened]:
        """The sources that are open now, by name."""

    def config_text(self) -> str:
        """The configuration in force, whole, as TOML, without secrets."""

    def report(self, part: str, state: str, reason: str, level: str = "info") -> None:
        """Put an event into the log and to all consumers."""

    def send(self, consumer: str, control: Control) -> bool:
        """Ask something of another consumer, e.g. ``recorder``; whether there is one."""

    def utc_offset_ns(self) -> int:
        """UTC less host monotonic time, now."""

    def silent(self) -> Mapping[str, float]:
        """How long the current turn of each thread that must go on has taken, s: ``main``,
        ``watch``, ``source.NAME``, ``model.NAME``; one that waits for work: 0."""


class Consumer(abc.ABC):
    """Takes what happens. All methods are called in one thread, the consumer's own.

        __init__(options) -> open(view) -> handle(items)... -> close()

    Whatever `open` or `handle` raises is logged as the reason; then `close` is called and, after a
    pause, `open` again on the same object. What came meanwhile waits in the mailbox (bounded,
    oldest dropped). A `handle` that does not return is told as stalled, and harms only itself.

    Attributes:
        Options: msgspec.Struct (frozen, forbid_unknown_fields) of a publisher's ``options`` table.
        wants: which classes of items it is given. Ask for `Samples` and `Packet` only if needed.
        gather_s: how long samples and packets may wait to come together; all else comes at once.
        tick_s: `handle` is called at least so often, with no items if need be; 0: never without.
    """

    Options: ClassVar[Any] = None
    wants: frozenset[type] = frozenset({Opened, Closed, Decision, Contact, Event, Control})
    gather_s: float = 0.02
    tick_s: float = 0.0

    @abc.abstractmethod
    def open(self, view: View) -> None:
        """Begin. Sources that are open already are in `view.streams()`.

        An `Opened` that is in the mailbox may be of one of these: compare `t_ns`.
        """

    @abc.abstractmethod
    def handle(self, items: list[Item]) -> None:
        """Take what has come since the last call, in order."""

    def close(self) -> None:  # noqa: B027
        """End; also after `open` or `handle` raised. At the daemon's end everything that waited
        has been handled before, if there was time."""

    def details(self) -> dict[str, str | int | float]:
        """What to tell in the snapshot; called from any thread, must be quick."""
        return {}
