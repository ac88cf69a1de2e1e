"""A ROS 2 node as far as DDS goes: types, topics and QoS as `rclpy` would have them, by Cyclone's
own API, and written out by hand. As a program it hears samples and says how old they were."""

import json
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import (
    InstanceState,
    Policy,
    Qos,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float32, float64, int32, int64, sequence, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

HERE = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces>
<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


@dataclass
class TimeMsg(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class HeaderMsg(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: TimeMsg
    frame_id: str


@dataclass
class Vector3Msg(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class PointMsg(IdlStruct, typename="geometry_msgs.msg.dds_.Point_"):
    x: float64
    y: float64
    z: float64


@dataclass
class QuaternionMsg(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class PoseMsg(IdlStruct, typename="geometry_msgs.msg.dds_.Pose_"):
    position: PointMsg
    orientation: QuaternionMsg


@dataclass
class WrenchMsg(IdlStruct, typename="geometry_msgs.msg.dds_.Wrench_"):
    force: Vector3Msg
    torque: Vector3Msg


@dataclass
class WrenchStampedMsg(IdlStruct, typename="geometry_msgs.msg.dds_.WrenchStamped_"):
    header: HeaderMsg
    wrench: WrenchMsg


@dataclass
class SamplesMsg(IdlStruct, typename="tactile_rt_msgs.msg.dds_.Samples_"):
    header: HeaderMsg
    seq: sequence[int64]
    t_ns: sequence[int64]
    elements: uint32
    channels: uint32
    values: sequence[float32]
    valid: sequence[bool]


@dataclass
class ArrayMsg(IdlStruct, typename="tactile_rt_msgs.msg.dds_.Array_"):
    header: HeaderMsg
    source: str
    name: str
    elements: sequence[str]
    rows: sequence[int32]
    columns: sequence[int32]
    poses: sequence[PoseMsg]
    channels: sequence[str]
    units: sequence[str]
    rate_hz: float64


@dataclass
class DecisionMsg(IdlStruct, typename="tactile_rt_msgs.msg.dds_.Decision_"):
    header: HeaderMsg
    source: str
    model: str
    t_ns: int64
    onset_ns: int64
    step: uint32
    is_final: bool
    label: str
    labels: sequence[str]
    probabilities: sequence[float64]
    prediction_set: sequence[str]
    coverage: float64
    names: sequence[str]
    names_coverage: float64
    object: str
    object_margin: float64
    object_touches: uint32
    model_ms: float64
    latency_ms: float64
    age_ms: float64
    late: bool
    json: str


@dataclass
class EventMsg(IdlStruct, typename="tactile_rt_msgs.msg.dds_.Event_"):
    header: HeaderMsg
    type: str
    source: str
    part: str
    state: str
    reason: str
    level: str
    touching: bool
    json: str


class Ros2Node:
    """Subscriptions in a domain.

    Args:
        domain: The DDS domain.
        own: Whether this process has no domain of that number yet.
    """

    def __init__(self, domain, own):
        self._domain = Domain(domain, HERE) if own else None
        self.participant = DomainParticipant(domain)

    def subscribe(self, topic, kind, depth=1000, latched=False, best_effort=False):
        """A reader; `heard` takes what has come."""
        durability = Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile
        reliability = (
            Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(10**8)
        )
        qos = Qos(reliability, durability, Policy.History.KeepLast(depth))
        return DataReader(self.participant, Topic(self.participant, f"rt{topic}", kind), qos)


def heard(reader):
    """Messages that have come since the last call; not those that say that a writer has gone."""
    return [m for m in reader.take(10_000) if type(m) is reader.topic.data_type]


def main(domain, topic):
    """Hear samples until one is numbered below 0; tell when each came, and how old it was."""
    node = Ros2Node(int(domain), own=True)
    reader = node.subscribe(topic, SamplesMsg)
    any_state = SampleState.Any | ViewState.Any | InstanceState.Any
    waiting = WaitSet(node.participant)
    waiting.attach(ReadCondition(reader, any_state))
    came, more = [], True
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    while more:
        waiting.wait(10**9)
        for message in heard(reader):
            now = time.monotonic_ns()
            more = more and message.seq[0] >= 0
            came += [(seq, t, now) for seq, t in zip(message.seq, message.t_ns, strict=True)]
    sys.stdout.write(json.dumps(came))


if __name__ == "__main__":
    main(*sys.argv[1:])
