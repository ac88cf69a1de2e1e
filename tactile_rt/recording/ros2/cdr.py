"""Encoding of messages as the bytes that ROS 2 sends and stores: CDR, little-endian.

A number is aligned to a multiple of its size, counted from the end of the four bytes that name the
kind of CDR. A sequence and a string begin with their length; a string ends with a zero byte, which
is counted. The definitions are those that a file or a topic carries with its messages.
"""

import re
import struct
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

PACKAGE = Path(__file__).parents[2] / "assets" / "tactile_rt_msgs"
# Types of a definition that are no messages, with their `struct` codes; a string has none.
SIMPLE = {
    "bool": "?", "uint8": "B", "int32": "i", "uint32": "I", "int64": "q", "float32": "f",
    "float64": "d", "string": "",
}  # fmt: skip
STANDARD = {
    "builtin_interfaces/msg/Time": "int32 sec\nuint32 nanosec\n",
    "std_msgs/msg/Header": "builtin_interfaces/Time stamp\nstring frame_id\n",
    "geometry_msgs/msg/Point": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Vector3": "float64 x\nfloat64 y\nfloat64 z\n",
    "geometry_msgs/msg/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w\n",
    "geometry_msgs/msg/Pose": (
        "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n"
    ),
    "geometry_msgs/msg/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque\n",
    "geometry_msgs/msg/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench\n",
}
LINE = "=" * 80


class Field(NamedTuple):
    """Field of a message, with its type."""

    name: str
    kind: str  # type of its value: of `SIMPLE`, or a message such as ``std_msgs/msg/Header``
    many: bool


@cache
def fields_of(message: str) -> tuple[Field, ...]:
    """Return the fields of a message, by its name such as ``tactile_rt_msgs/msg/Samples``."""
    found = []
    for line in _read_definition(message).splitlines():
        words = line.partition("#")[0].split()
        if not words:
            continue
        kind, name = words
        many, kind = kind.endswith("[]"), kind.removesuffix("[]")
        found.append(Field(name, kind if kind in SIMPLE else kind.replace("/", "/msg/"), many))
    return tuple(found)


@cache
def schema_text(message: str) -> str:
    """Return a message's definition, with those that it uses, in MCAP's form ``ros2msg``."""
    needed: list[str] = []

    def collect(name: str) -> None:
        for field in fields_of(name):
            if field.kind not in SIMPLE and field.kind not in needed:
                needed.append(field.kind)
                collect(field.kind)

    collect(message)
    others = (f"{LINE}\nMSG: {n.replace('/msg/', '/')}\n{_read_definition(n)}" for n in needed)
    return "".join((_read_definition(message), *others))


def dds_type(message: str) -> str:
    """Return the name of a message's type in DDS."""
    package, _, name = message.partition("/msg/")
    return f"{package}::msg::dds_::{name}_"


def token(text: str) -> str:
    """Convert a text to one word of a topic. ROS 2 allows only letters, digits and ``_``."""
    word = re.sub(r"[^A-Za-z0-9_]", "_", text) or "_"
    return f"_{word}" if word[0].isdigit() else word


def _read_definition(message: str) -> str:
    if message in STANDARD:
        return STANDARD[message]
    return (PACKAGE / "msg" / f"{message.rpartition('/')[2]}.msg").read_text("utf-8")


CDR = b"\x00\x01\x00\x00"  # little-endian, no options
MOST_S = 2**31 - 1  # a stamp's seconds are an int32
NS = 10**9


def encode(message: str, values: Mapping[str, Any]) -> bytes:
    """Encode a message in CDR.

    Args:
        message: Name of its type, such as ``tactile_rt_msgs/msg/Event``.
        values: Values by field name; a nested message is a mapping itself.
    """
    out = bytearray(CDR)
    _encode_fields(out, message, values)
    return bytes(out)


def decode(message: str, data: bytes) -> dict[str, Any]:
    """Decode a message to values by field. Raise ValueError if it is not of this type."""
    if data[:4] != CDR:
        raise ValueError(f"{data[:4]!r} begins no message in CDR")
    try:
        values, at = _decode_fields(data, 4, message)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"{len(data)} bytes are no {message}: {error}") from None
    if at != len(data):
        raise ValueError(f"{len(data)} bytes are no {message}, which has {at}")
    return values


def header(utc_ns: int, frame: str) -> bytes:
    """Encode `CDR` and a ``std_msgs/msg/Header``, the beginning of a message."""
    seconds, ns = divmod(min(max(utc_ns, 0), MOST_S * NS), NS)
    name = frame.encode()
    return CDR + struct.pack("<iII", seconds, ns, len(name) + 1) + name + b"\0"


def header_size(data: bytes) -> int:
    """Return the number of bytes at the beginning of a message that `header` wrote."""
    if len(data) < 16:
        raise ValueError(f"{len(data)} bytes have no header")
    (length,) = struct.unpack_from("<I", data, 12)
    return 16 + int(length)


def _encode_fields(out: bytearray, message: str, values: Mapping[str, Any]) -> None:
    for name, kind, many in fields_of(message):
        ones, code = values[name] if many else (values[name],), SIMPLE.get(kind)
        if many:
            _pack(out, "I", len(ones))
        if code and ones:
            _pack(out, code, *ones)
        for one in () if code else ones:
            if kind == "string":
                text = one.encode()
                _pack(out, "I", len(text) + 1)
                out += text + b"\0"
            else:
                _encode_fields(out, kind, one)


def _pack(out: bytearray, code: str, *numbers: Any) -> None:
    out += bytes(-(len(out) - 4) % struct.calcsize(f"<{code}"))
    out += struct.pack(f"<{len(numbers)}{code}", *numbers)


def _decode_fields(data: bytes, at: int, message: str) -> tuple[dict[str, Any], int]:
    found: dict[str, Any] = {}
    for name, kind, many in fields_of(message):
        n, code, ones = 1, SIMPLE.get(kind), list[Any]()
        if many:
            (n,), at = _unpack(data, at, "I")
            if n > len(data):
                raise ValueError(f"{n} of {name} in {len(data)} bytes")
        if code and n:
            ones, at = _unpack(data, at, code, n)
        for _ in range(0 if code else n):
            if kind == "string":
                (length,), at = _unpack(data, at, "I")
                if not 0 < length <= len(data) - at:
                    raise ValueError(f"a text of {length} bytes where {len(data) - at} are left")
                ones.append(data[at : at + length - 1].decode())
                at += length
            else:
                one, at = _decode_fields(data, at, kind)
                ones.append(one)
        found[name] = ones if many else ones[0]
    return found, at


def _unpack(data: bytes, at: int, code: str, n: int = 1) -> tuple[list[Any], int]:
    at += -(at - 4) % struct.calcsize(f"<{code}")
    code = f"<{n}{code}"
    return list(struct.unpack_from(code, data, at)), at + struct.calcsize(code)
