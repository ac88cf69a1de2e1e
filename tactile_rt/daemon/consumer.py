"""Consumers (publishers, recorder, page, metrics, systemd, log): their interface, and the part that
runs each in a thread of its own, fed from a mailbox."""

import abc
import time
from collections.abc import Mapping
from typing import Any, ClassVar, Protocol

from tactile_rt.daemon.config import LimitsConfig
from tactile_rt.daemon.diagnostics import LossWindow
from tactile_rt.daemon.items import (
    Closed,
    Contact,
    Control,
    Decision,
    Event,
    Item,
    Opened,
    Skipped,
)
from tactile_rt.daemon.mailbox import Mailbox
from tactile_rt.daemon.part import Part, Report
from tactile_rt.daemon.states import ConsumerState, LatencyMeter, OnDisk, Snapshot

TAKEN = "all its connections are taken, and others are turned away"


class View(Protocol):
    """The daemon's interface for consumers; every method returns at once, in any thread."""

    def snapshot(self) -> Snapshot:
        """Return the present states of all parts."""

    def streams(self) -> Mapping[str, Opened]:
        """Return the `Opened` item of each source that is open now, by source name."""

    def config_text(self) -> str:
        """Return the whole configuration in force as TOML, with secrets hidden."""

    def report(self, part: str, state: str, reason: str, level: str = "info") -> None:
        """Post an event to the log and all other consumers."""

    def send(self, consumer: str, control: Control) -> bool:
        """Send a control to a consumer, such as ``recorder``; return whether it was delivered."""

    def utc_offset_ns(self) -> int:
        """Return UTC minus host monotonic time at this moment, ns."""

    def silent(self) -> Mapping[str, float]:
        """Return how long each critical thread has been in its current loop pass, s. The threads
        are ``main``, ``watch``, ``source.NAME`` and ``model.NAME``; 0 means waiting for work."""


class Consumer(abc.ABC):
    """A consumer of the daemon's items, whose methods run in a thread of its own.

        __init__(options) -> open(view) -> handle(items)... -> close()

    An error of `open` or `handle` is logged as the reason; then `close` is called and, after a
    pause, `open` again on the same object. Items wait meanwhile in the mailbox (bounded, oldest
    dropped). A `handle` that does not return is reported as stalled, and delays no other part.

    Attributes:
        Options: The msgspec.Struct (frozen, forbid_unknown_fields) of a publisher's ``options``.
        wants: The classes of items that it receives. Ask for `SourceChunk` and `Packet` only if
            needed.
        gather_s: The time that samples and packets may wait to be handed over together, s; other
            items are handed over at once.
        tick_s: The longest time between two calls of `handle`, with an empty list if no item has
            come, s; with 0, `handle` is called only with items.
    """

    Options: ClassVar[Any] = None
    wants: frozenset[type] = frozenset({Opened, Closed, Decision, Contact, Skipped, Event, Control})
    gather_s: float = 0.02
    tick_s: float = 0.0

    @abc.abstractmethod
    def open(self, view: View) -> None:
        """Acquire resources and start. Sources that are already open are in `view.streams()`.

        The mailbox may contain the `Opened` of such a source again, with the same `t_ns`.
        """

    @abc.abstractmethod
    def handle(self, items: list[Item]) -> None:
        """Process the items that arrived since the last call, in order of arrival."""

    def close(self) -> None:  # noqa: B027
        """Release all resources, also after an error of `open` or `handle`. When the daemon stops,
        waiting items are handled before, if there is time."""

    def details(self) -> dict[str, str | int | float]:
        """Return named details for the snapshot; called from any thread, must be quick."""
        return {}

    def diagnose(self) -> str:
        """Return why the consumer cannot work now, or an empty string. The text contains no number
        that keeps changing; called from any thread, must be quick."""
        return ""

    def foresee(self) -> str:
        """Return why and when the consumer will soon stop working, or an empty string."""
        return ""

    def on_disk(self) -> Mapping[str, OnDisk]:
        """Return which samples of each source are on disk; empty unless the consumer records."""
        return {}


class ConsumerPart(Part):
    """The part that runs a consumer in its own thread, fed from a mailbox."""

    def __init__(
        self,
        name: str,
        kind: str,
        consumer: Consumer,
        view: View,
        report: Report,
        limits: LimitsConfig,
    ) -> None:
        super().__init__(name, report, limits)
        self.kind, self.consumer = kind, consumer
        self.box = Mailbox(
            consumer.wants, limits.queue_items, round(1e6 * limits.queue_mb), consumer.gather_s
        )
        self._view = view
        self._latency = LatencyMeter()
        self._age_s = 0.0
        self._losses = LossWindow()

    @property
    def consumer_state(self) -> ConsumerState:
        """Present state of the consumer, for the snapshot."""
        try:
            details, diagnostic = self.consumer.details(), self.consumer.diagnose()
            on_disk, soon = self.consumer.on_disk(), self.consumer.foresee()
        except Exception as error:  # it must not break the snapshot of all others
            diagnostic, on_disk = f"cannot report its state: {type(error).__name__}: {error}", {}
            details, soon = {}, ""
        queue = self.box.state
        return ConsumerState(
            self.state, self.kind, queue, self._latency.state, details, 1e3 * self._age_s,
            max(queue.oldest_s, self.silent_s), self._losses.add(sum(queue.dropped.values())),
            diagnostic, dict(on_disk), soon,
        )  # fmt: skip

    def stop(self) -> None:
        super().stop()
        self.box.close()

    def _work(self) -> None:
        consumer, box = self.consumer, self.box
        self._busy_ns = time.monotonic_ns()
        consumer.open(self._view)
        self._busy_ns = 0
        box.taking = True
        self._report_running(str(consumer.details().get("url", "")))
        tick = consumer.tick_s or None
        due = time.monotonic() + consumer.tick_s
        while True:
            items = box.take(tick and max(0.0, due - time.monotonic()))
            if not items and box.closed:
                return
            self._busy_ns = time.monotonic_ns()
            consumer.handle(items)
            now = time.monotonic_ns()
            self._busy_ns = 0
            due = now / 1e9 + consumer.tick_s
            for item in items:
                if isinstance(item, Decision):
                    self._age_s = (now - item.sample_ns) / 1e9
                    self._latency.add(self._age_s)

    def _release(self) -> None:
        self.box.taking = False
        self._busy_ns = time.monotonic_ns()
        try:
            self.consumer.close()
        finally:
            self._busy_ns = 0
