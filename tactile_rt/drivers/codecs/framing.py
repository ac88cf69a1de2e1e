"""What codecs share: checksums, frames in a stream of bytes, samples that come in several frames.

A wire delivers bytes cut anywhere, some of them damaged, some missing, some noise. What is needed:
- whole frames, whatever the cuts: the result never depends on where a packet ends;
- how many frames were damaged between two good ones, since a damaged sample and one that was never
  sent are different losses (see `accounting`), and noise is neither;
- bounded memory and no waiting for a length that is itself damaged.

`ByteBuffer` is the plain tool for a codec that decides for itself: bytes, and the next place where
a frame may begin. `FrameFinder` does all of it for frames of one length. `Rounds` is the other way
up: frames (of a CAN bus, which checks them) into the samples of which each carries a part.

How `FrameFinder` counts damage. It goes from one beginning to the next; one whose frame fails its
check is passed over by one byte, so that a beginning inside a damaged frame costs nothing. The
bytes so passed over are a gap, and its length tells what was lost in it: every length of bytes with
nearly the right beginning was one damaged frame, and a shorter rest with the right one was a frame
cut short; what else there is was never part of a frame. The rest may have come first or last, so
both ways are tried, and the one that explains more counts. Before the first good frame only whole
lengths count, for one joins a running stream in the middle of a frame. An answer or a boot message
in a gap means that the device was interrupted: what that cut short is no damage. A gap that goes on
and on is settled every 64 lengths, so that noise cannot pile up.
"""

import binascii
import re
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Final, Generic, TypeVar

from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.codec import CanCodec, CanFrame, SampleBatch, Samples, WireStats

GAP: Final = 64  # frames: what is remembered of bytes that are none
FILL: Final = 7  # bytes at most that fill a part, of a CAN frame's 8
NEAR: Final = 2  # wrong bits in a beginning: of 16 bits, noise has so few once in 500 times

T = TypeVar("T")

_REVERSED: Final = bytes(int(f"{b:08b}"[::-1], 2) for b in range(256))


def _modbus_table() -> tuple[int, ...]:
    table = []
    for b in range(256):
        for _ in range(8):
            b = b >> 1 ^ (0xA001 if b & 1 else 0)
        table.append(b)
    return tuple(table)


_MODBUS: Final = _modbus_table()


def crc16_xmodem(data: bytes | bytearray | memoryview) -> int:
    """CRC-16/XMODEM: polynomial 0x1021, initial value 0 ("123456789" gives 0x31C3)."""
    return binascii.crc_hqx(data, 0)


def crc16_x25(data: bytes | bytearray) -> int:
    """CRC-16/X-25: polynomial 0x1021 reflected ("123456789" gives 0x906E)."""
    # Python has only the CRC that takes bits from the other end: turn each byte, then the result.
    crc = binascii.crc_hqx(data.translate(_REVERSED), 0xFFFF)
    return (_REVERSED[crc & 0xFF] << 8 | _REVERSED[crc >> 8]) ^ 0xFFFF


def crc16_modbus(data: bytes | bytearray | memoryview) -> int:
    """CRC-16/MODBUS: polynomial 0x8005 reflected, initial value 0xFFFF ("123456789": 0x4B37)."""
    crc = 0xFFFF
    for b in data:
        crc = crc >> 8 ^ _MODBUS[(crc ^ b) & 0xFF]
    return crc


def seal_modbus(message: bytes) -> bytes:
    """Add the CRC of a Modbus message, low byte first."""
    return message + crc16_modbus(message).to_bytes(2, "little")


def _begun(data: bytearray, sync: bytes, at: int = 0) -> int:
    """How many of the last bytes, none before a place, may become `sync`."""
    for n in range(min(len(sync) - 1, len(data) - at), 0, -1):
        if data.endswith(sync[:n]):
            return n
    return 0


