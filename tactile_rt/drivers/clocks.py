"""Time stamps of samples in ns, from a device's clock, its counter or the arrivals.

Requirements
- A sample gets the time at which it was measured, not that at which it arrived: a USB adapter
  hands over 16 ms of samples at once, and a busy host reads them later still.
- It gets it at once, without waiting for later input; times increase strictly, and none is after
  its arrival if possible.
- Quartzes differ by up to 200 ppm, counters wrap, devices restart and clocks jump: all of this is
  followed without losing a sample.
- Live and replayed packets take one path, so that a recording decodes as the stream did.

Method. `Stamper` makes chunks of a codec's samples: `Sequencer` numbers the samples, then the best
available clock dates them:
- the device's own time, mapped to the host's clock (`DeviceClock`);
- if it sends a counter only, the counter, as a clock whose tick is the nominal period;
- if it sends neither, its steady rate: the number of samples received is the clock
  (`SteadyClock`); if the rate is not steady, the arrivals, those of one packet spread over the
  time before (`host_stamps`);
- on demand (``clock=device``), the device's own time, unmapped (`DeviceTime`).

Estimation of offset and drift in `DeviceClock`. A sample cannot arrive before it was taken, so the
promptest arrivals bound the offset from one side: the line that lies under all points (device
time, arrival - device time) and nearest to them on average is an edge of their lower convex hull
(Moon, Skelly and Towsley 1999, INFOCOM). Bursts and a busy host only add delay above that line, and
so do not matter. The delay that even the promptest sample has cannot be known. Only the promptest
point of each bucket of time is kept, and buckets double in length until ten minutes fit into 240,
so that memory and work stay small. Between two fits an arrival below the line moves the line down
at once. An arrival far below it means that the device's clock stepped forward, arrivals far above
it for seconds that it stepped back: then the fit starts again.
"""

from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk, SourceStats
from tactile_rt.drivers.accounting import Sequencer
from tactile_rt.drivers.codec import Codec, Samples

COUNTED_TOLERANCE = 0.1  # of a rate that is only nominal: the counter is the device's only clock
FIRST_BUCKET_NS: Final = NS_PER_S // 4  # only the promptest arrival of a bucket is kept
BUCKETS: Final = 240
LONGEST_BUCKET_NS: Final = 5 * NS_PER_S // 2  # so that the fit spans ten minutes
DRIFT_SEEN_AFTER: Final = 1e-3  # jitter, s; over the largest drift: time to the first slope, s
EARLY_NS: Final = 20_000_000  # a sample this early shows that the device's clock stepped
# ... and so does one that is only this early, if the promptest arrivals of the last buckets lie
# within half of that.
PROMPT_EARLY_NS: Final = 4_000_000
PROMPT_BUCKETS: Final = 8
LATE_NS: Final = 30_000_000  # samples this late ...
LATE_FOR_NS: Final = 2 * NS_PER_S  # ... for this long show that it stepped back
LEAST_STEP: Final = 0.5  # of the device's step, between two samples when the estimate moves back
LONG_NS: Final = 60_000_000_000  # a clock that wraps sooner cannot show that it went back
STEADY_TOLERANCE, STRAYED = 1.5, 0.5  # largest drift fitted; above the latter, use arrivals
SETTLED_NS: Final = 2 * NS_PER_S  # after which the rate is known well enough
LOST, LOST_NS, LOST_PACKETS = 0.7, NS_PER_S // 4, 8  # periods late, for so long, in so many packets
SILENCE_NS, SILENT_PERIODS = NS_PER_S // 10, 5  # after which the count starts again
OFTEN, OFTEN_NS = 5, 10 * NS_PER_S  # losses within this time, beyond which arrivals date samples


