"""The Foxglove publisher against a client that speaks its protocol over a real WebSocket.

Frames are taken apart here by hand, scenes by protobuf with the schema that the server gives.
"""

import base64
import contextlib
import json
import os
import socket
import struct

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from tactile_rt.core.errors import SourceError
from tactile_rt.core.stream import rotation_matrices
from tactile_rt.daemon.publishers.foxglove import FoxgloveOptions, FoxglovePublisher
from tactile_rt.daemon.publishers.scene import turn_x_to
from tactile_rt.daemon.publishers.sending import Due
from tactile_rt.testing import small_spec
from tests.helpers.published import (
    FORCES,
    UTC,
    View,
    busy_snapshot,
    closed,
    contact,
    decision,
    event,
    opened,
    running,
    samples,
)
from tests.helpers.waiting import PATIENCE_S, until

SCENE, VALUES = "/tactile/whiskers/scene", "/tactile/whiskers/values"
PROTOCOL = "foxglove.sdk.v1"
pytestmark = pytest.mark.usefixtures("no_thread_left")


class Client:
    """What the app does: takes all channels that it is told of."""

    def __init__(self, publisher, topics=None):
        self._stack = contextlib.ExitStack()
        options = {"max_size": None, "compression": None, "close_timeout": 0.2}
        line = connect(publisher.details()["url"], subprotocols=[PROTOCOL], **options)
        self.line = self._stack.enter_context(line)
        assert self.line.subprotocol == PROTOCOL
        self._publisher, self.channels, self.topics = publisher, {}, topics
        self._got = []

    def subscribed(self):
        """Until all channels that it takes have it as their reader."""

        def is_reader():
            taken = {
                topic: channel
                for topic, channel in self._publisher._channels.items()
                if self.topics is None or topic in self.topics
            }
            known = [c["topic"] for c in self.channels.values()]
            return all(known.count(t) == 1 and taken[t].has_sinks() for t in taken)

        until(is_reader, meanwhile=lambda: self._take(0.01))

    def read(self, *topics):
        """What has come once each of these topics has: [(topic, log time, body)]."""
        until(
            lambda: set(topics) <= {topic for topic, _, _ in self._got},
            meanwhile=lambda: self._take(0.01),
        )
        found, self._got = self._got, []
        return found

    def _take(self, timeout):
        try:
            data = self.line.recv(timeout)
        except TimeoutError:
            return
        if isinstance(data, str):
            self._told(json.loads(data))
            return
        # Operation 1: message data; then uint32 subscription, uint64 log time, little endian.
        op, channel, log_ns = struct.unpack_from("<BIQ", data)
        assert op == 1
        self._got.append((self.channels[channel]["topic"], log_ns, data[13:]))

    def close(self):
        self._stack.close()

    def _told(self, said):
        if said["op"] == "unadvertise":
            for n in said["channelIds"]:
                del self.channels[n]
        if said["op"] != "advertise":
            return
        self.channels |= {c["id"]: c for c in said["channels"]}
        new = [c for c in said["channels"] if self.topics is None or c["topic"] in self.topics]
        asked = [{"id": c["id"], "channelId": c["id"]} for c in new]
        self.line.send(json.dumps({"op": "subscribe", "subscriptions": asked}))

    def channel(self, topic):
        return next(c for c in self.channels.values() if c["topic"] == topic)

    def scenes(self, found):
        """SceneUpdates, decoded with the schema that came with the channel."""
        schema = self.channel(SCENE)
        assert schema["schemaName"] == "foxglove.SceneUpdate"
        files = descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(schema["schema"]))
        pool = descriptor_pool.DescriptorPool()
        for file in files.file:
            pool.Add(file)
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName("foxglove.SceneUpdate"))
        return [(t, kind.FromString(b)) for topic, t, b in found if topic == SCENE]


@pytest.fixture
def served():
    """(publisher, client, view) of a pair of whiskers; everything that came first is read."""
    publisher = FoxglovePublisher("fox", FoxgloveOptions(port=0, rate_hz=200, m_per_n=2.0))
    with running(publisher, View(FORCES, busy_snapshot())) as view:
        publisher._repeat_due = Due(0)
        client = Client(publisher)
        client.subscribed()
        yield publisher, client, view
        client.close()


