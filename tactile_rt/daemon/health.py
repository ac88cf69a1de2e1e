"""How the daemon is: all states, counts, ages and latencies at one moment.

A `Snapshot` is frozen, and `msgspec.json.encode` takes it as it is: the page, the metrics and the
``state`` message all tell it. Its counts only ever grow while the daemon runs, also over restarts
of a part. What does not work follows from it, see `tactile_rt.daemon.troubles`; `LatencyMeter`
measures what takes time.
"""

import bisect
import threading
from collections import deque
from dataclasses import dataclass, field

from tactile_rt.bounded_queue import QueueState
from tactile_rt.drivers.health import Health
from tactile_rt.stream import SourceStats

__all__ = [
    "ConsumerState",
    "Latency",
    "LatencyMeter",
    "Losses",
    "ModelState",
    "OnDisk",
    "PartState",
    "QueueState",
    "Snapshot",
    "SourceState",
    "Trouble",
]

EDGES_S = (
    0.0005, 0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.045, 0.07, 0.1, 0.2,
    0.5, 1.0, 5.0,
)  # fmt: skip
NEWEST = 1000  # measurements that percentiles are taken of
BREAKS = ("fails", "has failed", "stalls")  # what a part does, not what is the matter with it


@dataclass(frozen=True)
class Latency:
    """Of a repeated thing.

    Attributes:
        count: The number of measurements since the start.
        sum_s: The sum of all measurements since the start, s.
        p50_ms, p99_ms, max_ms: The median, the 99th percentile and the maximum of the newest 1000
            measurements, ms; 0 where there is none.
        edges_s: (b,) The upper edges of the histogram's buckets, s.
        buckets: (b + 1,) The counts since the start, the last beyond all edges; not cumulative.
    """

    count: int = 0
    sum_s: float = 0.0
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0
    edges_s: tuple[float, ...] = ()
    buckets: tuple[int, ...] = ()


@dataclass(frozen=True)
class Losses:
    """How much was lost lately of what is counted beside.

    Attributes:
        second: The number that was lost within the newest second.
        minute: The number that was lost within the newest minute.
    """

    second: int = 0
    minute: int = 0


@dataclass(frozen=True)
class PartState:
    """A supervised part.

    Attributes:
        name: The name of the part, as in `Event.part`.
        state: ``starting``; ``running``; ``stalled``: in a call that does not return, also while it
            starts; ``waiting``:
            it broke and is tried again after a pause; ``failed``: it cannot work as it is
            configured, and is not tried again; ``ended``: its stream is over; ``stopped``.
        reason: The reason why the part is not running, in words.
        since_ns: The time at which the part came into this state, host CLOCK_MONOTONIC, ns.
        starts: The number of times that the part was started.
        failures: The number of times that the part broke.
    """

    name: str
    state: str
    reason: str
    since_ns: int
    starts: int
    failures: int


@dataclass(frozen=True)
class SourceState:
    """A source: `part`, where it is, its array, and what came of it.

    Attributes:
        part: The state of the source as a part of the daemon.
        url: The URL of the source as configured.
        array, frame, rate_hz, elements, channels, units: The name of the sensor array, its mount
            frame, nominal rate (Hz), elements, channels and their units; empty before the source
            was first opened.
        device: The health of the device; None: there is no device, or it is not open.
        stats: The samples delivered and lost, summed over all times that the source was opened.
        samples: The number of samples read.
        newest_ns: The time at which the newest sample was taken, host CLOCK_MONOTONIC, ns; of a
            device whose own clock is kept that at which it came; 0: there is none yet.
        read_ns: The time at which the newest sample was read, host CLOCK_MONOTONIC, ns.
        flowing_ns: The time since which samples have come without a pause, host CLOCK_MONOTONIC,
            ns.
        live: Whether samples come whether or not anyone reads them, so that they can be too old.
        losses: The number of samples that were corrupt, missing or dropped lately.
        bad_samples: The number of samples of one element that held no number, or an absurd one,
            though the element was not marked as invalid.
        bad: The number of these lately.
        frozen_s: The time for which no value has changed though the sensor's noise should change
            some, s; 0: they change, or nothing is known of the noise.
    """

    part: PartState
    url: str
    array: str = ""
    frame: str = ""
    rate_hz: float = 0.0
    elements: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    device: Health | None = None
    stats: SourceStats = field(default_factory=SourceStats)
    samples: int = 0
    newest_ns: int = 0
    read_ns: int = 0
    flowing_ns: int = 0
    live: bool = False
    losses: Losses = field(default_factory=Losses)
    bad_samples: int = 0
    bad: Losses = field(default_factory=Losses)
    frozen_s: float = 0.0


