"""The sum that adds up, against a device whose truth is known: gaps, restarts, wraps and copies.

The device keeps its own book, sample by sample, and never looks at how the receiver decides. Its
narrow counter and its clock are all that the receiver sees. It only does what a receiver can know:
it loses no whole number of turns of the counter, and without a clock less than half a turn.
"""

import random
from dataclasses import dataclass, field

import numpy as np
import pytest

from tactile_rt.core.stream import SourceStats
from tactile_rt.drivers.accounting import Sequencer
from tactile_rt.drivers.codec import Samples

PERIOD = 1000  # ticks between samples, nominally


@dataclass
class Sent:
    """What comes over the wire for one sample."""

    number: int  # of the sample in the device's book
    count: int
    tick: int
    damaged: int


@dataclass
class Device:
    """Sends samples over a bad wire and keeps the book of it."""

    draw: random.Random
    bits: int
    clocked: bool
    stamped: int  # samples that share one reading of the clock
    period: float  # true, in ticks
    wire: list[Sent] = field(default_factory=list)
    sent = lost = damaged = twice = restarts = 0
    began = 0  # where on the wire the device began

    def run(self, events: int) -> None:
        self.base = self.draw.randrange(1 << min(self.bits, 30))
        self.origin = self.draw.randrange(1 << 20)
        self.k = 0  # samples taken since the device began
        self.deliver(0)
        for _ in range(events):
            kind = self.draw.choice(["next"] * 6 + ["gap", "gap", "damage", "copy", "restart"])
            if kind == "gap":
                self.gap(self.draw.choice([1, 2, 3, self.draw.randrange(1, self.longest())]))
            elif kind == "damage":
                self.deliver(1)
            elif kind == "copy":
                self.copy()
            elif kind == "restart":
                self.restart()
            else:
                self.deliver(0)
        self.deliver(0)

    def longest(self) -> int:
        """The longest gap that can be known."""
        half = (1 << self.bits) // 2
        if self.clocked and self.stamped == 1 and self.bits > 4:
            return min(20 * half, 3000)
        return min(half - 1, 3000)

    def deliver(self, damaged: int) -> None:
        """Take a sample, or lose one to damage and take the next."""
        self.k += damaged
        self.damaged += damaged
        self.sent += 1 + damaged
        stamp = self.k // self.stamped * self.stamped
        tick = self.origin + round(stamp * self.period)
        count = (self.base + self.k) % (1 << self.bits)
        self.wire.append(Sent(self.sent - 1, count, tick % (1 << 32), damaged))
        self.k += 1

    def gap(self, n: int) -> None:
        n -= n % (1 << self.bits) == 0  # whole turns cannot be seen
        self.k += n
        self.sent += n
        self.lost += n
        self.deliver(0)

    def copy(self) -> None:
        """Send the last few samples again, none from before the last restart."""
        some = self.draw.randrange(1, min(40, (1 << self.bits) // 4))
        newest, half = self.wire[-1].number, (1 << self.bits) // 2
        ours = self.wire[self.began :][-some:]
        if not self.clocked:
            ours = [s for s in ours if newest - s.number < half]
        fresh = {s.number: s for s in ours}
        self.twice += len(fresh)
        self.wire += [Sent(s.number, s.count, s.tick, 0) for s in fresh.values()]

    def restart(self) -> None:
        """Begin anew where the counter steps back, or where the clock does, too."""
        self.restarts += 1
        self.began = len(self.wire)
        last = self.wire[-1]
        half = (1 << self.bits) // 2
        if self.clocked and last.tick > PERIOD and self.draw.random() < 0.7:
            self.base = self.draw.choice([0, self.draw.randrange(1 << min(self.bits, 20))])
            if self.base == (last.count + 1) % (1 << self.bits):
                self.restarts -= 1  # no restart, to anyone
            self.origin = self.draw.randrange(last.tick) // 2
        else:  # the counter alone
            back = self.draw.randrange(min(half, last.count + 2) - 1)
            if self.clocked and self.stamped > 1:
                back = self.draw.randrange(min(half // 4, last.count + 1))
            self.base = (last.count - back) % (1 << self.bits)
            self.origin = last.tick + 10
        self.k = 0
        self.deliver(0)


def received(device: Device, draw: random.Random) -> tuple[SourceStats, Sequencer, list[int]]:
    """The receiver's book, after packets of any size, and the numbers it kept."""
    stats = SourceStats()
    sequencer = Sequencer(device.bits, stats, float(PERIOD) if device.clocked else None)
    kept, at = [], 0
    while at < len(device.wire):
        some = device.wire[at : at + draw.choice([1, 2, 5, 20, 100])]
        at += len(some)
        n = len(some)
        seq, keep = sequencer.number(
            Samples(
                np.array([s.number for s in some], np.float32).reshape(n, 1, 1),
                np.ones((n, 1), np.bool_),
                np.zeros(n, np.int64),
                np.array([s.damaged for s in some], np.int64),
                np.array([s.count for s in some], np.int64),
                np.array([s.tick for s in some], np.int64) if device.clocked else None,
            )
        )
        stats.delivered += int(keep.sum())
        kept += seq[keep].tolist()
    return stats, sequencer, kept


CASES = [
    (bits, stamped)
    for bits in (4, 8, 16, 32)
    for stamped in (0, 1, 2, 8, 20)  # samples that share a reading of the clock; 0: no clock
    if stamped <= (1 << bits) // 4
]


@pytest.mark.parametrize("bits, stamped", CASES)
def test_the_receivers_book_agrees_with_the_devices(bits, stamped):
    for seed in range(200):
        draw = random.Random(f"{bits} {stamped} {seed}")
        rate = draw.choice([1.0, 0.99, 1.01])
        device = Device(draw, bits, stamped > 0, stamped or 1, PERIOD * rate)
        device.run(60)
        stats, sequencer, kept = received(device, draw)
        assert (stats.missing, stats.corrupt) == (device.lost, device.damaged), seed
        assert (stats.duplicates, sequencer.resets) == (device.twice, device.restarts), seed
        whole = stats.delivered + stats.corrupt + stats.missing + stats.duplicates
        assert device.sent + device.twice == whole, seed
        numbers = dict.fromkeys(s.number for s in device.wire)
        assert kept == list(numbers), seed  # every gap is where it was, and as long
