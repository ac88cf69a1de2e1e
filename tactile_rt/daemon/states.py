"""How the daemon is: all states, counts, ages and latencies at one moment.

A `Snapshot` is frozen, and `msgspec.json.encode` takes it as it is: the page, the metrics and the
``state`` message all tell it. Its counts only ever grow while the daemon runs, also over restarts
of a part. What does not work follows from it, see `tactile_rt.daemon.diagnostics`; `LatencyMeter`
measures what takes time.
"""

import bisect
import threading
from collections import deque
from dataclasses import dataclass, field

from tactile_rt.core.bounded_queue import QueueState
from tactile_rt.core.stream import SourceStats
from tactile_rt.drivers.health import Health

__all__ = [
    "ConsumerState",
    "Diagnostic",
    "Latency",
    "LatencyMeter",
    "Losses",
    "ModelState",
    "OnDisk",
    "PartState",
    "QueueState",
    "Snapshot",
    "SourceState",
]

EDGES_S = (
    0.0005, 0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.045, 0.07, 0.1, 0.2,
    0.5, 1.0, 5.0,
)  # fmt: skip
NEWEST = 1000  # measurements that percentiles are taken of
BREAKS = ("fails", "has failed", "stalls")  # what a part does, not what is the matter with it


@dataclass(frozen=True)
class Latency:
    """Of a repeated thing: since the start, and of the newest 1000 measurements (`p50_ms` ...)."""

    count: int = 0
    sum_s: float = 0.0
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0
    edges_s: tuple[float, ...] = ()  # (b,) upper edges of the histogram's buckets
    buckets: tuple[int, ...] = ()  # (b + 1,) the last beyond all edges; not cumulative


@dataclass(frozen=True)
class Losses:
    """How much was lost within the newest second and minute of what is counted beside."""

    second: int = 0
    minute: int = 0


@dataclass(frozen=True)
class PartState:
    """A supervised part.

    Attributes:
        state: ``starting``; ``running``; ``stalled``: in a call that does not return, also while it
            starts; ``waiting``: it broke and is tried again after a pause; ``failed``: it cannot
            work as it is configured, and is not tried again; ``ended``: its stream is over;
            ``stopped``.
        reason: The reason why the part is not running, in words.
        since_ns: The time at which the part came into this state, host CLOCK_MONOTONIC, ns.
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

    Times are host CLOCK_MONOTONIC, ns; 0: not yet. What is of the array is empty before the source
    was first opened.
    """

    part: PartState
    url: str
    array: str = ""
    frame: str = ""
    rate_hz: float = 0.0
    elements: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    device: Health | None = None  # None: there is none, or it is not open
    stats: SourceStats = field(default_factory=SourceStats)  # over all times that it was opened
    samples: int = 0
    newest_ns: int = 0  # of the newest sample; of a device whose own clock is kept: when it came
    read_ns: int = 0  # when the newest sample was read
    flowing_ns: int = 0  # since when samples have come without a pause
    live: bool = False  # samples come whether or not anyone reads them, so that they can be too old
    losses: Losses = field(default_factory=Losses)  # corrupt, missing or dropped
    repeats: Losses = field(default_factory=Losses)  # samples that came again
    restarts: Losses = field(default_factory=Losses)  # of the device's counter, its line in place
    clock_off: bool = False  # the device's clock runs at another speed than the host's
    bad_samples: int = 0  # of one element, no number or an absurd one, though not marked invalid
    bad: Losses = field(default_factory=Losses)
    stuck_at_s: float = 0.0  # for so long no value has changed, though noise should change some
    stuck: tuple[str, ...] = ()  # elements of which no value changes, while others do
    zeros: bool = False  # nothing else has come
    another: str = ""  # why the array is another one than the source began with
    # what the device measured within the newest second, lost or not; 0: unknown
    measured_hz: float = 0.0
    slow: bool = False  # that is, most of the time, less than nine tenths of `rate_hz`


