"""From what a codec found to chunks: the device's counter and clock become ours.

Live and replayed packets take this one way, so that a recording decodes as the stream did.
"""

from typing import Any

import numpy as np

from tactile_rt.drivers.accounting import Sequencer
from tactile_rt.drivers.codec import Codec, Samples
from tactile_rt.drivers.device_clock import DeviceClock, host_stamps
from tactile_rt.drivers.device_time import DeviceTime
from tactile_rt.stream import NS_PER_S, ArraySpec, Chunk, SourceStats

__all__ = ["Stamper"]

COUNTED_TOLERANCE = 0.1  # of a rate that is only nominal: the counter is the device's only clock


class Stamper:
    """Numbers and times a device's samples.

    Args:
        codec: what the device speaks.
        spec: what the samples are.
        stats: where losses are counted; not what is delivered.

    Attributes:
        sequencer: by the device's counter.
        clock: the device's, on the host's; None: it has neither clock nor counter.
        newest_ns: arrival of the newest sample; 0: none yet.
        status: status bits of the newest sample.
    """

    def __init__(self, codec: Codec[Any], spec: ArraySpec, stats: SourceStats) -> None:
        self.spec, self._shape = spec, spec.shape
        self.newest_ns = self.status = 0
        self._period_ns = round(NS_PER_S / spec.rate_hz)
        ticks = None if codec.tick_ns is None else self._period_ns / codec.tick_ns
        self.sequencer = Sequencer(codec.count_bits, stats, ticks, codec.tick_bits)
        self.clock: DeviceClock | DeviceTime | None = None
        if codec.tick_ns is not None:
            self.clock = DeviceClock(codec.tick_ns, codec.tick_bits)
        elif codec.count_bits is not None:
            self.clock = DeviceClock(NS_PER_S / spec.rate_hz, codec.count_bits, COUNTED_TOLERANCE)
        self._told = 0  # time given to the newest sample

    def resume(self) -> None:
        """The device was away."""
        if self.clock is not None:
            self.clock.resume()

    def chunk(self, samples: Samples) -> Chunk | None:
        """The samples that have not come before, or None."""
        if samples.values.shape[1:] != self._shape:
            return None  # the codec has counted it
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
            t_ns = host_stamps(arrived, self._told, self._period_ns)
        self._told = int(t_ns[-1])
        self.newest_ns = int(arrived[-1])
        if samples.status is not None:
            self.status = int(samples.status[-1])
        if valid.shape != values.shape[:2]:
            valid = np.broadcast_to(valid, values.shape[:2])
        return Chunk(seq, t_ns, values, valid)
