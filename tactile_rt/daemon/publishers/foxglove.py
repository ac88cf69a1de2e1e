"""Live data for Foxglove: a WebSocket server that the app opens as a data source.

The topics of a source are a 3-D ``scene``, ``values`` to plot, ``decision``, ``contact`` and
``array``; those of the daemon ``health``, ``log`` and ``state``. Messages without a subscriber are
not encoded. A slow client loses messages beyond the 1024 that the SDK keeps for it.
"""

import logging
import time
from typing import Annotated, Any
from urllib.parse import quote

import msgspec
from foxglove import Channel, Context, start_server
from foxglove.channels import LogChannel, SceneUpdateChannel
from foxglove.messages import Log, LogLevel, Timestamp
from foxglove.websocket import WebSocketServer

from tactile_rt.core.errors import SourceError
from tactile_rt.core.stream import ArraySpec
from tactile_rt.daemon.consumer import TAKEN, Consumer, View
from tactile_rt.daemon.items import (
    Closed,
    Contact,
    Decision,
    Event,
    Item,
    Opened,
    Skipped,
    SourceChunk,
)
from tactile_rt.daemon.messages import (
    DecisionMessage,
    HealthMessage,
    Message,
    encode,
    message_of,
    shortest,
    topic_of,
)
from tactile_rt.daemon.publishers.scene import Scene
from tactile_rt.daemon.publishers.sending import (
    ConnectionLimit,
    Connections,
    Due,
    Prefix,
    repeat_messages,
    tell_exposed,
)

REPEAT_S = 1.0  # a client that comes late sees the array within this time
LEVELS = {"info": LogLevel.Info, "warning": LogLevel.Warning, "error": LogLevel.Error}


class FoxgloveOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of ``kind = "foxglove"``.

    Attributes:
        host: The address to listen on. Foxglove's protocol has no password.
        port: The TCP port to listen on; 0: a free one.
        rate_hz: The highest rate of ``scene`` and ``values`` messages, Hz.
        m_per_n: The length of the arrow of a force of 1 N, m; 0 adapts it to the largest force.
    """

    host: Annotated[str, msgspec.Meta(min_length=1, max_length=255)] = "127.0.0.1"
    port: Annotated[int, msgspec.Meta(ge=0, le=65535)] = 8766
    prefix: Prefix = "tactile"
    rate_hz: Annotated[float, msgspec.Meta(ge=0.1, le=200)] = 25.0
    m_per_n: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = 0.0
    connections: Connections = 32


class FoxglovePublisher(Consumer):
    """A server of the Foxglove WebSocket protocol (``foxglove.sdk.v1``)."""

    Options = FoxgloveOptions
    wants = frozenset({Opened, Closed, SourceChunk, Decision, Contact, Skipped, Event})
    tick_s = REPEAT_S

    def __init__(self, name: str, options: FoxgloveOptions) -> None:
        self.name, self._options = name, options
        self.gather_s = 1 / options.rate_hz
        self._server: WebSocketServer | None = None
        self._limit: ConnectionLimit | None = None
        self._context = Context()
        self._channels: dict[str, Any] = {}
        self._log: LogChannel | None = None
        self._scenes: dict[str, Scene] = {}
        self._repeat_due = Due(REPEAT_S)
        self._due: dict[str, float] = {}
        self._messages = 0
        self._port = options.port

    def open(self, view: View) -> None:
        host, port = self._options.host, self._options.port
        self._view, self._context = view, Context()
        # The SDK would log an error on stderr for each client that leaves without a close message.
        logging.getLogger("foxglove").setLevel(logging.CRITICAL + 1)
        try:
            self._server = start_server(
                name="tactile_rt", host=host, port=port, context=self._context
            )
        except RuntimeError as error:
            why = str(error).removeprefix("FoxgloveError: ").partition(" (os error")[0]
            raise SourceError(f"cannot listen at {host}:{port}: {why}") from None
        self._port = self._server.port
        name, most = f"{self.name} limit", self._options.connections
        self._limit = ConnectionLimit(name, {self._port}, most)
        tell_exposed(view, self.name, host)
        # The app's message paths begin with a slash.
        self._log = LogChannel(f"/{self._options.prefix}/log", context=self._context)
        self._channels[self._log.topic()] = self._log
        for opened in view.streams().values():
            self._add_source(opened)
        self._repeat(view)

    def handle(self, items: list[Item]) -> None:
        newest: dict[str, SourceChunk] = {}
        for item in items:
            if isinstance(item, SourceChunk):
                newest[item.source] = item
                continue
            if isinstance(item, Opened):
                self._add_source(item)
            elif isinstance(item, Closed):
                self._remove_source(item)
            message = message_of(item)
            if message is not None:
                self._publish(message)
        for samples in newest.values():
            self._show(samples)
        self._repeat(self._view)

    def close(self) -> None:
        server, self._server = self._server, None
        limit, self._limit = self._limit, None
        channels, self._channels = self._channels, {}
        self._scenes.clear()
        for channel in channels.values():
            channel.close()
        if limit is not None and server is not None:
            limit.close(server.stop)
        elif server is not None:
            server.stop()

    def diagnose(self) -> str:
        limit = self._limit
        return TAKEN if limit is not None and limit.full else ""

    def details(self) -> dict[str, str | int | float]:
        return {
            "url": f"ws://{self._options.host}:{self._port}",
            "messages": self._messages,
            "topics": len(self._channels),
        }

    def _publish(self, message: Message) -> None:
        topic = f"/{topic_of(message, self._options.prefix)}"
        if isinstance(message, DecisionMessage) and message.model != message.source:
            # If two models alternated in one topic, a plot would show neither.
            topic += f"/{quote(message.model, safe='')}"
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._add_channel(topic, schema_of(message))
        if channel.has_sinks():
            channel.log(encode(message), log_time=message.utc_ns)
            self._messages += 1
        if isinstance(message, HealthMessage):
            self._log_health(message)

    def _log_health(self, message: HealthMessage) -> None:
        if self._log is None or not self._log.has_sinks():
            return
        seconds, ns = divmod(message.utc_ns, 10**9)
        self._log.log(
            Log(
                timestamp=Timestamp(sec=seconds, nsec=ns), level=LEVELS[message.level],
                name=message.part, message=f"{message.state} {message.reason}".strip(),
            ),
            log_time=message.utc_ns,
        )  # fmt: skip
        self._messages += 1

    def _add_source(self, item: Opened) -> None:
        base = self._make_base_topic(item.source)
        self._scenes[item.source] = Scene(item.source, item.spec, self._options.m_per_n)
        if f"{base}/scene" not in self._channels:
            self._channels[f"{base}/scene"] = SceneUpdateChannel(
                f"{base}/scene", context=self._context
            )
        # The array may differ from the one before, and a channel cannot change its schema.
        old = self._channels.pop(f"{base}/values", None)
        if old is not None:
            old.close()
        self._add_channel(f"{base}/values", _make_values_schema(item.spec))

    def _remove_source(self, item: Closed) -> None:
        scene = self._scenes.pop(item.source, None)
        channel = self._channels.get(f"{self._make_base_topic(item.source)}/scene")
        if scene is not None and channel is not None:
            utc_ns = item.t_ns + self._view.utc_offset_ns()
            channel.log(scene.gone(utc_ns), log_time=utc_ns)

    def _show(self, item: SourceChunk) -> None:
        scene, now = self._scenes.get(item.source), time.monotonic()
        if scene is None or now < self._due.get(item.source, 0.0):
            return
        self._due[item.source] = now + 0.9 / self._options.rate_hz
        base, chunk = self._make_base_topic(item.source), item.chunk
        values, valid = chunk.values[-1], chunk.valid[-1]
        t_ns = int(chunk.t_ns[-1])
        utc_ns = t_ns + item.utc_offset_ns
        if self._channels[f"{base}/scene"].has_sinks():
            update = scene.forces(values, valid, utc_ns)
            if update is not None:
                self._channels[f"{base}/scene"].log(update, log_time=utc_ns)
                self._messages += 1
        if self._channels[f"{base}/values"].has_sinks():
            found = _group_values(item.spec, shortest(values).tolist(), valid.tolist())
            message = {"t_ns": t_ns, "utc_ns": utc_ns, "frame": item.spec.frame, **found}
            self._channels[f"{base}/values"].log(msgspec.json.encode(message), log_time=utc_ns)
            self._messages += 1

    def _repeat(self, view: View) -> None:
        if not self._repeat_due.now():
            return
        messages = repeat_messages(view)
        for message in messages:
            self._publish(message)
        utc_ns = messages[-1].utc_ns
        for source, scene in self._scenes.items():
            channel = self._channels[f"{self._make_base_topic(source)}/scene"]
            if channel.has_sinks():
                channel.log(scene.bases(utc_ns), log_time=utc_ns)
                self._messages += 1

    def _make_base_topic(self, source: str) -> str:
        return f"/{self._options.prefix}/{quote(source, safe='')}"

    def _add_channel(self, topic: str, schema: dict[str, Any]) -> Channel:
        channel = Channel(topic, schema=schema, message_encoding="json", context=self._context)
        self._channels[topic] = channel
        return channel


def schema_of(message: Message) -> dict[str, Any]:
    """Return a message's JSON schema without references, as Foxglove needs it. The schema of a
    decision lists its labels, so that each probability can be chosen for a plot."""
    schema = _infer_schema(msgspec.to_builtins(message))
    return {"title": f"tactile.{type(message).topic}", **schema}


def _infer_schema(value: Any) -> dict[str, Any]:
    if isinstance(value, dict):
        return {"type": "object", "properties": {k: _infer_schema(v) for k, v in value.items()}}
    if isinstance(value, list | tuple):
        return {"type": "array", "items": _infer_schema(value[0]) if value else {}}
    kinds = {bool: "boolean", int: "integer", float: "number", str: "string"}
    return {"type": kinds[type(value)]} if type(value) in kinds else {}


def _group_values(spec: ArraySpec, values: list[list[float]], valid: list[bool]) -> dict[str, Any]:
    """Return a sample as {channel: {element: value}}, with None for invalid elements."""
    return {
        channel: {
            element: row[c] if ok else None
            for element, row, ok in zip(spec.elements, values, valid, strict=True)
        }
        for c, channel in enumerate(spec.channels)
    }


def _make_values_schema(spec: ArraySpec) -> dict[str, Any]:
    zero = [[0.0] * len(spec.channels)] * len(spec.elements)
    found = {"t_ns": 0, "utc_ns": 0, "frame": "", **_group_values(spec, zero, [True] * len(zero))}
    return {"title": "tactile.values", **_infer_schema(found)}
