"""Frames of one length in a stream of bytes, and how many were lost between them."""

import re
from collections.abc import Callable
from typing import Final

from tactile_rt.drivers.codec import WireStats

__all__ = ["FrameFinder"]

GAP: Final = 64  # frames: what is remembered of bytes that are none
FILL: Final = 7  # bytes at most that fill a part, of a CAN frame's 8
NEAR: Final = 2  # wrong bits in a beginning: of 16 bits, noise has so few once in 500 times


class FrameFinder:
    """Finds frames that have a beginning, a length and a check, and counts the damage between them.

    The bytes between two intact frames tell how many frames were damaged there: every length of
    bytes with nearly the right beginning was one, and a shorter rest with the right one was cut
    short; what else there is was never part of a frame. Before the first intact frame only whole
    lengths count, for one joins a running stream in the middle of a frame. An answer or a boot
    message in a gap means that the device was interrupted: what it cut short is no damage.

    Args:
        sync: how a frame begins.
        size: its length, bytes.
        good: whether so many bytes that begin with `sync` are an intact frame.
        between: what else the device sends.
        stats: where to count.
        parts: whether frames come in parts of which one can be missing (a CAN bus): such a frame is
            incomplete, not corrupt, zeros may fill its last part, and the bytes beside frames are
            not counted.
        head: how a frame usually begins, if that is more than `sync`: a short one is no evidence.
    """

    def __init__(
        self,
        sync: bytes,
        size: int,
        good: Callable[[bytes], bool],
        between: re.Pattern[bytes],
        stats: WireStats,
        parts: bool = False,
        head: bytes = b"",
    ) -> None:
        self._sync, self._size, self._good, self._between = sync, size, good, between
        self._stats, self._parts, self._head = stats, parts, head or sync
        self._data, self._gap = bytearray(), bytearray()
        self._synchronised, self._damaged = False, 0

    def find(self, packet: bytes) -> tuple[list[bytes], list[int]]:
        """Take what has arrived, cut anywhere.

        Returns:
            The intact frames that it completes, and for each how many were damaged since the one
            before.
        """
        data, at = self._data, 0
        data += packet
        frames: list[bytes] = []
        damaged: list[int] = []
        while True:
            start = data.find(self._sync, at)
            if start < 0:
                start = len(data) - self._begun(at)
            self._skip(data[at:start])
            at = start
            if len(data) - at < self._size:
                break
            frame = bytes(data[at : at + self._size])
            if not self._good(frame):
                self._skip(data[at : at + 1])
                at += 1
                continue
            at += self._size
            if self._parts:
                after = data[at : at + FILL]
                at += len(after) - len(after.lstrip(b"\0"))
            frames.append(frame)
            damaged.append(self._close_gap())
        del data[:at]
        self._stats.intact += len(frames)
        return frames, damaged

    def forget(self) -> None:
        """Begin anew, as after a reconnection."""
        self._data.clear()
        self._gap.clear()
        self._synchronised, self._damaged = False, 0

    def _begun(self, at: int) -> int:
        """How many of the last bytes may become `sync`."""
        for n in range(min(len(self._sync) - 1, len(self._data) - at), 0, -1):
            if self._data.endswith(self._sync[:n]):
                return n
        return 0

    def _skip(self, some: bytearray) -> None:
        if not some:
            return
        if not self._parts:
            self._stats.skipped += len(some)
        self._gap += some
        while len(self._gap) >= GAP * self._size:
            rest = self._gap[GAP * self._size :]
            del self._gap[GAP * self._size :]
            self._count()
            self._gap = rest

    def _close_gap(self) -> int:
        if self._gap:
            self._count()
            self._gap.clear()
        self._synchronised = True
        damaged, self._damaged = self._damaged, 0
        return damaged

    def _count(self) -> None:
        gap, joined = self._gap, self._synchronised
        for message in self._between.finditer(bytes(gap)):
            gap, joined = self._gap[message.end() :], False
        if joined:
            lost = self._damaged_in(gap)
        else:
            at = gap.find(self._sync)
            lost = 0 if at < 0 else (len(gap) - at) // self._size
        if self._parts and joined and len(gap) % self._size:
            self._stats.incomplete += -(-len(gap) // self._size)
            lost = 0
        self._synchronised = joined
        self._stats.corrupt += lost
        self._damaged += lost

    def _damaged_in(self, gap: bytearray) -> int:
        """Frames that were damaged or cut short, rather than bytes that never were of a frame."""
        size, n = self._size, len(self._head)
        rest = len(gap) % size
        most = 0
        for first, at in ((0, len(gap) - rest), (rest, 0)):  # the rest came last, or first
            whole = range(first, first + len(gap) - rest, size)
            begun = rest > 0 and self._begins(gap[at : at + min(n, rest)])
            most = max(most, begun + sum(self._near(gap[k : k + n]) for k in whole))
        if rest and len(gap) > size:  # several may have been cut short
            several = sum(self._begins(gap[k : k + n]) for k in range(len(gap)))
            most = max(most, min(several, -(-len(gap) // size)))
        return most

    def _begins(self, some: bytearray) -> bool:
        return self._sync.startswith(some[: len(self._sync)]) and self._near(some)

    def _near(self, some: bytearray) -> bool:
        """Whether these bytes are how a frame begins but for a few bits."""
        usual = self._head[: len(some)]
        wrong = int.from_bytes(some, "big") ^ int.from_bytes(usual, "big")
        return wrong.bit_count() <= NEAR
