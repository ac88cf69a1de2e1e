"""How long things take: a histogram for ever, percentiles of the newest."""

import bisect
import threading
from collections import deque

from tactile_rt.daemon.snapshot import Latency

__all__ = ["LatencyMeter"]

EDGES_S = (
    0.0005, 0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.045, 0.07, 0.1, 0.2,
    0.5, 1.0, 5.0,
)  # fmt: skip
NEWEST = 1000


class LatencyMeter:
    """Add seconds from any thread; `state` is a frozen `Latency`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: deque[float] = deque(maxlen=NEWEST)
        self._buckets = [0] * (len(EDGES_S) + 1)
        self._count, self._sum = 0, 0.0

    def add(self, seconds: float) -> None:
        """One more."""
        with self._lock:
            self._newest.append(seconds)
            self._buckets[bisect.bisect_left(EDGES_S, seconds)] += 1
            self._count += 1
            self._sum += seconds

    @property
    def state(self) -> Latency:
        """What was measured."""
        with self._lock:
            ordered = sorted(self._newest)
            count, total, buckets = self._count, self._sum, tuple(self._buckets)
        if not ordered:
            return Latency(edges_s=EDGES_S, buckets=buckets)
        return Latency(
            count, total, 1e3 * _rank(ordered, 0.5), 1e3 * _rank(ordered, 0.99), 1e3 * ordered[-1],
            EDGES_S, buckets,
        )  # fmt: skip


def _rank(ordered: list[float], share: float) -> float:
    """The smallest value that at least this share of all are not above."""
    return ordered[max(0, -(-len(ordered) * round(1000 * share) // 1000) - 1)]
