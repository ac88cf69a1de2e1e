"""Encoding of the messages of a recording; `ros2_form` converts them to their form in the file.

Samples and packets are in CDR (little-endian), without a header; health, decisions and events are
JSON.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tactile_rt.core.stream import Chunk
from tactile_rt.drivers.codec import CanFrame

SAMPLES, WIRE, HEALTH = "samples", "wire", "health"
DECISIONS, EVENTS = "decisions", "events"  # the daemon's messages

Packet = bytes | Sequence[CanFrame] | None  # None marks where the line was opened

_CDR = b"\x00\x01\x00\x00"  # little-endian, no options
_FRAME = struct.Struct("<I???xI")  # followed by its data, padded to 4 bytes


@dataclass(frozen=True)
class Raw:
    """One message of a recording, undecoded."""

    topic: str
    t_ns: int  # time under which it was recorded, host monotonic time, ns
    data: bytes


def encode_samples(chunk: Chunk) -> bytes:
    """Encode a chunk as a message of ``Samples.msg`` without its header."""
    n, elements, channels = chunk.values.shape
    return b"".join(
        (
            _CDR,
            struct.pack("<II", n, 0),  # 8-byte numbers begin at multiples of 8
            chunk.seq.astype("<i8", copy=False).tobytes(),
            struct.pack("<II", n, 0),
            chunk.t_ns.astype("<i8", copy=False).tobytes(),
            struct.pack("<III", elements, channels, n * elements * channels),
            chunk.values.astype("<f4", copy=False).tobytes(),
            struct.pack("<I", n * elements),
            chunk.valid.tobytes(),
        )
    )


def samples_in(data: bytes) -> int:
    """Return the number of samples in a message of ``Samples.msg`` without its header."""
    (n,) = struct.unpack_from("<I", data, 4)
    return int(n)


def last_ns(data: bytes) -> int:
    """Return the host time of the last sample in a message, ns."""
    (t_ns,) = struct.unpack_from("<q", data, 12 + 16 * samples_in(data))
    return int(t_ns)


def decode_samples(data: bytes, shape: tuple[int, int]) -> Chunk:
    """Decode a message to a chunk of an array of shape (element, channel)."""
    elements, channels = shape
    n = samples_in(data)
    values_at = 4 + 16 + 16 * n + 12
    valid_at = values_at + 4 * n * elements * channels + 4
    if not is_samples(data, shape):
        raise ValueError(f"{len(data)} bytes are not samples of {elements} x {channels}")
    counts = struct.unpack_from("<III", data, values_at - 12)
    again = struct.unpack_from("<I", data, 12 + 8 * n) + struct.unpack_from(
        "<I", data, valid_at - 4
    )
    if (*counts, *again) != (elements, channels, n * elements * channels, n, n * elements):
        raise ValueError(f"samples of {counts[0]} x {counts[1]}, not {elements} x {channels}")
    # Copied, so that the reader may change it, as a chunk that a device delivers.
    return Chunk(
        np.frombuffer(data, "<i8", n, 12).astype(np.int64),
        np.frombuffer(data, "<i8", n, 20 + 8 * n).astype(np.int64),
        np.frombuffer(data, "<f4", n * elements * channels, values_at)
        .astype(np.float32)
        .reshape(n, elements, channels),
        np.frombuffer(data, np.uint8, n * elements, valid_at).astype(np.bool_).reshape(n, elements),
    )


def encode_packet(packet: Packet, wire: str) -> bytes:
    """Encode a raw packet as a message of ``SerialPacket.msg`` or ``CanPacket.msg``."""
    opened, things = packet is None, packet or b""
    parts = [_CDR, struct.pack("<?3xI", opened, len(things))]
    if wire == "serial":
        assert isinstance(things, bytes)
        return b"".join((*parts, things))
    for frame in things:
        assert isinstance(frame, CanFrame)
        pad = -len(parts[-1]) % 4
        parts += [
            bytes(pad),
            _FRAME.pack(frame.id, frame.extended, frame.fd, frame.remote, len(frame.data)),
            frame.data,
        ]
    return b"".join(parts)


def is_samples(data: bytes, shape: tuple[int, int]) -> bool:
    """Return whether length and beginning of data fit samples of shape (element, channel)."""
    if len(data) < 8 or data[:4] != _CDR:
        return False
    n, (elements, channels) = samples_in(data), shape
    return n > 0 and len(data) == 36 + n * (16 + elements * (4 * channels + 1))


def decode_packet(data: bytes, wire: str) -> Packet:
    """Decode a message to a raw packet; raise ValueError if it is damaged."""
    if len(data) < 12 or data[:4] != _CDR:
        raise ValueError(f"{len(data)} bytes are not a packet")
    opened, n = struct.unpack_from("<?3xI", data, 4)
    if opened:
        return None
    if wire == "serial":
        if len(data) != 12 + n:
            raise ValueError(f"a packet of {len(data) - 12} bytes, not {n}")
        return data[12:]
    frames, at = [], 12
    for _ in range(n):
        at += -at % 4
        if at + _FRAME.size > len(data):
            raise ValueError("a packet with too few frames")
        identifier, extended, fd, remote, length = _FRAME.unpack_from(data, at)
        at += _FRAME.size
        frames.append(CanFrame(identifier, data[at : at + length], extended, fd, remote))
        at += length
    if at != len(data):
        raise ValueError("the length of a packet is wrong")
    return frames
