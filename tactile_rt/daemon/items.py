"""Immutable items that the daemon's parts send to each other, in the order of events.

An item names its source and model as the configuration does; `frame` is the array's mount frame.
Times are host CLOCK_MONOTONIC, ns, unless stated otherwise; `utc_offset_ns` is UTC minus that.
"""

from dataclasses import dataclass
from typing import Any

from tactile_rt.classifier.classifier import Classification
from tactile_rt.core.stream import ArraySpec, Chunk, Source


@dataclass(frozen=True)
class Opened:
    """Notice that a source was opened or reopened; its samples and packets follow.

    Attributes:
        stream: The opened source, for `health`, `stats` and description; never read or close it.
        accepted: Whether the array is the accepted one of this source; models receive no other.
        prelude: The (packet, arrival in ns) pairs in which a device described itself at its start.
            The same packets are also posted as `Packet` items.
    """

    source: str
    spec: ArraySpec
    url: str
    stream: Source
    t_ns: int
    utc_offset_ns: int
    prelude: tuple[tuple[Any, int], ...] = ()
    accepted: bool = True


@dataclass(frozen=True)
class Closed:
    """Notice that a source was closed: it broke, has ended, or is no longer configured."""

    source: str
    t_ns: int


@dataclass(frozen=True)
class SourceChunk:
    """A calibrated chunk of a source's samples, and the time at which it was read."""

    source: str
    spec: ArraySpec
    chunk: Chunk
    arrived_ns: int
    utc_offset_ns: int
    accepted: bool = True  # see `Opened`


@dataclass(frozen=True)
class Packet:
    """A packet from a device's line: bytes, CAN frames, or None when the line opens."""

    source: str
    packet: Any
    t_ns: int


@dataclass(frozen=True)
class Decision:
    """A model's decision after one step.

    Attributes:
        decision: The label, probabilities and step; its times are the stream's.
        sample_ns: The host time of the sample that completed the step.
        made_ns: The host time at which the decision was made.
        deadline_ns: The age of that sample from which the decision is late, ns; 0 means never.
    """

    source: str
    model: str
    frame: str
    decision: Classification
    sample_ns: int
    made_ns: int
    utc_offset_ns: int
    deadline_ns: int = 0


@dataclass(frozen=True)
class Contact:
    """The beginning (`touching`) or end of contact, as a model's contact detector found it."""

    source: str
    model: str
    frame: str
    touching: bool
    t_ns: int
    utc_offset_ns: int


@dataclass(frozen=True)
class Skipped:
    """A stretch of its stream that a model skipped because it was behind.

    Attributes:
        from_ns, until_ns: The stream times of the first sample that was skipped, and of the first
            sample after the stretch, ns.
        lost: The number of samples of the stretch that were dropped from the model's mailbox, so
            that they did not even reach its contact detector.
    """

    source: str
    model: str
    frame: str
    from_ns: int
    until_ns: int
    lost: int
    t_ns: int
    utc_offset_ns: int


@dataclass(frozen=True)
class Event:
    """A change of state of a part or a device, or another fact worth logging.

    Attributes:
        part: ``source.NAME``, ``model.NAME``, ``publisher.NAME``, ``recorder``, ``page``,
            ``metrics``, ``systemd``, or ``daemon``.
        state: The new state, as in `PartState.state`; a device's state is ``device:streaming`` and
            so on.
        level: ``info``, ``warning`` or ``error``.
    """

    part: str
    state: str
    reason: str
    level: str
    t_ns: int
    utc_offset_ns: int


@dataclass(frozen=True)
class Control:
    """A request from one consumer to another, such as from the page to the recorder.

    The recorder knows ``start``, ``stop``, ``trigger`` and ``rotate``.
    """

    action: str


Item = Opened | Closed | SourceChunk | Packet | Decision | Contact | Skipped | Event | Control
