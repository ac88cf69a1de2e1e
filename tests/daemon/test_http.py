"""The server that the page and the metrics share: what it reads, sends, and refuses."""

import asyncio
import http.client
import socket
import time
from dataclasses import replace

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from tactile_rt.daemon.http import (
    HttpLimits,
    HttpServer,
    Refused,
    Request,
    Response,
    listen,
    parse_head,
)
from tests.helpers.waiting import PATIENCE_S, until

pytestmark = pytest.mark.usefixtures("no_thread_left")
LIMITS = HttpLimits(connections=8, head_bytes=1000, head_s=PATIENCE_S, send_s=PATIENCE_S)


class Application:
    """Answers as the path says."""

    def __init__(self):
        self.failures, self.closed, self.more = [], 0, None

    async def answer(self, request):
        if request.path == "/body":
            return Response(200, await request.body(10, PATIENCE_S))
        if request.path == "/stream":
            self.more = asyncio.Event()
            return Response(200, self.lines())
        if request.path == "/fault":
            raise ZeroDivisionError("by nought")
        if request.path == "/fault-in-stream":
            return Response(200, self.broken())
        return Response(200, request.path.encode(), headers={"x-peer": request.peer})

    async def lines(self):
        try:
            yield b"one\n"
            yield b""  # nothing to say is not the end
            await self.more.wait()
            yield b"two\n"
        finally:
            self.closed += 1

    async def broken(self):
        raise KeyError("gone")
        yield b""


@pytest.fixture
def serve():
    """Servers, which are closed after."""
    servers = []

    def make(**limits):
        application = Application()
        listening = listen("127.0.0.1", 0)
        server = HttpServer(
            "test server", listening, application.answer, replace(LIMITS, **limits),
            {"x-all": "yes"}, application.failures.append,
        )  # fmt: skip
        servers.append(server)
        return server, application, listening.getsockname()[1]

    yield make
    for server in servers:
        server.close()
        assert not server.alive


def raw(port, data):
    """All that comes back for these bytes."""
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
        line.sendall(data)
        found = b""
        while more := line.recv(65536):
            found += more
        return found


def test_an_answer_has_a_length_and_ends_the_connection(serve):
    server, _, port = serve()
    head, _, body = raw(port, b"GET /a%20b?c=d HTTP/1.1\r\nHost: x\r\n\r\n").partition(b"\r\n\r\n")
    assert body == b"/a%20b"
    assert head.decode().split("\r\n") == [
        "HTTP/1.1 200 OK", "x-all: yes", "connection: close",
        "content-type: text/plain; charset=utf-8", "content-length: 6", "x-peer: 127.0.0.1",
    ]  # fmt: skip
    assert raw(port, b"HEAD / HTTP/1.1\r\n\r\n").endswith(b"127.0.0.1\r\n\r\n")
    # What follows the request is not another one.
    assert raw(port, b"GET /1 HTTP/1.1\r\n\r\nGET /2 HTTP/1.1\r\n\r\n").count(b"HTTP/1.1 200") == 1
    assert server.answered == 3 and server.refused == server.dropped == 0


@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_a_stream_goes_on_until_it_is_over(serve, version):
    server, application, port = serve()
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
        line.sendall(f"GET /stream HTTP/{version}\r\n\r\n".encode())
        answer = http.client.HTTPResponse(line)
        answer.begin()
        assert answer.readline() == b"one\n"
        assert server.connections == 1 and application.closed == 0
        server.call(application.more.set)
        assert answer.read() == b"two\n"  # raises where chunks do not end as they should
        assert (answer.headers["transfer-encoding"] is not None) == (version == "1.1")
        answer.close()
    until(lambda: not server.connections)
    assert application.closed == 1


def test_a_stream_ends_with_its_reader(serve):
    server, application, port = serve()
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
        line.sendall(b"GET /stream HTTP/1.1\r\n\r\n")
        assert line.recv(1000)
    until(lambda: application.closed == 1 and not server.connections)


