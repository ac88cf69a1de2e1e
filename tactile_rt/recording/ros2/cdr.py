"""A message as the bytes that ROS 2 sends and stores: CDR, little-endian, by its definition.

A number stands at a multiple of its size, counted from after the four bytes that say which kind of
CDR it is; a sequence and a string begin with their length, and a string ends with a zero, which
counts.
"""

import struct
from collections.abc import Mapping
from typing import Any

from tactile_rt.recording.ros2.definitions import SIMPLE, fields_of

__all__ = ["CDR", "decode", "encode", "header", "header_size"]

CDR = b"\x00\x01\x00\x00"  # little-endian, no options
CODES = {
    "bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "int64": "q", "float32": "f",
    "float64": "d",
}  # fmt: skip
MOST_S = 2**31 - 1  # a stamp's seconds are an int32
NS = 10**9


def encode(message: str, values: Mapping[str, Any]) -> bytes:
    """The bytes of a message.

    Args:
        message: The name, such as ``tactile_rt_msgs/msg/Event``.
        values: By name of field; a message within is a mapping itself.
    """
    out = bytearray(CDR)
    _put(out, message, values)
    return bytes(out)


def decode(message: str, data: bytes) -> dict[str, Any]:
    """The values of a message.

    Raises:
        ValueError: It is not such a message.
    """
    if data[:4] != CDR:
        raise ValueError(f"{data[:4]!r} begins no message in CDR")
    try:
        values, at = _take(data, 4, message)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"{len(data)} bytes are no {message}: {error}") from None
    if at != len(data):
        raise ValueError(f"{len(data)} bytes are no {message}, which has {at}")
    return values


def header(utc_ns: int, frame: str) -> bytes:
    """A ``std_msgs/msg/Header`` at the beginning of a message, with `CDR` before it."""
    seconds, ns = divmod(min(max(utc_ns, 0), MOST_S * NS), NS)
    name = frame.encode()
    return CDR + struct.pack("<iII", seconds, ns, len(name) + 1) + name + b"\0"


def header_size(data: bytes) -> int:
    """How many bytes of a message `header` are."""
    if len(data) < 16:
        raise ValueError(f"{len(data)} bytes have no header")
    (length,) = struct.unpack_from("<I", data, 12)
    return 16 + int(length)


def _put(out: bytearray, message: str, values: Mapping[str, Any]) -> None:
    for name, kind, many in fields_of(message):
        value = values[name]
        if many:
            _number(out, "I", 4, len(value))
            if kind in CODES and value:
                out += bytes(-(len(out) - 4) % SIMPLE[kind])
                out += struct.pack(f"<{len(value)}{CODES[kind]}", *value)
                continue
        for one in value if many else (value,):
            if kind == "string":
                text = one.encode()
                _number(out, "I", 4, len(text) + 1)
                out += text + b"\0"
            elif kind in CODES:
                _number(out, CODES[kind], SIMPLE[kind], one)
            else:
                _put(out, kind, one)


def _number(out: bytearray, code: str, size: int, value: Any) -> None:
    out += bytes(-(len(out) - 4) % size)
    out += struct.pack(f"<{code}", value)


def _take(data: bytes, at: int, message: str) -> tuple[dict[str, Any], int]:
    found: dict[str, Any] = {}
    for name, kind, many in fields_of(message):
        n = 1
        if many:
            n, at = _read(data, at, "I", 4)
            if n > len(data):
                raise ValueError(f"{n} of {name} in {len(data)} bytes")
            if kind in CODES and n:
                at += -(at - 4) % SIMPLE[kind]
                code = f"<{n}{CODES[kind]}"
                found[name] = list(struct.unpack_from(code, data, at))
                at += struct.calcsize(code)
                continue
        ones: list[Any] = []
        for _ in range(n):
            if kind == "string":
                length, at = _read(data, at, "I", 4)
                if not 0 < length <= len(data) - at:
                    raise ValueError(f"a text of {length} bytes where {len(data) - at} are left")
                one: Any = data[at : at + length - 1].decode()
                at += length
            elif kind in CODES:
                one, at = _read(data, at, CODES[kind], SIMPLE[kind])
            else:
                one, at = _take(data, at, kind)
            ones.append(one)
        found[name] = ones if many else ones[0]
    return found, at


def _read(data: bytes, at: int, code: str, size: int) -> tuple[Any, int]:
    at += -(at - 4) % size
    return struct.unpack_from(f"<{code}", data, at)[0], at + size