def test_all_topics_are_there_for_whoever_comes(served):
    _, client, _ = served
    own = {"/tactile/log", "/tactile/state", "/tactile/whiskers/array"}
    assert {c["topic"] for c in client.channels.values()} == {*own, SCENE, VALUES}
    values = client.channel(VALUES)
    assert (values["encoding"], values["schemaEncoding"]) == ("json", "jsonschema")
    fields = json.loads(values["schema"])["properties"]
    assert fields["fx"]["properties"] == {"B1": {"type": "number"}, "C2": {"type": "number"}}


def test_decisions_and_health_are_json_and_each_probability_can_be_plotted(served):
    publisher, client, _ = served
    items = [decision(), decision("second"), contact(), event(reason="why", level="warning")]
    publisher.handle(items)  # channels come with the first of their kind
    client.subscribed()
    publisher.handle(items)
    topics = [f"/tactile/{x}" for x in ("health", "log", "whiskers/contact", "whiskers/decision")]
    read = client.read(*topics, "/tactile/whiskers/decision/second")
    found = {topic: (t, body) for topic, t, body in read}
    at, body = found["/tactile/whiskers/decision"]
    said = json.loads(body)
    assert at == UTC + 1000 == said["utc_ns"] and said["version"] == 1
    assert said["probabilities"] == {"duck": 0.25, "mug": 0.75}
    schema = json.loads(client.channel("/tactile/whiskers/decision")["schema"])
    plot = schema["properties"]["probabilities"]["properties"]
    assert plot == {"duck": {"type": "number"}, "mug": {"type": "number"}}
    assert "$ref" not in json.dumps(schema)
    other = json.loads(found["/tactile/whiskers/decision/second"][1])
    assert other["model"] == "second"
    assert json.loads(found["/tactile/whiskers/contact"][1])["touching"] is True
    assert json.loads(found["/tactile/health"][1])["reason"] == "why"
    assert b"running why" in found["/tactile/log"][1]


def test_forces_are_arrows_at_the_bases_in_the_mount_frame(served):
    publisher, client, _ = served
    publisher.handle([samples(FORCES, [[0.01, 0, 0], [0.02, 0, 0]], t_ns=500)])
    found = client.read(SCENE, VALUES)
    ((at, update),) = client.scenes(found)
    (entity,) = update.entities
    assert at == UTC + 500 == entity.timestamp.seconds * 10**9 + entity.timestamp.nanos
    assert (entity.frame_id, entity.id) == ("head", "whiskers/forces")
    first, second = entity.arrows
    assert (second.pose.position.x, second.pose.position.y) == (0.0, 0.03)
    # 2 m for 1 N: 10 mN are 20 mm, shaft and head together.
    assert first.shaft_length + first.head_length == pytest.approx(0.02)
    assert second.shaft_length + second.head_length == pytest.approx(0.04)
    # Arrows point along x. The second element is turned by a quarter about z: its x is our y.
    for arrow, along in ((first, (1, 0, 0)), (second, (0, 1, 0))):
        q = arrow.pose.orientation
        turned = rotation_matrices([[q.w, q.x, q.y, q.z]])[:, :, 0]
        assert turned[0] == pytest.approx(along, abs=1e-6)
    ((_, body),) = [(t, b) for topic, t, b in found if topic == "/tactile/whiskers/values"]
    assert json.loads(body)["fx"] == {"B1": pytest.approx(0.01), "C2": pytest.approx(0.02)}


def test_what_cannot_be_trusted_is_not_shown(served):
    publisher, client, _ = served
    publisher.handle([samples(FORCES, [[0.01, 0, 0], [np.nan, 0, 0]], valid=[False, True])])
    found = client.read(SCENE, VALUES)
    ((_, update),) = client.scenes(found)
    assert len(update.entities[0].arrows) == 0
    ((_, body),) = [(t, b) for topic, t, b in found if topic == "/tactile/whiskers/values"]
    assert json.loads(body)["fx"] == {"B1": None, "C2": None}