def test_the_end_of_the_server_is_the_end_of_its_streams(serve):
    server, application, port = serve()
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
        line.sendall(b"GET /stream HTTP/1.1\r\n\r\n")
        answer = http.client.HTTPResponse(line)
        answer.begin()
        assert answer.readline() == b"one\n"
        server.close()
        assert answer.read() == b""
        answer.close()
    assert application.closed == 1
    with pytest.raises(ConnectionRefusedError):
        socket.create_connection(("127.0.0.1", port), PATIENCE_S)
    server.close()  # twice does no harm


def test_a_fault_is_told_and_the_others_are_served(serve):
    server, application, port = serve()
    for path in ("/fault", "/fault-in-stream"):
        assert raw(port, f"GET {path} HTTP/1.1\r\n\r\n".encode()).startswith(b"HTTP/1.1 500 ")
    assert application.failures == [
        "/fault: ZeroDivisionError: by nought", "/fault-in-stream: KeyError: 'gone'"
    ]  # fmt: skip
    assert raw(port, b"GET / HTTP/1.1\r\n\r\n").startswith(b"HTTP/1.1 200 ")
    assert server.refused == 2


@pytest.mark.parametrize(
    ("headers", "body", "status"),
    [
        (b"Content-Length: 5", b"12345", 200),
        (b"Content-Length: 5", b"1234567", 200),
        (b"X: y", b"", 200),
        (b"Content-Length: 11", b"12345678901", 413),
        (b"Content-Length: 999999999999999999999999", b"", 400),
        (b"Content-Length: -1", b"", 400),
        (b"Content-Length: +5", b"12345", 400),
        ("Content-Length: \u00b2".encode("latin-1"), b"12", 400),
        (b"Content-Length: 5\r\nContent-Length: 5", b"12345", 400),
        (b"Transfer-Encoding: chunked", b"1\r\nx\r\n0\r\n\r\n", 411),
        (b"Content-Length: 5\r\nTransfer-Encoding: chunked", b"0\r\n\r\n", 411),
    ],
)
def test_a_body_is_read_as_it_tells_its_length(serve, headers, body, status):
    _, _, port = serve()
    answer = raw(port, b"POST /body HTTP/1.1\r\n" + headers + b"\r\n\r\n" + body)
    assert answer.startswith(b"HTTP/1.1 %d " % status)
    if status == 200:
        assert answer.partition(b"\r\n\r\n")[2] == body[:5]


def test_a_body_may_come_in_pieces_and_must_come_whole(serve):
    _, _, port = serve()
    pieces = [b"POST /body HT", b"TP/1.1\r\nContent-Length: 5\r\n\r", b"\n12", b"3"]
    for end in (b"45", b""):
        with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for piece in (*pieces, end):
                line.sendall(piece)
            line.shutdown(socket.SHUT_WR)
            assert line.recv(100).startswith(b"HTTP/1.1 200 " if end else b"HTTP/1.1 400 ")


@pytest.mark.parametrize("more, status", [(-1, 200), (0, 200), (1, 431), (2, 431), (50_000, 431)])
@pytest.mark.parametrize("body", [b"", b"12345"])
def test_a_head_is_as_long_as_it_may_be_and_no_byte_longer(serve, more, status, body):
    _, _, port = serve()
    begin = b"POST /body HTTP/1.1\r\nContent-Length: %d\r\nX: " % len(body)
    head = begin + b"a" * (LIMITS.head_bytes + more - len(begin) - 4) + b"\r\n\r\n"
    assert len(head) == LIMITS.head_bytes + more
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
        line.sendall(head + body)
        assert line.recv(100).startswith(b"HTTP/1.1 %d " % status)


def test_a_body_that_takes_too_long_is_refused():
    async def ask():
        request = Request("POST", "/", "", "HTTP/1.1", {"content-length": "2"}, begun=b"1")
        request.reader = asyncio.StreamReader()
        with pytest.raises(Refused, match="too slow"):
            await request.body(10, 0.01)

    asyncio.run(ask())


