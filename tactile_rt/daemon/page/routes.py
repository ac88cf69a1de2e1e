"""What the page answers: a few files, one stream of lines, and, if allowed, a control.

    GET  /, /*.js, /*.css, /icon.svg     the page itself; tells nothing
    POST /login    {"token": "..."}      gives the cookie
    GET  /live?source=NAME               lines of JSON without end (`tactile_rt.daemon.page.feed`)
    POST /control  {"action": "start"}   of the recorder

Beside what `tactile_rt.daemon.http` bounds, the streams and what waits for each are bounded here.
Who cannot keep up loses the oldest lines and nobody waits for them.
"""

import asyncio
from collections.abc import AsyncGenerator, Callable
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs

import msgspec

from tactile_rt.bounded_queue import BoundedQueue
from tactile_rt.daemon.http import HttpLimits, Refused, Request, Response
from tactile_rt.daemon.page.feed import Line
from tactile_rt.daemon.page.guard import Guard

__all__ = ["ACTIONS", "LIMITS", "MAX_STREAMS", "PageClient", "PageRoutes", "json_body", "only"]

LIMITS = HttpLimits(connections=64, head_bytes=16384, head_s=10.0, send_s=20.0)
MAX_STREAMS = 16
MAX_BODY, BODY_S = 2048, 5.0
MAX_LINES = 96  # that wait for one client: some three seconds
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


class _Login(msgspec.Struct, forbid_unknown_fields=True):
    token: str


class _Control(msgspec.Struct, forbid_unknown_fields=True):
    action: str


class PageClient:
    """Lines that wait for one browser; the oldest goes when there are too many."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._lines = BoundedQueue[bytes](MAX_LINES)
        self._some = asyncio.Event()

    @property
    def dropped(self) -> int:
        """How many lines went because there were too many."""
        return self._lines.dropped["items"]

    def put(self, line: bytes) -> None:
        """One more."""
        self._lines.put(line)
        self._some.set()

    async def take(self) -> bytes:
        """All that wait, as soon as there are any."""
        await self._some.wait()
        self._some.clear()
        return b"".join(self._lines.take(0))


class PageRoutes:
    """Answers requests; all in the thread of the page's server.

    Args:
        greet: Gives the first lines for a new client.
        control: Asked with an action and who asks; returns whether there is a recorder. None: the
            page may only look.

    Attributes:
        clients: The browsers that stream now.
        dropped: The number of lines that browsers which are gone were too slow for.
    """

    def __init__(
        self,
        guard: Guard,
        greet: Callable[[], list[bytes]],
        control: Callable[[str, str], bool] | None,
    ) -> None:
        self._guard, self._greet, self._control = guard, greet, control
        self.clients: set[PageClient] = set()
        self.dropped = 0
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

    async def answer(self, request: Request) -> Response:
        """What a request gets."""
        path = request.path
        self._guard.check(request.headers, request.method)
        if path in self._files:
            only(request, "GET")
            body, kind = self._files[path]
            return Response(200, body, kind)
        if path == "/login":
            only(request, "POST")
            return await self._login(await json_body(request, _Login))
        if path not in ("/live", "/control"):
            raise Refused(404, "there is no such page")
        if not self._guard.knows(request.headers):
            raise Refused(401, "a token is needed")
        if path == "/live":
            only(request, "GET")
            source = parse_qs(request.query[:1024]).get("source", [""])[0]
            return Response(200, self._live(source), "application/x-ndjson")
        only(request, "POST")
        if self._control is None:
            raise Refused(403, "this page may only look: set control = true in [page]")
        action = (await json_body(request, _Control)).action
        if action not in ACTIONS:
            raise Refused(400, f"the recorder knows {', '.join(ACTIONS)}")
        if not self._control(action, request.peer):
            raise Refused(404, "nothing is recorded: there is no [recorder]")
        return Response(202, b"asked for")

    async def _login(self, given: _Login) -> Response:
        if not self._guard.is_token(given.token):
            # Guessing takes time, and takes it of everybody who guesses.
            self._wrong += 1
            try:
                await asyncio.sleep(WRONG_TOKEN_S * self._wrong)
            finally:
                self._wrong -= 1
            raise Refused(401, "the token is wrong")
        return Response(204, headers={"set-cookie": self._guard.set_cookie()})

    async def _live(self, source: str) -> AsyncGenerator[bytes, None]:
        if len(self.clients) >= MAX_STREAMS:
            raise Refused(503, f"{MAX_STREAMS} browsers are looking already")
        client = PageClient(source)
        self.clients.add(client)
        try:
            yield b"".join(self._greet())
            while True:
                yield await client.take()
        finally:
            self.clients.discard(client)
            self.dropped += client.dropped


async def json_body(request: Request, kind: Any) -> Any:
    """Return what a request brings, of this msgspec type; refuse anything else."""
    # A form of another site cannot send this type without asking first, and is never allowed.
    sent = request.headers.get("content-type", "").partition(";")[0]
    if sent.strip().lower() != "application/json":
        raise Refused(415, "send application/json")
    body = await request.body(MAX_BODY, BODY_S)
    try:
        return msgspec.json.decode(body, type=kind)
    except (msgspec.MsgspecError, UnicodeError):
        raise Refused(400, "not what is expected here") from None


def only(request: Request, method: str) -> None:
    """Refuse a request of another method."""
    if request.method != method:
        raise Refused(405, f"only {method}", {"allow": method})
