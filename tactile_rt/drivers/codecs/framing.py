"""Tools of the codecs: checksums, finders of frames in a stream, samples from several frames.

A wire delivers bytes cut anywhere, some of them damaged, some missing, some noise. Requirements:
- whole frames, whatever the cuts: the result never depends on where a packet ends;
- the number of damaged frames between two good ones, since a damaged and an unsent sample are
  different losses (see `accounting`), and noise is no loss;
- bounded memory and no waiting for a length that is itself damaged.

`ByteBuffer` is for a codec with its own search: it holds bytes and finds the next place where a
frame may begin. `FrameFinder` does all this for frames of fixed length. `Rounds` assembles samples
from the frames of a CAN bus (which checks them), each of which carries a part of a sample.

Damage count of `FrameFinder`. It goes from one sync to the next; if the frame there fails its
check, it skips one byte only, so that a sync inside a damaged frame costs no later frame. The
skipped bytes are a gap, whose length shows its losses: each frame length of bytes with nearly the
right beginning was a damaged frame, and a shorter rest with the right beginning was a frame cut
short; all other bytes were never part of a frame. The rest may have come first or last, so both are
tried, and the larger count is used. Before the first good frame only whole lengths count,
since a host joins a running stream within a frame. An answer or a boot message in a gap means that
the device was interrupted: a frame cut short by it is no damage. A long gap is evaluated every 64
lengths, so that noise cannot pile up.
"""

import binascii
import re
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Final, Generic, TypeVar

from tactile_rt.core.stream import ArraySpec
from tactile_rt.drivers.codec import CanCodec, CanFrame, SampleBatch, Samples, WireStats

GAP: Final = 64  # longest gap, in frames, before it is evaluated
FILL: Final = 7  # most bytes of padding in a CAN frame of 8
NEAR: Final = 2  # wrong bits in a beginning: of 16 bits, noise has so few once in 500 times

T = TypeVar("T")

_REVERSED: Final = bytes(int(f"{b:08b}"[::-1], 2) for b in range(256))


def _make_modbus_table() -> tuple[int, ...]:
    table = []
    for b in range(256):
        for _ in range(8):
            b = b >> 1 ^ (0xA001 if b & 1 else 0)
        table.append(b)
    return tuple(table)


_MODBUS: Final = _make_modbus_table()


def crc16_xmodem(data: bytes | bytearray | memoryview) -> int:
    """Return the CRC-16/XMODEM: polynomial 0x1021, initial value 0 ("123456789": 0x31C3)."""
    return binascii.crc_hqx(data, 0)


def crc16_x25(data: bytes | bytearray) -> int:
    """Return the CRC-16/X-25: polynomial 0x1021 reflected ("123456789": 0x906E)."""
    # Python has only the unreflected CRC: reverse the bits of each byte, then of the result.
    crc = binascii.crc_hqx(data.translate(_REVERSED), 0xFFFF)
    return (_REVERSED[crc & 0xFF] << 8 | _REVERSED[crc >> 8]) ^ 0xFFFF


def crc16_modbus(data: bytes | bytearray | memoryview) -> int:
    """Return the CRC-16/MODBUS: 0x8005 reflected, initial value 0xFFFF ("123456789": 0x4B37)."""
    crc = 0xFFFF
    for b in data:
        crc = crc >> 8 ^ _MODBUS[(crc ^ b) & 0xFF]
    return crc


def seal_modbus(message: bytes) -> bytes:
    """Return a Modbus message with its CRC appended, low byte first."""
    return message + crc16_modbus(message).to_bytes(2, "little")


def _find_partial(data: bytearray, sync: bytes, at: int = 0) -> int:
    """Return how many bytes at the end of `data[at:]` may begin an incomplete `sync`."""
    for n in range(min(len(sync) - 1, len(data) - at), 0, -1):
        if data.endswith(sync[:n]):
            return n
    return 0


class ByteBuffer:
    """Buffer of received bytes that are not yet decoded."""

    def __init__(self) -> None:
        self.data = bytearray()

    def skip_to(self, sync: bytes) -> int:
        """Drop the bytes before the first, maybe incomplete, `sync`; return their number."""
        at = self.data.find(sync)
        if at < 0:
            at = len(self.data) - _find_partial(self.data, sync)
        del self.data[:at]
        return at

    def take(self, n: int) -> bytes:
        """Remove and return the first n bytes."""
        taken = bytes(self.data[:n])
        del self.data[:n]
        return taken


