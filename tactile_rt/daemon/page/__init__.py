"""The web page: live arrays, decisions and states in a browser, without a build step.

consumer thread:  items -> Feed -> lines
server thread:    lines -> one bounded queue per browser -> the page's HTTP server
"""

import time

import msgspec

from tactile_rt.core.errors import ConfigError, TactileError
from tactile_rt.daemon.config import PageConfig, is_loopback
from tactile_rt.daemon.consumer import TAKEN, Consumer, View
from tactile_rt.daemon.http import HttpServer, listen
from tactile_rt.daemon.items import Contact, Control, Decision, Event, Item, Opened, SourceChunk
from tactile_rt.daemon.messages import encode, state_message
from tactile_rt.daemon.page import routes
from tactile_rt.daemon.page.feed import FEED_VERSION, Feed, array_line
from tactile_rt.daemon.page.routes import HEADERS, Guard

__all__ = ["Page"]

STATE_S = 0.5
SHORTEST_TOKEN = 16


class Page(Consumer):
    """The consumer that serves the web page, configured by table ``[page]``.

    Raises:
        ConfigError: Other computers could reach the page without a token.
    """

    wants = frozenset({Opened, SourceChunk, Decision, Contact, Event})
    gather_s = 0.025
    tick_s = STATE_S

    def __init__(self, name: str, options: PageConfig) -> None:
        if not is_loopback(options.host) and len(options.token) < SHORTEST_TOKEN:
            raise ConfigError(
                f"{name}: {options.host} can be reached by others: a token of at least "
                f"{SHORTEST_TOKEN} characters is needed"
            )
        self._name, self._options = name, options
        self._feed = Feed()
        self._routes: routes.PageRoutes | None = None
        self._server: HttpServer | None = None
        self._state_sent = 0.0
        self._frames = 0

    def open(self, view: View) -> None:
        """Start the server at the configured address.

        Raises:
            SourceError: The port is taken, or the address is not of this computer.
        """
        options, self._view = self._options, view
        guard = Guard(options.host, options.port, options.token)
        control = self._control if options.control else None
        self._routes = routes.PageRoutes(guard, self._greet, control)
        self._server = HttpServer(
            "tactile-rt page server", listen(options.host, options.port), self._routes.answer,
            routes.LIMITS, HEADERS, self._log_error,
        )  # fmt: skip
        if not is_loopback(options.host):
            view.report(
                self._name, "exposed",
                "the token and all data cross the network unencrypted: "
                "see docs/explain/security.md",
                "warning",
            )  # fmt: skip

    def handle(self, items: list[Item]) -> None:
        """Encode items as lines and send them to the connected browsers.

        Raises:
            TactileError: The server's thread has ended.
        """
        answers, server = self._routes, self._server
        if answers is None or server is None or not server.alive:
            raise TactileError("the page's server has ended")
        clients = list(answers.clients.copy())
        lines = self._feed.take(items, {c.source for c in clients})
        self._frames += sum(bool(source) for source, _ in lines)
        now = time.monotonic()
        if clients and now - self._state_sent >= STATE_S:
            self._state_sent = now
            lines.append(("", self._encode_state()))
        if clients and lines:
            server.call(answers.deliver, lines)

    def close(self) -> None:
        """End all streams and stop listening."""
        if self._server is not None:
            self._server.close()

    def diagnose(self) -> str:
        server = self._server
        return TAKEN if server is not None and server.full else ""

    def details(self) -> dict[str, str | int | float]:
        options, answers, server = self._options, self._routes, self._server
        host = f"[{options.host}]" if ":" in options.host else options.host
        clients = list(answers.clients.copy()) if answers is not None else []
        dropped = answers.dropped if answers is not None else 0
        return {
            "url": f"http://{host}:{options.port}/",
            "browsers": len(clients),
            "frames": self._frames,
            "dropped": dropped + sum(c.dropped for c in clients),
            "refused": server.refused if server is not None else 0,
        }

    def _greet(self) -> list[bytes]:
        """Return the first lines for a new browser; called in the server's thread."""
        snapshot = self._view.snapshot()
        hello = {
            "type": "hello", "version": FEED_VERSION, "control": self._options.control,
            "instance": f"{snapshot.pid}-{snapshot.started_ns}",
        }  # fmt: skip
        arrays = [array_line(opened) for opened in self._view.streams().values()]
        recent = self._feed.recent()
        return [msgspec.json.encode(hello) + b"\n", *arrays, self._encode_state(), *recent]

    def _encode_state(self) -> bytes:
        return encode(state_message(self._view.snapshot())) + b"\n"

    def _control(self, action: str, who: str) -> bool:
        sent = self._view.send("recorder", Control(action))
        if sent:
            self._view.report(self._name, "control", f"{who} asked the recorder to {action}")
        return sent

    def _log_error(self, reason: str) -> None:
        self._view.report(self._name, "request", reason, "error")
