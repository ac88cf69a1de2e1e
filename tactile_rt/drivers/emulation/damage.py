"""What a fault makes of one sample's packet, and the record of it."""

import random
from array import array
from collections import Counter
from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from tactile_rt.drivers.codec import Packet
from tactile_rt.drivers.emulation.faults import Fault

__all__ = ["DeviceLog", "Fate", "damaged"]


class Fate(IntEnum):
    """What became of a sample's packet at the device's end of the line."""

    SENT = 0  # whole, once; also after random bytes
    DUPLICATED = 1  # whole, more than once
    CORRUPTED = 2  # with inverted bits; on CAN, without the frames that these were in
    TRUNCATED = 3  # without its end
    DROPPED = 4  # not sent
    OVERFLOWED = 5  # not sent: there was no room, the host did not read
    UNHEARD = 6  # not sent: nobody had the port open, or the device was pulled out


class DeviceLog:
    """What a device did with each of its samples.

    Attributes:
        counts: samples by fate.
        duplicated: packets sent beyond one per sample.
    """

    def __init__(self, kept: bool = True) -> None:
        self.counts: Counter[Fate] = Counter()
        self.duplicated = 0
        self._kept = kept
        self._seq, self._t_ns, self._fate = array("q"), array("q"), bytearray()

    @property
    def sent(self) -> int:
        """Samples that the device has numbered, whatever became of them."""
        return sum(self.counts.values())

    @property
    def seq(self) -> NDArray[np.int64]:
        """(n,) the device's counter, not wrapped; it begins anew where the device does."""
        return np.array(self._seq, np.int64)

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """(n,) the device's clock, not wrapped."""
        return np.array(self._t_ns, np.int64)

    @property
    def fate(self) -> NDArray[np.uint8]:
        """(n,) `Fate` of each."""
        return np.array(self._fate, np.uint8)

    def add(self, seq: int, t_ns: int, fate: Fate) -> int:
        """Write down one sample; return where, for `change`."""
        self.counts[fate] += 1
        if self._kept:
            self._seq.append(seq)
            self._t_ns.append(t_ns)
            self._fate.append(fate)
        return len(self._fate) - 1

    def change(self, at: int, old: Fate, new: Fate) -> None:
        """What was to be sent later became something else."""
        self.counts[old] -= 1
        self.counts[new] += 1
        if self._kept:
            self._fate[at] = new


def damaged(packet: Packet, fault: Fault, draw: random.Random) -> tuple[Packet, Fate]:
    """What a bit flip or a truncation leaves of a packet, and what to call it.

    CAN has a checksum of its own: a frame with a wrong bit does not arrive. Of a packet of bytes
    at least one is left, of frames none may be.
    """
    amount = int(fault.size)
    if fault.kind == "truncate":
        if isinstance(packet, bytes):
            return packet[: max(1, len(packet) - amount)], Fate.TRUNCATED
        return packet[: max(0, len(packet) - amount)], Fate.TRUNCATED
    if isinstance(packet, bytes):
        hurt = bytearray(packet)
        for bit in draw.sample(range(8 * len(hurt)), min(amount, 8 * len(hurt))):
            hurt[bit // 8] ^= 1 << bit % 8
        return bytes(hurt), Fate.CORRUPTED
    lost = set(draw.sample(range(len(packet)), min(amount, len(packet))))
    left: Sequence[object] = [frame for i, frame in enumerate(packet) if i not in lost]
    return left, Fate.CORRUPTED  # type: ignore[return-value]
