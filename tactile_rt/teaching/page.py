"""The teaching page in a browser: buttons for the classes, what to touch, and the results."""

from collections.abc import Callable
from importlib.resources import files
from typing import Any

import msgspec

from tactile_rt.daemon.http import HttpServer, Refused, Request, Response, listen
from tactile_rt.daemon.page.routes import HEADERS, LIMITS, Guard, json_body, only

MAX_ORDER = 200  # characters
STATIC = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/teach.js": ("teach.js", "text/javascript; charset=utf-8"),
    "/teach.css": ("teach.css", "text/css; charset=utf-8"),
}


class _Order(msgspec.Struct, forbid_unknown_fields=True):
    order: str


class TeachingPage:
    """The server of the teaching page, which runs until it is closed.

    Args:
        host, port: The address to listen at; port 0 means any free port.
        state: Returns what the page shows, see `Teacher.state`; called in the server's thread.
        obey: Called with a command of the user, in the server's thread.

    Raises:
        SourceError: The address is taken, or not of this computer.
    """

    def __init__(
        self, host: str, port: int, state: Callable[[], dict[str, Any]], obey: Callable[[str], None]
    ) -> None:
        listening = listen(host, port)
        port = listening.getsockname()[1]
        self.url = f"http://{host}:{port}/"
        self._guard, self._state, self._obey = Guard(host, port, ""), state, obey
        here = files("tactile_rt.teaching") / "static"
        self._files = {
            path: ((here / name).read_bytes(), kind) for path, (name, kind) in STATIC.items()
        }
        self._server = HttpServer(
            "tactile-rt-teaching", listening, self._answer, LIMITS, HEADERS, lambda why: None
        )

    def close(self) -> None:
        """Stop the server."""
        self._server.close()

    async def _answer(self, request: Request) -> Response:
        self._guard.check(request.headers, request.method)
        if request.path in self._files:
            only(request, "GET")
            return Response(200, *self._files[request.path])
        if request.path == "/state":
            only(request, "GET")
            return Response(200, msgspec.json.encode(self._state()), "application/json")
        if request.path == "/order":
            only(request, "POST")
            order = (await json_body(request, _Order)).order
            if not order or len(order) > MAX_ORDER:
                raise Refused(400, f"a command must have 1 to {MAX_ORDER} characters")
            self._obey(order)
            return Response(202)
        raise Refused(404, "there is no such page")