class Stamper:
    """Converter of a codec's samples to chunks with sequence numbers and times.

    Args:
        codec: The codec of the device, which specifies its counter and clock.
        steady: False for a log: its own times date samples that have neither time nor count.

    Attributes:
        clock: The clock that dates the samples; None for a device that sends neither time nor
            count.
        newest_ns: Host time at which the newest sample arrived, ns; 0 before the first.
        elapsed_ns: Time elapsed on the device's clock until the newest sample, ns; for a device
            that sends no time, host time of its arrival.
        status: Status bits of the newest sample.
        told_ns: Host time at which the last sample with a status bit set arrived, ns, by bit.
    """

    def __init__(
        self, codec: Codec[Any], spec: ArraySpec, stats: SourceStats, steady: bool = True
    ) -> None:
        self.spec, self._shape = spec, spec.shape
        self.newest_ns = self.elapsed_ns = self.status = 0
        self._tick_ns, self._tick_wrap, self._tick = codec.tick_ns, 1 << codec.tick_bits, 0
        self.told_ns: dict[int, int] = {}
        self._period_ns = round(NS_PER_S / spec.rate_hz)
        ticks = None if codec.tick_ns is None else self._period_ns / codec.tick_ns
        self.sequencer = Sequencer(codec.count_bits, stats, ticks, codec.tick_bits)
        self._steady = SteadyClock(self._period_ns, steady)
        self.clock: DeviceClock | DeviceTime | None = None
        if codec.tick_ns is not None:
            self.clock = DeviceClock(codec.tick_ns, codec.tick_bits)
        elif codec.count_bits is not None:
            self.clock = DeviceClock(NS_PER_S / spec.rate_hz, codec.count_bits, COUNTED_TOLERANCE)

    def resume(self) -> None:
        """Prepare for samples after a reconnection."""
        self._steady.resume()
        if self.clock is not None:
            self.clock.resume()

    def chunk(self, samples: Samples) -> Chunk | None:
        """Return new samples as a chunk with numbers and times; None if none are new."""
        if samples.values.shape[1:] != self._shape:
            return None  # the codec has counted them
        seq, keep = self.sequencer.number(samples)
        arrived, ticks, count = samples.arrived_ns, samples.ticks, samples.count
        values, valid = samples.values, samples.valid
        if False in keep.tolist():
            seq, arrived, values, valid = seq[keep], arrived[keep], values[keep], valid[keep]
            ticks = None if ticks is None else ticks[keep]
            count = None if count is None else count[keep]
            if not len(seq):
                return None
        counter = ticks if ticks is not None else count
        if self.clock is not None and counter is not None:
            t_ns = self.clock.to_host(counter, arrived)
        else:
            t_ns = self._steady.to_host(arrived)
        self.newest_ns = int(arrived[-1])
        if self._tick_ns is None or ticks is None:
            self.elapsed_ns = self.newest_ns
        else:
            passed, self._tick = (int(ticks[-1]) - self._tick) % self._tick_wrap, int(ticks[-1])
            self.elapsed_ns += round(passed * self._tick_ns)
        if samples.status is not None:
            self.status = int(samples.status[-1])
            if bits := int(np.bitwise_or.reduce(samples.status)):
                now = {bit: self.newest_ns for bit in range(bits.bit_length()) if bits >> bit & 1}
                self.told_ns = {**self.told_ns, **now}
        if valid.shape != values.shape[:2]:
            valid = np.broadcast_to(valid, values.shape[:2])
        return Chunk(seq, t_ns, values, valid)


