"""Message definitions: those of ``tactile_rt_msgs``, a package that ROS 2 builds, and the few of
other packages that these need."""

import re
from functools import cache
from pathlib import Path
from typing import NamedTuple

__all__ = ["PACKAGE", "SIMPLE", "Field", "dds_type", "fields_of", "schema_text", "token"]

PACKAGE = Path(__file__).parents[1] / "assets" / "tactile_rt_msgs"
# Of a definition's words, those that are no other message: bytes of each; a string has none.
SIMPLE = {
    "bool": 1, "uint8": 1, "int32": 4, "uint32": 4, "int64": 8, "float32": 4, "float64": 8,
    "string": 0,
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
    """A field of a message.

    Attributes:
        kind: The kind of its value: of `SIMPLE`, or a message such as ``std_msgs/msg/Header``.
    """

    name: str
    kind: str
    many: bool


@cache
def fields_of(message: str) -> tuple[Field, ...]:
    """The fields of a message, by its name such as ``tactile_rt_msgs/msg/Samples``."""
    found = []
    for line in _text(message).splitlines():
        words = line.partition("#")[0].split()
        if not words:
            continue
        kind, name = words
        many, kind = kind.endswith("[]"), kind.removesuffix("[]")
        found.append(Field(name, kind if kind in SIMPLE else kind.replace("/", "/msg/"), many))
    return tuple(found)


@cache
def schema_text(message: str) -> str:
    """The definition with all that it needs, as MCAP's ``ros2msg`` has it."""
    needed: list[str] = []

    def need(name: str) -> None:
        for field in fields_of(name):
            if field.kind not in SIMPLE and field.kind not in needed:
                needed.append(field.kind)
                need(field.kind)

    need(message)
    others = (f"{LINE}\nMSG: {n.replace('/msg/', '/')}\n{_text(n)}" for n in needed)
    return "".join((_text(message), *others))


def dds_type(message: str) -> str:
    """What ROS 2 calls this message in DDS."""
    package, _, name = message.partition("/msg/")
    return f"{package}::msg::dds_::{name}_"


def token(text: str) -> str:
    """The text as one word of a topic, of which ROS 2 allows letters, digits and ``_`` alone."""
    word = re.sub(r"[^A-Za-z0-9_]", "_", text) or "_"
    return f"_{word}" if word[0].isdigit() else word


def _text(message: str) -> str:
    if message in STANDARD:
        return STANDARD[message]
    return (PACKAGE / "msg" / f"{message.rpartition('/')[2]}.msg").read_text("utf-8")
