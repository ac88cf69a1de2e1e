"""A consumer in a thread of its own, fed from a mailbox."""

import time

from tactile_rt.daemon.config import LimitsConfig
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.items import Decision
from tactile_rt.daemon.latency import LatencyMeter
from tactile_rt.daemon.mailbox import Mailbox
from tactile_rt.daemon.part import Part, Report
from tactile_rt.daemon.snapshot import ConsumerState

__all__ = ["ConsumerPart"]


class ConsumerPart(Part):
    """Runs a consumer.

    Args:
        name: ``publisher.NAME``, ``recorder`` ...
        kind: for the snapshot.
        consumer: what it is.
        view: what the consumer sees of the daemon.
        report, limits: see `Part`.
    """

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

    @property
    def consumer_state(self) -> ConsumerState:
        """For the snapshot."""
        try:
            details = self.consumer.details()
        except Exception as error:  # telling of itself must not break the snapshot of all others
            details = {"error": f"{type(error).__name__}: {error}"}
        return ConsumerState(self.state, self.kind, self.box.state, self._latency.state, details)

    def stop(self) -> None:
        super().stop()
        self.box.close()

    def _work(self) -> None:
        consumer, box = self.consumer, self.box
        self._busy_ns = time.monotonic_ns()
        consumer.open(self._view)
        self._busy_ns = 0
        box.taking = True
        self._up()
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
                    self._latency.add((now - item.sample_ns) / 1e9)

    def _release(self) -> None:
        self.box.taking = False
        self._busy_ns = time.monotonic_ns()
        try:
            self.consumer.close()
        finally:
            self._busy_ns = 0
