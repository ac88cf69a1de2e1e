"""What moves between the parts of the daemon: few, frozen, in the order in which it happened.

Each names its source and model as the configuration does, and `frame`, the array's mount frame.
Times are host CLOCK_MONOTONIC, ns, where nothing else stands; `utc_offset_ns` is UTC less that.
"""

from dataclasses import dataclass
from typing import Any

from tactile_rt.classifier.classifier import Classification
from tactile_rt.core.stream import ArraySpec, Chunk, Source


@dataclass(frozen=True)
class Opened:
    """A source has been opened, or opened again; samples and packets of it follow.

    Attributes:
        stream: The opened source, for `health`, `stats` and what it is; never read or close it.
        accepted: Whether it is the array that the source began with; models hear of no other.
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
    accepted: bool = True


@dataclass(frozen=True)
class Closed:
    """A source has been closed: it broke, is over, or is no longer configured."""

    source: str
    t_ns: int


@dataclass(frozen=True)
class SourceChunk:
    """A chunk of a source as it came, calibrated, and when it was read."""

    source: str
    spec: ArraySpec
    chunk: Chunk
    arrived_ns: int
    utc_offset_ns: int
    accepted: bool = True  # see `Opened`


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
        decision: The label, probabilities and step; its times are the stream's.
        sample_ns: The host time of the sample that completed the step.
        made_ns: The host time at which the decision was there.
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
        from_ns, until_ns: The stream times of the first sample that was skipped, and of the first
            one that was not, ns.
        lost: The number of samples of the stretch that did not even reach the model's contact
            detector: they were dropped from its mailbox.
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
    """Asked of one consumer by another, as by the page of the recorder.

    The recorder knows ``start``, ``stop``, ``trigger`` and ``rotate``.
    """

    action: str


Item = Opened | Closed | SourceChunk | Packet | Decision | Contact | Skipped | Event | Control
