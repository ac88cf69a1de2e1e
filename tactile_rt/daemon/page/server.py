"""The page's web server: a few files, one stream of lines, and, if allowed, a control.

    GET  /, /*.js, /*.css, /icon.svg     the page itself; tells nothing
    POST /login    {"token": "..."}      gives the cookie
    GET  /live?source=NAME               lines of JSON without end (`tactile_rt.daemon.page.feed`)
    POST /control  {"action": "start"}   of the recorder

Everything is bounded: connections, streams, what waits for one of them, sizes and times. Who
cannot keep up loses the oldest lines and nobody waits for them.
"""

import asyncio
from collections.abc import Awaitable, Callable
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs

import msgspec
from uvicorn.protocols.http.h11_impl import H11Protocol

from tactile_rt.bounded_queue import BoundedQueue
from tactile_rt.daemon.page.feed import Line
from tactile_rt.daemon.page.guard import HEADERS, Guard, Refused

__all__ = ["ACTIONS", "MAX_STREAMS", "App", "Client", "Connection"]

MAX_CONNECTIONS = 64
MAX_STREAMS = 16
MAX_BODY = 2048
MAX_LINES = 96  # that wait for one client: some three seconds
BODY_S, IDLE_S, SEND_S = 5.0, 10.0, 20.0
WRONG_TOKEN_S = 0.5
ACTIONS = ("start", "stop", "trigger", "rotate")
STATIC = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/app.js": ("app.js", "text/javascript; charset=utf-8"),
    "/draw.js": ("draw.js", "text/javascript; charset=utf-8"),
    "/stream.js": ("stream.js", "text/javascript; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}

Send = Callable[[dict[str, Any]], Awaitable[None]]
Receive = Callable[[], Awaitable[dict[str, Any]]]


class _Login(msgspec.Struct, forbid_unknown_fields=True):
    token: str


class _Control(msgspec.Struct, forbid_unknown_fields=True):
    action: str


class Connection(H11Protocol):
    """Of uvicorn, but too many are dropped at once, and so is one that asks for nothing: each
    holds a file descriptor that the recorder may need."""

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        if len(self.connections) > MAX_CONNECTIONS:
            transport.abort()
        else:
            self.loop.call_later(IDLE_S, self._look, None)

    def _look(self, before: Any) -> None:
        idle = self.cycle is None or self.cycle.response_complete
        if self.transport.is_closing():
            return
        if idle and self.cycle is before:
            self.transport.abort()
        else:
            self.loop.call_later(IDLE_S, self._look, self.cycle)


class Client:
    """Lines that wait for one browser; the oldest goes when there are too many."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._lines = BoundedQueue[bytes](MAX_LINES)
        self._some = asyncio.Event()
        self._over = False

    @property
    def dropped(self) -> int:
        """How many lines went because there were too many."""
        return self._lines.dropped["items"]

    def put(self, line: bytes) -> None:
        """One more."""
        self._lines.put(line)
        self._some.set()

    def end(self) -> None:
        """No more."""
        self._over = True
        self._some.set()

    async def take(self) -> bytes:
        """All that wait, as soon as there are any; empty at the end."""
        await self._some.wait()
        self._some.clear()
        return b"" if self._over else b"".join(self._lines.take(0))


class App:
    """The ASGI application; all in one event loop.

    Args:
        guard: who may.
        greet: the first lines for a new client.
        control: asked with an action and who asks; returns whether there is a recorder. None: the
            page may only look.
        failed: told why when a request could not be answered for a fault of the page's own.

    Attributes:
        clients: that stream now.
        refused: requests so far; `dropped`: lines of clients that are gone.
    """

    def __init__(
        self,
        guard: Guard,
        greet: Callable[[], list[bytes]],
        control: Callable[[str, str], bool] | None,
        failed: Callable[[str], None],
    ) -> None:
        self._guard, self._greet, self._control, self._failed = guard, greet, control, failed
        self.clients: set[Client] = set()
        self.refused = self.dropped = 0
        self._wrong = 0
        here = files("tactile_rt.daemon.page") / "static"
        self._files = {
            path: ((here / name).read_bytes(), kind) for path, (name, kind) in STATIC.items()
        }

    def deliver(self, lines: list[Line]) -> None:
        """To all clients that they are for."""
        for client in self.clients:
            for source, line in lines:
                if not source or source == client.source:
                    client.put(line)

    def end(self) -> None:
        """Of all streams."""
        for client in self.clients:
            client.end()

    async def __call__(self, scope: dict[str, Any], receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            return
        try:
            await self._answer(scope, receive, send)
        except Refused as refused:
            self.refused += 1
            # What is left of a body that nobody reads must not be taken for the next request.
            await _reply(
                send, refused.status, refused.reason.encode(), more={"connection": "close"}
            )
        except Exception as error:
            self._failed(f"{scope['path']:.40}: {type(error).__name__}: {error}")
            raise

    async def _answer(self, scope: dict[str, Any], receive: Receive, send: Send) -> None:
        method, path = scope["method"], scope["path"]
        headers = self._guard.check(scope["headers"], method)
        if path in self._files:
            _only(method, "GET")
            body, kind = self._files[path]
            await _reply(send, 200, body, kind)
        elif path == "/login":
            _only(method, "POST")
            await self._login(await _json(headers, receive, _Login), send)
        elif path not in ("/live", "/control"):
            raise Refused(404, "there is no such page")
        elif not self._guard.knows(headers):
            raise Refused(401, "a token is needed")
        elif path == "/live":
            _only(method, "GET")
            query = parse_qs(scope["query_string"][:1024].decode("latin-1"))
            await self._live(query.get("source", [""])[0], receive, send)
        else:
            _only(method, "POST")
            if self._control is None:
                raise Refused(403, "this page may only look: set control = true in [page]")
            action = (await _json(headers, receive, _Control)).action
            if action not in ACTIONS:
                raise Refused(400, f"the recorder knows {', '.join(ACTIONS)}")
            who = (scope.get("client") or ("?",))[0]
            if not self._control(action, who):
                raise Refused(404, "nothing is recorded: there is no [recorder]")
            await _reply(send, 202, b"asked for")

    async def _login(self, given: _Login, send: Send) -> None:
        if not self._guard.is_token(given.token):
            # Guessing takes time, and takes it of everybody who guesses.
            self._wrong += 1
            try:
                await asyncio.sleep(WRONG_TOKEN_S * self._wrong)
            finally:
                self._wrong -= 1
            raise Refused(401, "the token is wrong")
        await _reply(send, 204, b"", more={"set-cookie": self._guard.set_cookie()})

    async def _live(self, source: str, receive: Receive, send: Send) -> None:
        if len(self.clients) >= MAX_STREAMS:
            raise Refused(503, f"{MAX_STREAMS} browsers are looking already")
        client = Client(source)
        self.clients.add(client)
        gone = asyncio.ensure_future(_until_gone(receive, client))
        try:
            await _start(send, 200, {"content-type": "application/x-ndjson"})
            await asyncio.wait_for(_write(send, b"".join(self._greet())), SEND_S)
            while lines := await client.take():
                # A browser that is gone without a word would keep its place for minutes.
                await asyncio.wait_for(_write(send, lines), SEND_S)
            await asyncio.wait_for(send({"type": "http.response.body", "body": b""}), SEND_S)
        except TimeoutError:
            return  # unfinished: the server closes the line
        finally:
            self.clients.discard(client)
            self.dropped += client.dropped
            gone.cancel()


async def _until_gone(receive: Receive, client: Client) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass
    client.end()


async def _json(headers: dict[str, str], receive: Receive, kind: Any) -> Any:
    # A form of another site cannot send this type without asking first, and is never allowed.
    if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
        raise Refused(415, "send application/json")
    body = b""
    try:
        async with asyncio.timeout(BODY_S):
            while True:
                event = await receive()
                if event["type"] == "http.disconnect":
                    raise Refused(400, "gone")
                body += event.get("body", b"")
                if len(body) > MAX_BODY:
                    raise Refused(413, f"more than {MAX_BODY} bytes")
                if not event.get("more_body"):
                    break
        return msgspec.json.decode(body, type=kind)
    except TimeoutError:
        raise Refused(408, "too slow") from None
    except (msgspec.MsgspecError, UnicodeError):
        raise Refused(400, "not what is expected here") from None


def _only(method: str, allowed: str) -> None:
    if method != allowed:
        raise Refused(405, f"only {allowed}")


async def _start(send: Send, status: int, headers: dict[str, str]) -> None:
    pairs = [(k.encode(), v.encode("latin-1")) for k, v in (HEADERS | headers).items()]
    await send({"type": "http.response.start", "status": status, "headers": pairs})


async def _write(send: Send, body: bytes) -> None:
    await send({"type": "http.response.body", "body": body, "more_body": True})


async def _reply(
    send: Send,
    status: int,
    body: bytes,
    kind: str = "text/plain; charset=utf-8",
    more: dict[str, str] | None = None,
) -> None:
    headers = {"content-type": kind, "content-length": str(len(body)), **(more or {})}
    if status == 204:
        headers = more or {}
    await _start(send, status, headers)
    await send({"type": "http.response.body", "body": body})
