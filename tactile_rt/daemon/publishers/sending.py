"""Common parts of network publishers: choice and repetition of messages, limit of connections.

ZeroMQ, Zenoh and Foxglove's server accept connections until the process has no descriptor left, and
then the recorder cannot open its next file. None of them has a limit that applies before a peer has
identified itself.

The kernel knows which connections a port has. Several times a second, a thread looks at the
descriptors of the process. Of those that are connected to the port, it keeps the first few and
shuts down the rest, whereupon the library closes them. It opens no descriptor to look, since none
may be left.
"""

import abc
import ctypes
import os
import resource
import socket
import stat
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Annotated, Final

import msgspec

from tactile_rt.daemon.config import is_loopback
from tactile_rt.daemon.consumer import TAKEN, Consumer, View
from tactile_rt.daemon.items import Contact, Decision, Event, Item, Opened, Skipped, SourceChunk
from tactile_rt.daemon.messages import Message, message_of, state_message

LOOK_S: Final = 0.1  # on loopback, some thousand connections may come meanwhile
BYE_S: Final = 0.2
AGAIN_S: Final = 0.002  # during a flood of connections
CALM: Final = 20  # looks without an excess connection, after which a flood is over
Key = tuple[int, int]  # descriptor and inode, which identify a socket as long as it is open


class ConnectionLimit:
    """A thread that shuts down a server's connections beyond a limit, until it is closed.

    Args:
        addresses: The TCP ports and the paths of Unix sockets where a server listens.
        most: The number of connections that may stay, all addresses together.

    Attributes:
        dropped: The number of connections so far that were shut down.
    """

    def __init__(self, name: str, addresses: set[int | str], most: int) -> None:
        self.dropped = 0
        self._addresses, self._most = addresses, most
        self._numbers: list[int] = []  # descriptors at the last look
        self._kept: set[Key] = set()
        self._others: set[Key] = set()  # sockets that do not count, or are shut down
        self._spare = os.open(os.devnull, os.O_RDWR)  # a descriptor in reserve
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def connections(self) -> int:
        """Number of connections when the thread last looked."""
        return len(self._kept)

    @property
    def full(self) -> bool:
        """True if a further connection would be shut down."""
        return len(self._kept) >= self._most

    def close(self, stop: Callable[[], object] | None = None) -> None:
        """Stop limiting connections, and end the thread.

        Args:
            stop: Stops the server before that. Connected peers have `BYE_S` to say goodbye and are
                then shut down: for a peer that never sent anything, Foxglove's server and Zenoh
                would wait for ever.
        """
        if stop is not None:
            stopping = threading.Thread(target=stop, name=f"{self._thread.name} stop", daemon=True)
            stopping.start()
            stopping.join(BYE_S)
            self._most = 0
            stopping.join()
        self._over.set()
        self._thread.join()
        os.close(self._spare)

    def _run(self) -> None:
        empty = os.open(os.devnull, os.O_RDWR)
        pause, calm = LOOK_S, CALM
        while not self._over.wait(pause):
            flooded = self._shut_down_excess(empty) > 0
            pause = AGAIN_S if flooded else LOOK_S
            calm = 0 if flooded else calm + 1
            if calm == CALM:
                _trim_memory()
        os.close(empty)

    def _shut_down_excess(self, empty: int) -> int:
        """Shut down excess connections; return their number."""
        numbers = _list_descriptors()
        # A socket replaced under the same number is noticed at the next change.
        if numbers == self._numbers and len(self._kept) <= self._most:
            return 0
        self._numbers = numbers
        new, open_now = [], set()
        for number in numbers:
            with suppress(OSError):  # closed by now
                found = os.fstat(number)
                if stat.S_ISSOCK(found.st_mode):
                    key = (number, found.st_ino)
                    open_now.add(key)
                    if key not in self._kept and key not in self._others:
                        new.append(key)
        self._kept &= open_now
        self._others &= open_now
        new += [self._kept.pop() for _ in range(len(self._kept) - self._most)]
        dropped = 0
        for key in new:
            with suppress(OSError):
                # Duplicated, as it may be closed meanwhile and its number be reused.
                os.dup2(key[0], self._spare)
                if os.fstat(self._spare).st_ino != key[1]:
                    continue
                connection = socket.socket(fileno=self._spare)
                try:
                    if not self._is_ours(connection):
                        self._others.add(key)
                    elif len(self._kept) < self._most:
                        self._kept.add(key)
                    else:
                        self._others.add(key)
                        dropped += 1
                        connection.shutdown(socket.SHUT_RDWR)
                finally:
                    connection.detach()
        os.dup2(empty, self._spare)
        self.dropped += dropped
        return dropped

    def _is_ours(self, connection: socket.socket) -> bool:
        """Return whether a socket is a connection at one of the addresses, not the listener."""
        if connection.type != socket.SOCK_STREAM or connection.getsockopt(
            socket.SOL_SOCKET, socket.SO_ACCEPTCONN
        ):
            return False
        local = connection.getsockname()
        if connection.family in (socket.AF_INET, socket.AF_INET6):
            return local[1] in self._addresses
        return connection.family == socket.AF_UNIX and local in self._addresses


