"""Messages of publishers: one versioned JSON schema for all of them.

Every message is one object with ``type``, ``version``, ``t_ns`` (host CLOCK_MONOTONIC) and
``utc_ns`` (the same moment in UTC); all but ``health`` and ``state`` also with the ``source`` and
its mount ``frame``. A field is never renamed and never changes its unit within a version; fields
may be added.
"""

import time
from typing import Any, ClassVar, TypeAlias
from urllib.parse import quote

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.daemon.items import (
    Contact,
    Decision,
    Event,
    Item,
    Opened,
    Skipped,
    SourceChunk,
)
from tactile_rt.daemon.states import Snapshot

MESSAGE_VERSION = 1
DIGITS = 4  # of probabilities
# Decimal digits of float32s, see `shortest`.
MOST = 9  # distinguish any float32 from all others
FEWEST = 6  # always survive a conversion to float32
SMALLEST, LARGEST = 1e-13, 1e8  # where powers of ten and products with them are exact enough


class _Message(msgspec.Struct, frozen=True, tag_field="type", kw_only=True):
    version: int = MESSAGE_VERSION
    t_ns: int
    utc_ns: int


class _FromSource(_Message, frozen=True, kw_only=True):
    source: str
    frame: str


class ArrayMessage(_FromSource, frozen=True, tag="array", kw_only=True):
    """Message that a source opened; `array` is its `ArraySpec`: elements, grid, poses, units."""

    topic: ClassVar[str] = "array"
    url: str
    array: dict[str, Any]


class DecisionMessage(_FromSource, frozen=True, tag="decision", kw_only=True):
    """Message with a model's decision after one step.

    Attributes:
        t_ns: The stream time of the last sample used, ns.
        onset_ns: The stream time at which contact began, ns; with `source` and `model` it
            identifies the episode.
        step: The number of the step since onset, from 1; `final` is the last of its episode.
        label: The most probable class, which for some models is a shape, or a refusal, such as
            "unknown".
        probabilities: The probability of each class, and of each refusal, by its label.
        latency_ms: The time from the sample that completed the step until the decision was made,
            ms.
        age_ms: The age of that sample when the message was written, ms: a reader on this computer
            may add the time since, by the monotonic clock.
        late: Whether the step took longer than allowed, or the sample was older than that when the
            message was written.
        prediction_set: The classes that are still possible, the most probable first; empty if the
            model has no rule for it.
        coverage: The share of touches of known kinds whose true class is in the prediction set of
            every step; null without a set.
        names: The kinds of the label's class that are still possible, the most probable first;
            empty if the model distinguishes none.
        names_coverage: The share of touches of that class whose true kind is among the names of
            every step; null without names.
        object: The enrolled object, or "none of these", in the decision of a touch's last step;
            empty before, and if none is enrolled.
        object_margin: The object's score less its threshold; null without objects.
        object_touches: The number of touches from which `object` was identified.
    """

    topic: ClassVar[str] = "decision"
    model: str
    onset_ns: int
    step: int
    final: bool
    label: str
    probabilities: dict[str, float]
    model_ms: float
    latency_ms: float
    age_ms: float = 0.0
    late: bool = False
    prediction_set: tuple[str, ...] = ()
    coverage: float | None = None
    names: tuple[str, ...] = ()
    names_coverage: float | None = None
    object: str = ""
    object_margin: float | None = None
    object_touches: int = 0


class ContactMessage(_FromSource, frozen=True, tag="contact", kw_only=True):
    """Message that contact began (`touching`) or ended; `t_ns` is the stream's time."""

    topic: ClassVar[str] = "contact"
    model: str
    touching: bool


class SkipMessage(_FromSource, frozen=True, tag="skip", kw_only=True):
    """Message that a model was behind its stream and skipped to the newest sample. It decides
    nothing from `from_ns`, the stream time of the first skipped sample, to `until_ns`, that of the
    next sample after these. Of the skipped samples, `lost` did not even reach its contact detector.
    """

    topic: ClassVar[str] = "skip"
    model: str
    from_ns: int
    until_ns: int
    lost: int = 0


class HealthMessage(_Message, frozen=True, tag="health", kw_only=True):
    """Message that a part or a device has changed its state; see `items.Event`."""

    topic: ClassVar[str] = "health"
    part: str
    state: str
    reason: str
    level: str


class SamplesMessage(_FromSource, frozen=True, tag="samples", kw_only=True):
    """Message with a chunk of n samples; `t_ns` and `utc_ns` are of the last.

    Attributes:
        elements, channels, units: The axes of `values`, and the SI unit of each channel.
        seq, times_ns: (n,) The sequence numbers and stream times of the samples.
        values: (n, element, channel) The values, each written as the shortest decimal that reads
            back as the same float32; null where the element has no trustworthy value.
    """

    topic: ClassVar[str] = "samples"
    elements: tuple[str, ...]
    channels: tuple[str, ...]
    units: tuple[str, ...]
    seq: list[int]
    times_ns: list[int]
    values: list[list[list[float] | None]]


class StateMessage(_Message, frozen=True, tag="state", kw_only=True):
    """Message with the state of all parts; see `states.Snapshot`."""

    topic: ClassVar[str] = "state"
    snapshot: Snapshot


Message: TypeAlias = (
    ArrayMessage
    | ContactMessage
    | DecisionMessage
    | HealthMessage
    | SamplesMessage
    | SkipMessage
    | StateMessage
)

_encoder = msgspec.json.Encoder()
_now_ns = time.monotonic_ns  # tests replace it


def encode(message: Message) -> bytes:
    """Encode a message as one line of JSON, without a line break."""
    return _encoder.encode(message)


