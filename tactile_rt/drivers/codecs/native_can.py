"""The native protocol over CAN and CAN FD: see docs/reference/native-protocol.md.

    base      host     command: type u8, payload
    base + 1  device   ACK: type u8 (6), type acknowledged u8, 0 or an error number u8
    base + 2  device   header of a sample: sequence u16, time in us u32, status u8, flags u8 (low
                       four bits: 1 float32, 2 parts of 62 bytes; high four: the same inverted)
    base + 3  device   part of a sample: low byte of its sequence u8, index u8, payload
    base + 4  device   part of the description: type u8 (2), index u16, payload

all little-endian. A sample is its header, then its parts with indices from 0. Joined, the parts are
the payload of the serial form (one bit of validity per element, then the values) and the
CRC-16/XMODEM of header and payload: CAN has a CRC, but the path from the bus to a program often has
none. The description is its length u16, the JSON of the serial form, and the CRC-32 of that; it
ends with an ACK. Commands win arbitration, so that a device that fills the bus can still be
stopped.
"""

import struct
import zlib
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import (
    CanCodec,
    CanFrame,
    Command,
    SampleBatch,
    Samples,
    Step,
    WireStats,
)
from tactile_rt.drivers.codecs import native_common as common
from tactile_rt.drivers.codecs.framing import crc16_xmodem
from tactile_rt.drivers.codecs.native_common import DeviceDescription, MessageType, NativeOptions

COMMAND, ACK, HEADER, PART, DESCRIPTION = range(5)  # identifiers, relative to the base
WHISKING: Final = struct.Struct("<BHhh")  # type, mHz, 0.1 mrad twice: one frame, so one change
LENGTHS: Final = (8, 12, 16, 20, 24, 32, 48, 64)  # of CAN FD frames, above 7
HEAD: Final = struct.Struct("<HIBB")  # sequence, us, status, flags
FLOAT32, LONG = 1, 2  # flags: the values' type; parts of 62 bytes, not 6
FLAGS: Final = {_f | (~_f & 15) << 4 for _f in range((FLOAT32 | LONG) + 1)}
CHECK: Final = 2  # bytes of CRC
MOST_PARTS: Final = 256  # since the index is one byte
PIECE: Final = struct.Struct("<BH")  # type and index, before each part of the description


@dataclass(frozen=True)
class NativeCanOptions(NativeOptions):
    """Options of the native protocol over CAN, in addition to those of the serial one.

    Attributes:
        base: The first of the device's five identifiers, of 11 bits.
        fd: Whether commands, and the frames of an emulated device, are CAN FD. A host accepts
            samples in both.
    """

    format: str = "int16"
    base: int = 0x100
    fd: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 <= self.base <= 0x7FF - DESCRIPTION:
            raise ConfigError(
                f"base must be from 0 to {0x7FF - DESCRIPTION:#x}, so that base to base + 4 have "
                f"11 bits, not {self.base:#x}"
            )


