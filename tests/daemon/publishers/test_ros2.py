"""The ROS 2 publisher, heard by a node that knows nothing of it but topics and types."""

import json
import os
import socket
from dataclasses import replace

import numpy as np
import pytest

from bench.daemon import ros2_node
from bench.daemon.ros2 import free_domain, measure
from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.daemon.items import SourceChunk
from tactile_rt.daemon.messages import encode, message_of
from tactile_rt.daemon.publishers.ros2 import Ros2Options, Ros2Publisher
from tests.helpers.published import (
    FORCES,
    UTC,
    View,
    busy_snapshot,
    contact,
    decision,
    event,
    running,
    samples,
)
from tests.helpers.waiting import until

pytestmark = pytest.mark.usefixtures("no_thread_left")
DOMAIN = free_domain()
FINGER = replace(
    FORCES, elements=("tip",), grid=((0, 0),), positions=((0.0, 0.03, 0.0),),
    orientations=((0.5**0.5, 0.0, 0.0, 0.5**0.5),),  # its own x is the mount's y
    channels=("fz", "fx", "fy", "mx", "my", "mz"), units=("N",) * 3 + ("N m",) * 3,
)  # fmt: skip


def publisher(**options):
    return Ros2Publisher("r", Ros2Options(**{"domain": DOMAIN, "state_s": 0, **options}))


class Heard:
    """Subscriptions of a node in this process: `heard["/tactile/health"]` are the messages."""

    def __init__(self, **topics):
        node = ros2_node.Ros2Node(DOMAIN, own=False)
        self._readers = {t: node.subscribe(t, kind, latched=t.endswith("array"))
                         for t, kind in topics.items()}  # fmt: skip
        self._found = {t: [] for t in topics}

    def __getitem__(self, topic):
        self._found[topic] += ros2_node.heard(self._readers[topic])
        return self._found[topic]

    def one(self, topic):
        until(lambda: self[topic])
        (message,) = self[topic]
        return message


@pytest.mark.usefixtures("still_clock")
def test_each_message_comes_to_its_topic_as_its_type():
    items = [decision(), contact(), event(reason="why", level="error")]
    topics = ("/tactile/whiskers/decision", "/tactile/whiskers/contact", "/tactile/health")
    made = publisher()
    with running(made, View(FORCES)) as view:
        kinds = (ros2_node.DecisionMsg, ros2_node.EventMsg, ros2_node.EventMsg)
        heard = Heard(**dict(zip(topics, kinds, strict=True)))
        made.handle(items)
        told, touched, health = (heard.one(topic) for topic in topics)
        assert view.reports == []
    assert told.header == ros2_node.HeaderMsg(ros2_node.TimeMsg(1_700_000_000, 1000), "mount")
    assert (told.source, told.model, told.label, told.step) == ("whiskers", "whiskers", "mug", 2)
    assert dict(zip(told.labels, told.probabilities, strict=True)) == {"duck": 0.25, "mug": 0.75}
    assert np.isnan(told.coverage) and told.prediction_set == [] and not told.is_final
    assert (touched.type, touched.part, touched.touching) == ("contact", "whiskers", True)
    assert (health.type, health.state, health.reason, health.level) == (
        "health", "running", "why", "error",
    )  # fmt: skip
    for item, message in zip(items, (told, touched, health), strict=True):
        assert message.json == encode(message_of(item)).decode()


def test_samples_come_bit_for_bit_and_a_late_node_hears_what_the_array_is():
    made = publisher()
    values = np.array([[1.5, -0.0, 1e-42], [3, np.inf, np.nan]], np.float32)
    with running(made, View(FORCES)):
        heard = Heard(
            **{"/tactile/whiskers/samples": ros2_node.SamplesMsg,
               "/tactile/whiskers/array": ros2_node.ArrayMsg}
        )  # fmt: skip
        made.handle([samples(FORCES, values, t_ns=50, valid=[True, False])])
        message, array = (heard.one(f"/tactile/whiskers/{n}") for n in ("samples", "array"))
    assert (message.seq, message.t_ns, message.valid) == ([3], [50], [True, False])
    assert np.array(message.values, np.float32).tobytes() == values.tobytes()
    assert (message.elements, message.channels) == FORCES.shape
    stamp = message.header.stamp
    assert stamp.sec * 10**9 + stamp.nanosec == UTC + 50 and message.header.frame_id == "head"
    assert (array.source, array.name, array.elements) == ("whiskers", "pair", ["B1", "C2"])
    assert (array.channels, array.units) == (["fx", "fy", "fz"], ["N"] * 3)
    assert (array.rows, array.columns, array.rate_hz) == ([0, 1], [0, 1], 1000.0)
    assert [p.position.y for p in array.poses] == [0.0, 0.03]
    assert array.poses[1].orientation.z == array.poses[1].orientation.w == 0.5**0.5


