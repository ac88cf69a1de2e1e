"""Accounting of lost and duplicate samples by the device's own counter.

Requirement: this sum adds up, whatever happens on the wire:

    sent + duplicated = delivered + corrupt + missing + dropped + duplicates

The left side is the device's, the right side `SourceStats`. A sample number counts from 0, goes on
over restarts of the device, and has a gap exactly where the stream has one.

Method. A device's counter is narrow, starts at any value and restarts with the device. So only its
steps between samples are used, modulo its width:
- a sample with the counter and the exact content of a recent one is a copy of it;
- a step of one is the next sample; a step of g + 1 is a gap of g. If d damaged frames came within
  the gap, min(d, g) of it count as corrupt and the rest as missing: noise looks like damage, too;
- a step back means that the counter was reset, and so does a step far ahead while the device's
  clock hardly moved or went back. The losses around a restart are unknown, so none are counted.
  Several samples may share one reading of the clock, as those of one packet do: a clock that
  stands still between two samples is no sign of a restart;
- if the clock shows how many samples passed, it also reveals gaps beyond the counter's width, and
  distinguishes a gap of more than half that width from a step back.

For a device without a counter, only damage can be counted.
"""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import SourceStats
from tactile_rt.drivers.codec import Samples

REMEMBERED = 1024  # last samples among which a duplicate is searched
HARDLY = 0.25  # of a step's nominal time: rates are off by less, so a faster step is a restart
RATE_TOLERANCE = 0.02  # of the nominal rate, where the clock shows how many samples passed
STANDING = 5  # samples in a row with an unchanged count: the counter is useless
LEAST_TURN = 10_000  # samples: a clock that wraps sooner cannot show that it went back


class Sequencer:
    """Counter of samples and losses, by the method in this module's docstring.

    Args:
        bits: Width of the device's counter, which wraps at 2^bits; None for a device without one.
        period_ticks: Nominal time between samples, in ticks of the device's clock; None for a
            device without a clock.
        tick_bits: Width of the device's clock, which wraps at 2^tick_bits.

    Attributes:
        numbered: Number of samples numbered so far, including those lost in gaps.
        known_resets: Number of resets of the counter after which it went on.
    """

    def __init__(
        self,
        bits: int | None,
        stats: SourceStats,
        period_ticks: float | None = None,
        tick_bits: int = 32,
    ) -> None:
        self.known_resets = 0
        self._unsure = 0  # resets after which the counter has not gone on yet
        self._standing = 0  # successive samples of an unchanged count
        self._wrap = None if bits is None else 1 << bits
        self._stats = stats
        self._period_ticks, self._tick_wrap = period_ticks, 1 << tick_bits
        self._count: int | None = None  # of the newest sample
        self._tick = 0
        self._steps_in_tick = self._most_steps_in_tick = 0  # of the counter, per clock reading
        self._damaged = 0  # frames since the newest sample
        self.numbered = 0
        self._seen: dict[int, None] = {}  # hashes of the last samples, oldest first
        # Without a clock, a sample before the counter's last wrap can look like this one.
        turn = REMEMBERED if bits is None or period_ticks is not None else 1 << bits
        self._remembered = min(REMEMBERED, turn)

    @property
    def resets(self) -> int:
        """Number of resets of the counter, including those not yet known for sure."""
        return self.known_resets + self._unsure

    @property
    def useless(self) -> bool:
        """Whether the device's counter stands still, so it cannot reveal losses."""
        return self._standing >= STANDING

    def number(self, samples: Samples) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the sequence number of each sample, (n,), and False for duplicates, (n,).

        Sequence numbers count from 0 and go on over a reset; a gap in them is a gap in the stream.
        """
        n = len(samples)
        damaged = samples.damaged.tolist()
        if self._wrap is None or samples.count is None:
            self._stats.corrupt += sum(damaged)
            self.numbered += n
            return self.numbered - n + np.arange(n), np.ones(n, np.bool_)
        ticks = [0] * n if samples.ticks is None else samples.ticks.tolist()
        counts = samples.count.tolist()
        seq = [
            self._number_sample(counts[i], ticks[i], damaged[i], samples.values[i].tobytes())
            for i in range(n)
        ]
        if None not in seq:
            return np.array(seq, np.int64), np.ones(n, np.bool_)
        keep = np.array([number is not None for number in seq], np.bool_)
        return np.array([number or 0 for number in seq], np.int64), keep

    def _number_sample(self, count: int, tick: int, damaged: int, values: bytes) -> int | None:
        """Return the sequence number of one sample; None if it is a duplicate."""
        content = hash((count, tick, values))
        self._damaged += damaged
        gap = self._find_gap(count, tick)
        # While the clock stands still, the same content may come after a wrap of the counter.
        if content in self._seen and (gap < 0 or tick != self._tick):
            self._stats.duplicates += 1
            return None
        if gap < 0:
            stood = self.useless
            self._standing = self._standing + 1 if count == self._count else 0
            self._unsure = 0 if stood or self.useless else self._unsure + 1
            self._seen.clear()
            self._steps_in_tick = gap = 0
        elif self._count is not None:
            self.known_resets += self._unsure
            self._standing = self._unsure = 0
            self._steps_in_tick = self._steps_in_tick + gap + 1 if tick == self._tick else 0
            self._most_steps_in_tick = max(self._most_steps_in_tick, self._steps_in_tick)
        if gap:
            corrupt = min(self._damaged, gap)
            self._stats.corrupt += corrupt
            self._stats.missing += gap - corrupt
        number = self.numbered + gap
        self.numbered = number + 1
        self._count, self._tick, self._damaged = count, tick, 0
        self._seen[content] = None
        if len(self._seen) > self._remembered:
            del self._seen[next(iter(self._seen))]
        return number

    def _find_gap(self, count: int, tick: int) -> int:
        """Return the number of samples missing before this one; negative if it is not later."""
        assert self._wrap is not None
        if self._count is None:
            return 0
        ahead = (count - self._count) % self._wrap
        if ahead == 1:
            return 0
        forward = 0 < ahead <= self._wrap // 2
        period = self._period_ticks
        if period is None or ahead * period >= self._tick_wrap / 2:  # the clock is ambiguous
            return ahead - 1 if forward else -1
        passed = (tick - self._tick) % self._tick_wrap
        if passed > self._tick_wrap // 2 and self._tick_wrap >= LEAST_TURN * period:
            return -1
        steps = ahead or self._wrap
        expected = passed / period
        steps += self._wrap * max(0, round((expected - steps) / self._wrap))
        margin = 1 + self._most_steps_in_tick + RATE_TOLERANCE * expected
        if margin < self._wrap / 2 and abs(steps - expected) <= margin:
            return steps - 1
        hardly = 0 < passed < HARDLY * ahead * period
        return ahead - 1 if forward and not hardly else -1
