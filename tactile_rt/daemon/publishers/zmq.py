"""Messages over ZeroMQ: a PUB socket, two frames each: topic, JSON.

A slow subscriber loses messages, and delays nothing.
"""

from urllib.parse import urlsplit

import zmq

from tactile_rt.core.errors import SourceError
from tactile_rt.daemon.consumer import View
from tactile_rt.daemon.messages import Message, encode, topic_of
from tactile_rt.daemon.publishers.sending import (
    ConnectionLimit,
    ListenerOptions,
    Sender,
    is_port,
    tell_exposed,
)

LINGER_MS = 200  # how long the last messages may take to leave


class ZmqOptions(ListenerOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of ``kind = "zmq"``.

    Attributes:
        bind: The endpoint to wait for subscribers at: ``tcp://ADDRESS:PORT`` (port ``*``: a free
            one) or ``ipc://PATH``.
        queue: The number of messages that may wait for one subscriber before new ones are dropped
            for that one.
    """

    bind: str = "tcp://127.0.0.1:5556"
    queue: int = 1000

    def __post_init__(self) -> None:
        scheme, _, rest = self.bind.partition("://")
        if scheme not in ("tcp", "ipc") or not rest:
            raise ValueError(
                f"bind must be like tcp://127.0.0.1:5556 or ipc:///run/x, not {self.bind}"
            )
        port = rest.rpartition(":")[2]
        if scheme == "tcp" and port != "*" and not is_port(port):
            raise ValueError(f"bind: a port must be from 1 to 65535, or *, not {port}")
        if not 1 <= self.queue <= 1_000_000:
            raise ValueError(f"queue must be from 1 to 1000000, not {self.queue}")


class ZmqPublisher(Sender):
    """A publisher on a PUB socket; subscribers filter by a message's first frame, its topic."""

    Options = ZmqOptions

    def __init__(self, name: str, options: ZmqOptions) -> None:
        super().__init__(name, options)
        self._options = options
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._endpoint = ""
        self._dropped = 0

    def _connect(self, view: View) -> None:
        self._context = zmq.Context()
        self._socket = socket = self._context.socket(zmq.PUB)
        socket.setsockopt(zmq.LINGER, LINGER_MS)
        socket.setsockopt(zmq.SNDHWM, self._options.queue)
        bind = self._options.bind
        socket.setsockopt(zmq.IPV6, int("[" in bind))
        try:
            socket.bind(bind)
        except zmq.ZMQError as error:
            raise SourceError(f"cannot listen at {bind}: {error.strerror}") from None
        self._endpoint = socket.getsockopt(zmq.LAST_ENDPOINT).decode().rstrip("\0")  # type: ignore[union-attr]
        address = self._endpoint.partition("://")[2]
        local = int(address.rpartition(":")[2]) if bind.startswith("tcp:") else address
        self._limit = ConnectionLimit(f"{self.name} limit", {local}, self._options.connections)
        if bind.startswith("tcp:"):
            # An interface's name looks like a host's: it counts as open to others.
            tell_exposed(view, self.name, urlsplit(self._endpoint).hostname or "")

    def _send(self, message: Message) -> int:
        assert self._socket is not None
        frames = [topic_of(message, self._options.prefix).encode(), encode(message)]
        # ZeroMQ drops silently. With NODROP it refuses if any subscriber's queue is full, so that
        # the drop can be counted; sent again without, the message misses only slow subscribers.
        try:
            self._socket.setsockopt(zmq.XPUB_NODROP, 1)
            self._socket.send_multipart(frames, zmq.NOBLOCK, copy=True)
        except zmq.Again:
            self._dropped += 1
            self._socket.setsockopt(zmq.XPUB_NODROP, 0)
            self._socket.send_multipart(frames, zmq.NOBLOCK, copy=True)
        return len(frames[0]) + len(frames[1])

    def close(self) -> None:
        socket, self._socket = self._socket, None
        context, self._context = self._context, None
        limit, self._limit = self._limit, None
        if limit is not None:
            limit.close()
        if socket is not None:
            socket.close()
        if context is not None:
            context.term()

    def details(self) -> dict[str, str | int | float]:
        return {
            "endpoint": self._endpoint or self._options.bind,
            "messages": self._messages,
            "bytes": self._bytes,
            "dropped": self._dropped,  # messages that at least one subscriber did not get
        }
