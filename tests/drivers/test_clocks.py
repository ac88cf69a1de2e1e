"""A device's clock against a simulated world in which the truth is known."""

import numpy as np
import pytest

from tactile_rt.drivers.clocks import DeviceClock, DeviceTime, SteadyClock, host_stamps

MS = 1_000_000


class World:
    """Samples taken at known host times, ticked by a device's clock, arriving late.

    Args:
        seconds: how long.
        ppm: how much faster the device's clock runs.
        burst_ms: samples arrive together, at multiples of this (a USB adapter's latency timer).
        bits: width of the device's clock, which starts just before it wraps.
    """

    def __init__(self, seconds, ppm=0.0, burst_ms=0.0, bits=32, rate=1000.0, tick_ns=1000.0):
        draw = np.random.default_rng(1)
        self.taken = np.round(1e12 + np.arange(int(seconds * rate)) * 1e9 / rate).astype(np.int64)
        since = (self.taken - self.taken[0]) * (1 + 1e-6 * ppm)
        self.wrap = 1 << bits
        self.ticks = (np.floor(since / tick_ns).astype(np.int64) + self.wrap - 3000) % self.wrap
        sent = self.taken + 30_000  # the least delay, which no one can know
        if burst_ms:
            # no timer is in step with a sensor: else some of the delay could never be seen
            period = round(burst_ms * MS * 1.0002)
            sent = -(-sent // period) * period
        late = sent + draw.exponential(100_000, len(sent)).astype(np.int64)
        _, packet = np.unique(sent, return_inverse=True)
        newest = np.zeros(packet.max() + 1, np.int64)
        np.maximum.at(newest, packet, late)
        self.arrived = np.maximum.accumulate(newest)[packet]
        self.clock = DeviceClock(tick_ns, bits)

    def told(self):
        """What the clock makes of it, packet by packet."""
        edges = [0, *np.flatnonzero(np.diff(self.arrived)) + 1, len(self.arrived)]
        parts = (
            self.clock.to_host(self.ticks[a:b], self.arrived[a:b])
            for a, b in zip(edges, edges[1:], strict=False)  # noqa: RUF007
        )
        return np.concatenate(list(parts))


@pytest.mark.parametrize("bits", [16, 32])
@pytest.mark.parametrize("burst_ms", [0.0, 16.0])
@pytest.mark.parametrize("ppm", [-200.0, 0.0, 200.0])
def test_within_a_millisecond_after_thirty_seconds(ppm, burst_ms, bits):
    world = World(45, ppm, burst_ms, bits)
    told = world.told()
    error = np.abs(told - world.taken)[30_000:]
    assert np.quantile(error, 0.99) < 1 * MS
    assert (np.diff(told) > 0).all()
    assert (told <= world.arrived).all()
    assert world.clock.steps == 0


@pytest.mark.slow
@pytest.mark.parametrize("ppm", [-200.0, 200.0])
def test_the_drift_is_known_after_ten_minutes(ppm):
    world = World(600, ppm, 16.0)
    world.told()
    true = 1e6 * (1 / (1 + 1e-6 * ppm) - 1)
    assert world.clock.drift_ppm == pytest.approx(true, abs=2.0)


@pytest.mark.parametrize("jump_s", [-3.0, -0.1, 0.1, 5.0, 2000.0])
def test_a_jump_of_the_device_s_clock_is_left_behind(jump_s):
    world = World(40, 50.0)
    world.ticks[15_000:] = (world.ticks[15_000:] + round(jump_s * 1e6)) % world.wrap
    told = world.told()
    assert world.clock.steps == 1
    assert (np.diff(told) > 0).all()
    assert np.abs(told - world.taken)[20_000:].max() < 1 * MS


@pytest.mark.parametrize("burst_ms", [0.0, 1.0])
@pytest.mark.parametrize("jump_ms", [5, 10, 15, 19, 30])
def test_a_small_jump_ahead_is_seen_where_samples_come_promptly(jump_ms, burst_ms):
    world = World(40, 50.0, burst_ms)
    world.ticks[15_000:] = (world.ticks[15_000:] + 1000 * jump_ms) % world.wrap
    told = world.told()
    assert world.clock.steps == 1
    assert (np.diff(told) > 0).all()
    assert np.abs(told - world.taken)[15_100:].max() < 1.5 * MS


def test_a_line_that_was_late_for_long_and_is_prompt_at_last_saw_no_jump():
    """16 ms of an adapter's timer, and then it is told to wait no longer."""
    world = World(40, 50.0, 16.0)
    prompt = World(40, 50.0)
    world.arrived[20_000:] = np.maximum(prompt.arrived[20_000:], world.arrived[19_999])
    told = world.told()
    assert world.clock.steps == 0
    assert np.abs(told - world.taken)[30_000:].max() < 1 * MS


def test_a_device_that_begins_anew_is_followed():
    world = World(40)
    world.ticks[15_000:] = np.arange(len(world.ticks) - 15_000) * 1000
    told = world.told()
    assert world.clock.steps == 1
    assert np.abs(told - world.taken)[15_000:].max() < 2 * MS


def test_a_host_that_slept_does_not_move_the_clock():
    world = World(40)
    stuck = (world.taken >= world.taken[15_000]) & (world.taken < world.taken[18_000])
    world.arrived[stuck] = world.arrived[18_000]  # three seconds come at once
    told = world.told()
    assert world.clock.steps == 0
    assert np.abs(told - world.taken).max() < 1 * MS


def test_a_host_that_slept_as_the_device_began_saw_no_jump():
    world = World(10)
    world.arrived[:1100] = world.arrived[1100]  # read one by one, all of them late
    told = np.concatenate(
        [world.clock.to_host(world.ticks[k : k + 1], world.arrived[k : k + 1]) for k in range(9000)]
    )
    assert world.clock.steps == 0
    assert np.abs(told - world.taken[:9000])[2000:].max() < 1 * MS


def test_a_device_that_was_away_did_not_jump():
    world = World(10)
    world.clock.to_host(world.ticks[:5000], world.arrived[:5000])
    world.clock.resume()
    told = world.clock.to_host(world.ticks[:5000], world.arrived[5000:])
    assert world.clock.steps == 0
    assert np.abs(told - world.taken[5000:]).max() < 1 * MS


def test_samples_without_time_or_count_are_spread_before_their_arrival():
    arrived = np.full(4, 100 * MS)
    assert host_stamps(arrived, 0, 10 * MS).tolist() == [70 * MS, 80 * MS, 90 * MS, 100 * MS]
    squeezed = host_stamps(arrived, 80 * MS, 10 * MS)
    assert squeezed.tolist() == [85 * MS, 90 * MS, 95 * MS, 100 * MS]
    late = host_stamps(arrived, 100 * MS, 10 * MS)  # something was dated after it already
    assert (np.diff(late) > 0).all() and late[0] > 100 * MS


def packets_of(taken, seed, busy):
    """Samples and arrivals as a host reads them that waits for a processor every so often."""
    rng, at, now = np.random.default_rng(seed), 0, 0
    while at < len(taken):
        now = max(now, int(taken[at])) + int(rng.exponential(0.3 * MS))
        if rng.random() < busy:
            now += int(rng.exponential(60 * MS))
        end = max(at + 1, int(np.searchsorted(taken, now, side="right")))
        yield slice(at, end), np.full(end - at, now)
        at = end


def dated(taken, nominal_hz, busy=0.1, seed=1):
    """Errors of the times, ms, by a steady rate, and by arrival."""
    clock, told, before = SteadyClock(round(1e9 / nominal_hz)), [], [0]
    arrived = []
    for _, at in packets_of(taken, seed, busy):
        told += clock.to_host(at).tolist()
        before += host_stamps(at, before[-1], round(1e9 / nominal_hz)).tolist()
        arrived += at.tolist()
    assert (np.diff(told) > 0).all()
    assert (np.array(told) <= np.array(arrived) + len(told)).all()
    return (np.array(told) - taken) / MS, (np.array(before[1:]) - taken) / MS, clock


@pytest.mark.parametrize("rate_hz", [70, 80, 97, 100, 130])
def test_a_steady_rate_dates_samples_that_a_busy_host_reads_late(rate_hz):
    taken = np.round(np.arange(3000) * 1e9 / rate_hz).astype(np.int64)
    steady, by_arrival, clock = dated(taken, 100)
    late = slice(10 * rate_hz, -50)
    assert np.abs(steady[late]).max() < 1 and clock.lost == 0
    assert np.percentile(np.abs(by_arrival[late]), 95) > 4


@pytest.mark.parametrize("rate_hz", [30, 300])
def test_where_the_rate_is_another_the_arrival_dates_samples(rate_hz):
    taken = np.round(np.arange(3000) * 1e9 / rate_hz).astype(np.int64)
    steady, by_arrival, _ = dated(taken, 100, busy=0.02)
    late = slice(6 * rate_hz, -50)
    assert np.abs(steady[late]).mean() < 1.2 * np.abs(by_arrival[late]).mean() + 0.1


def test_a_sample_that_is_lost_shows_in_those_after_it():
    taken = np.arange(6000) * 10 * MS
    kept = np.delete(taken, [1500, 3000, 3001, 4500])
    steady, _, clock = dated(kept, 100)
    assert clock.lost == 4
    assert np.abs(steady[:-50]).max() < 21 and np.median(np.abs(steady)) < 0.1
    often = taken[np.random.default_rng(0).random(6000) > 0.03]
    steady, by_arrival, _ = dated(often, 100)
    assert np.abs(steady).mean() < 1.3 * np.abs(by_arrival).mean()


def test_after_a_silence_nothing_is_dated_before_it():
    taken = np.arange(4000) * 10 * MS
    taken[2000:] += 1500 * MS
    steady, _, _ = dated(taken, 100, busy=0)
    assert np.abs(steady[2000:]).max() < 2


def test_device_time_unwraps_and_never_goes_back() -> None:
    clock = DeviceTime(1000.0, 32)
    first, arrived = 2**32 - 3000, np.arange(6) * 1_000_000
    ticks = (first + 1000 * np.arange(6)) % 2**32
    told = clock.to_host(ticks, arrived)
    assert told.tolist() == [(first + 1000 * i) * 1000 for i in range(6)]
    clock.resume()
    assert clock.to_host(ticks[-1:] + 1000, arrived[-1:] + 1).tolist() == [told[-1] + 1_000_000]
    # it begins anew two milliseconds later, by the host's clock
    anew = clock.to_host(np.array([0, 1000]), arrived[-1:].repeat(2) + 2_000_001)
    assert anew.tolist() == [told[-1] + 3_000_000, told[-1] + 4_000_000] and clock.steps == 1
    same = clock.to_host(np.array([1000]), arrived[-1:] + 3_000_000)
    assert same[0] == anew[-1] + 1


def test_a_short_clock_only_goes_forward() -> None:
    clock = DeviceTime(100_000.0, 16)
    told = clock.to_host(np.array([65_000, 60_000]), np.array([0, 1]))
    assert np.diff(told).tolist() == [(65_536 - 5_000) * 100_000] and clock.steps == 0
