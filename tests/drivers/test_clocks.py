"""A device's clock against a simulated world in which the truth is known."""

import numpy as np
import pytest

from tactile_rt.drivers.clocks import DeviceClock, DeviceTime, host_stamps

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