class NativeCan(CanCodec):
    """Codec of the reference firmware over CAN, with a counter, time and self-description.

    A device queues its frames first-in-first-out, not by identifier. A sample ends when all parts
    have come, or else with the next sample's first frame; then the elements with a lost part are
    invalid, and only CAN's checksum covers the others. A sample that lost its header, or all
    frames but its header, is not delivered: its number is missing.
    """

    Options = NativeCanOptions
    data_bitrate = 8_000_000  # 35 elements x 6 x int16 at 1 kHz take 1.09 ms a sample at 5 Mbit/s
    count_bits = 16
    tick_ns = 1000.0
    status_bits = common.STATUS
    harmless_bits = common.HARMLESS
    describes = True
    cannot_detect = "65,536 samples lost in succession (over CAN)"

    @classmethod
    def variants(cls, identifiers: Collection[int] = ()) -> list[dict[str, str]]:
        return [
            {"base": f"{first - HEADER:#x}"}
            for first in identifiers
            if first - HEADER != NativeCanOptions.base
            and first >= HEADER
            and first + PART - HEADER in identifiers
            and first - HEADER <= 0x7FF - DESCRIPTION
        ]

    def __init__(self, options: NativeCanOptions) -> None:
        super().__init__(None)
        self._options, self._base, self._fd = options, options.base, options.fd
        self.serial_number = options.serial_number
        self._device_description: DeviceDescription | None = None
        self._assembler = SampleParts(self.stats)
        self._description_parts = DescriptionParts()
        self.streaming = False
        self.whisking: tuple[float, float, float] | None = None  # as last commanded, Hz and rad
        self.may_whisk: Callable[[float, float, float], bool] = lambda *motion: True

    def forget(self) -> None:
        self._assembler.forget()
        self._description_parts = DescriptionParts()

    # the host's side

    def feed(self, packet: Sequence[CanFrame], t_ns: int) -> Samples | None:
        batch = SampleBatch()
        first, stats, sample = self._base, self.stats, self._assembler
        described = self._describe()
        for identifier, data, extended, _, remote in packet:
            which = identifier - first
            if extended or remote or not ACK <= which <= DESCRIPTION:
                stats.skipped += 1
            elif which == PART:
                sample.part(batch, data, described)
            elif which == HEADER:
                sample.header(batch, data, described)
            elif which == DESCRIPTION:
                self._add_description(data)
                described = self._describe()
            elif data[:1] == bytes((MessageType.ACK,)):
                stats.intact += 1
            else:
                stats.skipped += 1
        return batch.take(self.spec.shape, t_ns) if self.spec else None

    def _add_description(self, data: bytes) -> None:
        if len(data) < 4 or data[0] != MessageType.DESCRIPTION:
            self._assembler.refuse()
            return
        self.stats.intact += 1
        found = self._description_parts.add(data)
        if not isinstance(found, DeviceDescription):
            if found is False:
                self._assembler.refuse()
            return
        # within a stream of samples, another array would change their shape
        if self.spec and found.spec.shape != self.spec.shape and not self._assembler.fresh:
            self._assembler.refuse()
        else:
            self._device_description, self.spec = found, found.spec
            self.serial_number = found.serial_number

    def commands(self, command: Command) -> tuple[Step[Sequence[CanFrame]], ...]:
        if command == Command.START:
            ask = self._make_command(MessageType.DESCRIBE, "its description", 2.0)
            start = self._make_command(MessageType.START, "the answer to START", 1.0)
            return (start,) if self.spec and not self._device_description else (ask, start)
        if command == Command.STOP:
            return (Step((self._make_frame(COMMAND, bytes((MessageType.STOP,))),)),)
        return ()

    def _make_command(self, kind: int, what: str, timeout_s: float) -> Step[Sequence[CanFrame]]:
        frame = self._make_frame(COMMAND, bytes((kind,)))
        return Step((frame,), self._base + ACK, timeout_s, what=what)

    def whisk(
        self, frequency_hz: float, amplitude_rad: float, offset_rad: float
    ) -> Step[Sequence[CanFrame]]:
        """Return the command to whisk, for active arrays, up to 65 Hz and 3.2 rad."""
        motion = np.array([frequency_hz * 1e3, amplitude_rad * 1e4, offset_rad * 1e4])
        counts = np.clip(np.rint(np.nan_to_num(motion)), (0, -32767, -32767), (65535, 32767, 32767))
        data = WHISKING.pack(MessageType.WHISK, *counts.astype(int).tolist())
        return Step((self._make_frame(COMMAND, data),))

    # the device's side

    def encode(self, chunk: Chunk) -> list[Sequence[CanFrame]]:
        described = self._describe()
        assert described is not None
        flags = (LONG if self._fd else 0) | FLOAT32 * (self._options.format == "float32")
        flags |= (~flags & 15) << 4
        packets: list[Sequence[CanFrame]] = []
        samples = common.encode_samples(chunk, described, self._options.format)
        for seq, time_us, payload in samples:
            head = HEAD.pack(seq & 0xFFFF, time_us & 0xFFFFFFFF, self.status, flags)
            parts = sample_parts(head, payload)
            if parts is None:
                elements, channels = described.spec.shape
                raise ConfigError(
                    f"{elements} elements of {channels} channels do not fit in the 256 frames that "
                    f"a sample may have: use {'int16' if self._fd else 'fd'}"
                )
            packets.append(
                [self._make_frame(HEADER, head), *(self._make_frame(PART, data) for data in parts)]
            )
        return packets

    def respond(self, packet: Sequence[CanFrame]) -> Sequence[CanFrame]:
        answer: list[CanFrame] = []
        for frame in packet:
            mine = frame.id == self._base + COMMAND and not frame.extended and not frame.remote
            if not mine or not frame.data or frame.data[0] in MessageType.FROM_DEVICE:
                continue
            kind = frame.data[0]
            error = self._execute(kind, frame.data, answer)
            answer.append(self._make_frame(ACK, bytes((MessageType.ACK, kind, error))))
        return answer

    def _execute(self, kind: int, data: bytes, answer: list[CanFrame]) -> int:
        """Execute a command, append to the answer, and return the error number for the ACK."""
        if kind == MessageType.DESCRIBE:
            described = self._describe()
            if described is None:
                return common.IMPOSSIBLE
            size = 64 if self._fd else 8
            pieces = cut_description(MessageType.DESCRIPTION, described.to_json(), size)
            answer += [self._make_frame(DESCRIPTION, piece) for piece in pieces]
        elif kind in (MessageType.START, MessageType.STOP):
            self.streaming = kind == MessageType.START
        elif kind == MessageType.WHISK and len(data) >= WHISKING.size:
            _, mhz, amplitude, offset = WHISKING.unpack_from(data)
            motion = (mhz / 1e3, amplitude / 1e4, offset / 1e4)
            if not self.may_whisk(*motion):
                return common.IMPOSSIBLE
            self.whisking = motion
        else:
            return common.UNKNOWN
        return 0

    # both

    def _make_frame(self, which: int, data: bytes) -> CanFrame:
        if self._fd and len(data) > 8:
            data = data.ljust(next(n for n in LENGTHS if n >= len(data)), b"\0")
        return CanFrame(self._base + which, data, fd=self._fd)

    def _describe(self) -> DeviceDescription | None:
        if self._device_description is None and self.spec is not None:
            return DeviceDescription.of(self.spec, self._options, self.serial_number)
        return self._device_description


