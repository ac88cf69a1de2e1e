"""Conversion of messages to and from their form in the file: every channel is a ROS 2 topic whose
message definition is in the file, so that any reader of ROS 2 can read it.

    /tactile/whiskers/samples    tactile_rt_msgs/msg/Samples
"""

from tactile_rt.recording import layout
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2.cdr import CDR

ARRAY, WRENCH = "array", "wrench"
# In the order of their numbers, by which a file with a damaged beginning is recovered.
CHANNELS = {
    (layout.SAMPLES, ""): messages.SAMPLES,
    (layout.WIRE, "serial"): f"{messages.OURS}/SerialPacket",
    (layout.WIRE, "can"): f"{messages.OURS}/CanPacket",
    (layout.HEALTH, ""): messages.EVENT,
    (layout.DECISIONS, ""): messages.DECISION,
    (layout.EVENTS, ""): messages.EVENT,
    (ARRAY, ""): messages.ARRAY,
}
PREFIX = "tactile"  # of a topic: /tactile/SOURCE/CHANNEL
TEXTS = (layout.HEALTH, layout.DECISIONS, layout.EVENTS)


def name_channel(topic: str) -> str:
    """Return the channel in a topic's name, such as ``samples``; else the topic itself."""
    parts = topic.split("/")
    if len(parts) == 4 and parts[:2] == ["", PREFIX]:
        return parts[3]
    return " ".join(topic.split())


def put_in_form(name: str, data: bytes, utc_offset_ns: int, frame: str) -> bytes:
    """Convert a message from the form of `layout` to that in the file."""
    if name == layout.SAMPLES:
        return messages.add_header(data, layout.last_ns(data) + utc_offset_ns, frame)
    if name == layout.DECISIONS:
        return messages.decision_message(data)
    return messages.event_message(data) if name in TEXTS else data


def plain(name: str, data: bytes) -> bytes:
    """Convert a message from its form in the file to that of `layout`."""
    if name == layout.SAMPLES:
        return messages.strip_header(data)
    if name in TEXTS:
        return messages.json_of(
            messages.DECISION if name == layout.DECISIONS else messages.EVENT, data
        )
    return data


def is_in_file_form(name: str, data: bytes, shape: tuple[int, int]) -> bool:
    """Return whether data can be a message that `put_in_form` made for a channel. Only length,
    beginning and end are checked.

    Args:
        shape: (element, channel) of the array.
    """
    if name in TEXTS:
        return data[:4] == CDR and data[-2:] == b"}\0"
    if name == layout.WIRE:
        return len(data) >= 12 and data[:4] == CDR
    try:
        return name != layout.SAMPLES or layout.is_samples(messages.strip_header(data), shape)
    except ValueError:
        return False
