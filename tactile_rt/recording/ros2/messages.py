"""Samples, decisions, events, arrays and wrenches as ROS 2 messages."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec, rotation_matrices
from tactile_rt.recording.ros2 import cdr

OURS = "tactile_rt_msgs/msg"
ARRAY, DECISION, EVENT, SAMPLES = (f"{OURS}/{n}" for n in ("Array", "Decision", "Event", "Samples"))
WRENCH = "geometry_msgs/msg/WrenchStamped"
BODY = 12  # offset of the first sequence number in a message of samples without header
FORCE, TORQUE = ("fx", "fy", "fz"), ("mx", "my", "mz")

Int64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
UInt32 = Annotated[int, msgspec.Meta(ge=0, le=2**32 - 1)]


class _Message(msgspec.Struct):
    """Fields that are read from a JSON message; missing fields get these defaults."""

    type: str = "device"
    t_ns: Int64 = 0
    utc_ns: Int64 = 0
    utc_offset_ns: Int64 = 0
    source: str = ""
    frame: str = ""

    def header(self) -> dict[str, Any]:
        return _header(self.utc_ns or self.t_ns + self.utc_offset_ns, self.frame)


class _Decision(_Message):
    model: str = ""
    onset_ns: Int64 = 0
    step: UInt32 = 0
    final: bool = False
    label: str = ""
    probabilities: dict[str, float] = {}
    prediction_set: list[str] = []
    coverage: float | None = None
    names: list[str] = []
    names_coverage: float | None = None
    object: str = ""
    object_margin: float | None = None
    object_touches: UInt32 = 0
    model_ms: float = 0.0
    latency_ms: float = 0.0
    age_ms: float = 0.0
    late: bool = False


class _Event(_Message):
    model: str = ""
    part: str = ""
    state: str = ""
    reason: str = ""
    level: str = ""
    touching: bool = False


def decision_message(text: bytes) -> bytes:
    """Encode a decision from a line of JSON; use default fields if it is malformed."""
    try:
        parsed = msgspec.json.decode(text, type=_Decision)
    except msgspec.MsgspecError:
        parsed = _Decision()
    return cdr.encode(
        DECISION,
        {
            "header": parsed.header(), "source": parsed.source, "model": parsed.model,
            "t_ns": parsed.t_ns, "onset_ns": parsed.onset_ns, "step": parsed.step,
            "is_final": parsed.final, "label": parsed.label, "labels": list(parsed.probabilities),
            "probabilities": list(parsed.probabilities.values()),
            "prediction_set": parsed.prediction_set,
            "coverage": math.nan if parsed.coverage is None else parsed.coverage,
            "names": parsed.names,
            "names_coverage": math.nan if parsed.names_coverage is None else parsed.names_coverage,
            "object": parsed.object,
            "object_margin": math.nan if parsed.object_margin is None else parsed.object_margin,
            "object_touches": parsed.object_touches,
            "model_ms": parsed.model_ms, "latency_ms": parsed.latency_ms, "age_ms": parsed.age_ms,
            "late": parsed.late, "json": text.decode(),
        },
    )  # fmt: skip


def event_message(text: bytes) -> bytes:
    """Encode an event or health from JSON; use default fields if it is malformed."""
    try:
        parsed = msgspec.json.decode(text, type=_Event)
    except msgspec.MsgspecError:
        parsed = _Event()
    return cdr.encode(
        EVENT,
        {
            "header": parsed.header(), "type": parsed.type, "source": parsed.source,
            "part": parsed.part or parsed.model, "state": parsed.state, "reason": parsed.reason,
            "level": parsed.level, "touching": parsed.touching, "json": text.decode(),
        },
    )  # fmt: skip


def json_of(message: str, data: bytes) -> bytes:
    """Return the JSON text of a decision or an event. Raise ValueError if it is neither."""
    text: str = cdr.decode(message, data)["json"]
    return text.encode()


def array_message(spec: ArraySpec, source: str, utc_ns: int) -> bytes:
    """Encode the spec of an array as a message."""
    rows, columns = zip(*spec.grid, strict=True)
    poses = [
        {"position": _vector(position), "orientation": {"w": w, "x": x, "y": y, "z": z}}
        for position, (w, x, y, z) in zip(spec.positions, spec.orientations, strict=True)
    ]
    return cdr.encode(
        ARRAY,
        {
            "header": _header(utc_ns, spec.frame), "source": source, "name": spec.name,
            "elements": spec.elements, "rows": rows, "columns": columns, "poses": poses,
            "channels": spec.channels, "units": spec.units, "rate_hz": spec.rate_hz,
        },
    )  # fmt: skip


def add_header(samples: bytes, utc_ns: int, frame: str) -> bytes:
    """Insert a header into samples that `recording.layout.encode_samples` wrote."""
    begin = bytearray(cdr.header(utc_ns, frame))
    begin += bytes(-len(begin) % 4)
    begin += samples[4:8]  # number of samples
    begin += bytes(-(len(begin) - 4) % 8)
    return bytes(begin) + samples[BODY:]


def strip_header(data: bytes) -> bytes:
    """Remove the header that `add_header` inserted; raise ValueError if it is missing."""
    at = cdr.header_size(data)
    at += -at % 4
    many = data[at : at + 4]
    at += 4
    at += -(at - 4) % 8
    return data[:4] + many + bytes(4) + data[at:]


def wrenches_of(spec: ArraySpec, values: NDArray[np.float32]) -> NDArray[np.float64] | None:
    """Return ROS 2 wrenches: force and torque at the mount frame's origin, in its axes.

    Args:
        spec: The array; only an array of one element that measures fx, fy and fz in N has a wrench.
        values: (n, 1, channel) values of such an array, SI.

    Returns:
        (n, 6) N and N m; if the element measures no torque, that of the force alone. None if the
        array has no wrench.
    """
    units = dict(zip(spec.channels, spec.units, strict=True))
    if len(spec.elements) != 1 or any(units.get(c) != "N" for c in FORCE):
        return None
    at = {c: k for k, c in enumerate(spec.channels)}
    rows = values[:, 0].astype(np.float64)
    turn, base = rotation_matrices(spec.orientations[0]), np.array(spec.positions[0])
    force = rows[:, [at[c] for c in FORCE]] @ turn.T
    torque = np.cross(base, force)
    if set(TORQUE) <= set(at):
        torque += rows[:, [at[c] for c in TORQUE]] @ turn.T
    return np.concatenate([force, torque], axis=1)


def wrench_message(wrench: Sequence[float], utc_ns: int, frame: str) -> bytes:
    """Encode a row of `wrenches_of` with its UTC time, ns, in the mount frame."""
    parts = {"force": _vector(wrench[:3]), "torque": _vector(wrench[3:])}
    return cdr.encode(WRENCH, {"header": _header(utc_ns, frame), "wrench": parts})


def _vector(numbers: Any) -> Mapping[str, float]:
    return dict(zip("xyz", numbers, strict=True))


def array_of(data: bytes) -> ArraySpec:
    """Decode a message of `array_message` to a spec; raise ValueError if it is none."""
    fields = cdr.decode(ARRAY, data)
    poses = fields["poses"]
    return ArraySpec(
        name=fields["name"],
        elements=tuple(fields["elements"]),
        grid=tuple(zip(map(int, fields["rows"]), map(int, fields["columns"]), strict=True)),
        positions=tuple((p["x"], p["y"], p["z"]) for p in (pose["position"] for pose in poses)),
        orientations=tuple(
            (q["w"], q["x"], q["y"], q["z"]) for q in (pose["orientation"] for pose in poses)
        ),
        channels=tuple(fields["channels"]),
        units=tuple(fields["units"]),
        rate_hz=float(fields["rate_hz"]),
        frame=fields["header"]["frame_id"],
    )


def _header(utc_ns: int, frame: str) -> dict[str, Any]:
    seconds, ns = divmod(min(max(utc_ns, 0), cdr.MOST_S * cdr.NS), cdr.NS)
    return {"stamp": {"sec": seconds, "nanosec": ns}, "frame_id": frame}