def test_who_takes_nothing_is_hung_up_on(serve):
    server, _, port = serve(send_s=0.05)

    async def flood(request):
        async def pieces():
            while True:
                yield b"x" * 1_000_000

        return Response(200, pieces())

    server._answer = flood
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
        line.sendall(b"GET / HTTP/1.1\r\n\r\n")
        until(lambda: server.dropped == 1 and not server.connections)
        with pytest.raises((ConnectionResetError, http.client.IncompleteRead)):
            answer = http.client.HTTPResponse(line)
            answer.begin()
            answer.read()


def test_one_connection_too_many_is_dropped_and_leaves_the_others_alone(serve):
    server, _, port = serve(connections=2)
    lines = [socket.create_connection(("127.0.0.1", port), PATIENCE_S) for _ in range(2)]
    until(lambda: server.connections == 2)
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as late:
        with pytest.raises(ConnectionResetError):
            assert late.recv(1) == b""
            raise ConnectionResetError
    assert server.dropped == 1
    for line in lines:
        line.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert line.recv(100).startswith(b"HTTP/1.1 200 ")
        line.close()


def test_a_head_that_drips_has_so_long_and_no_longer(serve):
    _, _, port = serve(head_s=0.3)
    began = time.monotonic()
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as line:
        line.settimeout(0.02)
        told = b""
        while not told:
            assert time.monotonic() - began < PATIENCE_S
            line.sendall(b"G")
            try:
                told = line.recv(100)
            except TimeoutError:
                continue
    assert told.startswith(b"HTTP/1.1 408 ")


@pytest.mark.parametrize(
    "head",
    [
        b"", b"GET /", b"GET  / HTTP/1.1", b"GET / HTTP/2.0", b"GET / HTTP/1.1 ", b"GET x HTTP/1.1",
        b"GET http://a/ HTTP/1.1", b"G(T / HTTP/1.1", b"GET /\x00 HTTP/1.1", b"GET /\n HTTP/1.1",
        b"GET / HTTP/1.1\r\nHost", b"GET / HTTP/1.1\r\nHost : a", b"GET / HTTP/1.1\r\n: a",
        b"GET / HTTP/1.1\r\nX: a\r\n b", b"GET / HTTP/1.1\r\nX: a\nY: b",
        b"GET / HTTP/1.1\r\nX: a\rY: b", b"GET / HTTP/1.1\r\nHost: a\r\nhost: a",
        b"GET / HTTP/1.1\r\nOrigin: http://a\r\nOrigin: null", b"\x16\x03\x01\x02",
    ],
)  # fmt: skip
def test_what_is_no_request_is_refused(head):
    with pytest.raises(Refused) as told:
        parse_head(head)
    assert told.value.status == 400


def test_headers_are_found_by_name_whatever_their_case_and_count():
    head = b"GET /p?q?r HTTP/1.1\r\nHOST:\t a \r\nCookie: b=1\r\ncookie: c=2\r\nX: d\r\nX: e"
    request = parse_head(head)
    assert (request.path, request.query) == ("/p", "q?r")
    assert request.headers == {"host": "a", "cookie": "b=1; c=2", "x": "d, e"}


@given(st.binary(max_size=60), st.lists(st.binary(max_size=30), max_size=4))
@example(b"GET / HTTP/1.1", [b"a: \xff"])
def test_any_bytes_are_a_request_or_refused(first, lines):
    try:
        request = parse_head(b"\r\n".join([first, *lines]))
    except Refused as refused:
        assert refused.status == 400
    else:
        text = "".join([request.method, request.path, request.query, *request.headers.values()])
        assert not any(ord(c) < 32 and c != "\t" for c in text)


def test_addresses_and_names_are_listened_at():
    with listen("[::1]", 0, both=True) as six, listen("localhost", 0, both=True) as name:
        assert six.getsockname()[0] == "::1" and name.getsockname()[0] == "127.0.0.1"
    # Of IPv6's "everyone", one of the two takes IPv4, too; the page does not.
    for both in (True, False):
        with listen("::", 0, both=both) as everyone:
            four = ("127.0.0.1", everyone.getsockname()[1])
            with socket.socket() as line:
                assert (line.connect_ex(four) == 0) == both
