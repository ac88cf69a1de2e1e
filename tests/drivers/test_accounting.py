"""Which samples were lost: the sender's book against the receiver's."""

import numpy as np
import pytest

from tactile_rt.core.stream import SourceStats
from tactile_rt.drivers.accounting import REMEMBERED, Sequencer
from tactile_rt.drivers.codec import Samples


def samples(counts, damaged=None, ticks=None, content=None):
    n = len(counts)
    values = np.asarray(counts if content is None else content, np.float32).reshape(n, 1, 1)
    return Samples(
        values,
        np.ones((n, 1), np.bool_),
        np.arange(n, dtype=np.int64),
        np.array(damaged or [0] * n, np.int64),
        np.array(counts, np.int64),
        None if ticks is None else np.array(ticks, np.int64),
    )


@pytest.mark.parametrize("clock", [None, 1000.0])
def test_a_counter_that_stands_is_none_until_it_goes_on(clock):
    sequencer = Sequencer(16, SourceStats(), clock)
    found = []
    for k in range(60):
        count = k if k < 20 or k >= 40 else 20
        sequencer.number(samples([count], content=[float(k)], ticks=[1000 * k]))
        found.append(sequencer.useless)
    assert not any(found[:24]) and all(found[25:40]) and not any(found[40:])
    assert sequencer.resets == 0, "what stands was not begun anew"


def test_noise_between_samples_is_no_lost_sample():
    stats = SourceStats()
    Sequencer(16, stats).number(samples([0, 1, 2], [0, 5, 0]))
    assert stats == SourceStats()


@pytest.mark.parametrize("first", [500, 0])  # from 0 at once it does not repeat itself
def test_a_counter_that_begins_anew_loses_nothing(first):
    stats = SourceStats()
    sequencer = Sequencer(16, stats)
    counts = [first, first + 1, first + 2, 0, 1, 2]
    seq, keep = sequencer.number(samples(counts, content=range(6)))
    assert keep.all() and seq.tolist() == [0, 1, 2, 3, 4, 5]
    assert sequencer.resets == 1 and stats == SourceStats()


def test_a_counter_that_jumps_ahead_of_the_clock_lost_nothing():
    stats = SourceStats()
    sequencer = Sequencer(16, stats, period_ticks=1000.0)
    seq, _ = sequencer.number(samples([7, 8, 900, 901], ticks=[0, 1000, 2000, 3000]))
    assert seq.tolist() == [0, 1, 2, 3]
    assert stats.missing == 0 and sequencer.resets == 1


@pytest.mark.parametrize("bits, damaged", [(None, 0), (None, 3), (16, 2)])
def test_a_device_that_does_not_count_shows_damage_only(bits, damaged):
    """Ever, or in this packet."""
    stats = SourceStats()
    one = samples([0, 0, 0], [0, damaged, 0])
    one = Samples(one.values, one.valid, one.arrived_ns, one.damaged)
    seq, keep = Sequencer(bits, stats).number(one)
    assert seq.tolist() == [0, 1, 2] and keep.all()
    assert stats == SourceStats(corrupt=damaged)


def test_a_step_of_half_the_counter_is_a_gap_and_of_more_a_restart():
    for step, missing, resets in ((128, 127, 0), (129, 0, 1)):
        stats = SourceStats()
        sequencer = Sequencer(8, stats)
        sequencer.number(samples([7, 7 + step], content=[1, 2]))
        assert (stats.missing, sequencer.resets) == (missing, resets)


def test_a_copy_is_known_for_as_long_as_is_remembered():
    for later, duplicates in ((REMEMBERED, 1), (REMEMBERED + 1, 0)):
        stats = SourceStats()
        counts = [*range(later), 0]
        sent = samples(counts, ticks=[10 * count for count in counts])
        Sequencer(16, stats, period_ticks=10.0).number(sent)
        assert stats.duplicates == duplicates


