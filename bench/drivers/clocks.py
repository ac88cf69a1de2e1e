"""How well a device's clock is followed, where the truth is known because it is made up."""

import itertools

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import NS_PER_S
from tactile_rt.drivers.clocks import DeviceClock
from tactile_rt.models.evaluation.records import Record

RATE_HZ = 1000
SETTLED_S = 30
SHORT_S, LONG_S = 60, 600
BURST_NS = 16_003_000  # of an adapter's latency timer; none is in step with a sensor
LEAST_NS, MEAN_NS = 30_000, 100_000  # of the delay besides: what nobody can know, what varies
TICK_NS = 1000.0
RESET_S = 45  # the device begins anew


class _World:
    """Samples taken at known host times, ticked by the device's clock, arriving in bursts."""

    def __init__(self, seconds: int, ppm: float, bits: int, reset: bool = False) -> None:
        draw = np.random.default_rng(1)
        n = seconds * RATE_HZ
        self.taken = 10**12 + np.arange(n, dtype=np.int64) * (NS_PER_S // RATE_HZ)
        since = (self.taken - self.taken[0]) * (1 + 1e-6 * ppm)
        self._settled = SETTLED_S * RATE_HZ
        if reset:
            at = RESET_S * RATE_HZ
            self._settled += at
            since[at:] -= since[at]
        wrap = 1 << bits
        self.ticks = (np.floor(since / TICK_NS).astype(np.int64) + (0 if reset else -3000)) % wrap
        sent = -(-(self.taken + LEAST_NS) // BURST_NS) * BURST_NS
        late = sent + draw.exponential(MEAN_NS, n).astype(np.int64)
        _, packet = np.unique(sent, return_inverse=True)
        newest = np.zeros(packet.max() + 1, np.int64)
        np.maximum.at(newest, packet, late)  # those of one burst arrive together
        self.arrived = np.maximum.accumulate(newest)[packet]
        self.clock = DeviceClock(TICK_NS, bits)
        self.told = self._told()

    def _told(self) -> NDArray[np.int64]:
        edges = [0, *(np.flatnonzero(np.diff(self.arrived)) + 1).tolist(), len(self.arrived)]
        return np.concatenate([
            self.clock.to_host(self.ticks[a:b], self.arrived[a:b])
            for a, b in itertools.pairwise(edges)
        ])  # fmt: skip

    def error_ms(self) -> float:
        """p99 of the error half a minute after the clock began, or began anew."""
        error = np.abs(self.told - self.taken) / 1e6
        return float(np.percentile(error[self._settled :], 99))

    @property
    def backwards(self) -> int:
        """Samples that are not told to be after the one before."""
        return int((np.diff(self.told) <= 0).sum())


def clocks(quick: bool) -> list[Record]:
    """Clocks 200 ppm fast and slow, read in bursts of 16 ms, of 16 and 32 bits."""
    cases = {
        f"{ppm:+g} ppm, {bits} bits": _World(SHORT_S, ppm, bits)
        for ppm in (-200.0, 200.0) for bits in (16, 32)
    }  # fmt: skip
    reset = _World(2 * SHORT_S, 200.0, 32, reset=True)
    cases["+200 ppm, restarted"] = reset
    off = {}
    for ppm in (-200.0, 200.0):
        world = _World(LONG_S, ppm, 32)
        off[ppm] = abs(world.clock.drift_ppm - 1e6 * (1 / (1 + 1e-6 * ppm) - 1))
        cases[f"{ppm:+g} ppm, {LONG_S} s"] = world
    errors = {name: world.error_ms() for name, world in cases.items()}
    how = f"arrival times computed, {RATE_HZ} Hz in bursts of 16 ms"
    return [
        Record(
            "drivers.clock.error_p99", max(errors.values()), "ms", "<= 1", f"after {SETTLED_S} s",
            f"{how}; worst of {', '.join(f'{n}: {e:.3f}' for n, e in errors.items())}",
        ),
        Record(
            "drivers.clock.drift_off", max(off.values()), "ppm", "<= 2", f"after {LONG_S} s",
            f"{how}; worst of -200 and +200 ppm",
        ),
        Record(
            "drivers.clock.backwards", sum(world.backwards for world in cases.values()), "samples",
            "== 0", "strictly increasing, across wraps (16 bits: each 65 ms) and a restart", how,
        ),
        Record(
            "drivers.clock.restarts_missed", abs(reset.clock.steps - 1), "restarts", "== 0",
            "the device's clock began anew once", how,
        ),
    ]  # fmt: skip