class DeviceClock:
    """Converter of a device's ticks to times of the host's monotonic clock.

    Args:
        tick_ns: Nominal length of a tick, ns.
        bits: Width of the device's clock, which wraps at 2^bits.
        tolerance: Largest drift that is fitted, as a fraction (a quartz is within 2e-4).

    Attributes:
        drift: Excess speed of the host's clock over the device's, as a fraction.
        steps: Number of times that the device's clock jumped or restarted while it was connected.
    """

    def __init__(self, tick_ns: float, bits: int, tolerance: float = 5e-4) -> None:
        self.drift = 0.0
        self.steps = 0
        self._tick_ns, self._wrap, self._tolerance = tick_ns, 1 << bits, tolerance
        self._drift_after_ns = min(5 * NS_PER_S, round(NS_PER_S * DRIFT_SEEN_AFTER / tolerance))
        self._tick: int | None = None  # of the last sample
        self._arrived = self._stamp_ns = 0  # host times of the last sample: arrival and stamp
        self._x = 0.0  # device time of the last sample since the base
        self._restart_fit(0)

    @property
    def drift_ppm(self) -> float:
        """`drift` in parts per million."""
        return 1e6 * self.drift

    def to_host(self, ticks: NDArray[np.int64], arrived_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert ticks, (n,), to increasing host times, (n,) ns, not after arrival if possible.

        Args:
            arrived_ns: Host times of arrival, (n,), ns, never decreasing.
        """
        stamps: list[int] = []
        waiting: list[tuple[float, float, int]] = []  # device time, its step, arrival
        for tick, arrived in zip(ticks.tolist(), arrived_ns.tolist(), strict=True):
            step = self._measure_step(tick, arrived)
            x = self._x + step
            early = arrived - self._base - x - self._offset - self.drift * x < -self._early_ns
            if self._tick is None or early:
                # In a backlog, samples are early only relative to a first one that came late.
                self.steps += step - (arrived - self._arrived) > self._early_ns
                stamps += [self._date_sample(*sample) for sample in waiting]
                waiting, x, step = [], 0.0, 0.0
                self._restart_fit(arrived)
            self._x, self._tick, self._arrived = x, tick, arrived
            self._add_arrival(x, arrived)
            waiting.append((x, step, arrived))
        # dated only now: the last sample of a packet is the promptest, and dates the others
        return np.array(stamps + [self._date_sample(*sample) for sample in waiting], np.int64)

    def resume(self) -> None:
        """Accept any device time next, since the clock may have restarted while disconnected."""
        self._tick = None

    def _date_sample(self, x: float, step: float, arrived: int) -> int:
        """Return a sample's host time, ns, by the current fit of offset and drift."""
        t = min(self._base + round(x + self._offset + self.drift * x), arrived)
        room = min(LEAST_STEP * step, arrived - self._stamp_ns)
        self._stamp_ns = max(t, self._stamp_ns + max(1, round(room)))
        return self._stamp_ns

    def _measure_step(self, tick: int, arrived: int) -> float:
        """Return the device time that passed since the last sample, ns."""
        if self._tick is None:
            return 0.0
        ticks = (tick - self._tick) % self._wrap
        # a short counter may have wrapped more than once since then
        missed = (arrived - self._arrived) / self._tick_ns - ticks
        if missed > self._wrap / 2:
            ticks += self._wrap * round(missed / self._wrap)
        return ticks * self._tick_ns

    def _restart_fit(self, arrived: int) -> None:
        self._base, self._x = arrived, 0.0
        self._points: list[tuple[float, float]] = []  # promptest of each bucket
        self._bucket_ns = FIRST_BUCKET_NS
        self._bucket_start, self._bucket_best = 0.0, (0.0, 0.0)
        self._offset = 0.0
        self._late_since: int | None = None  # host time
        self._late_best = (0.0, 0.0)
        self._early_ns = EARLY_NS

    def _add_arrival(self, x: float, arrived: int) -> None:
        d = float(arrived - self._base - x)
        below = d - self.drift * x
        late = below - self._offset
        if late < 0:
            self._offset += late  # the line is under all points again
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
                self._bucket_start, self._bucket_best, self._late_since = x, (x, d), None
                self._offset = best_d - self.drift * best_x
                return
        if x - self._bucket_start > self._bucket_ns:
            self._points.append(self._bucket_best)
            self._bucket_start, self._bucket_best = x, (x, d)
            self._thin_points()
            self._fit()
        elif below < self._bucket_best[1] - self.drift * self._bucket_best[0]:
            self._bucket_best = (x, d)

    def _thin_points(self) -> None:
        if len(self._points) < BUCKETS:
            return
        if self._bucket_ns >= LONGEST_BUCKET_NS:
            del self._points[0]
            return
        self._bucket_ns *= 2
        pairs = zip(self._points[::2], self._points[1::2], strict=True)
        self._points = [min(pair, key=lambda p: p[1] - self.drift * p[0]) for pair in pairs]

    def _fit(self) -> None:
        points = [*self._points, self._bucket_best]
        if points[-1][0] - points[0][0] >= self._drift_after_ns:
            slope = _fit_slope(points)
            self.drift = min(max(slope, -self._tolerance), self._tolerance)
        above = [d - self.drift * x for x, d in points]
        self._offset = min(above)
        last = above[-PROMPT_BUCKETS:]
        prompt = len(last) == PROMPT_BUCKETS and max(last) - self._offset < PROMPT_EARLY_NS / 2
        self._early_ns = PROMPT_EARLY_NS if prompt else EARLY_NS


def _fit_slope(points: Sequence[tuple[float, float]]) -> float:
    """Return the slope of the line under all points and nearest to them on average."""
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


class SteadyClock:
    """Clock for a device without clock or counter, by its steady rate.

    A lost sample delays all later ones by a period, which reveals it. Samples are dated by their
    arrival in the first two seconds, also after a silence, and if the rate is far from nominal or
    losses are frequent.

    Args:
        period_ns: Nominal time between samples, ns.
        steady: False dates all samples by their arrival.

    Attributes:
        lost: Number of missing samples, estimated from the arrivals of later ones.
    """

    def __init__(self, period_ns: int, steady: bool = True) -> None:
        self.lost = 0
        self._period_ns, self._stamp_ns, self._unsteady = period_ns, 0, not steady
        self.resume()

    def resume(self) -> None:
        """Start counting again after a reconnection or a silence."""
        self._clock = DeviceClock(self._period_ns, 62, STEADY_TOLERANCE)
        self._count, self._began = 0, -1
        self._late: list[tuple[int, int]] = []  # arrivals of the newest packets, and delays, ns
        self._losses: list[int] = []  # times of lost samples

    def to_host(self, arrived_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return strictly increasing host times, (n,) ns, for the samples of one packet."""
        n, last = len(arrived_ns), int(arrived_ns[-1])
        silent_ns = last - self._late[-1][0] if self._late else 0
        if silent_ns > max(SILENCE_NS, SILENT_PERIODS * self._period_ns, 4 * n * self._period_ns):
            self.resume()
        if self._began < 0:
            self._began = last
        numbers = np.arange(self._count, self._count + n)
        self._count += n
        t_ns = self._clock.to_host(numbers, arrived_ns)
        late_ns = last - int(t_ns[-1])
        settled = last - self._began > SETTLED_NS
        self._losses = [at for at in self._losses if last - at < OFTEN_NS]
        self._unsteady = self._unsteady or (settled and abs(self._clock.drift) > STRAYED)
        if self._unsteady or not settled or len(self._losses) >= OFTEN:
            t_ns = host_stamps(arrived_ns, self._stamp_ns, self._period_ns)
        elif t_ns[0] <= self._stamp_ns:
            t_ns = np.maximum(t_ns, self._stamp_ns + 1 + np.arange(n))
        self._stamp_ns = int(t_ns[-1])
        self._count_lost(last, late_ns, settled)
        return t_ns

    def _count_lost(self, arrived: int, late_ns: int, settled: bool) -> None:
        """Count samples as lost, and skip their numbers, if all recent packets are late."""
        self._late.append((arrived, late_ns))
        while len(self._late) > LOST_PACKETS and arrived - self._late[1][0] >= LOST_NS:
            del self._late[0]
        enough = len(self._late) >= LOST_PACKETS and arrived - self._late[0][0] >= LOST_NS
        period = self._period_ns * (1 + self._clock.drift)
        least = min(late for _, late in self._late)
        if settled and enough and least > LOST * period:
            lost = round(least / period)
            self.lost, self._count = self.lost + lost, self._count + lost
            self._losses += [arrived] * min(lost, OFTEN)
            self._late = self._late[-1:]


class DeviceTime:
    """Substitute for `DeviceClock` that returns the device's own time, not the host's.

    The first sample has the time of the device's clock. A forward jump of the clock becomes a gap
    in the stream. If the clock goes back or restarts, the next time is that of the last sample
    plus the time that passed on the host's clock.

    Attributes:
        drift_ppm: Always 0, since no other clock is compared with this one.
        steps: Number of times that the clock went back or restarted.
    """

    drift_ppm = 0.0

    def __init__(self, tick_ns: float, bits: int) -> None:
        self.steps = 0
        self._tick_ns, self._wrap = tick_ns, 1 << bits
        self._can_go_back = self._wrap * tick_ns >= LONG_NS
        self._tick: int | None = None  # of the last sample
        self._arrived = self._stamp_ns = 0  # of the last sample: arrival and stamp, ns
        self._ticks, self._origin = 0, 0  # ticks since the clock started, and its time then, ns

    def to_host(self, ticks: NDArray[np.int64], arrived_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Convert ticks, (n,), to strictly increasing device times, (n,) ns."""
        stamps = np.empty(len(ticks), np.int64)
        for i, (tick, arrived) in enumerate(zip(ticks.tolist(), arrived_ns.tolist(), strict=True)):
            if self._tick is None:
                self._ticks = tick
            else:
                ahead = (tick - self._tick) % self._wrap
                if self._can_go_back and ahead > self._wrap // 2:
                    self.steps += 1
                    self._origin = self._stamp_ns + max(1, arrived - self._arrived)
                    self._ticks = 0
                else:
                    self._ticks += ahead
            t = self._origin + round(self._ticks * self._tick_ns)
            self._stamp_ns = t if self._tick is None else max(t, self._stamp_ns + 1)
            self._tick, self._arrived = tick, arrived
            stamps[i] = self._stamp_ns
        return stamps

    def resume(self) -> None:
        """Do nothing after a reconnection: the ticks themselves show a restart."""


def host_stamps(arrived_ns: NDArray[np.int64], before_ns: int, period_ns: int) -> NDArray[np.int64]:
    """Estimate the times of one packet's samples from its arrival, (n,) ns.

    For a device that sends neither time nor count. The samples are spread over the time before
    their arrival, a nominal period apart, or less if the previous sample leaves less room.

    Args:
        arrived_ns: Host times at which the samples of one packet arrived, (n,), ns, never
            decreasing.
        before_ns: Time assigned to the previous sample, ns.
        period_ns: Nominal time between samples, ns.
    """
    n = len(arrived_ns)
    last = max(int(arrived_ns[-1]), before_ns + n)
    step = max(1, min(period_ns, (last - before_ns) // n))
    return last - step * np.arange(n - 1, -1, -1, dtype=np.int64)
