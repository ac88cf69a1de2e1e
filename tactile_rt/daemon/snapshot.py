"""All states, counts and latencies at one moment, frozen; `msgspec.json.encode` takes it as it is.

Counts only ever grow while the daemon runs, also over restarts of a part.
"""

from dataclasses import dataclass, field

from tactile_rt.bounded_queue import QueueState
from tactile_rt.drivers.health import Health
from tactile_rt.stream import SourceStats

__all__ = [
    "ConsumerState",
    "Latency",
    "ModelState",
    "PartState",
    "QueueState",
    "Snapshot",
    "SourceState",
]


@dataclass(frozen=True)
class Latency:
    """Of a repeated thing.

    Attributes:
        count: measured since the start.
        sum_s: of all of them, s.
        p50_ms, p99_ms, max_ms: of the newest 1000, ms; 0 when there is none.
        edges_s: (b,) upper edges of the buckets, s.
        buckets: (b + 1,) counts since the start, the last beyond all edges; not cumulative.
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
        name: as in `Event.part`.
        state: ``starting``; ``running``; ``stalled``: in a call that does not return; ``waiting``:
            it broke and is tried again after a pause; ``ended``: its stream is over; ``stopped``.
        reason: why it is not running, in words.
        since_ns: since when, host CLOCK_MONOTONIC.
        starts: times that it was started.
        failures: times that it broke.
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
        part: of the daemon.
        url: where it is.
        array, frame, rate_hz, elements, channels, units: of its array; empty before it was opened.
        device: how the device is doing; None: not a device, or not open.
        stats: losses, summed over all times it was opened.
        samples: read.
        newest_ns: when the newest sample was read; 0: none yet.
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
        part: of the daemon.
        source: name of its source.
        file: the model's.
        sha256: of that file; empty if it cannot be read.
        labels: its classes.
        queue: of samples for it.
        decisions: so far; `final`: of these the last ones of their episode.
        touching: whether there is contact.
        label, probability: of the newest decision; empty and 0 before.
        latency: from the sample that completed a step to the decision.
        step: time the network took alone.
        late: steps that took longer than they may.
        bad_samples: that held what is no number, and were left out.
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
        part: of the daemon.
        kind: ``jsonl``, ``recorder``, ...
        queue: of items for it.
        latency: from the sample that completed a step to the decision having been published.
        details: whatever it says of itself.
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
        version: of this package.
        pid: of the process.
        config: path of the configuration.
        t_ns, utc_ns: when this is true.
        started_ns: when the daemon started, host CLOCK_MONOTONIC.
        reloads: of the configuration.
        state: ``starting``, ``running``, ``degraded`` or ``stopping``.
        degraded: what does not work, and what goes on all the same; one line each.
        clock_steps: times that the wall clock jumped.
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
