"""A small HTTP server, which the page and the metrics each run at an address of their own.

It exists so that metrics alone need no other package, and so that the protection against a hostile
network is written once. It does only what those two need: GET and small POSTs, answers of known
length, and streams without end.

A connection carries one request. Its head must arrive within limits of time and size, its body is
read when the application asks for it, and after the answer the connection is closed. So no second
request can be mistaken for the rest of the first, and no peer keeps a connection without a request.
Everything that a peer can make the server hold is bounded: connections, bytes of a head and of a
body, the time to send either, and the time to take an answer. A peer that exceeds a limit is
disconnected and counted.

All connections of a server are tasks of one event loop in a thread of its own. The application is
one function, from a `Request` to a `Response`; it refuses by raising `Refused`.
"""

import asyncio
import re
import socket
import threading
from collections.abc import AsyncGenerator, Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any

from tactile_rt.core.errors import SourceError

BACKLOG = 64
END_S = 0.5  # for streams to end when the server closes
TURNS = 5  # loop passes at closing; an accepted connection reaches `_accept` after three
JOIN_S = 2.0
TOKEN = re.compile(r"[!#$%&'*+.^_`|~0-9A-Za-z-]+")
CONTROL = re.compile(r"[\x00-\x08\x0a-\x1f\x7f]")
ONCE = ("host", "origin", "content-length", "transfer-encoding")  # ambiguous if repeated


@dataclass(frozen=True)
class HttpLimits:
    """Limits on the connections and requests of a server's clients.

    Attributes:
        connections: The number of connections at a time; a further one is dropped at once, before
            the process runs out of file descriptors.
        head_bytes: The largest head of a request with the empty line that ends it, in bytes.
        head_s: The time from the connection to the end of the head, however slowly it arrives, s.
        send_s: The time that a peer may take to receive what is sent, s.
        newest_first: Whether a further connection replaces the oldest one instead of being dropped.
            If all answers are short, the oldest is slow, and no peer can keep others away.
    """

    connections: int
    head_bytes: int
    head_s: float
    send_s: float
    newest_first: bool = False


class Refused(Exception):
    """Raised to answer a request with an HTTP error status.

    Args:
        reason: One line, shown to the client.
    """

    def __init__(self, status: int, reason: str, headers: Mapping[str, str] | None = None) -> None:
        super().__init__(reason)
        self.status, self.reason, self.headers = status, reason, headers or {}


@dataclass
class Request:
    """A parsed HTTP request; `body` reads the rest of it from the connection.

    Attributes:
        path: The path as it was sent, not decoded, beginning with a slash.
        query: The part after the first question mark of the target.
        version: HTTP/1.0 or HTTP/1.1.
        headers: The values by name in lower case; repeated headers are joined.
        begun: The part of the body that came with the head.
        reader: The connection, from which the rest of the body is read.
    """

    method: str
    path: str
    query: str
    version: str
    headers: dict[str, str]
    peer: str = ""
    begun: bytes = b""
    reader: asyncio.StreamReader | None = None

    async def body(self, most: int, seconds: float) -> bytes:
        """Read and return the whole body, of at most `most` bytes, within `seconds`.

        Raises:
            Refused: The body is too large or slow, breaks off, or does not state its length.
        """
        if "transfer-encoding" in self.headers:
            raise Refused(411, "give the length of the body")
        length = self.headers.get("content-length", "0")
        if not re.fullmatch("[0-9]{1,15}", length):
            raise Refused(400, "content-length is no number")
        if int(length) > most:
            raise Refused(413, f"more than {most} bytes")
        data, missing = self.begun[: int(length)], int(length) - len(self.begun)
        if missing <= 0 or self.reader is None:
            return data
        try:
            async with asyncio.timeout(seconds):
                return data + await self.reader.readexactly(missing)
        except TimeoutError:
            raise Refused(408, "too slow") from None
        except asyncio.IncompleteReadError:
            raise Refused(400, "the body is cut short") from None


@dataclass(frozen=True)
class Response:
    """The answer to an HTTP request.

    Attributes:
        body: The body, or a generator of its pieces, which is closed when the peer goes or the
            server ends. An error that it raises before its first piece becomes the answer.
        headers: Headers in addition to those that the server adds to all answers.
    """

    status: int = 200
    body: bytes | AsyncGenerator[bytes, None] = b""
    kind: str = "text/plain; charset=utf-8"
    headers: Mapping[str, str] = field(default_factory=dict)


