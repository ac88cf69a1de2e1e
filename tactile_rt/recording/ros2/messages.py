"""What we tell, as ROS 2 messages."""

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
BODY = 12  # where the first sample's number is in a message of samples without header
FORCE, TORQUE = ("fx", "fy", "fz"), ("mx", "my", "mz")

Int64 = Annotated[int, msgspec.Meta(ge=-(2**63), le=2**63 - 1)]
UInt32 = Annotated[int, msgspec.Meta(ge=0, le=2**32 - 1)]


class _Told(msgspec.Struct):
    """What is looked for in JSON; of what is not there, or is of another type, nothing is told."""

    type: str = "device"
    t_ns: Int64 = 0
    utc_ns: Int64 = 0
    utc_offset_ns: Int64 = 0
    source: str = ""
    frame: str = ""

    def header(self) -> dict[str, Any]:
        return _header(self.utc_ns or self.t_ns + self.utc_offset_ns, self.frame)


class _Decision(_Told):
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


class _Event(_Told):
    model: str = ""
    part: str = ""
    state: str = ""
    reason: str = ""
    level: str = ""
    touching: bool = False


def decision_message(text: bytes) -> bytes:
    """A decision, which is a line of JSON, as a message."""
    try:
        said = msgspec.json.decode(text, type=_Decision)
    except msgspec.MsgspecError:
        said = _Decision()
    return cdr.encode(
        DECISION,
        {
            "header": said.header(), "source": said.source, "model": said.model,
            "t_ns": said.t_ns, "onset_ns": said.onset_ns, "step": said.step,
            "is_final": said.final, "label": said.label, "labels": list(said.probabilities),
            "probabilities": list(said.probabilities.values()),
            "prediction_set": said.prediction_set,
            "coverage": math.nan if said.coverage is None else said.coverage,
            "names": said.names,
            "names_coverage": math.nan if said.names_coverage is None else said.names_coverage,
            "object": said.object,
            "object_margin": math.nan if said.object_margin is None else said.object_margin,
            "object_touches": said.object_touches,
            "model_ms": said.model_ms, "latency_ms": said.latency_ms, "age_ms": said.age_ms,
            "late": said.late, "json": text.decode(),
        },
    )  # fmt: skip


def event_message(text: bytes) -> bytes:
    """Whatever else is told, a line of JSON, as a message."""
    try:
        said = msgspec.json.decode(text, type=_Event)
    except msgspec.MsgspecError:
        said = _Event()
    return cdr.encode(
        EVENT,
        {
            "header": said.header(), "type": said.type, "source": said.source,
            "part": said.part or said.model, "state": said.state, "reason": said.reason,
            "level": said.level, "touching": said.touching, "json": text.decode(),
        },
    )  # fmt: skip


def json_of(message: str, data: bytes) -> bytes:
    """Return the JSON of a decision or an event, or raise ValueError."""
    text: str = cdr.decode(message, data)["json"]
    return text.encode()


def array_message(spec: ArraySpec, source: str, utc_ns: int) -> bytes:
    """What an array is."""
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


def stamped(samples: bytes, utc_ns: int, frame: str) -> bytes:
    """Samples as `recording.layout.encode_samples` writes them, with a header before."""
    begin = bytearray(cdr.header(utc_ns, frame))
    begin += bytes(-len(begin) % 4)
    begin += samples[4:8]  # how many there are
    begin += bytes(-(len(begin) - 4) % 8)
    return bytes(begin) + samples[BODY:]


def unstamped(data: bytes) -> bytes:
    """Return the samples that `stamped` took; raise ValueError if there is no header."""
    at = cdr.header_size(data)
    at += -at % 4
    many = data[at : at + 4]
    at += 4
    at += -(at - 4) % 8
    return data[:4] + many + bytes(4) + data[at:]


def wrenches_of(spec: ArraySpec, values: NDArray[np.float32]) -> NDArray[np.float64] | None:
    """Force and torque at the origin of the mount frame, in its axes, as ROS 2 has a wrench.

    Args:
        spec: The array; only one of a single element that measures a whole force in N has a wrench.
        values: (n, 1, channel) of such an array.

    Returns:
        (n, 6) N and N m; where the element measures no torque, that of the force alone. None: the
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
    """A row of `wrenches_of`, taken at this time, in the mount frame."""
    parts = {"force": _vector(wrench[:3]), "torque": _vector(wrench[3:])}
    return cdr.encode(WRENCH, {"header": _header(utc_ns, frame), "wrench": parts})


def _vector(numbers: Any) -> Mapping[str, float]:
    return dict(zip("xyz", numbers, strict=True))


def array_of(data: bytes) -> ArraySpec:
    """Return the array of a message of `array_message`, or raise ValueError."""
    told = cdr.decode(ARRAY, data)
    poses = told["poses"]
    return ArraySpec(
        name=told["name"],
        elements=tuple(told["elements"]),
        grid=tuple(zip(map(int, told["rows"]), map(int, told["columns"]), strict=True)),
        positions=tuple((p["x"], p["y"], p["z"]) for p in (pose["position"] for pose in poses)),
        orientations=tuple(
            (q["w"], q["x"], q["y"], q["z"]) for q in (pose["orientation"] for pose in poses)
        ),
        channels=tuple(told["channels"]),
        units=tuple(told["units"]),
        rate_hz=float(told["rate_hz"]),
        frame=told["header"]["frame_id"],
    )


def _header(utc_ns: int, frame: str) -> dict[str, Any]:
    seconds, ns = divmod(min(max(utc_ns, 0), cdr.MOST_S * cdr.NS), cdr.NS)
    return {"stamp": {"sec": seconds, "nanosec": ns}, "frame_id": frame}