@dataclass(frozen=True)
class ModelState:
    """A model: its source and file, and what it decided."""

    part: PartState
    source: str
    file: str
    sha256: str = ""  # empty if the file cannot be read
    labels: tuple[str, ...] = ()
    queue: QueueState = field(default_factory=QueueState)
    decisions: int = 0
    final: int = 0  # decisions that were the last ones of their episode
    touching: bool = False
    label: str = ""  # most probable class of the newest decision; empty before the first one
    probability: float = 0.0
    latency: Latency = field(default_factory=Latency)  # from the sample that completed a step
    step: Latency = field(default_factory=Latency)  # of the network alone
    late: int = 0  # steps that took longer than they may, or whose samples were too old
    bad_samples: int = 0  # no numbers, and left out
    decision_age_ms: float = 0.0  # of the newest decision's newest sample when that was there
    behind_s: float = 0.0  # how long the oldest samples wait to be classified
    skipped: int = 0  # times that it skipped to the newest sample
    skips: Losses = field(default_factory=Losses)
    lost: Losses = field(default_factory=Losses)  # samples that were dropped from its mailbox
    refused: str = ""  # why the model that was to take the place of this one does not
    implausible: bool = False  # the newest touch has loads far beyond those that it learnt from
    object: str = ""  # enrolled one that the newest decision's touch is of, or "none of these"
    bad_steps: int = 0  # whose answer was no number, so that there was no decision
    undecided: bool = False  # the newest step was one of them
    drift: str = ""  # which reading moves while nothing is touched, and how fast


@dataclass(frozen=True)
class OnDisk:
    """What of a source is on the disk. Times are host CLOCK_MONOTONIC, ns; 0: none."""

    written_ns: int = 0  # of the newest sample that outlives the process: the system has it
    synced_ns: int = 0  # of the newest sample that outlives a power cut: the medium has it
    samples: int = 0
    lost_samples: int = 0  # beside those that did not reach the recorder: see its queue
    lost_ns: int = 0  # when samples were lost last
    lost_why: str = ""
    open: bool = False
    meant_ns: int = 0  # since when it is to be recorded; 0: closed, stopped, or without a trigger
    waits_ns: int = 0  # since when something that the system has waits for the medium
    slow_s: float = 0.0  # for how long that may wait; 0: for ever


@dataclass(frozen=True)
class ConsumerState:
    """A consumer: its queue, what it tells of itself, and how late it is."""

    part: PartState
    kind: str  # such as jsonl or recorder
    queue: QueueState = field(default_factory=QueueState)
    latency: Latency = field(default_factory=Latency)  # to the decision having been published
    details: dict[str, str | int | float] = field(default_factory=dict)
    decision_age_ms: float = 0.0  # of the newest decision's newest sample when it was published
    behind_s: float = 0.0  # how long the oldest item waits to be handled
    losses: Losses = field(default_factory=Losses)  # items dropped from its mailbox, or by itself
    diagnostic: str = ""  # what keeps it from its work now, in words
    on_disk: dict[str, OnDisk] = field(default_factory=dict)  # of the recorder alone, by source
    soon: str = ""  # what will keep it from its work if it goes on so, in words


@dataclass(frozen=True)
class Diagnostic:
    """One diagnostic: a thing that does not work.

    Attributes:
        part: The name of the part that does not do its work: ``source.NAME``, ``model.NAME``,
            ``publisher.NAME``, ``recorder``, ``page``, ``metrics``, ``log``, or ``daemon``.
        what: What is missing, in a few words.
        why: The reason in words; of a part that breaks what it does, such as ``fails: no port``.
        still: What goes on all the same; may be empty.
        since_ns: The time at which it was first found, host CLOCK_MONOTONIC, ns.
        says: All of it in a sentence, with the time in UTC; empty before it is explained.
        do: What to do.
    """

    part: str
    what: str
    why: str
    still: str = ""
    since_ns: int = 0
    says: str = ""
    do: str = ""

    @property
    def line(self) -> str:
        """All of it in one line."""
        gap = " " if self.why.startswith(BREAKS) else ": "
        return f"{self.what}: {self.part}{gap}{self.why}{f'; {self.still}' if self.still else ''}"


@dataclass(frozen=True)
class Snapshot:
    """The daemon at `t_ns`, host CLOCK_MONOTONIC, which is `utc_ns` in UTC."""

    version: str
    pid: int
    config: str
    t_ns: int
    utc_ns: int
    started_ns: int
    reloads: int
    state: str  # starting, running, degraded or stopping
    degraded: tuple[str, ...] = ()  # the lines of `diagnostics`
    clock_steps: int = 0  # times that the wall clock jumped
    sources: tuple[SourceState, ...] = ()
    models: tuple[ModelState, ...] = ()
    consumers: tuple[ConsumerState, ...] = ()
    diagnostics: tuple[Diagnostic, ...] = ()
    soon: tuple[Diagnostic, ...] = ()  # what will not work if it goes on so; no fault yet


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
