"""Messages over ROS 2 (rclpy). UNTESTED: it has not been run with a ROS 2 installation.

    [project.entry-points."tactile_rt.publishers"]
    ros2 = "tactile_ros2:Ros2Publisher"

    [[publisher]]
    kind = "ros2"

Each topic carries the JSON of docs/messages.md as std_msgs/String; the forces of an array whose
channels are fx fy fz mx my mz also go out as one geometry_msgs/WrenchStamped per element. Install
tactile_rt into a virtual environment made with --system-site-packages, after sourcing ROS 2.
"""

import re
from typing import Any

import rclpy
from geometry_msgs.msg import WrenchStamped
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from tactile_rt.daemon.consumer import View
from tactile_rt.daemon.items import Item, SourceChunk
from tactile_rt.daemon.messages import Message, encode, topic_of
from tactile_rt.daemon.publishers.sending import Sender, SenderOptions

CHANNELS = ("fx", "fy", "fz", "mx", "my", "mz")
# Best effort, of which the newest are kept: a subscriber that is slow holds nobody up.
QOS = QoSProfile(
    depth=10, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT
)


class Ros2Options(SenderOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of ``kind = "ros2"``; `wrenches` sends the newest sample of each batch."""

    wrenches: bool = False


class Ros2Publisher(Sender):
    Options = Ros2Options

    def __init__(self, name: str, options: Ros2Options) -> None:
        super().__init__(name, options)
        self._options = options
        if options.wrenches:
            self.wants = frozenset({*self.wants, SourceChunk})
        self._context: Any = None
        self._node: Any = None
        self._topics: dict[str, Any] = {}

    def _connect(self, view: View) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context, signal_handler_options=rclpy.SignalHandlerOptions.NO)
        self._node = rclpy.create_node("tactile_rt", context=self._context)

    def handle(self, items: list[Item]) -> None:
        if not self._options.wrenches:
            super().handle(items)
            return
        for item in items:
            if isinstance(item, SourceChunk) and item.spec.channels == CHANNELS:
                self._wrenches(item)
        wanted = self._options.samples
        super().handle([i for i in items if wanted or not isinstance(i, SourceChunk)])

    def _send(self, message: Message) -> int:
        data = encode(message)
        topic = self._topic(topic_of(message, self._options.prefix), String)
        topic.publish(String(data=data.decode()))
        return len(data)

    def _wrenches(self, item: SourceChunk) -> None:
        utc_ns = int(item.chunk.t_ns[-1]) + item.utc_offset_ns
        values, valid = item.chunk.values[-1].tolist(), item.chunk.valid[-1].tolist()
        for element, row, ok in zip(item.spec.elements, values, valid, strict=True):
            if not ok:
                continue
            message = WrenchStamped()
            # The element's own frame: publish its pose in item.spec.frame with tf2.
            message.header.frame_id = f"{item.spec.frame}/{element}"
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(utc_ns, 10**9)
            force, torque = message.wrench.force, message.wrench.torque
            force.x, force.y, force.z, torque.x, torque.y, torque.z = row
            name = f"{self._options.prefix}/{item.source}/wrench/{element}"
            self._topic(name, WrenchStamped).publish(message)

    def _topic(self, name: str, kind: Any) -> Any:
        legal = re.sub(r"[^A-Za-z0-9_/]", "_", name)
        if legal not in self._topics:
            self._topics[legal] = self._node.create_publisher(kind, legal, QOS)
        return self._topics[legal]

    def close(self) -> None:
        self._topics.clear()
        node, self._node = self._node, None
        context, self._context = self._context, None
        if node is not None:
            node.destroy_node()
        if context is not None:
            rclpy.shutdown(context=context)
