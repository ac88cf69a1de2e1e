"""What the native protocol sends in several CAN frames, put together: samples and descriptions."""

import struct
import zlib
from typing import Final

import numpy as np

from tactile_rt.drivers.codec import SampleBatch, WireStats
from tactile_rt.drivers.codecs.framing import crc16_xmodem
from tactile_rt.drivers.codecs.native_common import DeviceDescription, unpack_valid

__all__ = ["DescriptionParts", "SampleParts", "cut_description", "head_of", "sample_parts"]

HEAD: Final = struct.Struct("<HIBB")  # sequence, us, status, flags
FLOAT32, LONG = 1, 2  # flags: the values' type; parts of 62 bytes, not 6
FLAGS: Final = {_f | (~_f & 15) << 4 for _f in range((FLOAT32 | LONG) + 1)}
CHECK: Final = 2  # bytes of CRC
MOST_PARTS: Final = 256  # what one byte of index counts
PIECE: Final = struct.Struct("<BH")  # type and index, before each part of the description


def head_of(seq: int, time_us: int, flags: int, status: int = 0) -> bytes:
    """The header of a sample."""
    return HEAD.pack(seq & 0xFFFF, time_us & 0xFFFFFFFF, status, flags | (~flags & 15) << 4)


def sample_parts(head: bytes, body: bytes) -> list[bytes] | None:
    """The data of the frames after the header; None if there would be too many."""
    size = 62 if head[7] & LONG else 6
    body += crc16_xmodem(head + body).to_bytes(CHECK, "little")
    if len(body) > MOST_PARTS * size:
        return None
    starts = range(0, len(body), size)
    return [bytes((head[0], i)) + body[at : at + size] for i, at in enumerate(starts)]


class SampleParts:
    """Samples out of headers and parts, of the newest sample only."""

    def __init__(self, stats: WireStats) -> None:
        self._stats = stats
        self._damaged = 0
        self.forget()

    def forget(self) -> None:
        """Begin anew."""
        self.fresh = True  # no sample yet
        self._low = -1  # low byte of the newest sample's sequence; -1: none yet
        self._head: bytes | None = None  # of the sample that parts are missing of
        self._parts: list[bytes | None] = []
        self._missing = 0  # parts
        self._size = self._payload = self._last = 0  # bytes: of a part, of all, of the last part

    def refuse(self) -> None:
        """Count a frame that failed a check."""
        self._stats.corrupt += 1
        self._damaged += 1

    def header(self, batch: SampleBatch, data: bytes, described: DeviceDescription | None) -> None:
        """Take a header; what came before it has ended."""
        if len(data) != HEAD.size or data[7] not in FLAGS:
            self.refuse()
            return
        self._stats.intact += 1
        if described is None:
            return  # nothing can be said of it yet
        if data == self._head and self._missing == len(self._parts):
            return  # CAN may deliver a frame twice when its end is disturbed
        self._close(batch)
        self._described = described
        elements, channels = described.spec.shape
        itemsize = 4 if data[7] & FLOAT32 else 2
        self._payload = -(-elements // 8) + elements * channels * itemsize + CHECK
        self._size = 62 if data[7] & LONG else 6
        parts = -(-self._payload // self._size)
        self._low, self._head = data[0], data
        self._parts, self._missing = [None] * parts, parts
        self._last = self._payload - self._size * (parts - 1)

    def part(self, batch: SampleBatch, data: bytes, described: DeviceDescription | None) -> None:
        """Take a part; deliver the sample that it completes."""
        if len(data) < 3:
            self.refuse()
            return
        low, index = data[0], data[1]
        if self._head is None or low != self._low:
            self._stats.intact += 1
            if low != self._low and described is not None:
                self._without_header(batch, low)
            return
        parts = self._parts
        last = len(parts) - 1
        need = self._size if index < last else self._last
        if index > last or len(data) < need + 2:
            self.refuse()
            return
        self._stats.intact += 1
        part, before = data[2 : need + 2], parts[index]
        if before is None:
            parts[index] = part
            self._missing -= 1
            if not self._missing:
                self._close(batch)
        elif before != part:  # one of the two indices is wrong
            self._head = None
            self.refuse()

    def _without_header(self, batch: SampleBatch, low: int) -> None:
        """A part of a sample whose header was lost: the one before it has ended."""
        self._close(batch)
        if self._low >= 0:  # else it began before we listened
            self._stats.incomplete += 1
        self._low = low

    def _close(self, batch: SampleBatch) -> None:
        """Deliver the open sample, whole or not."""
        head, self._head = self._head, None
        if head is None:
            return
        if self._missing:
            self._stats.incomplete += 1
            if self._missing == len(self._parts):
                return
        shape = self._described.spec.shape
        bits, end = -(-shape[0] // 8), self._payload - CHECK
        blank = bytes(self._size)
        body = b"".join([blank if p is None else p for p in self._parts])[: self._payload]
        check = int.from_bytes(body[end:], "little")
        if not self._missing and crc16_xmodem(head + body[:end]) != check:
            self.refuse()
            return
        seq, time_us, status, flags = HEAD.unpack(head)
        valid = unpack_valid(body[:bits], shape[0])
        kind = np.dtype("<f4" if flags & FLOAT32 else "<i2")
        values = np.frombuffer(body[:end], kind, offset=bits).reshape(shape)
        if not flags & FLOAT32:
            scaled = values * np.asarray(self._described.scale)
            values = scaled.astype(np.float32)
        if self._missing:
            came = np.repeat([p is not None for p in self._parts], self._size)[:end]
            known = np.repeat(came[:bits], 8)[: shape[0]]
            known = known & came[bits:].reshape(shape[0], -1).all(axis=1)
            valid = valid & known
            values = np.where(known[:, None], values, np.float32(0))
        batch.values.append(values)
        batch.valid.append(valid)
        batch.damaged.append(self._damaged)
        batch.count.append(seq)
        batch.ticks.append(time_us)
        batch.status.append(status)
        self._damaged, self.fresh = 0, False


class DescriptionParts:
    """A description out of its parts, which come in order."""

    def __init__(self) -> None:
        self._text = bytearray()
        self._next = -1  # index; -1: none before the first

    def add(self, data: bytes) -> DeviceDescription | bool | None:
        """Take a part.

        Returns:
            The description that it completes; False if it is not one; None if it goes on.
        """
        index = int.from_bytes(data[1:3], "little")
        if index == 0:
            self._text, self._next = bytearray(), 0
        if index != self._next:
            return None  # one was lost; who wants the description asks again
        self._text += data[PIECE.size :]
        self._next += 1
        length = int.from_bytes(self._text[:2], "little") + 6
        if len(self._text) < length:
            return None
        text, check = bytes(self._text[2 : length - 4]), self._text[length - 4 : length]
        self._text, self._next = bytearray(), -1
        if zlib.crc32(text).to_bytes(4, "little") != check:
            return False
        return DeviceDescription.from_json(text) or False


def cut_description(kind: int, text: bytes, size: int) -> list[bytes]:
    """The data of the frames that carry a description."""
    whole = len(text).to_bytes(2, "little") + text + zlib.crc32(text).to_bytes(4, "little")
    starts = range(0, len(whole), size - PIECE.size)
    return [PIECE.pack(kind, i) + whole[at : at + size - PIECE.size] for i, at in enumerate(starts)]
