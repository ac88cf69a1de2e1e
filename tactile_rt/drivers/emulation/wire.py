"""How long bytes and frames take on a line, and what a host hears that listens too fast or slowly.

Sources: the frame of a UART (a start bit, eight bits, the lowest first, a parity bit if there is
one, a stop bit); ISO 11898-1 for the bits of a CAN frame, without stuff bits, as in the tables of
docs/reference/native-protocol.md.
"""

import math
from collections.abc import Sequence
from typing import Final

from tactile_rt.drivers.codec import CanFrame

__all__ = ["Wire", "bytes_s", "frames_s", "misheard"]

STANDARD, EXTENDED = 47, 67  # bits of a frame beside its data, the gap to the next one included
FD_SLOW, FD_SLOW_EXTENDED = 30, 49  # of CAN FD, at the speed of the arbitration
FD_FAST, FD_FAST_LONG = 31, 36  # at that of the data: up to 16 bytes, and more
LONG: Final = 16


class Wire:
    """A line on which one thing follows the other.

    Attributes:
        gather_s: Time for which an adapter gathers what has come before it hands it on, s: 1 ms by
            USB, 16 ms by FTDI's as they are delivered.
    """

    def __init__(self) -> None:
        self.gather_s = 0.0
        self._free_at = -math.inf

    def heard_at(self, takes_s: float, now: float) -> float:
        """When something is at the other end that is sent now and takes so long.

        Args:
            takes_s: the time that it takes on the line, s.
            now: the present, s, on a clock that never goes back.
        """
        self._free_at = max(self._free_at, now) + takes_s
        if self.gather_s:
            return math.ceil(self._free_at / self.gather_s) * self.gather_s
        return self._free_at


def bytes_s(n: int, baud: int, parity: str = "N") -> float:
    """The time that bytes take on a serial line, s."""
    return n * (10 if parity == "N" else 11) / baud


def frames_s(frames: Sequence[CanFrame], bitrate: int, data_bitrate: int | None = None) -> float:
    """The time that frames take on a CAN bus, s."""
    slow = fast = 0
    for frame in frames:
        n = 0 if frame.remote else len(frame.data)
        if frame.fd:
            slow += FD_SLOW_EXTENDED if frame.extended else FD_SLOW
            fast += (FD_FAST if n <= LONG else FD_FAST_LONG) + 8 * n
        else:
            slow += (EXTENDED if frame.extended else STANDARD) + 8 * n
    return slow / bitrate + fast / (data_bitrate or bitrate)


def misheard(data: bytes, spoken: int, heard: int) -> bytes:
    """What a receiver makes of bytes that follow each other at another speed than its own.

    It looks at the line in the middle of its own bits, from the edge of each start bit on.

    Args:
        spoken: the speed at which it is sent, bit/s.
        heard: the speed that the receiver is set to, bit/s.
    """
    line = [bit for byte in data for bit in (0, *(byte >> k & 1 for k in range(8)), 1)]
    line += [1] * 20
    step = spoken / heard
    found, at = bytearray(), 0.0
    while at < len(line) - 20:
        if line[int(at)]:  # idle: until the next edge
            at = math.floor(at) + 1.0
            continue
        places = [int(at + (k + 1.5) * step) for k in range(8)]
        bits = [line[p] if p < len(line) else 1 for p in places]
        found.append(sum(bit << k for k, bit in enumerate(bits)))
        at += 9.5 * step
    return bytes(found)
