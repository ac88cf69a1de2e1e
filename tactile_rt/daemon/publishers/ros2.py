"""Messages for ROS 2 nodes: over DDS, with the names of topics and types that ROS 2 uses.

The daemon needs no ROS. A node needs the message definitions, a package that `tactile-rt config
ros2-messages` writes. Messages for a node that cannot keep up are dropped, so it delays nothing.
"""

import os
import re
import socket
import stat
from functools import cache
from ipaddress import IPv4Address
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np
from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.daemon.config import is_loopback
from tactile_rt.daemon.consumer import View
from tactile_rt.daemon.items import Item, Opened, SourceChunk
from tactile_rt.daemon.messages import (
    DecisionMessage,
    Message,
    encode,
    message_of,
    state_message,
    topic_of,
)
from tactile_rt.daemon.publishers.sending import Publisher, SenderOptions, tell_exposed
from tactile_rt.recording.layout import encode_samples
from tactile_rt.recording.ros2 import messages
from tactile_rt.recording.ros2.cdr import SIMPLE, dds_type, fields_of, token

OF_SOURCE = {
    "samples": messages.SAMPLES, "wrench": messages.WRENCH, "decision": messages.DECISION,
    "contact": messages.EVENT, "skip": messages.EVENT,
}  # fmt: skip
KINDS: dict[str, Any] = {
    "bool": bool, "uint8": types.uint8, "int32": types.int32, "uint32": types.uint32,
    "int64": types.int64, "float32": types.float32, "float64": types.float64, "string": str,
}  # fmt: skip
# On loopback, multicast finds no participants: each queries the ports where another may be.
LOOPBACK = """<AllowMulticast>false</AllowMulticast></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="{0}"/></Peers></Discovery>"""
FIRST_PORT, PORTS = 7400, 250  # of domain 0; per domain
CONFIG = """<CycloneDDS><Domain Id="any"><General>
<Interfaces><NetworkInterface address="{0}"/></Interfaces>{1}</Domain></CycloneDDS>"""