class ByteBuffer:
    """Bytes that have come and are not yet taken."""

    def __init__(self) -> None:
        self.data = bytearray()

    def skip_to(self, sync: bytes) -> int:
        """Drop all before the first `sync` (or what may become one); return how many bytes."""
        at = self.data.find(sync)
        if at < 0:
            at = len(self.data) - _begun(self.data, sync)
        del self.data[:at]
        return at

    def take(self, n: int) -> bytes:
        """Take the first n bytes."""
        taken = bytes(self.data[:n])
        del self.data[:n]
        return taken


class FrameFinder:
    """Finds frames that have a beginning, a length and a check, and counts the damage between them.

    How damage is counted is told at the head of this module.

    Args:
        size: Length of a frame, bytes.
        good: Tells of `size` bytes that begin with `sync` whether they are an intact frame.
        parts: Whether frames come in parts of which one can be missing (a CAN bus): such a frame is
            incomplete, not corrupt, zeros may fill its last part, and the bytes beside frames are
            not counted.
        head: How a frame usually begins, if that is more than `sync`, since a short beginning is no
            evidence.
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
                start = len(data) - _begun(data, self._sync, at)
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


class Rounds(Generic[T]):
    """Puts parts together: a device sends 0 to n - 1 in ascending order, then begins again.

    A round ends with part n - 1, or when a part comes that is not after the one before. Nothing
    tells that a round was lost whole, or that two halves of two rounds were.
    """

    def __init__(self, parts: int) -> None:
        self._n = parts
        self.forget()

    def forget(self) -> None:
        """Begin anew; what is left of a round that we entered in the middle is no loss."""
        self._parts: list[T | None] = [None] * self._n
        self._last = -1
        self._entered = False
        self._newest: tuple[int, T] | None = None

    def add(self, index: int, part: T) -> list[list[T | None]]:
        """Take a part; return the rounds that it ends (none, one or two), None for parts not come.

        Args:
            index: Which part has come, from 0 to n - 1.
        """
        # CAN may deliver a frame twice when its end is disturbed
        if self._n > 1 and self._newest == (index, part):
            return []
        self._newest = (index, part)
        ended: list[list[T | None]] = []
        if index <= self._last:
            ended += self._end()
        self._parts[index] = part
        self._last = index
        if index == self._n - 1:
            ended += self._end()
        return ended

    def end(self) -> list[list[T | None]]:
        """End the round that has begun, if one has."""
        return self._end() if self._last >= 0 else []

    def _end(self) -> list[list[T | None]]:
        parts, self._parts, self._last = self._parts, [None] * self._n, -1
        entered, self._entered = self._entered, True
        return [parts] if entered or parts[0] is not None else []


class CodecOfParts(CanCodec):
    """A device on CAN of which each frame carries a part of a sample, see `Rounds`."""

    def __init__(self, spec: ArraySpec, parts: int) -> None:
        super().__init__(spec)
        self._shape = spec.shape
        self._rounds: Rounds[bytes] = Rounds(parts)

    @abstractmethod
    def _part(self, identifier: int, data: bytes) -> tuple[int, int] | None:
        """Which part a frame carries, and its least length; None if it is not this device's."""

    @abstractmethod
    def _sample(self, batch: SampleBatch, parts: list[bytes | None]) -> None:
        """Add the sample of a round."""

    def forget(self) -> None:
        self._rounds.forget()

    def feed(self, packet: Sequence[CanFrame], t_ns: int) -> Samples | None:
        batch, stats = SampleBatch(), self.stats
        for identifier, data, extended, _, remote in packet:
            found = None if extended or remote else self._part(identifier, data)
            if found is None:
                stats.skipped += 1
            elif len(data) < found[1]:
                stats.corrupt += 1
            else:
                stats.intact += 1
                for parts in self._rounds.add(found[0], data):
                    stats.incomplete += None in parts
                    self._sample(batch, parts)
        return batch.take(self._shape, t_ns)
