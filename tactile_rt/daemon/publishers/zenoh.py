"""Messages over Zenoh: JSON under key expressions such as ``tactile/whiskers/decision``.

Messages for a peer that cannot keep up are dropped by Zenoh, which does not say how many.
"""

import re
from typing import Any

import msgspec
import zenoh

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.daemon.consumer import View
from tactile_rt.daemon.messages import Message, encode, topic_of
from tactile_rt.daemon.publishers.sending import (
    ConnectionLimit,
    ListenerOptions,
    Sender,
    is_port,
    tell_exposed,
)

ON_PORTS = ("tcp", "udp", "tls", "quic", "ws")
DROP = zenoh.CongestionControl.DROP


class ZenohOptions(ListenerOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of ``kind = "zenoh"``.

    Attributes:
        listen: The endpoints at which peers may connect, like ``tcp/ADDRESS:PORT``; may be empty.
        connect: The endpoints of peers or routers to connect to; unreachable ones are retried.
        scouting: Whether peers find each other by multicast, which the whole network receives.
        config_file: The file of Zenoh's own configuration (JSON5), for TLS, access control and the
            like; the options here override it.
    """

    listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    connect: tuple[str, ...] = ()
    scouting: bool = False
    config_file: str = ""

    def __post_init__(self) -> None:
        for endpoint in (*self.listen, *self.connect):
            protocol, slash, address = endpoint.partition("/")
            if not (protocol.isalnum() and slash and address):
                raise ValueError(f"an endpoint must be like tcp/127.0.0.1:7447, not {endpoint}")
            port = _split_port(address)
            if protocol in ON_PORTS and port != "0" and not is_port(port):
                raise ValueError(f"{endpoint}: a port must be from 0 to 65535, not {port}")
        if not (self.listen or self.connect or self.scouting or self.config_file):
            raise ValueError("no peer could be reached: give listen, connect, scouting or a file")


class ZenohPublisher(Sender):
    """A Zenoh peer that publishes messages; it listens only at the endpoints of `listen`."""

    Options = ZenohOptions

    def __init__(self, name: str, options: ZenohOptions) -> None:
        super().__init__(name, options)
        self._options = options
        self._make_config()  # refuse what Zenoh does not understand before anything starts
        self._session: zenoh.Session | None = None

    def _connect(self, view: View) -> None:
        try:
            self._session = zenoh.open(self._make_config())
        except zenoh.ZError as error:
            raise SourceError(f"zenoh: {_shorten(error)}") from None
        ports = {port for endpoint in self._options.listen if (port := _find_port(endpoint))}
        if ports:
            name, most = f"{self.name} limit", self._options.connections
            self._limit = ConnectionLimit(name, set(ports), most)
        for endpoint in self._options.listen:
            address = endpoint.partition("/")[2].partition("?")[0].partition("#")[0]
            tell_exposed(view, self.name, address.rpartition(":")[0])
        if self._options.scouting:
            tell_exposed(view, self.name, "the network by multicast")

    def _send(self, message: Message) -> int:
        assert self._session is not None
        data = encode(message)
        self._session.put(
            topic_of(message, self._options.prefix), data,
            encoding=zenoh.Encoding.APPLICATION_JSON, congestion_control=DROP,
        )  # fmt: skip
        return len(data)

    def close(self) -> None:
        session, self._session = self._session, None
        limit, self._limit = self._limit, None
        if limit is not None and session is not None:
            limit.close(session.close)
        elif session is not None:
            session.close()  # type: ignore[no-untyped-call]

    def details(self) -> dict[str, str | int | float]:
        return {
            "listen": " ".join(self._options.listen),
            "connect": " ".join(self._options.connect),
            "messages": self._messages,
            "bytes": self._bytes,
        }

    def _make_config(self) -> Any:
        options = self._options
        own: dict[str, Any] = {
            "listen/endpoints": list(options.listen),
            "connect/endpoints": list(options.connect),
            "scouting/multicast/enabled": options.scouting,
        }
        try:
            if options.config_file:
                config = zenoh.Config.from_file(options.config_file)
                # The file's settings stay, unless an option here differs from its default.
                default = ZenohOptions()
                own = {
                    key: value
                    for key, value in own.items()
                    if getattr(options, key.split("/")[0]) != getattr(default, key.split("/")[0])
                }
            else:
                config = zenoh.Config()
                # A peer that is away is retried for ever, without blocking anything else.
                own |= {"mode": "peer", "connect/timeout_ms": -1, "connect/exit_on_failure": False}
            for key, value in own.items():
                config.insert_json5(key, msgspec.json.encode(value).decode())
        except (zenoh.ZError, OSError) as error:
            raise ConfigError(f"zenoh: {_shorten(error)}") from None
        return config


def _split_port(address: str) -> str:
    return re.split("[?#]", address)[0].rpartition(":")[2]


def _find_port(endpoint: str) -> int:
    """Return an endpoint's TCP port, or 0 without TCP or a fixed port."""
    protocol, _, address = endpoint.partition("/")
    return int(_split_port(address)) if protocol in ("tcp", "tls", "ws") else 0


def _shorten(error: BaseException) -> str:
    """Return the first sentence of an error, without the source locations that Zenoh adds."""
    return " ".join(str(error).split()).partition(" at /")[0]