class Ros2Options(SenderOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of ``kind = "ros2"``.

    Attributes:
        samples: Whether samples are published, too; for an array of one element that measures a
            force, also as wrenches.
        domain: The DDS domain, as ``ROS_DOMAIN_ID`` of the nodes.
        interface: The IP address of the network interface to publish at. Beyond loopback, everyone
            on that network can read the messages.
        config_file: The file of Cyclone DDS's own configuration (XML), for security, peers and the
            like; it then also selects the interface.
        queue: The number of messages of a topic that may wait for a node before the oldest go.
    """

    samples: bool = True
    domain: Annotated[int, msgspec.Meta(ge=0, le=232)] = 0
    interface: str = "127.0.0.1"
    config_file: str = ""
    queue: Annotated[int, msgspec.Meta(ge=1, le=100_000)] = 1000

    def __post_init__(self) -> None:
        try:
            IPv4Address(self.interface)
        except ValueError:
            raise ValueError(
                f"interface must be an IPv4 address, like 127.0.0.1, not {self.interface}"
            ) from None


class Ros2Publisher(Publisher):
    """A DDS publisher that writes each message to its topic without gathering."""

    Options = Ros2Options

    def __init__(self, name: str, options: Ros2Options) -> None:
        super().__init__(name, options.samples, options.state_s)
        self._options = options
        self.gather_s = 0.0  # a control loop may read it
        self._read_config()  # refuse an unreadable file before anything starts
        self._domain: Domain | None = None
        self._participant: DomainParticipant | None = None
        self._writers: dict[str, DataWriter[Any]] = {}
        self._dropped = 0

    def open(self, view: View) -> None:
        self._view = view
        options = self._options
        try:
            self._domain = Domain(options.domain, self._read_config())
            self._participant = DomainParticipant(options.domain)
        except DDSException as error:
            raise SourceError(
                f"no DDS domain {options.domain} at {options.interface}: {error.msg.rstrip('. ')}"
            ) from None
        if options.config_file:
            tell_exposed(view, self.name, f"what {options.config_file} opens")
        elif not (is_loopback(options.interface) and _keep_to_loopback(options.domain)):
            tell_exposed(view, self.name, f"DDS at {options.interface}")
        for name in ("health", "state"):
            self._find_writer(name, messages.EVENT)
        for opened in view.streams().values():
            self._add_source(opened)

    def handle(self, items: list[Item]) -> None:
        for item in items:
            if isinstance(item, SourceChunk):
                self._write_samples(item)
            elif isinstance(item, Opened):
                self._add_source(item)
            elif (message := message_of(item)) is not None:
                self._write_message(message)
        if self._state_due.now():
            self._write_message(state_message(self._view.snapshot()))

    def close(self) -> None:
        # Writers before their participant, and that before its domain.
        self._writers.clear()
        self._participant = None
        self._domain = None

    def details(self) -> dict[str, str | int | float]:
        listeners = [len(w.get_matched_subscriptions()) for w in tuple(self._writers.values())]
        return {
            "domain": self._options.domain,
            "interface": self._options.config_file or self._options.interface,
            "topics": len(self._writers),
            "nodes": max(listeners, default=0),  # the most that listen to one topic
            "messages": self._messages,
            "bytes": self._bytes,
            "dropped": self._dropped,  # messages that at least one node did not get
        }

    def _add_source(self, item: Opened) -> None:
        """Create a source's topics and publish its array. Nodes can then find the topics before
        the first message, and miss none."""
        spec, wanted = item.spec, dict(OF_SOURCE)
        if not self._options.samples:
            del wanted["samples"], wanted["wrench"]
        elif messages.wrenches_of(spec, np.zeros((0, *spec.shape), np.float32)) is None:
            del wanted["wrench"]
        for name, message in wanted.items():
            self._find_writer(f"{item.source}/{name}", message)
        utc_ns = item.t_ns + item.utc_offset_ns
        data = messages.array_message(item.spec, item.source, utc_ns)
        self._write(f"{item.source}/array", messages.ARRAY, data, keep=True)

    def _write_samples(self, item: SourceChunk) -> None:
        chunk, spec = item.chunk, item.spec
        utc_ns = chunk.t_ns + item.utc_offset_ns
        data = messages.add_header(encode_samples(chunk), int(utc_ns[-1]), spec.frame)
        self._write(f"{item.source}/samples", messages.SAMPLES, data)
        wrenches = messages.wrenches_of(spec, chunk.values)
        if wrenches is None:
            return
        rows = zip(utc_ns.tolist(), wrenches.tolist(), chunk.valid[:, 0], strict=True)
        for at_ns, row, ok in rows:
            if ok:
                data = messages.wrench_message(row, at_ns, spec.frame)
                self._write(f"{item.source}/wrench", messages.WRENCH, data)

    def _write_message(self, message: Message) -> None:
        name = topic_of(message, "").lstrip("/")
        if isinstance(message, DecisionMessage):
            self._write(name, messages.DECISION, messages.decision_message(encode(message)))
        else:
            self._write(name, messages.EVENT, messages.event_message(encode(message)))

    def _write(self, name: str, message: str, data: bytes, keep: bool = False) -> None:
        writer = self._find_writer(name, message, keep)
        try:
            writer.write(_wrap(_make_type(message), data))
        except DDSException as error:
            if error.code != DDSException.DDS_RETCODE_TIMEOUT:
                raise SourceError(f"ros2: {name}: {error.msg}") from None
            self._dropped += 1
        self._messages += 1
        self._bytes += len(data)

    def _find_writer(self, name: str, message: str, keep: bool = False) -> "DataWriter[Any]":
        """Return a topic's writer; with `keep`, nodes that come later get the newest message."""
        if name in self._writers:
            return self._writers[name]
        assert self._participant is not None
        parts = map(token, f"{self._options.prefix}/{name}".split("/"))
        durability = Policy.Durability.TransientLocal if keep else Policy.Durability.Volatile
        qos = Qos(
            Policy.Reliability.Reliable(max_blocking_time=0), durability,
            Policy.History.KeepLast(1 if keep else self._options.queue),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )  # fmt: skip
        topic = Topic(self._participant, f"rt/{'/'.join(parts)}", _make_type(message))
        self._writers[name] = writer = DataWriter(self._participant, topic, qos)
        return writer

    def _read_config(self) -> str:
        options = self._options
        if options.config_file:
            try:
                return Path(options.config_file).read_text("utf-8")
            except (OSError, UnicodeDecodeError) as error:
                raise ConfigError(f"ros2: {options.config_file}: {error}") from None
        lone = is_loopback(options.interface)
        rest = LOOPBACK.format(options.interface) if lone else "</General>"
        return CONFIG.format(options.interface, rest)


def _keep_to_loopback(domain: int) -> bool:
    """Restrict the sockets of DDS to loopback; return whether the system allows that. By itself,
    DDS listens at all addresses."""
    first = FIRST_PORT + PORTS * domain
    for name in os.listdir("/proc/self/fd"):
        try:
            if not stat.S_ISSOCK(os.stat(f"/proc/self/fd/{name}").st_mode):
                continue
            mine = socket.socket(fileno=os.dup(int(name)))
        except OSError:  # closed by now
            continue
        with mine:
            if mine.type == socket.SOCK_DGRAM and mine.family == socket.AF_INET:
                if first <= mine.getsockname()[1] < first + PORTS:
                    try:
                        mine.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo\0")
                    except OSError:
                        return False
    return True


def _wrap(kind: Any, data: bytes) -> Any:
    """Wrap an encoded message as an object of a DDS type."""
    made = kind.__new__(kind)
    made.serialize = lambda **_: data
    return made


@cache
def _make_type(message: str) -> Any:
    """Return the DDS type of a named ROS 2 message definition."""
    fields: dict[str, Any] = {}
    sequence: Any = types.sequence
    for name, kind, many in fields_of(message):
        one = KINDS[kind] if kind in SIMPLE else _make_type(kind)
        fields[name] = sequence[one] if many else one
    name = dds_type(message)
    return make_idl_struct(re.sub(r"\W", "_", name), name.replace("::", "."), fields)
