"""How the daemon is: all states, counts and latencies at one moment, and what does not work.

A `Snapshot` is frozen, and `msgspec.json.encode` takes it as it is: the page, the metrics and the
``state`` message all tell it. Its counts only ever grow while the daemon runs, also over restarts
of a part. `degraded` says in words what does not work; `LatencyMeter` measures what takes time.
"""

import bisect
import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from tactile_rt.bounded_queue import QueueState
from tactile_rt.drivers.health import Health, State
from tactile_rt.stream import SourceStats

__all__ = [
    "ConsumerState",
    "Latency",
    "LatencyMeter",
    "ModelState",
    "PartState",
    "QueueState",
    "Snapshot",
    "SourceState",
    "degraded",
]

EDGES_S = (
    0.0005, 0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.045, 0.07, 0.1, 0.2,
    0.5, 1.0, 5.0,
)  # fmt: skip
NEWEST = 1000  # measurements that percentiles are taken of


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
class PartState:
    """A supervised part.

    Attributes:
        name: The name of the part, as in `Event.part`.
        state: ``starting``; ``running``; ``stalled``: in a call that does not return; ``waiting``:
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
        newest_ns: The time at which the newest sample was read, host CLOCK_MONOTONIC, ns; 0: none
            was read yet.
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
        late: The number of steps that took longer than they may.
        bad_samples: The number of samples that held what is no number, and were left out.
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
    """

    part: PartState
    kind: str
    queue: QueueState = field(default_factory=QueueState)
    latency: Latency = field(default_factory=Latency)
    details: dict[str, str | int | float] = field(default_factory=dict)


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


def degraded(
    sources: Sequence[SourceState],
    models: Sequence[ModelState],
    consumers: Sequence[ConsumerState],
) -> tuple[str, ...]:
    """One line for each part that does not work. Reasons that count on are left out, so that a
    line stays the same as long as what it says."""
    lines = []
    recording = any(c.kind == "recorder" and c.part.state == "running" for c in consumers)
    for source in sources:
        device = source.device
        if _broken(source.part):
            lines.append(f"no samples: {_why(source.part)}")
        elif device is not None and device.state in (State.STALE, State.LOST):
            lines.append(f"no samples: {source.part.name}: the device is {device.state}")
    for model in models:
        if _broken(model.part):
            goes_on = "recording goes on" if recording else "acquisition goes on"
            lines.append(f"no decisions: {_why(model.part)}; {goes_on}")
    for consumer in consumers:
        if _broken(consumer.part):
            lines.append(f"{_what(consumer)}: {_why(consumer.part)}; acquisition goes on")
    return tuple(lines)


def _broken(part: PartState) -> bool:
    # While it is tried again it is not well yet.
    broken = part.state in ("waiting", "stalled", "failed")
    return broken or (part.state == "starting" and part.failures > 0)


def _why(part: PartState) -> str:
    if part.state == "stalled":
        return f"{part.name} stalls"
    return f"{part.name} {'has failed' if part.state == 'failed' else 'fails'}: {part.reason}"


def _what(consumer: ConsumerState) -> str:
    return {"recorder": "no recording", "page": "no page", "log": "no log"}.get(
        consumer.kind, "not published" if consumer.part.name.startswith("publisher.") else "missing"
    )
