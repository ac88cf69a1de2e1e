"""A device's clock on the host's: offset and drift from arrival times that are never early.

A sample cannot arrive before it was taken, so of all arrivals the promptest bound the offset from
one side: the line that lies under all points (device time, arrival - device time) and nearest to
them on average is an edge of their lower convex hull (Moon, Skelly and Towsley 1999, INFOCOM). USB
bursts and a busy host only add delay above that line, and so do not matter. What cannot be known is
the delay that the promptest sample has, too.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["DeviceClock", "host_stamps"]

S: Final = 1_000_000_000
FIRST_BUCKET_NS: Final = S // 4  # of each only the promptest arrival is kept
BUCKETS: Final = 240
LONGEST_BUCKET_NS: Final = 5 * S // 2  # so ten minutes are looked back on
DRIFT_SEEN_AFTER: Final = 1e-3  # s of uncertainty over the allowed drift: when a slope means much
EARLY_NS: Final = 20_000_000  # a sample this early is no prompt one: the device's clock stepped
LATE_NS: Final = 30_000_000  # so late for ...
LATE_FOR_NS: Final = 2 * S  # ... so long: it stepped back
LEAST_STEP: Final = 0.5  # of the device's, between two samples when the estimate moves back


class DeviceClock:
    """Maps a device's ticks to the host's monotonic clock.

    Args:
        tick_ns: nominal length of a tick, ns.
        bits: the counter wraps at 2^bits.
        tolerance: largest drift believed, as a fraction (a quartz is within 2e-4).

    Attributes:
        drift: how much faster the host's clock runs than the device's, as a fraction.
        steps: times that the device's clock jumped or began anew, as long as it was connected.
    """

    def __init__(self, tick_ns: float, bits: int, tolerance: float = 5e-4) -> None:
        self.drift = 0.0
        self.steps = 0
        self._tick_ns, self._wrap, self._tolerance = tick_ns, 1 << bits, tolerance
        self._drift_after_ns = min(5 * S, round(S * DRIFT_SEEN_AFTER / tolerance))
        self._tick: int | None = None  # of the last sample
        self._arrived = self._told = 0
        self._x = 0.0  # device time of the last sample since the base
        self._begin(0)

    @property
    def drift_ppm(self) -> float:
        """`drift` in parts per million."""
        return 1e6 * self.drift

    def to_host(self, ticks: NDArray[np.int64], arrived_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """(n,) host times of samples, ns: strictly increasing, none after its arrival if possible.

        Args:
            ticks: (n,) the counter as it came.
            arrived_ns: (n,) host times of arrival, never decreasing.
        """
        told: list[int] = []
        waiting: list[tuple[float, float, int]] = []  # device time, since the last, arrival
        for tick, arrived in zip(ticks.tolist(), arrived_ns.tolist(), strict=True):
            step = self._step(tick, arrived)
            x = self._x + step
            early = arrived - self._base - x - self._a - self.drift * x < -EARLY_NS
            if self._tick is None or early:
                # In a backlog, samples are early only against a first one that came late.
                self.steps += step - (arrived - self._arrived) > EARLY_NS
                told += self._tell(waiting)
                waiting, x, step = [], 0.0, 0.0
                self._begin(arrived)
            self._x, self._tick, self._arrived = x, tick, arrived
            self._observe(x, arrived)
            waiting.append((x, step, arrived))
        # told only now: the last sample of a packet is the promptest, and dates the others
        return np.array(told + self._tell(waiting), np.int64)

    def resume(self) -> None:
        """The device was away: its clock may have begun anew."""
        self._tick = None

    def _tell(self, waiting: list[tuple[float, float, int]]) -> list[int]:
        """Host times of these samples, by what is known of the clock now."""
        told = []
        for x, step, arrived in waiting:
            t = min(self._base + round(x + self._a + self.drift * x), arrived)
            room = min(LEAST_STEP * step, arrived - self._told)
            self._told = max(t, self._told + max(1, round(room)))
            told.append(self._told)
        return told

    def _step(self, tick: int, arrived: int) -> float:
        """Device time since the last sample, ns."""
        if self._tick is None:
            return 0.0
        ticks = (tick - self._tick) % self._wrap
        # a short counter may have wrapped more than once meanwhile
        missed = (arrived - self._arrived) / self._tick_ns - ticks
        if missed > self._wrap / 2:
            ticks += self._wrap * round(missed / self._wrap)
        return ticks * self._tick_ns

    def _begin(self, arrived: int) -> None:
        self._base, self._x = arrived, 0.0
        self._points: list[tuple[float, float]] = []  # promptest of each bucket
        self._bucket_ns = FIRST_BUCKET_NS
        self._opened, self._best = 0.0, (0.0, 0.0)
        self._a = 0.0
        self._late_since: int | None = None  # host time
        self._late_best = (0.0, 0.0)

    def _observe(self, x: float, arrived: int) -> None:
        d = float(arrived - self._base - x)
        below = d - self.drift * x
        late = below - self._a
        if late < 0:
            self._a += late  # the line is under all points, now
        if late < LATE_NS:
            self._late_since = None
        elif self._late_since is None:
            self._late_since, self._late_best = arrived, (x, d)
        else:
            if below < self._late_best[1] - self.drift * self._late_best[0]:
                self._late_best = (x, d)
            if arrived - self._late_since > LATE_FOR_NS:
                best_x, best_d = self._late_best
                self.steps += 1
                self._points, self._bucket_ns = [], FIRST_BUCKET_NS
                self._opened, self._best, self._late_since = x, (x, d), None
                self._a = best_d - self.drift * best_x
                return
        if x - self._opened > self._bucket_ns:
            self._points.append(self._best)
            self._opened, self._best = x, (x, d)
            self._forget_old()
            self._fit()
        elif below < self._best[1] - self.drift * self._best[0]:
            self._best = (x, d)

    def _forget_old(self) -> None:
        if len(self._points) < BUCKETS:
            return
        if self._bucket_ns >= LONGEST_BUCKET_NS:
            del self._points[0]
            return
        self._bucket_ns *= 2
        pairs = zip(self._points[::2], self._points[1::2], strict=True)
        self._points = [min(pair, key=lambda p: p[1] - self.drift * p[0]) for pair in pairs]

    def _fit(self) -> None:
        points = [*self._points, self._best]
        if points[-1][0] - points[0][0] >= self._drift_after_ns:
            slope = _slope_below(points)
            self.drift = min(max(slope, -self._tolerance), self._tolerance)
        self._a = min(d - self.drift * x for x, d in points)


def _slope_below(points: Sequence[tuple[float, float]]) -> float:
    """Slope of the line under all points that is nearest to them on average."""
    hull: list[tuple[float, float]] = []
    for x, d in points:
        while len(hull) > 1:
            (x1, d1), (x2, d2) = hull[-2:]
            if (d2 - d1) * (x - x1) < (d - d1) * (x2 - x1):
                break
            hull.pop()
        hull.append((x, d))
    middle = sum(x for x, _ in points) / len(points)
    for (x1, d1), (x2, d2) in zip(hull, hull[1:], strict=False):  # noqa: RUF007
        if x2 >= middle:
            return (d2 - d1) / (x2 - x1)
    return 0.0


def host_stamps(arrived_ns: NDArray[np.int64], before_ns: int, period_ns: int) -> NDArray[np.int64]:
    """(n,) times for samples of a device that tells neither time nor count.

    Samples that arrive together were not taken together: they are spread over the time before
    their arrival, a nominal period apart or as much as fits after the sample before.

    Args:
        arrived_ns: (n,) of one packet, never decreasing.
        before_ns: time given to the sample before these.
        period_ns: nominal.
    """
    n = len(arrived_ns)
    last = max(int(arrived_ns[-1]), before_ns + n)
    step = max(1, min(period_ns, (last - before_ns) // n))
    return last - step * np.arange(n - 1, -1, -1, dtype=np.int64)
