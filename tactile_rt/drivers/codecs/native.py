"""The native protocol over a serial line: our own reference format.

It is specified in docs/reference/native-protocol.md.

A frame is a header of 20 bytes with its own CRC-16/XMODEM, a payload, and a CRC-32 of both, all
little-endian. The header's checksum protects the length, so a false synchronisation in damaged
bytes costs no waiting. The last checksum covers the header, too, so that a header with the payload
of another frame (after a loss of exactly a frame's length) is not taken for a sample.
"""

import struct
import zlib
from binascii import crc_hqx
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import Command, Samples, SerialCodec, Step
from tactile_rt.drivers.codecs import native_common as common
from tactile_rt.drivers.codecs.framing import crc16_xmodem
from tactile_rt.drivers.codecs.native_common import DeviceDescription, MessageType, NativeOptions

__all__ = ["NativeOptions", "NativeSerial", "frame"]

VERSION: Final = 1
SYNC: Final = b"TR"
HEADER: Final = struct.Struct("<2sBBHHIIBBH")  # sync .. header CRC
CRC: Final = struct.Struct("<I")
AROUND: Final = HEADER.size + CRC.size  # bytes of a frame without its payload
SAMPLE_KIND: Final = VERSION << 4 | MessageType.SAMPLE
LONGEST: Final = 65_535  # payload, bytes: the range of the length field
WHISKING: Final = struct.Struct("<3f")  # frequency in Hz, amplitude and offset in rad

_TYPES: Final[dict[int, np.dtype[Any]]] = {0: np.dtype("<f4"), 1: np.dtype("<i2")}


def frame(
    kind: int,
    payload: bytes = b"",
    *,
    format: int = 0,
    status: int = 0,
    seq: int = 0,
    time_us: int = 0,
    shape: tuple[int, int] = (0, 0),
) -> bytes:
    """Return a frame of the native protocol on a serial line, with its checksums."""
    head = HEADER.pack(
        SYNC, VERSION << 4 | kind, format, len(payload), status, seq & 0xFFFFFFFF,
        time_us & 0xFFFFFFFF, *shape, 0,
    )[:-2]  # fmt: skip
    whole = head + crc16_xmodem(head[2:]).to_bytes(2, "little") + payload
    return whole + CRC.pack(zlib.crc32(whole))