class FrameFinder:
    """Finder of frames with a fixed beginning, length and check; it counts damaged frames.

    This module's docstring describes the count.

    Args:
        size: Length of a frame, bytes.
        good: Returns whether `size` bytes that begin with `sync` are an intact frame.
        between: Messages that the device may send between frames.
        parts: Whether frames come in parts of which one can be missing (a CAN bus): such a frame is
            incomplete, not corrupt, zeros may fill its last part, and bytes between frames are not
            counted.
        head: Usual beginning of a frame, if longer than `sync`, since a short one proves little.
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
        """Return the intact frames that these bytes complete; the bytes may be cut anywhere.

        Returns:
            The frames, and for each the number of damaged ones since the previous frame.
        """
        data, at = self._data, 0
        data += packet
        frames: list[bytes] = []
        damaged: list[int] = []
        while True:
            start = data.find(self._sync, at)
            if start < 0:
                start = len(data) - _find_partial(data, self._sync, at)
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
        """Discard all state, as after a reconnection."""
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
            self._evaluate_gap()
            self._gap = rest

    def _close_gap(self) -> int:
        if self._gap:
            self._evaluate_gap()
            self._gap.clear()
        self._synchronised = True
        damaged, self._damaged = self._damaged, 0
        return damaged

    def _evaluate_gap(self) -> None:
        gap, joined = self._gap, self._synchronised
        for message in self._between.finditer(bytes(gap)):
            gap, joined = self._gap[message.end() :], False
        if joined:
            lost = self._count_damaged(gap)
        else:
            at = gap.find(self._sync)
            lost = 0 if at < 0 else (len(gap) - at) // self._size
        if self._parts and joined and len(gap) % self._size:
            self._stats.incomplete += -(-len(gap) // self._size)
            lost = 0
        self._synchronised = joined
        self._stats.corrupt += lost
        self._damaged += lost

    def _count_damaged(self, gap: bytearray) -> int:
        """Return how many frames were damaged or cut short in a gap."""
        size, n = self._size, len(self._head)
        rest = len(gap) % size
        most = 0
        for first, at in ((0, len(gap) - rest), (rest, 0)):  # the rest is last, or first
            whole = range(first, first + len(gap) - rest, size)
            part = rest > 0 and self._may_begin_frame(gap[at : at + min(n, rest)])
            most = max(most, part + sum(self._is_near_head(gap[k : k + n]) for k in whole))
        if rest and len(gap) > size:  # several may have been cut short
            several = sum(self._may_begin_frame(gap[k : k + n]) for k in range(len(gap)))
            most = max(most, min(several, -(-len(gap) // size)))
        return most

    def _may_begin_frame(self, some: bytearray) -> bool:
        return self._sync.startswith(some[: len(self._sync)]) and self._is_near_head(some)

    def _is_near_head(self, some: bytearray) -> bool:
        """Return whether these bytes differ from a frame's beginning by at most `NEAR` bits."""
        usual = self._head[: len(some)]
        wrong = int.from_bytes(some, "big") ^ int.from_bytes(usual, "big")
        return wrong.bit_count() <= NEAR


class Rounds(Generic[T]):
    """Assembler of samples from parts 0 to n - 1, sent in ascending order, repeatedly.

    A round is the parts of one sample. It ends with part n - 1, or when a part comes whose number
    is not higher. The loss of a round, or of adjacent halves of two rounds, cannot be detected.
    """

    def __init__(self, parts: int) -> None:
        self._n = parts
        self.forget()

    def forget(self) -> None:
        """Discard all state; a first round without its beginning will not count as lost."""
        self._parts: list[T | None] = [None] * self._n
        self._last = -1
        self._entered = False
        self._newest: tuple[int, T] | None = None

    def add(self, index: int, part: T) -> list[list[T | None]]:
        """Add a part; return the rounds that it ends, with None for missing parts.

        Args:
            index: Number of the part, from 0 to n - 1.
        """
        # CAN may deliver a frame twice when its end is disturbed
        if self._n > 1 and self._newest == (index, part):
            return []
        self._newest = (index, part)
        ended: list[list[T | None]] = []
        if index <= self._last:
            ended += self._end_round()
        self._parts[index] = part
        self._last = index
        if index == self._n - 1:
            ended += self._end_round()
        return ended

    def end(self) -> list[list[T | None]]:
        """End the unfinished round; return it in a list, empty without one."""
        return self._end_round() if self._last >= 0 else []

    def _end_round(self) -> list[list[T | None]]:
        parts, self._parts, self._last = self._parts, [None] * self._n, -1
        entered, self._entered = self._entered, True
        return [parts] if entered or parts[0] is not None else []


class CodecOfParts(CanCodec):
    """Base of codecs of CAN devices that send samples in several frames; see `Rounds`."""

    def __init__(self, spec: ArraySpec, parts: int) -> None:
        super().__init__(spec)
        self._shape = spec.shape
        self._rounds: Rounds[bytes] = Rounds(parts)

    @abstractmethod
    def _identify_part(self, identifier: int, data: bytes) -> tuple[int, int] | None:
        """Return (number of the part in a frame, least data length); None for other devices."""

    @abstractmethod
    def _add_sample(self, batch: SampleBatch, parts: list[bytes | None]) -> None:
        """Decode the parts of one sample, None if missing, and add it to the batch."""

    def forget(self) -> None:
        self._rounds.forget()

    def feed(self, packet: Sequence[CanFrame], t_ns: int) -> Samples | None:
        batch, stats = SampleBatch(), self.stats
        for identifier, data, extended, _, remote in packet:
            found = None if extended or remote else self._identify_part(identifier, data)
            if found is None:
                stats.skipped += 1
            elif len(data) < found[1]:
                stats.corrupt += 1
            else:
                stats.intact += 1
                for parts in self._rounds.add(found[0], data):
                    stats.incomplete += None in parts
                    self._add_sample(batch, parts)
        return batch.take(self._shape, t_ns)
