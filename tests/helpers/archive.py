"""An object store on this machine: serves the files of a folder by ranges, and misbehaves if asked.

It is a process of its own. h5py holds its lock while it reads, over the network too; a server in
the same process waits for that lock whenever one of its threads happens to collect an object of
h5py's, and then the two wait for each other.
"""

import json
import re
import subprocess
import sys
import threading
from http.client import HTTPConnection
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

CONTROL = "/control"  # what tests say to the server


class Archive:
    """A server of a folder's files, looked at anew with every request; runs in the context."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __enter__(self) -> "Archive":
        self._process = subprocess.Popen(
            [sys.executable, __file__, self.folder],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self._process.stdout is not None
        self.port = int(self._process.stdout.readline())
        return self

    def __exit__(self, *_: object) -> None:
        self._process.communicate()

    def url(self, name: str) -> str:
        return f"http://127.0.0.1:{self.port}/{name}"

    def misbehave(self, fault: str) -> None:
        """gone, no ranges, another size, cut; or once busy, which ends by itself."""
        self._say("PUT", fault)

    def requests(self) -> list[tuple[str, str]]:
        """Path and range of each so far."""
        return [(path, asked) for path, asked in json.loads(self._say("GET"))]

    def forget(self) -> None:
        """No request so far."""
        self._say("DELETE")

    def _say(self, method: str, body: str = "") -> bytes:
        connection = HTTPConnection("127.0.0.1", self.port)
        try:
            connection.request(method, CONTROL, body)
            return connection.getresponse().read()
        finally:
            connection.close()


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    folder = Path()
    fault = ""
    requests: ClassVar[list[tuple[str, str | None]]] = []

    def do_GET(self) -> None:
        here = type(self)
        if self.path == CONTROL:
            return self.answer(200, json.dumps(self.requests).encode())
        path = self.folder / self.path[1:]
        asked = re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        self.requests.append((self.path, self.headers.get("Range")))
        if not path.exists() or self.fault == "gone":
            return self.answer(404, b"no such key")
        data = path.read_bytes()
        if self.fault == "no ranges" or not asked:
            return self.answer(200, data[:1000])
        if self.fault == "once busy":
            here.fault = ""
            return self.answer(503, b"slow down")
        begin, end = int(asked[1]), int(asked[2])
        size = len(data) + (self.fault == "another size")
        part = data[begin : end + 1]
        self.answer(206, part, f"bytes {begin}-{end}/{size}", cut=self.fault == "cut")

    def do_PUT(self) -> None:
        type(self).fault = self.rfile.read(int(self.headers["Content-Length"])).decode()
        self.answer(200, b"")

    def do_DELETE(self) -> None:
        self.requests.clear()
        self.answer(200, b"")

    def answer(self, status: int, body: bytes, content_range: str = "", cut: bool = False) -> None:
        self.send_response(status)
        if content_range:
            self.send_header("Content-Range", content_range)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body[: len(body) // 2] if cut else body)
        self.close_connection = cut

    def log_message(self, *_: Any) -> None:
        pass


class _Server(ThreadingHTTPServer):
    def handle_error(self, *_: Any) -> None:
        pass  # who is refused hangs up


if __name__ == "__main__":
    _Handler.folder = Path(sys.argv[1])
    server = _Server(("127.0.0.1", 0), _Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    sys.stdout.write(f"{server.server_port}\n")
    sys.stdout.flush()
    sys.stdin.read()  # until whoever started it has closed it, or is gone
