"""The state of the daemon: all states, counts, ages and latencies at one moment.

A `Snapshot` is frozen, and `msgspec.json.encode` takes it as it is: the page, the metrics and the
``state`` message all show it. Its counts only ever grow while the daemon runs, also over restarts
of a part. Diagnostics are derived from it, see `tactile_rt.daemon.diagnostics`; `LatencyMeter`
measures durations.
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
NEWEST = 1000  # measurements for percentiles
BREAKS = ("fails", "has failed", "stalls")  # reasons whose subject is the part


@dataclass(frozen=True)
class Latency:
    """Durations of an action: a histogram since the start, percentiles of the newest 1000."""

    count: int = 0
    sum_s: float = 0.0
    p50_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0
    edges_s: tuple[float, ...] = ()  # (b,) upper edges of the histogram's buckets
    buckets: tuple[int, ...] = ()  # (b + 1,) the last beyond all edges; not cumulative


@dataclass(frozen=True)
class Losses:
    """Number of losses or other events within the newest second and minute."""

    second: int = 0
    minute: int = 0


@dataclass(frozen=True)
class PartState:
    """State of a supervised part.

    Attributes:
        state: ``starting``; ``running``; ``stalled``: in a call that does not return, also while it
            starts; ``waiting``: it broke and is restarted after a pause; ``failed``: it cannot
            work as it is configured, and is not restarted; ``ended``: its stream has ended;
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
    """State of a source: its part, address, array and samples.

    Times are host CLOCK_MONOTONIC, ns, or 0 before the event. The fields of the array are empty
    before the source is first opened.
    """

    part: PartState
    url: str
    array: str = ""
    frame: str = ""
    rate_hz: float = 0.0
    elements: tuple[str, ...] = ()
    channels: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    device: Health | None = None  # None: no device, or not open
    stats: SourceStats = field(default_factory=SourceStats)  # over all times that it was opened
    samples: int = 0
    newest_ns: int = 0  # when the newest sample was taken; its arrival if times are the device's
    read_ns: int = 0  # when the newest sample was read
    flowing_ns: int = 0  # since when samples have come without a pause
    live: bool = False  # samples come even if nothing reads them, so that they can be too old
    losses: Losses = field(default_factory=Losses)  # corrupt, missing or dropped
    repeats: Losses = field(default_factory=Losses)  # samples that came again
    restarts: Losses = field(default_factory=Losses)  # of the device's counter, while connected
    clock_off: bool = False  # the device's clock runs at another speed than the host's
    bad_samples: int = 0  # of one element, NaN or absurdly large, though not marked invalid
    bad: Losses = field(default_factory=Losses)
    stuck_at_s: float = 0.0  # time without a change of any value, though noise should change some
    stuck: tuple[str, ...] = ()  # elements of which no value changes, while others do
    zeros: bool = False  # all values so far are 0
    another: str = ""  # how the array differs from the one that the source began with
    # rate of measurements within the newest second, lost or not; 0: unknown
    measured_hz: float = 0.0
    slow: bool = False  # `measured_hz` is mostly less than nine tenths of `rate_hz`


@dataclass(frozen=True)
class ModelState:
    """State of a model: its part, source, file and decisions."""

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
    late: int = 0  # steps that took longer than allowed, or whose samples were too old
    bad_samples: int = 0  # not numbers, and ignored
    decision_age_ms: float = 0.0  # of the newest decision's newest sample when it was made
    behind_s: float = 0.0  # how long the oldest samples wait to be classified
    skipped: int = 0  # times that it skipped to the newest sample
    skips: Losses = field(default_factory=Losses)
    lost: Losses = field(default_factory=Losses)  # samples that were dropped from its mailbox
    refused: str = ""  # why the newest replacement is refused
    implausible: bool = False  # the newest touch has loads far beyond those that it learnt from
    object: str = ""  # the enrolled object of the newest decision's touch, or "none of these"
    bad_steps: int = 0  # whose answer was not finite, so that there was no decision
    undecided: bool = False  # the newest step was a bad one
    drift: str = ""  # the reading that moves fastest at rest, and how fast


