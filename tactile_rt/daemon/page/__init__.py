"""The web page: live whiskers, decisions and states in a browser, without a build step.

consumer thread:  items -> Feed -> lines
server thread:    lines -> one bounded queue per browser -> uvicorn
"""

import asyncio
import logging
import socket
import threading
import time

import msgspec
import uvicorn

from tactile_rt.daemon.config import PageConfig, is_loopback
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.items import Contact, Control, Decision, Event, Item, Opened, SourceChunk
from tactile_rt.daemon.messages import encode, state_message
from tactile_rt.daemon.page.feed import FEED_VERSION, Feed, array_line
from tactile_rt.daemon.page.guard import Guard
from tactile_rt.daemon.page.server import App, Connection
from tactile_rt.stream import ConfigError, TactileError

__all__ = ["Page"]

STATE_S = 0.5
START_S, END_S = 10.0, 1.0
SHORTEST_TOKEN = 16


class Page(Consumer):
    """Serves the page.

    Args:
        name: of the part.
        options: ``[page]``.

    Raises:
        ConfigError: others could reach it without a token.
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
        self._view: View | None = None
        self._app: App | None = None
        self._server: uvicorn.Server | None = None
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._told_state = 0.0
        self._frames = 0

    def open(self, view: View) -> None:
        """Listen.

        Raises:
            OSError: the port is taken, or the address is not of this computer.
        """
        options, self._view = self._options, view
        listening = _listen(options.host, options.port)
        try:
            guard = Guard(options.host, options.port, options.token)
            control = self._control if options.control else None
            self._app = App(guard, self._greet, control, self._failed)
            # Whatever a client sends must not fill the log; what matters is counted instead.
            logging.getLogger("uvicorn.error").setLevel(logging.CRITICAL)
            self._server = uvicorn.Server(
                uvicorn.Config(
                    self._app, http=Connection, ws="none", loop="asyncio", lifespan="off",
                    log_config=None, access_log=False, server_header=False, backlog=64,
                    h11_max_incomplete_event_size=16384, timeout_keep_alive=5,
                    proxy_headers=False,
                )
            )  # fmt: skip
            self._thread = threading.Thread(
                target=self._run, args=(listening,), name="tactile-rt page server", daemon=True
            )
            self._thread.start()
        except BaseException:
            listening.close()
            raise
        until = time.monotonic() + START_S
        while not self._server.started:
            if not self._thread.is_alive() or time.monotonic() > until:
                raise TactileError("the page's server did not start")
            time.sleep(0.01)
        if not is_loopback(options.host):
            view.report(
                self._name, "exposed",
                "the token and all data cross the network unencrypted: see docs/security.md",
                "warning",
            )  # fmt: skip

    def handle(self, items: list[Item]) -> None:
        """Send what browsers are to see.

        Raises:
            TactileError: the server is gone.
        """
        app, loop, thread = self._app, self._loop, self._thread
        if app is None or loop is None or thread is None or not thread.is_alive():
            raise TactileError("the page's server has ended")
        clients = list(app.clients.copy())
        lines = self._feed.take(items, {c.source for c in clients})
        self._frames += sum(bool(source) for source, _ in lines)
        now = time.monotonic()
        if clients and now - self._told_state >= STATE_S:
            self._told_state = now
            lines.append(("", self._state()))
        if clients and lines:
            loop.call_soon_threadsafe(app.deliver, lines)

    def close(self) -> None:
        """End all streams and stop listening."""
        thread, loop, server, app = self._thread, self._loop, self._server, self._app
        self._thread = None
        if thread is None:
            return
        if server is not None:
            server.should_exit = server.force_exit = True
        if loop is not None and app is not None and thread.is_alive():
            loop.call_soon_threadsafe(app.end)
        thread.join(END_S)

    def details(self) -> dict[str, str | int | float]:
        app, options = self._app, self._options
        host = f"[{options.host}]" if ":" in options.host else options.host
        clients = list(app.clients.copy()) if app is not None else []
        return {
            "url": f"http://{host}:{options.port}/",
            "browsers": len(clients),
            "frames": self._frames,
            "dropped": (app.dropped if app is not None else 0) + sum(c.dropped for c in clients),
            "refused": app.refused if app is not None else 0,
        }

    def _run(self, listening: socket.socket) -> None:
        assert self._server is not None
        with asyncio.Runner() as runner:
            self._loop = runner.get_loop()
            try:
                runner.run(self._server.serve(sockets=[listening]))
            finally:
                listening.close()

    def _greet(self) -> list[bytes]:
        """The first lines, made in the server's thread."""
        assert self._view is not None
        snapshot = self._view.snapshot()
        hello = {
            "type": "hello", "version": FEED_VERSION, "control": self._options.control,
            "instance": f"{snapshot.pid}-{snapshot.started_ns}",
        }  # fmt: skip
        arrays = [array_line(opened) for opened in self._view.streams().values()]
        recent = self._feed.recent()
        return [msgspec.json.encode(hello) + b"\n", *arrays, self._state(), *recent]

    def _state(self) -> bytes:
        assert self._view is not None
        return encode(state_message(self._view.snapshot())) + b"\n"

    def _control(self, action: str, who: str) -> bool:
        assert self._view is not None
        there = self._view.send("recorder", Control(action))
        if there:
            self._view.report(self._name, "control", f"{who} asked the recorder to {action}")
        return there

    def _failed(self, reason: str) -> None:
        assert self._view is not None
        self._view.report(self._name, "request", reason, "error")


def _listen(host: str, port: int) -> socket.socket:
    found = socket.getaddrinfo(host.strip("[]"), port, type=socket.SOCK_STREAM)
    family, _, _, _, address = found[0]
    try:
        return socket.create_server(address[:2], family=family, backlog=64)
    except OSError as error:
        raise OSError(f"cannot listen on {host}:{port}: {error.strerror}") from None