class NativeSerial(SerialCodec):
    """Codec of the reference firmware, with a counter, time, self-description and checksums."""

    Options = NativeOptions
    usb = True
    baud = 2_000_000  # nominal: most boards use USB, which has no baud rate
    count_bits = 32
    tick_ns = 1000.0
    status_bits = common.STATUS
    harmless_bits = common.HARMLESS
    describes = True
    cannot_detect = ""

    def __init__(self, options: NativeOptions) -> None:
        super().__init__(None)
        self._options, self._format = options, common.FORMATS[options.format]
        self.serial_number = options.serial_number
        self._known_device: DeviceDescription | None = None
        self._rest = b""  # beginning of an incomplete frame
        self._synchronised = True
        self._damaged = 0  # samples, since the last intact one
        self._lost = self._framed = 0  # bytes skipped since then, and damaged frames with a header
        self._usual = -1  # length of the last frame
        self._flags, self._valid = b"", np.empty((0, 0), np.bool_)  # of the last packet
        self.streaming = False
        self.whisking: tuple[float, float, float] | None = None  # as last commanded, Hz and rad
        self.may_whisk: Callable[[float, float, float], bool] = lambda *motion: True

    # the host's side

    def feed(self, packet: bytes, t_ns: int) -> Samples | None:
        if len(packet) == self._usual and (one := self._decode_usual(packet, t_ns)) is not None:
            return one
        return self._decode_any(packet, t_ns)

    def _decode_usual(self, packet: bytes, t_ns: int) -> Samples | None:
        """Decode a packet of one intact sample, faster than `_decode_any`; else return None."""
        head = HEADER.unpack_from(packet)
        sync, kind, form, length, status, count, ticks, elements, channels, check = head
        if (
            self._rest or self._lost or self._damaged or self._framed
            or sync != SYNC or kind != SAMPLE_KIND or form != 0
            or self.spec is None or (elements, channels) != self.spec.shape
            or length + AROUND != len(packet)
            or crc_hqx(packet[2 : HEADER.size - 2], 0) != check
            or zlib.crc32(packet[: -CRC.size]) != CRC.unpack_from(packet, len(packet) - CRC.size)[0]
        ):  # fmt: skip
            return None
        flat = np.frombuffer(
            packet, "<f4", elements * channels, len(packet) - CRC.size - 4 * elements * channels
        )
        if not np.vdot(flat, flat) < np.inf:  # NaN, infinite, or too large for this fast check
            return None
        self.stats.intact += 1
        self._synchronised = True
        valid = self._unpack_flags(packet[HEADER.size : HEADER.size + -(-elements // 8)], 1)
        values = flat.reshape(1, elements, channels).copy()
        row = np.array((t_ns, 0, count, ticks, status), np.int64)
        return Samples(values, valid, row[:1], row[1:2], row[2:3], row[3:4], row[4:])

    def _decode_any(self, packet: bytes, t_ns: int) -> Samples | None:
        rows: list[tuple[int, ...]] = []
        parts: list[NDArray[Any]] = []
        flags = b""
        for kind, head, payload in self._read_frames(packet):
            if kind == MessageType.SAMPLE:
                if self.spec is None:
                    continue  # its shape is not known yet
                shape = head[7:9]
                if shape != self.spec.shape:
                    self._refuse()
                    continue
                bits = -(-shape[0] // 8)
                part: NDArray[Any] = np.ndarray((1, *shape), _TYPES[head[2]], payload, bits)
                if head[2] == common.FORMATS["int16"]:
                    part = (part * np.array(self._describe().scale)).astype(np.float32)
                parts.append(part)
                flags += payload[:bits]
                rows.append((t_ns, self._damaged, head[5], head[6], head[4]))
                self._damaged = 0
            elif kind == MessageType.DESCRIPTION:
                found = DeviceDescription.from_json(payload)
                if found is None:
                    self._refuse()
                    continue
                if self.spec is not None and found.spec.shape != self.spec.shape:
                    del rows[:], parts[:]  # they are of another device
                    flags = b""
                self._known_device, self.spec = found, found.spec
                self.serial_number = found.serial_number
        if not rows:
            return None
        self._usual = AROUND + head[3]
        values = np.concatenate(parts)
        valid = self._unpack_flags(flags, len(rows))
        # a value that is not finite is no measurement, whatever the device's flags claim
        finite = np.isfinite(values)
        if 0 in finite.tobytes():
            valid &= finite.all(axis=2)
        return Samples(values, valid, *np.array(rows, np.int64).T)

    def commands(self, command: Command) -> tuple[Step[bytes], ...]:
        if command == Command.START:
            reply = SYNC + bytes((VERSION << 4 | MessageType.DESCRIPTION,))
            ask = Step(frame(MessageType.DESCRIBE), reply, what="its description")
            start = Step(frame(MessageType.START))
            return (start,) if self.spec and not self._known_device else (ask, start)
        return (Step(frame(MessageType.STOP)),) if command == Command.STOP else ()

    def whisk(self, frequency_hz: float, amplitude_rad: float, offset_rad: float) -> Step[bytes]:
        """Return the command to whisk, for active arrays, in Hz and rad."""
        return Step(
            frame(MessageType.WHISK, WHISKING.pack(frequency_hz, amplitude_rad, offset_rad))
        )

    def forget(self) -> None:
        self._rest = b""
        self._synchronised = True

    # the device's side

    def encode(self, chunk: Chunk) -> list[bytes]:
        described = self._describe()
        shape = described.spec.shape
        width = _TYPES[self._format].itemsize
        if max(shape) > 255 or -(-shape[0] // 8) + shape[0] * shape[1] * width > LONGEST:
            raise ConfigError(
                f"{shape[0]} elements of {shape[1]} channels: the native protocol carries 255 of "
                f"255 at most, in {LONGEST} bytes"
            )
        return [
            frame(
                MessageType.SAMPLE, payload, format=self._format, status=self.status, seq=seq,
                time_us=time_us, shape=shape,
            )
            for seq, time_us, payload in common.encode_samples(
                chunk, described, self._options.format
            )
        ]  # fmt: skip

    def respond(self, packet: bytes) -> bytes:
        answer = b""
        for kind, _, payload in self._read_frames(packet):
            error = 0
            if kind in MessageType.FROM_DEVICE:
                continue  # an echo of our own; answering it would never end
            if kind == MessageType.DESCRIBE:
                self._known_device = None  # its serial number may have changed
                answer += frame(MessageType.DESCRIPTION, self._describe().to_json())
                continue
            if kind in (MessageType.START, MessageType.STOP):
                self.streaming = kind == MessageType.START
            elif kind == MessageType.WHISK and len(payload) == WHISKING.size:
                motion = WHISKING.unpack(payload)
                if np.isfinite(motion).all() and self.may_whisk(*motion):
                    self.whisking = motion
                else:
                    error = common.IMPOSSIBLE
            else:
                error = common.UNKNOWN
            answer += frame(MessageType.ACK, bytes((kind, error)))
        return answer

    # both

    def _describe(self) -> DeviceDescription:
        if self._known_device is None:
            assert self.spec is not None
            self._known_device = DeviceDescription.of(self.spec, self._options, self.serial_number)
        return self._known_device

    def _unpack_flags(self, flags: bytes, n: int) -> NDArray[np.bool_]:
        """Unpack validity, (n, element), from the bits of n samples; reuse the last result."""
        if flags != self._flags:
            assert self.spec is not None
            bits = np.frombuffer(flags, np.uint8).reshape(n, -1)
            count = len(self.spec.elements)
            valid = np.unpackbits(bits, axis=1, count=count, bitorder="little")
            self._flags, self._valid = flags, valid.view(np.bool_)
        return self._valid.copy()

    def _read_frames(self, packet: bytes) -> Iterator[tuple[int, tuple[Any, ...], bytes]]:
        """Yield (type, header, payload) of the intact frames that this packet completes."""
        data = self._rest + packet if self._rest else packet
        at = 0  # first byte that is not yet decoded
        while True:
            begin = data.find(SYNC, at)
            if begin < 0:  # the last byte may be half of it
                begin = len(data) - data.endswith(SYNC[:1], at)
            if begin > at:
                self._lose_sync(begin - at)
                at = begin
            if len(data) - at < HEADER.size:
                break
            head = HEADER.unpack_from(data, at)
            if crc_hqx(data[at + 2 : at + HEADER.size - 2], 0) != head[-1]:  # XMODEM
                self._lose_sync(1)
                at += 1
                continue
            end = at + HEADER.size + head[3]
            if len(data) < end + CRC.size:
                break
            whole = data[at:end]
            if zlib.crc32(whole) != CRC.unpack_from(data, end)[0]:
                self._synchronised = True  # this was a frame
                self._lose_sync(1)
                self._framed += 1
                at += 1
                continue
            if self._lost:
                self._count_lost(end + CRC.size - at)
            at = end + CRC.size
            self._synchronised = True
            kind = head[1] & 15
            if head[1] >> 4 != VERSION or (kind == MessageType.SAMPLE and not _length_fits(head)):
                self._refuse()
                continue
            self.stats.intact += 1
            yield kind, head, whole[HEADER.size :]
        self._rest = data[at:]

    def _lose_sync(self, n: int) -> None:
        """Skip n bytes; count a single damaged frame until the next good frame."""
        self.stats.skipped += n
        self._lost += n
        self.stats.corrupt += self._synchronised
        self._synchronised = False

    def _count_lost(self, length: int) -> None:
        """Estimate the damaged samples in the skipped bytes by their headers and their length.

        A burst of noise between frames counts as none, two successive damaged frames as two.
        """
        self._damaged += max(self._framed, round(self._lost / length))
        self._lost = self._framed = 0

    def _refuse(self) -> None:
        self.stats.corrupt += 1
        self._damaged += 1


def _length_fits(head: tuple[Any, ...]) -> bool:
    """Return whether a sample's length fits its number of elements and channels."""
    form, length, elements, channels = head[2], head[3], head[7], head[8]
    if form not in _TYPES or not elements or not channels:
        return False
    return bool(length == -(-elements // 8) + elements * channels * _TYPES[form].itemsize)