def sample_parts(head: bytes, body: bytes) -> list[bytes] | None:
    """Split a sample's payload and CRC into frame data; None if over 256 frames."""
    size = 62 if head[7] & LONG else 6
    body += crc16_xmodem(head + body).to_bytes(CHECK, "little")
    if len(body) > MOST_PARTS * size:
        return None
    starts = range(0, len(body), size)
    return [bytes((head[0], i)) + body[at : at + size] for i, at in enumerate(starts)]


class SampleParts:
    """Assembler of samples from headers and parts; it buffers only the newest sample."""

    def __init__(self, stats: WireStats) -> None:
        self._stats = stats
        self._damaged = 0
        self.forget()

    def forget(self) -> None:
        """Discard all state, as after a reconnection."""
        self.fresh = True  # no sample yet
        self._low = -1  # low byte of the newest sample's sequence; -1 before the first
        self._head: bytes | None = None  # header of the incomplete sample
        self._parts: list[bytes | None] = []
        self._missing = 0  # parts
        self._size = self._payload = self._last = 0  # bytes: of a part, of all, of the last part

    def refuse(self) -> None:
        """Count a frame that failed a check."""
        self._stats.corrupt += 1
        self._damaged += 1

    def header(self, batch: SampleBatch, data: bytes, described: DeviceDescription | None) -> None:
        """Check a header frame, end the previous sample, and begin the next."""
        if len(data) != HEAD.size or data[7] not in FLAGS:
            self.refuse()
            return
        self._stats.intact += 1
        if described is None:
            return  # its layout is not known yet
        if data == self._head and self._missing == len(self._parts):
            return  # CAN may deliver a frame twice when its end is disturbed
        self._close(batch)
        self._device_description = described
        elements, channels = described.spec.shape
        itemsize = 4 if data[7] & FLOAT32 else 2
        self._payload = -(-elements // 8) + elements * channels * itemsize + CHECK
        self._size = 62 if data[7] & LONG else 6
        parts = -(-self._payload // self._size)
        self._low, self._head = data[0], data
        self._parts, self._missing = [None] * parts, parts
        self._last = self._payload - self._size * (parts - 1)

    def part(self, batch: SampleBatch, data: bytes, described: DeviceDescription | None) -> None:
        """Add a part frame to the open sample; add the sample to `batch` once complete."""
        if len(data) < 3:
            self.refuse()
            return
        low, index = data[0], data[1]
        if self._head is None or low != self._low:
            self._stats.intact += 1
            if low != self._low and described is not None:
                self._begin_without_header(batch, low)
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

    def _begin_without_header(self, batch: SampleBatch, low: int) -> None:
        """End the open sample, since a part of a sample without its header has come."""
        self._close(batch)
        if self._low >= 0:  # else it began before the host joined
            self._stats.incomplete += 1
        self._low = low

    def _close(self, batch: SampleBatch) -> None:
        """Add the open sample, unless no part came or, if complete, its checksum is wrong."""
        head, self._head = self._head, None
        if head is None:
            return
        if self._missing:
            self._stats.incomplete += 1
            if self._missing == len(self._parts):
                return
        shape = self._device_description.spec.shape
        bits, end = -(-shape[0] // 8), self._payload - CHECK
        blank = bytes(self._size)
        body = b"".join([blank if p is None else p for p in self._parts])[: self._payload]
        check = int.from_bytes(body[end:], "little")
        if not self._missing and crc16_xmodem(head + body[:end]) != check:
            self.refuse()
            return
        seq, time_us, status, flags = HEAD.unpack(head)
        known_bits = np.frombuffer(body[:bits], np.uint8)
        valid = np.unpackbits(known_bits, count=shape[0], bitorder="little").view(np.bool_)
        kind = np.dtype("<f4" if flags & FLOAT32 else "<i2")
        values = np.frombuffer(body[:end], kind, offset=bits).reshape(shape)
        if not flags & FLOAT32:
            scaled = values * np.asarray(self._device_description.scale)
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
    """Assembler of a description from its parts, which come in order."""

    def __init__(self) -> None:
        self._text = bytearray()
        self._next = -1  # index of the next part; -1 before the first

    def add(self, data: bytes) -> DeviceDescription | bool | None:
        """Add a part; return the description that it completes.

        Returns:
            The description; False if it is invalid; None if parts are missing.
        """
        index = int.from_bytes(data[1:3], "little")
        if index == 0:
            self._text, self._next = bytearray(), 0
        if index != self._next:
            return None  # a part was lost; the host requests the description again
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
    """Split a description into the data of its frames, of up to `size` bytes."""
    whole = len(text).to_bytes(2, "little") + text + zlib.crc32(text).to_bytes(4, "little")
    starts = range(0, len(whole), size - PIECE.size)
    return [PIECE.pack(kind, i) + whole[at : at + size - PIECE.size] for i, at in enumerate(starts)]
