"""The routes of the page: a few files, one stream of lines, and optionally a control.

    GET  /, /*.js, /*.css, /icon.svg     the page itself; holds no data
    POST /login    {"token": "..."}      gives the cookie
    GET  /live?source=NAME               lines of JSON without end (`tactile_rt.daemon.page.feed`)
    POST /control  {"action": "start"}   of the recorder

In addition to the limits of `tactile_rt.daemon.http`, the streams and the lines that wait for each
are bounded here. A browser that cannot keep up loses the oldest lines and delays nothing else.
"""

import asyncio
import hashlib
import hmac
import ipaddress
import socket
from collections.abc import AsyncGenerator, Callable, Mapping
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

import msgspec

from tactile_rt.core.bounded_queue import BoundedQueue
from tactile_rt.daemon.http import HttpLimits, Refused, Request, Response
from tactile_rt.daemon.page.feed import Line

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

# Trusted Types: the browser itself refuses innerHTML and its like, whatever a label contains.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
    "manifest-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'; trusted-types 'none'"
)
HEADERS = {
    "content-security-policy": POLICY,
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
    "cache-control": "no-store",
}
COOKIE_S = 30 * 86400
MAX_TOKEN = 1024


class _Login(msgspec.Struct, forbid_unknown_fields=True):
    token: str


class _Control(msgspec.Struct, forbid_unknown_fields=True):
    action: str


class Guard:
    """Access control of requests, by their headers alone.

    Args:
        host: The address that the page is bound to, as configured.
        token: The secret that a browser must know; empty for none.
    """

    def __init__(self, host: str, port: int, token: str) -> None:
        own = socket.gethostname().lower()
        self._names = {"localhost", host.strip("[]").lower(), own, f"{own}.local"}
        self._token = token.encode()
        # Cookies are shared by all ports of a host: two daemons must not overwrite each other's.
        self.cookie = f"tactile_rt_{port}"
        # It outlives the daemon, so that a page goes on after a restart, and hides the token.
        self._session = hmac.digest(self._token, b"tactile_rt page", hashlib.sha256).hex().encode()

    def check(self, headers: Mapping[str, str], method: str) -> None:
        """Raise `Refused` if a request comes from another website.

        A foreign site cannot point its own name at this address (DNS rebinding), as only IP
        addresses and this host's names are served. It cannot send requests from its own pages, as
        browsers state the origin.

        Raises:
            Refused: Status 403.
        """
        host = headers.get("host", "")
        if not self._is_own(host):
            raise Refused(403, "this page is not served under that name; use its IP address")
        origin = headers.get("origin")
        if origin is not None and urlsplit_netloc(origin) != host.lower():
            raise Refused(403, "requested by another site")
        if headers.get("sec-fetch-site", "none") not in ("same-origin", "none") and (
            method != "GET" or headers.get("sec-fetch-mode") != "navigate"
        ):
            raise Refused(403, "requested by another site")

    def knows(self, headers: Mapping[str, str]) -> bool:
        """Return whether a request has the token or its cookie, or no token is set."""
        if not self._token:
            return True
        kind, _, given = headers.get("authorization", "").partition(" ")
        if kind.lower() == "bearer" and self.is_token(given.strip()):
            return True
        for pair in headers.get("cookie", "").split(";"):
            name, _, value = pair.strip().partition("=")
            if name == self.cookie and hmac.compare_digest(value.encode("latin-1"), self._session):
                return True
        return False

    def is_token(self, given: str) -> bool:
        """Return whether a text is the token; the time does not depend on its content."""
        return len(given) <= MAX_TOKEN and hmac.compare_digest(
            given.encode("utf-8", "surrogatepass"), self._token
        )

    def set_cookie(self) -> str:
        """Return the ``Set-Cookie`` value that logs a browser in, hidden from scripts and sites."""
        return (
            f"{self.cookie}={self._session.decode()}; HttpOnly; SameSite=Strict; Path=/; "
            f"Max-Age={COOKIE_S}"
        )

    def _is_own(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
            if name.lower().rstrip(".") in self._names:
                return True
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


def urlsplit_netloc(origin: str) -> str:
    """Return HOST:PORT of an ``Origin`` header, or an empty string if it is no website."""
    try:
        parts = urlsplit(origin)
    except ValueError:
        return ""
    return parts.netloc.lower() if parts.scheme in ("http", "https") else ""


class PageClient:
    """A bounded queue of lines for one browser, which drops the oldest when full."""

    def __init__(self, source: str) -> None:
        self.source = source
        self._lines = BoundedQueue[bytes](MAX_LINES)
        self._some = asyncio.Event()

    @property
    def dropped(self) -> int:
        """Number of lines that were dropped."""
        return self._lines.dropped["items"]

    def put(self, line: bytes) -> None:
        """Append a line to the queue."""
        self._lines.put(line)
        self._some.set()

    async def take(self) -> bytes:
        """Wait for lines; remove and return all queued lines, joined."""
        await self._some.wait()
        self._some.clear()
        return b"".join(self._lines.take(0))


class PageRoutes:
    """The request handler of the page; runs in the thread of the page's server.

    Args:
        greet: Returns the first lines for a new client.
        control: Called with an action and the client's address; returns whether a recorder exists.
            With None, the page may not control it.

    Attributes:
        clients: The browsers that stream now.
        dropped: The number of lines dropped for browsers that have left.
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
        """Queue each line for the clients that watch its source, or for all clients."""
        for client in self.clients:
            for source, line in lines:
                if not source or source == client.source:
                    client.put(line)

    async def answer(self, request: Request) -> Response:
        """Return the answer to a request, or raise `Refused`."""
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
            return Response(200, self._stream_lines(source), "application/x-ndjson")
        only(request, "POST")
        if self._control is None:
            raise Refused(403, "this page is read-only: set control = true in [page]")
        action = (await json_body(request, _Control)).action
        if action not in ACTIONS:
            raise Refused(400, f"action must be one of {', '.join(ACTIONS)}")
        if not self._control(action, request.peer):
            raise Refused(404, "nothing is recorded: there is no [recorder]")
        return Response(202, b"asked for")

    async def _login(self, given: _Login) -> Response:
        if not self._guard.is_token(given.token):
            # Each wrong token delays the answers to all of them, so that guessing takes long.
            self._wrong += 1
            try:
                await asyncio.sleep(WRONG_TOKEN_S * self._wrong)
            finally:
                self._wrong -= 1
            raise Refused(401, "the token is wrong")
        return Response(204, headers={"set-cookie": self._guard.set_cookie()})

    async def _stream_lines(self, source: str) -> AsyncGenerator[bytes, None]:
        if len(self.clients) >= MAX_STREAMS:
            raise Refused(503, f"{MAX_STREAMS} browsers are connected already")
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
    """Decode the JSON body of a request as a msgspec type, or raise `Refused`."""
    # A form of another site needs a CORS preflight to send this type, which is never granted.
    sent = request.headers.get("content-type", "").partition(";")[0]
    if sent.strip().lower() != "application/json":
        raise Refused(415, "send application/json")
    body = await request.body(MAX_BODY, BODY_S)
    try:
        return msgspec.json.decode(body, type=kind)
    except (msgspec.MsgspecError, UnicodeError):
        raise Refused(400, "the body is not the expected JSON") from None


def only(request: Request, method: str) -> None:
    """Raise `Refused` unless a request has the given HTTP method."""
    if request.method != method:
        raise Refused(405, f"only {method}", {"allow": method})
