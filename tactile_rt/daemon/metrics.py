"""Metrics, health and state over HTTP: ``/metrics`` (Prometheus), ``/health``, ``/state``.

Only GET; one request per connection, of at most 8 KiB, in at most two seconds, 16 at a time.
"""

import contextlib
import socket
import socketserver
import threading
import time
from urllib.parse import urlsplit

import msgspec

from tactile_rt.daemon.config import MetricsConfig, is_loopback
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.items import Item
from tactile_rt.daemon.messages import encode, state_message
from tactile_rt.daemon.prometheus import CONTENT_TYPE, exposition
from tactile_rt.stream import SourceError

__all__ = ["Metrics"]

LARGEST = 8192  # bytes of a request
REQUEST_S = 2.0
AT_ONCE = 16
POLL_S = 0.2  # how soon it hears that it is to end
JSON = "application/json"
REASONS = {
    200: "OK", 400: "Bad Request", 403: "Forbidden", 404: "Not Found", 405: "Method Not Allowed",
    408: "Request Timeout", 431: "Request Header Fields Too Large", 503: "Service Unavailable",
}  # fmt: skip


class Metrics(Consumer):
    """Answers those who ask; each in a thread of its own, so that none waits for another.

    Args:
        name: of the part.
        config: where to listen.
    """

    wants = frozenset()
    tick_s = 1.0

    def __init__(self, name: str, config: MetricsConfig) -> None:
        self._name, self._config = name, config
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None

    def open(self, view: View) -> None:
        host, port = self._config.host, self._config.port
        try:
            self._server = _Server(host, port, view)
        except OSError as error:
            raise SourceError(f"cannot listen at {host}:{port}: {error.strerror}") from None
        if not is_loopback(host):
            view.report(
                self._name, "exposed", f"whoever can reach {host} can read the state", "warning"
            )
        self._thread = threading.Thread(
            target=self._server.serve_forever,
            args=(POLL_S,),
            name="tactile-rt metrics server",
            daemon=True,
        )
        self._thread.start()

    def handle(self, items: list[Item]) -> None:
        if self._thread is None or not self._thread.is_alive():
            raise SourceError("the server's thread has ended")

    def close(self) -> None:
        server, self._server = self._server, None
        thread, self._thread = self._thread, None
        if server is not None:
            if thread is not None:
                server.shutdown()
            server.hang_up()
            server.server_close()
        if thread is not None:
            thread.join(REQUEST_S)

    def details(self) -> dict[str, str | int | float]:
        server = self._server
        return {
            "url": f"http://{self._config.host}:{self._config.port}",
            "requests": server.requests if server else 0,
            "refused": server.refused if server else 0,
        }


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = False  # so that closing waits for them, after they have been hung up on
    request_queue_size = 32

    def __init__(self, host: str, port: int, view: View) -> None:
        self.view = view
        self.only_loopback = is_loopback(host)
        self.requests = self.refused = 0
        self._open: set[socket.socket] = set()
        if ":" in host:
            self.address_family = socket.AF_INET6
        super().__init__((host.strip("[]"), port), _Request)

    def verify_request(self, request: object, client_address: object) -> bool:
        if len(self._open) >= AT_ONCE:
            self.refused += 1
            return False
        return True

    def process_request(self, request: socket.socket, client_address: object) -> None:  # type: ignore[override]
        self._open.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: socket.socket) -> None:  # type: ignore[override]
        self._open.discard(request)
        super().shutdown_request(request)

    def handle_error(self, request: object, client_address: object) -> None:
        self.refused += 1  # the peer went away: no traceback on stderr for that

    def hang_up(self) -> None:
        for request in self._open.copy():
            with contextlib.suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)


class _Request(socketserver.BaseRequestHandler):
    server: _Server
    request: socket.socket

    def handle(self) -> None:
        status, head = self._read()
        body, kind = b"", "text/plain; charset=utf-8"
        if status == 200:
            status, body, kind = self._answer(head)
        if status not in (200, 503) or not body:
            body = f"{status} {REASONS[status]}\n".encode()
            kind = "text/plain; charset=utf-8"
        if status == 200:
            self.server.requests += 1
        elif status != 503:
            self.server.refused += 1
        header = (
            f"HTTP/1.1 {status} {REASONS[status]}\r\nContent-Type: {kind}\r\n"
            f"Content-Length: {len(body)}\r\nConnection: close\r\nCache-Control: no-store\r\n"
            "X-Content-Type-Options: nosniff\r\n"
            f"{'Allow: GET' + chr(13) + chr(10) if status == 405 else ''}\r\n"
        )
        self.request.settimeout(REQUEST_S)
        self.request.sendall(header.encode() + body)

    def _read(self) -> tuple[int, bytes]:
        """The head of a request; the time is for all of it, however it drips in."""
        end, data = time.monotonic() + REQUEST_S, b""
        while b"\r\n\r\n" not in data:
            left = end - time.monotonic()
            if left <= 0:
                return 408, b""
            self.request.settimeout(left)
            try:
                more = self.request.recv(LARGEST + 1 - len(data))
            except TimeoutError:
                return 408, b""
            if not more:
                return 400, b""
            data += more
            if len(data) > LARGEST:
                return 431, b""
        return 200, data.partition(b"\r\n\r\n")[0]

    def _answer(self, head: bytes) -> tuple[int, bytes, str]:
        first, *lines = head.decode("latin-1").split("\r\n")
        words = first.split(" ")
        if len(words) != 3 or not words[2].startswith("HTTP/1."):
            return 400, b"", ""
        if words[0] != "GET":
            return 405, b"", ""
        headers = {k.strip().lower(): v.strip() for k, _, v in (x.partition(":") for x in lines)}
        # A page of a foreign site may have its name resolve to us, and then ask from a browser.
        if self.server.only_loopback and not _local(headers.get("host", "localhost")):
            return 403, b"", ""
        view = self.server.view
        path = words[1].partition("?")[0]
        if path == "/metrics":
            return 200, exposition(view.snapshot()), CONTENT_TYPE
        if path == "/state":
            return 200, encode(state_message(view.snapshot())), JSON
        if path == "/health":
            snapshot = view.snapshot()
            body = {
                "state": snapshot.state,
                "degraded": snapshot.degraded,
                "version": snapshot.version,
                "uptime_s": (snapshot.t_ns - snapshot.started_ns) / 1e9,
            }
            return 200 if snapshot.state == "running" else 503, msgspec.json.encode(body), JSON
        return 404, b"", ""


def _local(host: str) -> bool:
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False
