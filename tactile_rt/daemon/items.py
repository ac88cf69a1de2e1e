"""What moves between the parts of the daemon: few, frozen, in the order in which it happened."""

from dataclasses import dataclass
from typing import Any

from tactile_rt.classifier.classifier import Classification
from tactile_rt.stream import ArraySpec, Chunk, Source

__all__ = [
    "Closed",
    "Contact",
    "Control",
    "Decision",
    "Event",
    "Item",
    "Opened",
    "Packet",
    "Skipped",
    "SourceChunk",
]


@dataclass(frozen=True)
class Opened:
    """A source has been opened, or opened again; samples and packets of it follow.

    Attributes:
        source: The name of the source in the configuration.
        spec: The sensor array of the source.
        url: The URL of the source as configured.
        stream: The opened source, for `health`, `stats` and what it is; never read or close it.
        t_ns: The time at which the source was opened, host CLOCK_MONOTONIC, ns.
        utc_offset_ns: UTC less monotonic time then, ns.
        prelude: The (packet, arrival in ns) pairs that came of a device while it was started, in
            which it describes itself. The same packets also come as `Packet` items.
    """

    source: str
    spec: ArraySpec
    url: str
    stream: Source
    t_ns: int
    utc_offset_ns: int
    prelude: tuple[tuple[Any, int], ...] = ()


@dataclass(frozen=True)
class Closed:
    """A source has been closed: it broke, is over, or is no longer configured."""

    source: str
    reason: str
    t_ns: int


@dataclass(frozen=True)
class SourceChunk:
    """A chunk of a source as it came, calibrated.

    Attributes:
        source: The name of the source in the configuration.
        spec: The sensor array of the source.
        chunk: The samples as they came, calibrated.
        arrived_ns: The time at which the chunk was read, host CLOCK_MONOTONIC, ns.
        utc_offset_ns: UTC less monotonic time then, ns.
    """

    source: str
    spec: ArraySpec
    chunk: Chunk
    arrived_ns: int
    utc_offset_ns: int


@dataclass(frozen=True)
class Packet:
    """What came over a device's line: bytes or CAN frames; None when the line was opened."""

    source: str
    packet: Any
    t_ns: int


@dataclass(frozen=True)
class Decision:
    """A model's decision.

    Attributes:
        source, model: The names of the source and of the model in the configuration.
        frame: The mount frame of the array.
        decision: The label, probabilities and step; its times are the stream's.
        sample_ns: The host time of the sample that completed the step, CLOCK_MONOTONIC, ns.
        made_ns: The host time at which the decision was there, CLOCK_MONOTONIC, ns.
        utc_offset_ns: UTC less monotonic time then, ns.
        deadline_ns: The age of that sample from which the decision is late, ns; 0: there is none.
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
    """A model's contact detector found that contact begins (`touching`) or ends."""

    source: str
    model: str
    frame: str
    touching: bool
    t_ns: int
    utc_offset_ns: int


@dataclass(frozen=True)
class Skipped:
    """A model skipped a stretch of its stream: it was behind, and goes on at the newest sample.

    Attributes:
        source, model: The names of the source and of the model in the configuration.
        frame: The mount frame of the array.
        from_ns, until_ns: The stream times of the first sample that was skipped, and of the first
            one that was not, ns.
        lost: The number of samples of the stretch that did not even reach the model's contact
            detector: they were dropped from its mailbox.
        t_ns: The host time at which this was decided, CLOCK_MONOTONIC, ns.
        utc_offset_ns: UTC less monotonic time then, ns.
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
    """A part of the daemon, or a device, changed its state; or something worth a line in the log.

    Attributes:
        part: ``source.NAME``, ``model.NAME``, ``publisher.NAME``, ``recorder``, ``page``,
            ``metrics``, ``systemd``, or ``daemon``.
        state: The new state, as in `PartState.state`; a device's state is ``device:streaming`` and
            so on.
        reason: The reason for the change, in words.
        level: ``info``, ``warning`` or ``error``.
        t_ns: The time of the change, host CLOCK_MONOTONIC, ns.
        utc_offset_ns: UTC less monotonic time then, ns.
    """

    part: str
    state: str
    reason: str
    level: str
    t_ns: int
    utc_offset_ns: int


@dataclass(frozen=True)
class Control:
    """Asked of one consumer by another, as by the page of the recorder.

    The recorder knows ``start``, ``stop``, ``trigger`` and ``rotate``.
    """

    action: str
    argument: str = ""


Item = Opened | Closed | SourceChunk | Packet | Decision | Contact | Skipped | Event | Control