def topic_of(message: Message, prefix: str = "tactile") -> str:
    """Return a message's topic, such as ``tactile/SOURCE/decision`` or ``tactile/health``.

    Characters of a source's name other than letters, digits and ``-._~`` are percent-encoded.
    """
    parts = [quote(message.source, safe="")] if isinstance(message, _FromSource) else []
    return "/".join([prefix, *parts, message.topic])


def state_message(snapshot: Snapshot) -> StateMessage:
    """Return a snapshot as a message."""
    return StateMessage(t_ns=snapshot.t_ns, utc_ns=snapshot.utc_ns, snapshot=snapshot)


def message_of(item: Item) -> Message | None:
    """Return the message that publishes an item, or None. `Packet`, `Control` and `Closed` are not
    published; an `Event` reports the closed source."""
    if isinstance(item, Decision):
        return _make_decision(item)
    if isinstance(item, SourceChunk):
        return _make_samples(item)
    if isinstance(item, Event):
        utc_ns = item.t_ns + item.utc_offset_ns
        return HealthMessage(
            t_ns=item.t_ns, utc_ns=utc_ns, part=item.part, state=item.state, reason=item.reason,
            level=item.level,
        )  # fmt: skip
    if isinstance(item, Contact):
        return ContactMessage(
            t_ns=item.t_ns, utc_ns=item.t_ns + item.utc_offset_ns, source=item.source,
            frame=item.frame, model=item.model, touching=item.touching,
        )  # fmt: skip
    if isinstance(item, Skipped):
        return SkipMessage(
            t_ns=item.t_ns, utc_ns=item.t_ns + item.utc_offset_ns, source=item.source,
            frame=item.frame, model=item.model, from_ns=item.from_ns, until_ns=item.until_ns,
            lost=item.lost,
        )  # fmt: skip
    if isinstance(item, Opened):
        return ArrayMessage(
            t_ns=item.t_ns, utc_ns=item.t_ns + item.utc_offset_ns, source=item.source,
            frame=item.spec.frame, url=item.url, array=msgspec.to_builtins(item.spec),
        )  # fmt: skip
    return None


def _make_decision(item: Decision) -> DecisionMessage:
    d = item.decision
    age_ns = _now_ns() - item.sample_ns
    return DecisionMessage(
        t_ns=d.t_ns, utc_ns=d.t_ns + item.utc_offset_ns, source=item.source, frame=item.frame,
        model=item.model, onset_ns=d.onset_ns, step=d.step, final=d.final, label=d.label,
        probabilities={
            label: round(p, DIGITS)
            for label, p in zip(d.labels, d.probabilities.tolist(), strict=True)
        },
        model_ms=round(1e3 * d.latency_s, 3),
        latency_ms=round((item.made_ns - item.sample_ns) / 1e6, 3), age_ms=round(age_ns / 1e6, 3),
        late=d.late or (0 < item.deadline_ns < age_ns),
        prediction_set=d.prediction_set, coverage=d.coverage,
        names=d.names, names_coverage=d.names_coverage, object=d.object,
        object_margin=None if d.object_margin is None else round(d.object_margin, DIGITS),
        object_touches=d.object_touches,
    )  # fmt: skip


def _make_samples(item: SourceChunk) -> SamplesMessage:
    chunk, spec = item.chunk, item.spec
    values: list[list[list[float] | None]] = shortest(chunk.values).tolist()
    if not chunk.valid.all():
        values = [
            [cell if ok else None for cell, ok in zip(row, valid, strict=True)]
            for row, valid in zip(values, chunk.valid.tolist(), strict=True)
        ]
    t_ns = int(chunk.t_ns[-1])
    return SamplesMessage(
        t_ns=t_ns, utc_ns=t_ns + item.utc_offset_ns, source=item.source, frame=spec.frame,
        elements=spec.elements, channels=spec.channels, units=spec.units,
        seq=chunk.seq.tolist(), times_ns=chunk.t_ns.tolist(), values=values,
    )  # fmt: skip


# By the exponent bits of a float32: the power of ten that leaves 9 or 10 digits before the point.
_DECIMAL = np.floor((np.arange(256) - 127) * np.log10(2.0)).astype(int)
SCALES = np.array([10.0 ** min(max(MOST - 1 - e, 0), 22) for e in _DECIMAL])


def shortest(values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return float32 numbers as doubles, rounded to the shortest decimals that identify them.

    Such a decimal is nearer to its number than to any other float32, so it is short to write and no
    less exact. The JSON encoder takes doubles only and would write all digits of the same number:
    0.1 as 0.10000000149011612.

    Args:
        values: Numbers in any shape; NaN and infinities stay.
    """
    singles = np.ascontiguousarray(values, np.float32).ravel()
    exact = singles.astype(np.float64)
    size = np.abs(exact)
    within = (size >= SMALLEST) & (size < LARGEST)
    scale = SCALES[singles.view(np.uint32) >> 23 & 0xFF]
    # Whole numbers below 2^53 and powers of ten up to 10^22 are exact in double precision, so that
    # their quotient is the same double that a parser makes of the decimal.
    found = np.rint(exact * scale) / scale
    found[~within] = exact[~within]
    for n in range(1, MOST - FEWEST + 1):
        scale_n = scale / 10.0**n
        fewer = np.rint(exact * scale_n) / scale_n
        np.copyto(found, fewer, where=within & (fewer.astype(np.float32) == singles))
    for i in np.flatnonzero(~within & (size > 0) & np.isfinite(size)).tolist():
        found[i] = float(str(singles[i]))
    made: NDArray[Any] = found.reshape(values.shape)
    return made
