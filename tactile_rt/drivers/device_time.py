"""A device's own clock, unwrapped: for what must not depend on when samples arrived.

A classifier that resamples by the host's time gives slightly other results at every run, as
arrival times differ. By the device's own time a stream gives the same ones however it comes.
"""

from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["DeviceTime"]

LONG_NS: Final = 60_000_000_000  # a clock that wraps sooner cannot show that it went back


class DeviceTime:
    """Stands in for `DeviceClock`: gives the device's time instead of the host's.

    The first sample has the time that its clock shows. A clock that leaps forward makes a silence;
    one that goes back or begins anew goes on from the last sample's time after the time that passed
    on the host's clock.

    Args:
        tick_ns: length of a tick, ns.
        bits: the counter wraps at 2^bits.

    Attributes:
        drift_ppm: 0: nothing is compared.
        steps: times that the clock went back or began anew.
    """

    drift_ppm = 0.0

    def __init__(self, tick_ns: float, bits: int) -> None:
        self.steps = 0
        self._tick_ns, self._wrap = tick_ns, 1 << bits
        self._can_go_back = self._wrap * tick_ns >= LONG_NS
        self._tick: int | None = None  # of the last sample
        self._arrived = self._told = 0
        self._ticks, self._origin = 0, 0  # since the clock began, and its time then, ns

    def to_host(self, ticks: NDArray[np.int64], arrived_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """(n,) device times of samples, ns: strictly increasing.

        Args:
            ticks: (n,) the counter as it came.
            arrived_ns: (n,) host times of arrival, never decreasing.
        """
        told = np.empty(len(ticks), np.int64)
        for i, (tick, arrived) in enumerate(zip(ticks.tolist(), arrived_ns.tolist(), strict=True)):
            if self._tick is None:
                self._ticks = tick
            else:
                ahead = (tick - self._tick) % self._wrap
                if self._can_go_back and ahead > self._wrap // 2:
                    self.steps += 1
                    self._origin = self._told + max(1, arrived - self._arrived)
                    self._ticks = 0
                else:
                    self._ticks += ahead
            t = self._origin + round(self._ticks * self._tick_ns)
            self._told = t if self._tick is None else max(t, self._told + 1)
            self._tick, self._arrived = tick, arrived
            told[i] = self._told
        return told

    def resume(self) -> None:
        """The device was away; its clock tells whether it began anew."""