@dataclass(frozen=True)
class ModelState:
    """A model: its source and file, and what it decided.

    Attributes:
        part: The state of the model as a part of the daemon.
        source: The name of the source that is classified.
        file: The path of the model file.
        sha256: The hash of the model file, hexadecimal; empty if the file cannot be read.
        labels: The classes that the model tells apart.
        queue: The mailbox of samples for the model.
        decisions, final: The number of decisions so far, and of those that were the last ones of
            their episode.
        touching: Whether there is contact now.
        label, probability: The most probable class of the newest decision, and how probable; empty
            and 0 before the first one.
        latency: The time from the sample that completed a step to the decision.
        step: The time that the network alone took for a step.
        decision_age_ms: The age of the newest sample of the newest decision when that decision was
            there, ms.
        behind_s: The time that the oldest samples that are not yet classified have waited, s.
        late: The number of steps that took longer than they may, or whose samples were too old.
        skipped: The number of times that it skipped to the newest sample.
        skips: The number of times that it did so lately.
        lost: The number of samples that were dropped from its mailbox lately.
        refused: The reason for which the model that was to take the place of this one does not;
            empty if none was refused since this one was admitted.
        bad_samples: The number of samples that held what is no number, and were left out.
        engine: The name of the engine that runs it; empty if that is not known yet.
    """

    part: PartState
    source: str
    file: str
    sha256: str = ""
    labels: tuple[str, ...] = ()
    queue: QueueState = field(default_factory=QueueState)
    decisions: int = 0
    final: int = 0
    touching: bool = False
    label: str = ""
    probability: float = 0.0
    latency: Latency = field(default_factory=Latency)
    step: Latency = field(default_factory=Latency)
    late: int = 0
    bad_samples: int = 0
    decision_age_ms: float = 0.0
    behind_s: float = 0.0
    skipped: int = 0
    skips: Losses = field(default_factory=Losses)
    lost: Losses = field(default_factory=Losses)
    refused: str = ""
    engine: str = ""


@dataclass(frozen=True)
class OnDisk:
    """What of a source is on the disk.

    Attributes:
        written_ns: The host monotonic time of the newest sample that the operating system has, so
            that it outlives the process, ns; 0 if there is none.
        synced_ns: The host monotonic time of the newest sample that is on the medium, so that it
            outlives a power cut, ns; 0 if there is none.
        samples: The number of samples that are recorded.
        lost_samples: The number of samples that should have been recorded and are not; those that
            did not reach the recorder are counted in its queue.
        lost_ns: The host monotonic time at which samples were lost last, ns; 0 if none were.
        lost_why: The reason for which samples were lost last; empty if none were.
        open: Whether a file of the source is open.
        meant_ns: The host monotonic time since which the source is to be recorded, ns; 0: it is not
            now, as it is closed, somebody has stopped the recorder, or it waits for a trigger.
        waits_ns: The host monotonic time since which something that the operating system has waits
            for the medium, ns; 0: nothing does.
        slow_s: The time for which that may wait, s; 0: for ever.
    """

    written_ns: int = 0
    synced_ns: int = 0
    samples: int = 0
    lost_samples: int = 0
    lost_ns: int = 0
    lost_why: str = ""
    open: bool = False
    meant_ns: int = 0
    waits_ns: int = 0
    slow_s: float = 0.0