@dataclass(frozen=True)
class OnDisk:
    """State of a source's samples on disk. Times are host CLOCK_MONOTONIC, ns; 0 means none."""

    written_ns: int = 0  # of the newest sample that outlives the process: the system has it
    synced_ns: int = 0  # of the newest sample that outlives a power cut: the medium has it
    samples: int = 0
    lost_samples: int = 0  # without those that did not reach the recorder: see its queue
    lost_ns: int = 0  # when samples were last lost
    lost_why: str = ""
    open: bool = False
    meant_ns: int = 0  # since when it should be recorded; 0: closed, stopped, or without a trigger
    waits_ns: int = 0  # since when data that the system has waits for the medium
    slow_s: float = 0.0  # for how long data may wait; 0: no limit


@dataclass(frozen=True)
class ConsumerState:
    """State of a consumer: its part, queue, details and delay."""

    part: PartState
    kind: str  # such as jsonl or recorder
    queue: QueueState = field(default_factory=QueueState)
    latency: Latency = field(default_factory=Latency)  # until the decision was published
    details: dict[str, str | int | float] = field(default_factory=dict)
    decision_age_ms: float = 0.0  # of the newest decision's newest sample when it was published
    behind_s: float = 0.0  # how long the oldest item waits to be handled
    losses: Losses = field(default_factory=Losses)  # items dropped from its mailbox, or by itself
    diagnostic: str = ""  # what prevents its work now, in words
    on_disk: dict[str, OnDisk] = field(default_factory=dict)  # of the recorder alone, by source
    soon: str = ""  # what will soon prevent its work, in words


@dataclass(frozen=True)
class Diagnostic:
    """A diagnostic: something that does not work.

    Attributes:
        part: The name of the part that does not do its work: ``source.NAME``, ``model.NAME``,
            ``publisher.NAME``, ``recorder``, ``page``, ``metrics``, ``log``, or ``daemon``.
        what: What is missing, in a few words.
        why: The reason in words; for a part that breaks, what it does, such as ``fails: no port``.
        still: What goes on nevertheless; may be empty.
        since_ns: The time at which it was first found, host CLOCK_MONOTONIC, ns.
        says: The whole diagnostic as a sentence, with the time in UTC; empty before `explain`.
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
        """The whole diagnostic in one line."""
        gap = " " if self.why.startswith(BREAKS) else ": "
        return f"{self.what}: {self.part}{gap}{self.why}{f'; {self.still}' if self.still else ''}"


@dataclass(frozen=True)
class Snapshot:
    """State of the whole daemon at `t_ns`, host CLOCK_MONOTONIC, which is `utc_ns` in UTC."""

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
    soon: tuple[Diagnostic, ...] = ()  # what will stop working if it goes on so; no fault yet


class LatencyMeter:
    """A meter of durations: a histogram of all, percentiles of the newest. Any thread may add
    seconds; `state` is a frozen `Latency`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._newest: deque[float] = deque(maxlen=NEWEST)
        self._buckets = [0] * (len(EDGES_S) + 1)
        self._count, self._sum = 0, 0.0

    def add(self, seconds: float) -> None:
        """Add a duration to the histogram and the newest values."""
        with self._lock:
            self._newest.append(seconds)
            self._buckets[bisect.bisect_left(EDGES_S, seconds)] += 1
            self._count += 1
            self._sum += seconds

    @property
    def state(self) -> Latency:
        """Histogram and percentiles of the durations added so far."""
        with self._lock:
            ordered = sorted(self._newest)
            count, total, buckets = self._count, self._sum, tuple(self._buckets)
        if not ordered:
            return Latency(edges_s=EDGES_S, buckets=buckets)
        return Latency(
            count, total, 1e3 * _find_quantile(ordered, 0.5), 1e3 * _find_quantile(ordered, 0.99),
            1e3 * ordered[-1], EDGES_S, buckets,
        )  # fmt: skip


def _find_quantile(ordered: list[float], share: float) -> float:
    """Return the smallest of sorted values that a share (0 to 1) do not exceed."""
    return ordered[max(0, -(-len(ordered) * round(1000 * share) // 1000) - 1)]
