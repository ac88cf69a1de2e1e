"""How what is recorded stands in the file: every channel is a ROS 2 topic of a message whose
definition is in the file, so that whatever reads ROS 2 reads it.

    /tactile/whiskers/samples    tactile_rt_msgs/msg/Samples
"""

from tactile_rt.recording import layout
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2.cdr import CDR

ARRAY, WRENCH = "array", "wrench"
# In the order in which they are numbered, by which a file is recovered whose beginning is damaged.
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
    """Return the channel of a topic, such as ``samples``; another topic as it is."""
    parts = topic.split("/")
    if len(parts) == 4 and parts[:2] == ["", PREFIX]:
        return parts[3]
    return " ".join(topic.split())


def put_in_form(name: str, data: bytes, utc_offset_ns: int, frame: str) -> bytes:
    """Write a message of `layout` as it stands in the file."""
    if name == layout.SAMPLES:
        return messages.stamped(data, layout.last_ns(data) + utc_offset_ns, frame)
    if name == layout.DECISIONS:
        return messages.decision_message(data)
    return messages.event_message(data) if name in TEXTS else data


def plain(name: str, data: bytes) -> bytes:
    """What was given to `put_in_form`."""
    if name == layout.SAMPLES:
        return messages.unstamped(data)
    if name in TEXTS:
        return messages.json_of(
            messages.DECISION if name == layout.DECISIONS else messages.EVENT, data
        )
    return data


def is_in_file_form(name: str, data: bytes, shape: tuple[int, int]) -> bool:
    """Whether data can be what `put_in_form` gave for a message of this channel, as far as its
    length, beginning and end tell.

    Args:
        shape: (element, channel) of the array.
    """
    if name in TEXTS:
        return data[:4] == CDR and data[-2:] == b"}\0"
    if name == layout.WIRE:
        return len(data) >= 12 and data[:4] == CDR
    try:
        return name != layout.SAMPLES or layout.is_samples(messages.unstamped(data), shape)
    except ValueError:
        return False