def _trim_memory() -> None:
    """Return freed memory to the system, which the C library would otherwise keep."""
    with suppress(AttributeError, OSError):  # musl has no such call, and keeps less
        ctypes.CDLL(None).malloc_trim(0)


def _list_descriptors() -> list[int]:
    try:
        return [int(number) for number in os.listdir("/proc/self/fd")]
    except OSError:  # none is left to look with
        return list(range(min(resource.getrlimit(resource.RLIMIT_NOFILE)[0], 1 << 20)))


Prefix = Annotated[
    str,
    msgspec.Meta(
        pattern=r"^[A-Za-z0-9_.-]{1,64}(/[A-Za-z0-9_.-]{1,64}){0,7}\Z",
        description="prefix: one to eight words of letters, digits, ., - and _, with / between",
    ),
]
Connections = Annotated[int, msgspec.Meta(ge=1, le=1000)]
StateSeconds = Annotated[float, msgspec.Meta(ge=0, le=86400)]


class SenderOptions(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options that all network publishers have.

    Attributes:
        state_s: The time after which ``state`` and all ``array`` messages are repeated, for peers
            that come late, s; 0 means never.
    """

    prefix: Prefix = "tactile"
    samples: bool = False
    state_s: StateSeconds = 1.0


class ListenerOptions(SenderOptions, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Options of publishers that peers connect to."""

    connections: Connections = 32  # at a time; more are shut down


class Due:
    """A timer of an action that is due regularly; a period of 0 means never."""

    def __init__(self, every_s: float) -> None:
        self._every_s, self._due_at = every_s, 0.0

    def now(self) -> bool:
        """Return whether the action is due; if so, start the next period."""
        now = time.monotonic()
        if not self._every_s or now < self._due_at:
            return False
        self._due_at = now + self._every_s
        return True


def repeat_messages(view: View) -> list[Message]:
    """Return the messages to repeat: the array of each open source, and the state."""
    arrays = [m for m in map(message_of, view.streams().values()) if m is not None]
    return [*arrays, state_message(view.snapshot())]


class Publisher(Consumer):
    """The base class of message publishers, with optional samples and a timer for the state."""

    def __init__(self, name: str, samples: bool, state_s: float) -> None:
        self.name = name
        wants = {Opened, Decision, Contact, Skipped, Event}
        self.wants = frozenset(wants | {SourceChunk} if samples else wants)
        self.tick_s, self._state_due = state_s, Due(state_s)
        self._messages = self._bytes = 0


class Sender(Publisher):
    """The base class of publishers that pass each message to `_send` and repeat the state."""

    def __init__(self, name: str, options: SenderOptions) -> None:
        super().__init__(name, options.samples, options.state_s)
        self._limit: ConnectionLimit | None = None

    def open(self, view: View) -> None:
        self._view = view
        self._connect(view)

    def handle(self, items: list[Item]) -> None:
        messages: list[Message] = [m for m in map(message_of, items) if m is not None]
        if self._state_due.now():
            messages += repeat_messages(self._view)
        for message in messages:
            self._bytes += self._send(message)
            self._messages += 1

    def diagnose(self) -> str:
        limit = self._limit
        return TAKEN if limit is not None and limit.full else ""

    @abc.abstractmethod
    def _connect(self, view: View) -> None:
        """Connect to peers, or listen for them; may raise an error."""

    @abc.abstractmethod
    def _send(self, message: Message) -> int:
        """Send a message without waiting for a peer; return its size in bytes."""


def is_port(text: str) -> bool:
    """Return whether a text is the number of a TCP port."""
    return text.isdecimal() and len(text) < 6 and 1 <= int(text) <= 65535


def tell_exposed(view: View, name: str, host: str) -> None:
    """Report a warning if programs on other computers can read the messages."""
    if not is_loopback(host):
        view.report(
            f"publisher.{name}", "exposed",
            f"anyone who can reach {host or 'this computer'} can read what is published", "warning",
        )  # fmt: skip