@dataclass(frozen=True)
class ConsumerState:
    """A consumer.

    Attributes:
        part: The state of the consumer as a part of the daemon.
        kind: The kind of consumer, such as ``jsonl`` or ``recorder``.
        queue: The mailbox of items for the consumer.
        latency: The time from the sample that completed a step to the decision having been
            published.
        details: Whatever the consumer tells of itself, by name.
        decision_age_ms: The age of the newest sample of the newest decision when that decision had
            been published, ms.
        behind_s: The time that the oldest item that is not yet handled has waited, s.
        losses: The number of items that were dropped from its mailbox, or by itself, lately.
        trouble: What keeps the consumer from its work now, in words; empty if nothing does.
        on_disk: What is known of each source's recording, of the recorder alone, by source.
    """

    part: PartState
    kind: str
    queue: QueueState = field(default_factory=QueueState)
    latency: Latency = field(default_factory=Latency)
    details: dict[str, str | int | float] = field(default_factory=dict)
    decision_age_ms: float = 0.0
    behind_s: float = 0.0
    losses: Losses = field(default_factory=Losses)
    trouble: str = ""
    on_disk: dict[str, OnDisk] = field(default_factory=dict)


@dataclass(frozen=True)
class Trouble:
    """A thing that does not work.

    Attributes:
        part: The name of the part that does not do its work: ``source.NAME``, ``model.NAME``,
            ``publisher.NAME``, ``recorder``, ``page``, ``metrics``, ``log``, or ``daemon``.
        what: What is missing, in a few words.
        why: The reason in words; of a part that breaks what it does, such as ``fails: no port``.
        still: What goes on all the same; may be empty.
    """

    part: str
    what: str
    why: str
    still: str = ""

    @property
    def line(self) -> str:
        """All of it in one line."""
        gap = " " if self.why.startswith(BREAKS) else ": "
        return f"{self.what}: {self.part}{gap}{self.why}{f'; {self.still}' if self.still else ''}"


@dataclass(frozen=True)
class Snapshot:
    """The daemon.

    Attributes:
        version: The version of this package.
        pid: The process id of the daemon.
        config: The path of the configuration.
        t_ns, utc_ns: The time at which all this is true, host CLOCK_MONOTONIC and UTC, ns.
        started_ns: The time at which the daemon started, host CLOCK_MONOTONIC, ns.
        reloads: The number of times that the configuration was reloaded.
        state: ``starting``, ``running``, ``degraded`` or ``stopping``.
        degraded: The lines, one for each thing that does not work, with what
            goes on all the same.
        clock_steps: The number of times that the wall clock jumped.
        troubles: The same things as `degraded`, in their pieces.
        sources, models, consumers: The states of all sources, models and consumers.
    """

    version: str
    pid: int
    config: str
    t_ns: int
    utc_ns: int
    started_ns: int
    reloads: int
    state: str
    degraded: tuple[str, ...] = ()
    clock_steps: int = 0
    sources: tuple[SourceState, ...] = ()
    models: tuple[ModelState, ...] = ()
    consumers: tuple[ConsumerState, ...] = ()
    troubles: tuple[Trouble, ...] = ()


class LatencyMeter:
    """How long a thing takes: a histogram for ever, percentiles of the newest. Add seconds from any
    thread; `state` is a frozen `Latency`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: deque[float] = deque(maxlen=NEWEST)
        self._buckets = [0] * (len(EDGES_S) + 1)
        self._count, self._sum = 0, 0.0

    def add(self, seconds: float) -> None:
        """One more."""
        with self._lock:
            self._newest.append(seconds)
            self._buckets[bisect.bisect_left(EDGES_S, seconds)] += 1
            self._count += 1
            self._sum += seconds

    @property
    def state(self) -> Latency:
        """What was measured."""
        with self._lock:
            ordered = sorted(self._newest)
            count, total, buckets = self._count, self._sum, tuple(self._buckets)
        if not ordered:
            return Latency(edges_s=EDGES_S, buckets=buckets)
        return Latency(
            count, total, 1e3 * _rank(ordered, 0.5), 1e3 * _rank(ordered, 0.99), 1e3 * ordered[-1],
            EDGES_S, buckets,
        )  # fmt: skip


def _rank(ordered: list[float], share: float) -> float:
    """The smallest value that at least this share of all are not above."""
    return ordered[max(0, -(-len(ordered) * round(1000 * share) // 1000) - 1)]