class HttpServer:
    """An HTTP server that answers from its creation until it is closed.

    Args:
        listening: The listening socket, see `listen`; closed with the server.
        answer: The application, called in the thread of the server.
        failed: Called with the reason when an error of the application prevents an answer.

    Attributes:
        answered: The number of requests so far that were answered with 200.
        refused: The number of requests so far that were refused, or prevented by an error.
        dropped: The number of connections so far that were cut off: one too many, one without a
            request, or one that did not take its answer.
    """

    def __init__(
        self,
        name: str,
        listening: socket.socket,
        answer: Callable[[Request], Awaitable[Response]],
        limits: HttpLimits,
        headers: Mapping[str, str],
        failed: Callable[[str], None],
    ) -> None:
        self._listening, self._answer, self._failed = listening, answer, failed
        self._limits, self._headers = limits, headers
        self.answered = self.refused = self.dropped = 0
        self._tasks: dict[asyncio.Task[None], asyncio.StreamWriter] = {}  # the oldest first
        self._asking: set[asyncio.Task[None]] = set()  # tasks whose request head is incomplete
        self._over = asyncio.Event()
        self._loop = asyncio.new_event_loop()
        # If file descriptors run out, count that, without a traceback on stderr.
        self._loop.set_exception_handler(lambda loop, context: self._count_drop())
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """True while the server's thread runs."""
        return self._thread.is_alive()

    @property
    def connections(self) -> int:
        """Number of open connections; safe from any thread."""
        return len(self._tasks)

    @property
    def full(self) -> bool:
        """True if a further connection would be dropped; safe from any thread."""
        return self.connections >= self._limits.connections and not self._limits.newest_first

    def call(self, function: Callable[..., object], *arguments: Any) -> None:
        """Schedule a call of a function in the server's thread, without waiting for it.

        Raises:
            RuntimeError: The server has ended.
        """
        self._loop.call_soon_threadsafe(function, *arguments)

    def close(self) -> None:
        """Stop listening, let streams end, and close all other connections."""
        with suppress(RuntimeError):  # it has ended already
            self.call(self._over.set)
        self._thread.join(JOIN_S)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:
            try:
                runner.run(self._serve())
            finally:
                self._listening.close()

    async def _serve(self) -> None:
        server = await asyncio.start_server(
            self._accept, sock=self._listening, backlog=BACKLOG, limit=self._limits.head_bytes
        )
        await self._over.wait()
        server.close()
        for _ in range(TURNS):  # accepted connections reach `_accept` and are dropped
            await asyncio.sleep(0.002)
        for task in self._asking:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=END_S)
        # The runner cancels the remaining tasks.

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._tasks) >= self._limits.connections or self._over.is_set():
            self._count_drop()
            if not self._limits.newest_first or self._over.is_set():
                writer.transport.abort()
                return
            slowest = next(iter(self._tasks))
            self._tasks.pop(slowest).transport.abort()
            slowest.cancel()
        task = self._loop.create_task(self._serve_peer(reader, writer))
        self._tasks[task] = writer
        self._asking.add(task)
        task.add_done_callback(lambda task: self._tasks.pop(task, None))
        task.add_done_callback(self._asking.discard)
        # A task that is cancelled before it begins never reaches its `finally`.
        task.add_done_callback(lambda _: writer.transport.abort())

    def _count_drop(self) -> None:
        self.dropped += 1

    async def _serve_peer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await self._exchange(reader, writer)
            writer.close()
            async with asyncio.timeout(self._limits.send_s):
                await writer.wait_closed()
        except (OSError, TimeoutError):  # the peer is gone, silent, or takes nothing
            self._count_drop()
        finally:
            writer.transport.abort()

    async def _exchange(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        request: Request | None = None
        try:
            request = await self._receive(reader, writer)
            answer = await self._answer(request)
            # A stream can still be refused before its first piece.
            first = answer.body if isinstance(answer.body, bytes) else await anext(answer.body)
        except Refused as refused:
            self.refused += 1
            first = refused.reason.encode()
            answer = Response(refused.status, first, headers=refused.headers)
        except Exception as error:
            if request is None:  # the connection failed, not the application
                raise
            self.refused += 1
            self._failed(f"{request.path:.40}: {type(error).__name__}: {error}")
            first = b"this is a fault of the server: see its log"
            answer = Response(500, first)
        self.answered += answer.status == 200
        stream = None if isinstance(answer.body, bytes) else answer.body
        # Proxies use HTTP/1.0, which has no chunks: the end of the connection ends the body.
        chunked = stream is not None and request is not None and request.version != "HTTP/1.0"
        headers = {**self._headers, "connection": "close", "content-type": answer.kind}
        if chunked:
            headers["transfer-encoding"] = "chunked"
        elif stream is None:
            headers["content-length"] = str(len(first))
        if answer.status == 204:
            del headers["content-type"], headers["content-length"]
        lines = [f"HTTP/1.1 {answer.status} {HTTPStatus(answer.status).phrase}"]
        lines += [f"{name}: {value}" for name, value in (headers | dict(answer.headers)).items()]
        head = "\r\n".join([*lines, "", ""]).encode("latin-1")
        if request is not None and request.method == "HEAD":
            first = b""
        try:
            await self._send(writer, head + (_encode_chunk(first) if chunked else first))
            if stream is not None:
                await self._send_stream(stream, reader, writer, chunked)
        finally:
            if stream is not None:
                await stream.aclose()

    async def _receive(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> Request:
        """Read and parse the head of a request.

        Raises:
            Refused: The head is malformed, too long or too slow.
            TimeoutError: No byte has arrived, as from browsers that connect in advance.
        """
        data, most = b"", self._limits.head_bytes
        try:
            async with asyncio.timeout(self._limits.head_s):
                while b"\r\n\r\n" not in data:
                    if len(data) == most:
                        raise Refused(431, f"more than {most} bytes of headers")
                    more = await reader.read(most - len(data))
                    if not more:
                        raise Refused(400, "the request is cut short")
                    data += more
        except TimeoutError:
            if not data:
                raise
            raise Refused(408, "too slow") from None
        task = asyncio.current_task()
        assert task is not None
        self._asking.discard(task)
        head, _, begun = data.partition(b"\r\n\r\n")
        request = parse_head(head)
        request.peer = str((writer.get_extra_info("peername") or ("?",))[0])
        request.begun, request.reader = begun, reader
        return request

    async def _send_stream(
        self,
        pieces: AsyncGenerator[bytes, None],
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        chunked: bool,
    ) -> None:
        """Send a stream's pieces until it ends, the peer leaves, or the server closes."""

        async def send_all() -> None:
            async for piece in pieces:
                await self._send(writer, _encode_chunk(piece) if chunked else piece)

        sending = asyncio.ensure_future(send_all())
        # A peer that sends more than its request counts as gone.
        gone = asyncio.ensure_future(reader.read(1))
        over = asyncio.ensure_future(self._over.wait())
        tasks: list[asyncio.Future[Any]] = [sending, gone, over]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            found = await asyncio.gather(*tasks, return_exceptions=True)
        if isinstance(found[0], Exception):
            raise found[0]
        if gone not in done:
            await self._send(writer, b"0\r\n\r\n" if chunked else b"")

    async def _send(self, writer: asyncio.StreamWriter, data: bytes) -> None:
        writer.write(data)
        async with asyncio.timeout(self._limits.send_s):
            await writer.drain()


def listen(host: str, port: int, *, both: bool = False) -> socket.socket:
    """Return a TCP socket that listens for connections at a host and port.

    Args:
        host: The address, or a name for it; IPv6 with or without brackets.
        both: Whether an IPv6 address also accepts IPv4, and a name means its IPv4 address.

    Raises:
        SourceError: The port is taken, or the address is not of this computer.
    """
    plain = host.strip("[]")
    family = socket.AF_INET if both and ":" not in plain else socket.AF_UNSPEC
    try:
        found = socket.getaddrinfo(plain, port, family, socket.SOCK_STREAM)
        dual = both and found[0][0] == socket.AF_INET6
        return socket.create_server(
            (plain, port), family=found[0][0], backlog=BACKLOG, dualstack_ipv6=dual
        )
    except OSError as error:
        why = str(error.strerror).partition(" (while")[0]
        raise SourceError(f"cannot listen at {host}:{port}: {why}") from None


def parse_head(head: bytes) -> Request:
    """Parse the head of a request, without the empty line at its end.

    Parsing is strict, so that a proxy reads the same: no folded lines, no bare line ends, no blanks
    in names, no repetition of headers that may occur once.

    Raises:
        Refused: 400, the head is malformed.
    """
    first, *lines = head.decode("latin-1").split("\r\n")
    words = first.split(" ")
    if (
        len(words) != 3
        or not TOKEN.fullmatch(words[0])
        or not words[1].startswith("/")
        or not re.fullmatch(r"HTTP/1\.[0-9]", words[2])
        or CONTROL.search(first)
    ):
        raise Refused(400, "not an HTTP/1 request")
    headers: dict[str, str] = {}
    for line in lines:
        name, colon, value = line.partition(":")
        name, value = name.lower(), value.strip(" \t")
        if not colon or not TOKEN.fullmatch(name) or CONTROL.search(value):
            raise Refused(400, "a header is malformed")
        if name in headers:
            if name in ONCE:
                raise Refused(400, f"{name} is given twice")
            value = f"{headers[name]}{'; ' if name == 'cookie' else ', '}{value}"
        headers[name] = value
    path, _, query = words[1].partition("?")
    return Request(words[0], path, query, words[2], headers)


def _encode_chunk(data: bytes) -> bytes:
    """Encode data as an HTTP chunk. Empty data gives no chunk, as that would end the stream."""
    return b"%x\r\n%b\r\n" % (len(data), data) if data else b""
