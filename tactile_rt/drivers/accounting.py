"""Which samples came, came twice or never, by the device's own counter.

What is needed is one sum that adds up, whatever happens on the wire:

    sent + duplicated = delivered + corrupt + missing + dropped + duplicates

The left side is the device's, the right side `SourceStats`. A sample number counts from 0, goes on
over restarts of the device, and has a gap exactly where the stream has one.

The plan. A device's counter is narrow, may begin anywhere and begins anew with the device. So only
its steps count, modulo its width:
- a step of one is the next sample; a step of g + 1 is a gap of g. If d damaged frames came within
  the gap, min(d, g) of it count as corrupt and the rest as missing: noise looks like damage, too;
- a step of zero, or back, is a copy if a sample with this counter and this very content came
  lately; else the counter has begun anew;
- a step forward though the device's clock hardly moved is a restart as well, not a gap of
  thousands. What was lost around a restart nobody knows, so nothing is counted.

A device without a counter can show damage only.
"""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codec import Samples
from tactile_rt.stream import SourceStats

__all__ = ["Sequencer"]

REMEMBERED = 64  # samples back that a repeated one is looked for


class Sequencer:
    """Numbers samples and counts what is lost, as the head of this module says.

    Args:
        bits: Width of the device's counter, which wraps at 2^bits; None for a device without one.
        stats: The account in which losses are counted.
        period_ticks: Nominal time between samples, in ticks of the device's clock; None for a
            device without a clock.
        tick_bits: Width of the device's clock, which wraps at 2^tick_bits.

    Attributes:
        resets: Number of times that the counter began anew.
    """

    def __init__(
        self,
        bits: int | None,
        stats: SourceStats,
        period_ticks: float | None = None,
        tick_bits: int = 32,
    ) -> None:
        self.resets = 0
        self._wrap = None if bits is None else 1 << bits
        self._stats = stats
        self._period_ticks, self._tick_wrap = period_ticks, 1 << tick_bits
        self._count: int | None = None  # of the newest sample
        self._tick = 0
        self._next = 0
        self._seen: dict[int, int] = {}  # of the last samples: what was in it, by its counter

    def number(self, samples: Samples) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """((n,) sequence numbers, (n,) which samples to keep); the others came before.

        Sequence numbers count from 0 and go on over a reset; a gap in them is a gap in the stream.
        """
        n = len(samples)
        damaged = samples.damaged.tolist()
        if self._wrap is None or samples.count is None:
            self._stats.corrupt += sum(damaged)
            self._next += n
            return self._next - n + np.arange(n), np.ones(n, np.bool_)
        seq, keep = [0] * n, [True] * n
        ticks = [0] * n if samples.ticks is None else samples.ticks.tolist()
        for i, count in enumerate(samples.count.tolist()):
            content = hash((ticks[i], samples.values[i].tobytes()))
            gap = self._gap(count, ticks[i])
            if gap < 0 and self._seen.get(count) == content:
                keep[i], seq[i] = False, self._next
                self._stats.duplicates += 1
                continue
            if gap < 0:
                self.resets += 1
                self._seen.clear()
                gap = 0
            if gap:
                corrupt = min(damaged[i], gap)
                self._stats.corrupt += corrupt
                self._stats.missing += gap - corrupt
            seq[i] = self._next + gap
            self._next = seq[i] + 1
            self._count, self._tick = count, ticks[i]
            self._seen[count] = content
            if len(self._seen) > REMEMBERED:
                del self._seen[next(iter(self._seen))]
        return np.array(seq, np.int64), np.array(keep, np.bool_)

    def _gap(self, count: int, tick: int) -> int:
        """Samples between the newest one and this; negative: none, it is not after it."""
        assert self._wrap is not None
        if self._count is None:
            return 0
        ahead = (count - self._count) % self._wrap
        if not 0 < ahead <= self._wrap // 2:
            return -1
        if self._period_ticks is not None and ahead > 1:
            passed = (tick - self._tick) % self._tick_wrap
            expected = ahead * self._period_ticks
            if expected < self._tick_wrap / 2 and passed < expected / 2:
                return -1
        return ahead - 1