def test_one_element_is_a_wrench_at_the_origin_of_its_mount():
    made = publisher()
    with running(made, View(FINGER)):
        heard = Heard(**{"/tactile/whiskers/wrench": ros2_node.WrenchStampedMsg})
        # Channels are fz fx fy mx my mz; the element's x is the mount's y, its y is minus x.
        made.handle([samples(FINGER, [[3, 1, 2, 0.25, 0, 0]]),
                     samples(FINGER, [[9] * 6], valid=[False])])  # fmt: skip
        message = heard.one("/tactile/whiskers/wrench")
    force, torque = message.wrench.force, message.wrench.torque
    assert (force.x, force.y, force.z) == pytest.approx((-2, 1, 3))
    # At (0, 0.03, 0): r x F is (0.03 * 3, 0, 0.03 * 2), and the element's own 0.25 about y.
    assert (torque.x, torque.y, torque.z) == pytest.approx((0.09, 0.25, 0.06))
    assert message.header.frame_id == "head"


def test_names_are_those_that_ros_allows_and_the_state_comes_again_and_again():
    made = publisher(prefix="fleet-7/left.arm", state_s=0.01, samples=False)
    with running(made, View(FORCES, busy_snapshot())):
        heard = Heard(**{"/fleet_7/left_arm/state": ros2_node.EventMsg})
        until(lambda: made.handle([]) or len(heard["/fleet_7/left_arm/state"]) > 2)
        (first, *_) = heard["/fleet_7/left_arm/state"]
        assert json.loads(first.json)["snapshot"]["state"] == "degraded"
        assert not any("samples" in name for name in made._writers)
    assert SourceChunk not in made.wants


def test_a_node_that_does_not_read_holds_nobody_up():
    made = publisher(queue=10)
    with running(made, View(FORCES)):
        node = ros2_node.Ros2Node(DOMAIN, own=False)
        reader = node.subscribe("/tactile/health", ros2_node.EventMsg, depth=5)
        fat = event(reason="x" * 200_000)
        for _ in range(100):  # 20 MB
            made.handle([fat])
        assert len(ros2_node.heard(reader)) == 5


def test_it_is_reached_on_loopback_alone_and_opened_again():
    made = publisher()
    for _ in range(2):
        with running(made) as view:
            bound = list(own_devices())
            assert len(bound) >= 2 and set(bound) == {"lo"}
            assert view.reports == []
        assert list(own_devices()) == []


def own_devices():
    """The network interface of each socket at the domain's ports."""
    for handle in os.listdir("/proc/self/fd"):
        try:
            found = socket.socket(fileno=os.dup(int(handle)))
        except OSError:
            continue
        with found:
            port = found.getsockname()[1] if found.family == socket.AF_INET else 0
            if 7400 + 250 * DOMAIN <= port < 7650 + 250 * DOMAIN:
                device = found.getsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, 16)
                yield device.rstrip(b"\0").decode()


def test_beyond_loopback_is_told_and_a_second_one_in_a_domain_refused(tmp_path):
    (tmp_path / "dds.xml").write_text(ros2_node.HERE)
    made, other = publisher(config_file=str(tmp_path / "dds.xml")), publisher()
    with running(made) as view:
        assert [r[1:] for r in view.reports] == [("exposed", "warning")]
        with pytest.raises(SourceError, match=f"no DDS domain {DOMAIN} at 127.0.0.1"):
            other.open(View())
        other.close()
    with pytest.raises(ConfigError, match="No such file"):
        publisher(config_file=str(tmp_path / "none.xml"))


# at the full rate, to another process

QUEUE_MS = 1000.0  # of samples that wait for a node at most


def test_a_thousand_samples_a_second_reach_another_process():
    """How soon they do is measured by `bench.daemon.ros2`, on a quiet machine."""
    ages = measure(seconds=2)
    assert (np.diff(ages.seq) > 0).all() and ages.seq[-1] < ages.sent
    # None is lost unless a busy machine let more wait than the queue holds.
    assert ages.lost == 0 or ages.age_ms.max() > QUEUE_MS / 2