def test_a_constant_signal_is_no_copy_of_itself_a_turn_of_the_counter_later():
    stats = SourceStats()
    counts = [k % 256 for k in range(1000)]
    _, keep = Sequencer(8, stats).number(samples(counts, content=[3.0] * 1000))
    assert keep.all() and stats == SourceStats()


def test_what_came_a_turn_of_the_counter_ago_or_before_it_began_anew_is_no_copy():
    stats = SourceStats()
    sequencer = Sequencer(4, stats)
    sequencer.number(samples([k % 16 for k in range(24)], content=[k // 16 for k in range(24)]))
    for count, duplicates, resets in ((7, 1, 0), (3, 1, 1)):  # of this turn; of the one before
        sequencer.number(samples([count], content=[count == 7]))
        assert (stats.duplicates, sequencer.resets) == (duplicates, resets)
    stats = SourceStats()
    sequencer = Sequencer(16, stats)
    sequencer.number(samples([20_005, 60_010, 10_000, 25_000, 20_005]))
    assert (stats.duplicates, sequencer.resets) == (0, 2)


PACKET, TICKS = 8, 1000  # samples that share a reading of the clock; its ticks to a sample


@pytest.mark.parametrize("off, missing, resets", [(-11, 179, 0), (11, 179, 0), (12, 0, 1)])
def test_the_clock_bears_a_gap_out_within_a_packet_and_two_percent(off, missing, resets):
    """A step of 180 of an 8-bit counter: more than half, so that it may be a step back, too."""
    stats = SourceStats()
    sequencer = Sequencer(8, stats, float(TICKS))
    first = list(range(3 * PACKET))
    ticks = [TICKS * PACKET * (k // PACKET) for k in first]
    passed = TICKS * (180 + off)
    sequencer.number(samples([*first, first[-1] + 180], ticks=[*ticks, ticks[-1] + passed]))
    # 1 + (a packet less one) + 2 % of about 190 is between 11 and 12
    assert (stats.missing, sequencer.resets) == (missing, resets)


@pytest.mark.parametrize(
    "bits, tick_bits, period, ahead, passed, missing, resets",
    [
        # a clock that wraps sooner than 10,000 samples cannot show that it went back
        (16, 16, 1000.0, 2, 40_000, 1, 0),
        # one that does not can, from half of its turn on
        (16, 16, 1.0, 25_000, 25_000, 24_999, 0),
        (16, 16, 1.0, 2, 40_000, 0, 1),
        # a gap of half the clock's turn, or more: it tells nothing
        (16, 16, 1024.0, 32, 5, 31, 0),
        (16, 16, 1024.0, 40, 5, 39, 0),
        (16, 16, 1024.0, 31, 5, 0, 1),
        # it hardly moved: by less than a quarter of what the counter says
        (16, 32, 1000.0, 900, 224_999, 0, 1),
        (16, 32, 1000.0, 900, 225_000, 899, 0),
        (16, 32, 1000.0, 900, 300_000, 899, 0),
        (16, 32, 1000.0, 900, 1, 0, 1),
        (16, 32, 1000.0, 900, 0, 899, 0),
        # half of its turn, and a tick more
        (16, 16, 4.0, 8000, 32_768, 7999, 0),
        (16, 16, 4.0, 8000, 32_769, 0, 1),
        # whole turns of an 8-bit counter: 101 samples that the clock may be off, and half a turn
        (8, 16, 4.0, 86, 19_800, 4949, 0),
        (8, 16, 4.0, 206, 25_400, 0, 1),
    ],
)
def test_what_the_clock_says_of_a_step(bits, tick_bits, period, ahead, passed, missing, resets):
    stats = SourceStats()
    sequencer = Sequencer(bits, stats, period, tick_bits)
    sequencer.number(samples([100, 100 + ahead], ticks=[7, (7 + passed) % 2**tick_bits]))
    assert (stats.missing, sequencer.resets) == (missing, resets)