def test_bases_and_state_are_repeated_and_go_when_the_source_goes(served):
    publisher, client, _ = served
    publisher._repeat_due = Due(1e-6)
    publisher.handle([])
    found = client.read(SCENE, "/tactile/state", "/tactile/whiskers/array")
    ((_, update),) = client.scenes(found)
    (entity,) = update.entities
    assert entity.id == "whiskers/array" and len(entity.spheres) == 2
    points = np.array([(p.x, p.y, p.z) for p in entity.lines[0].points])
    assert points[2] == pytest.approx([0, 0.03, 0])
    assert points[3][1] > 0.03 and points[3][0] == pytest.approx(0)  # along its own x
    assert {"/tactile/state", "/tactile/whiskers/array"} <= {topic for topic, _, _ in found}
    publisher._repeat_due = Due(0)
    publisher.handle([closed()])
    ((_, update),) = client.scenes(client.read(SCENE))
    assert {d.id for d in update.deletions} == {"whiskers/array", "whiskers/forces"}
    # Another array under the same name: its values have another schema.
    publisher.handle([opened(small_spec())])
    client.subscribed()
    fields = json.loads(client.channel("/tactile/whiskers/values")["schema"])["properties"]
    assert {"fy", "mz"} <= fields.keys() and "fx" not in fields


def test_one_that_does_not_read_holds_nobody_up_and_nothing_is_made_for_nobody(served):
    publisher, quick, _ = served
    lazy = Client(publisher, {"/tactile/health"})
    fat = event(reason="x" * 20_000)
    publisher.handle([fat])
    lazy.subscribed()
    quick.topics = set()
    before = publisher.details()["messages"]
    for _ in range(2500):  # 50 MB, more than the system and the server keep for one client
        publisher.handle([fat])
    assert publisher.details()["messages"] >= before + 2500
    publisher.handle([decision()])
    lazy.line.socket.shutdown(socket.SHUT_RDWR)
    lazy.close()


def test_without_subscribers_nothing_is_encoded():
    publisher = FoxglovePublisher("fox", FoxgloveOptions(port=0))
    with running(publisher, View(FORCES, busy_snapshot())):
        publisher.handle([decision(), event(), samples(FORCES, [[1, 0, 0]] * 2)])
        assert publisher.details()["messages"] == 0


def lasting_port() -> int:
    """Find a free port below those that connections of other processes are given meanwhile."""
    for port in range(20_000 + os.getpid() % 10_000, 32_768):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no port is free")


def test_it_comes_back_after_close_and_names_a_port_that_is_taken():
    publisher = FoxglovePublisher("fox", FoxgloveOptions(port=lasting_port()))
    with running(publisher, View(FORCES)):
        client = Client(publisher)
        client.subscribed()
        port = int(publisher.details()["url"].rpartition(":")[2])
        other = FoxglovePublisher("fox", FoxgloveOptions(port=port))
        with pytest.raises(SourceError, match=f"cannot listen at 127.0.0.1:{port}: .*in use"):
            other.open(View())
        other.close()
    with pytest.raises(ConnectionClosed):
        while client.line.recv(PATIENCE_S):  # what was on the way
            pass
    client.close()

    def free() -> bool:  # the server lets go of its port in a thread of its own
        with socket.socket() as line:
            return line.connect_ex(("127.0.0.1", port)) != 0

    until(free)
    with running(other, View(FORCES)):
        client = Client(other)
        client.subscribed()
        assert client.channels
        client.close()


def test_others_can_look_only_if_asked_and_then_it_is_told():
    assert FoxgloveOptions().host == "127.0.0.1"
    with running(FoxglovePublisher("f", FoxgloveOptions(host="0.0.0.0", port=0))) as view:
        assert view.reports == [("publisher.f", "exposed", "warning")]


def test_turns_take_x_to_any_direction():
    rng = np.random.default_rng(0)
    found = rng.normal(size=(50, 3))
    found = np.vstack([found, np.eye(3), -np.eye(3)])
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    turns = turn_x_to(found)
    assert np.linalg.norm(turns, axis=1) == pytest.approx(1)
    assert np.allclose(rotation_matrices(turns)[:, :, 0], found, atol=1e-9)
