"""The page: what it sends, whom it refuses, and that nobody can hurt the rest through it."""

import base64
import http.client
import json
import re
import socket
from contextlib import closing, nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from bench.daemon.process import free_port
from tactile_rt.classifier.classifier import Classification
from tactile_rt.core.errors import ConfigError
from tactile_rt.daemon.config import PageConfig
from tactile_rt.daemon.http import Refused
from tactile_rt.daemon.items import Control, Decision, Event, Opened, SourceChunk
from tactile_rt.daemon.page import Page
from tactile_rt.daemon.page import feed as feed_module
from tactile_rt.daemon.page.feed import Feed, map_axes
from tactile_rt.daemon.page.routes import LIMITS, MAX_LINES, MAX_STREAMS, STATIC, Guard, PageClient
from tactile_rt.daemon.states import Snapshot
from tactile_rt.testing import ArraySource, cut_chunks, small_spec
from tests.helpers.waiting import PATIENCE_S, until

SPEC = small_spec()
TOKEN = "correct horse battery"

pytestmark = pytest.mark.usefixtures("no_thread_left")


def opened(spec=SPEC, name="a"):
    return Opened(name, spec, "test:", ArraySource(spec, []), 7, 0)


def samples(values, name="a", valid=None):
    chunk = cut_chunks(np.asarray(values, np.float32), 1000.0, samples=len(values))[0]
    if valid is not None:
        chunk = replace(chunk, valid=np.asarray(valid))
    return SourceChunk(name, SPEC, chunk, 5, 0)


def decision(label="y"):
    d = Classification(10, 20, 3, True, label, ("x", label), np.array([0.25, 0.75]), 0.001)
    return Decision("a", "m", "mount", d, 1, 2, 0)


class FakeView:
    """Of a daemon with one source."""

    def __init__(self, recorder=True):
        self.reports, self.sent, self.recorder = [], [], recorder

    def snapshot(self):
        return Snapshot("1", 1, "robot.toml", 5, 6, 7, 0, "running")

    def streams(self):
        return {"a": opened()}

    def report(self, *event):
        self.reports.append(event)

    def send(self, consumer, control):
        self.sent.append((consumer, control))
        return self.recorder


@pytest.fixture
def serve():
    """Open pages; close them after."""
    pages = []

    def make(view=None, **options):
        port = free_port()
        page = Page("page", PageConfig(port=port, **options))
        pages.append(page)
        page.open(view or FakeView())
        return page, port

    yield make
    for page in pages:
        page.close()


def ask(port, method="GET", path="/", body=None, headers=None):
    """(status, headers, body) of one request."""
    line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    try:
        sent = {"Content-Type": "application/json", **(headers or {})}
        line.request(method, path, json.dumps(body) if isinstance(body, dict) else body, sent)
        answer = line.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read()
    finally:
        line.close()


class Stream:
    """A browser that reads ``/live``."""

    def __init__(self, port, source="a", headers=None):
        self.line = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        self.line.request("GET", f"/live?source={source}", headers=headers or {})
        self.answer = self.line.getresponse()
        self.status = self.answer.status

    def until(self, kind):
        while True:
            message = json.loads(self.answer.readline())
            if message["type"] == kind:
                return message

    def close(self):
        self.answer.close()
        self.line.close()


def floats(text):
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(SPEC.shape)


def test_a_frame_holds_the_newest_sample_and_the_extremes_since_the_last(monkeypatch):
    monkeypatch.setattr(feed_module.time, "monotonic", iter([100.0, 100.001, 100.1]).__next__)
    values = np.random.default_rng(0).normal(size=(30, *SPEC.shape)).astype(np.float32)
    feed = Feed()
    (first,) = feed.take([samples(values[:1])], {"a"})
    assert json.loads(first[1])["samples"] == 1 and "least" not in json.loads(first[1])
    assert feed.take([samples(values[1:10])], {"a"}) == []  # too soon: it is kept, not lost
    ((source, line),) = feed.take([samples(values[10:])], {"a"})
    frame = json.loads(line)
    assert source == "a" and frame["samples"] == 29
    np.testing.assert_array_equal(floats(frame["newest"]), values[-1])
    np.testing.assert_array_equal(floats(frame["least"]), values[1:].min(axis=0))
    np.testing.assert_array_equal(floats(frame["most"]), values[1:].max(axis=0))


def test_what_is_not_valid_is_not_a_number_and_hides_no_extreme():
    values = np.arange(12, dtype=np.float32).reshape(2, *SPEC.shape)
    valid = [[True, False, True], [False, False, True]]
    ((_, line),) = Feed().take([samples(values, valid=valid)], {"a"})
    frame = json.loads(line)
    assert np.isnan(floats(frame["newest"])[:2]).all()
    np.testing.assert_array_equal(floats(frame["least"])[0], values[0, 0])
    np.testing.assert_array_equal(floats(frame["most"])[2], values[1, 2])
    assert np.isnan(floats(frame["least"])[1]).all()


def test_samples_that_nobody_looks_at_are_not_sent_and_the_recent_is_kept():
    feed = Feed()
    assert feed.take([samples(np.ones((5, *SPEC.shape)))], {"b"}) == []
    feed.take([decision(), Event("a", "running", "", "info", 1, 0)], set())
    kinds = [json.loads(line)["type"] for line in feed.recent()]
    assert kinds == ["health", "decision"]
    feed.take([decision()] * 5000, set())
    told = [Event("a", "waiting", str(i % 2), "warning", i, 0) for i in range(5000)]
    feed.take([*told, *(Event("b", "running", str(i), "info", i, 0) for i in range(10))], set())
    recent = [json.loads(line) for line in feed.recent()]
    assert len(recent) < 500
    # What comes again and again is kept once, the newest, and hides nothing else.
    kept = [(m["part"], m["t_ns"]) for m in recent if m["type"] == "health"]
    assert [t for part, t in kept if part == "a"] == [1, 4998, 4999]
    assert sum(part == "b" for part, _ in kept) == 10


def test_arrows_are_right_and_down_on_the_map_however_elements_are_turned():
    # A grid in the mount's y (columns) and -z (rows); each element turned about another axis.
    grid = [(r, c) for r in range(2) for c in range(3)]
    rng = np.random.default_rng(1)
    turns = rng.normal(size=(6, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    places = tuple((0.3, 0.01 * c, -0.02 * r) for r, c in grid)
    spec = replace(
        small_spec(6), grid=tuple(grid), positions=places, orientations=tuple(map(tuple, turns))
    )
    force = np.array([5.0, 2.0, -3.0])  # of the mount frame: 2 to the right, 3 down

    def turn(q, v):  # v' = q v q*, by quaternion products
        w, u = q[0], q[1:]
        return v + 2 * np.cross(u, np.cross(u, v) + w * v)

    for q, axes in zip(turns, map_axes(spec), strict=True):
        own = turn(q * [1, -1, -1, -1], force)
        np.testing.assert_allclose(axes @ own, [2.0, 3.0], atol=2e-3)


def test_places_that_span_no_plane_leave_each_element_its_own_axes():
    spec = replace(small_spec(4), grid=((0, 0), (0, 1), (1, 0), (1, 1)))
    flat = replace(spec, positions=((0.0, 0.0, 0.0),) * 4)
    for one in (flat, small_spec(1)):
        np.testing.assert_array_equal(map_axes(one)[0] @ [1.0, 2.0, 9.0], [1.0, -2.0])


def test_a_client_that_does_not_read_loses_the_oldest_and_they_are_counted():
    client = PageClient("a")
    for i in range(MAX_LINES + 30):
        client.put(b"%d\n" % i)
    assert client.dropped == 30
    coroutine = client.take()
    with pytest.raises(StopIteration) as end:  # it has no need to wait
        coroutine.send(None)
    assert end.value.value.split()[0] == b"30"


def test_a_browser_sees_what_happens(serve):
    page, port = serve()
    with closing(Stream(port)) as stream:
        assert stream.until("hello")["control"] is False
        assert stream.until("array")["source"] == "a"
        assert stream.until("state")["snapshot"]["state"] == "running"
        page.handle([decision("<b>y"), samples(np.ones((4, *SPEC.shape)))])
        assert stream.until("decision")["label"] == "<b>y"
        assert stream.until("frame")["samples"] == 4
        assert page.details()["browsers"] == 1
    until(lambda: page.details()["browsers"] == 0)


@pytest.mark.parametrize("token", ["", "short"])
def test_beyond_loopback_a_page_without_a_good_token_is_not_made(token):
    with pytest.raises(ConfigError, match="token of at least 16 characters"):
        Page("page", PageConfig(host="0.0.0.0", token=token))


def test_beyond_loopback_it_is_said_that_nothing_is_encrypted(serve):
    view = FakeView()
    _, port = serve(view, host="0.0.0.0", token=TOKEN)
    assert [r[1] for r in view.reports] == ["exposed"]
    assert ask(port, path="/live")[0] == 401


def test_only_who_knows_the_token_sees_data(serve):
    view = FakeView()
    _, port = serve(view, token=TOKEN, control=True)
    assert ask(port, path="/")[0] == 200  # the page itself tells nothing
    assert ask(port, path="/live")[0] == 401
    assert ask(port, "POST", "/control", {"action": "stop"})[0] == 401
    status, headers, body = ask(port, "POST", "/login", {"token": TOKEN[:-1] + "x"})
    assert (status, body) == (401, b"the token is wrong") and "set-cookie" not in headers
    status, headers, _ = ask(port, "POST", "/login", {"token": TOKEN})
    assert status == 204
    cookie = headers["set-cookie"]
    assert "HttpOnly" in cookie and "SameSite=Strict" in cookie and TOKEN not in cookie
    pair = cookie.partition(";")[0]
    for headers, status in [
        ({"Cookie": pair}, 202),
        ({"Cookie": f"other=1; {pair}"}, 202),
        ({"Authorization": f"Bearer {TOKEN}"}, 202),
        ({"Cookie": pair[:-1] + "!"}, 401),
        ({"Cookie": pair[:-1] + "ü"}, 401),
        ({"Authorization": f"Bearer {TOKEN}x"}, 401),
        ({"Authorization": f"Basic {TOKEN}"}, 401),
        ({"Authorization": "Bearer"}, 401),
    ]:
        headers = {k: v.encode("latin-1") for k, v in headers.items()}
        assert ask(port, "POST", "/control", {"action": "trigger"}, headers)[0] == status, headers
    assert view.sent == [("recorder", Control("trigger"))] * 3


def test_a_cookie_is_good_after_a_restart_and_bad_for_another_token():
    cookie = Guard("::", 1, TOKEN).set_cookie().partition(";")[0]
    assert Guard("::", 1, TOKEN).knows({"cookie": cookie})
    assert not Guard("::", 1, TOKEN + "x").knows({"cookie": cookie})


@pytest.mark.parametrize(
    ("headers", "good"),
    [
        ({"host": "127.0.0.1:8765"}, True),
        ({"host": "[::1]:8765"}, True),
        ({"host": "192.168.7.2"}, True),
        ({"host": "robot.example:8765"}, False),  # DNS rebinding
        ({"host": "localhost.evil.example"}, False),
        ({"host": "[::1"}, False),
        ({"host": ""}, False),
        ({}, False),
        ({"host": "localhost:1", "origin": "http://localhost:1"}, True),
        ({"host": "localhost:1", "origin": "http://localhost:2"}, False),
        ({"host": "localhost:1", "origin": "null"}, False),
        ({"host": "localhost:1", "sec-fetch-site": "same-origin"}, True),
        ({"host": "localhost:1", "sec-fetch-site": "cross-site"}, False),
        ({"host": "localhost:1", "sec-fetch-site": "same-site"}, False),
        (
            {"host": "localhost:1", "sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate"},
            True,  # a link to the page
        ),
    ],
)
def test_only_this_page_may_ask_under_this_hosts_names(headers, good):
    with nullcontext() if good else pytest.raises(Refused):
        Guard("127.0.0.1", 8765, "").check(headers, "GET")


def test_the_server_refuses_other_sites_and_wrong_methods(serve):
    page, port = serve(control=True)
    evil = {"Origin": "http://evil.example"}
    assert ask(port, path="/live", headers=evil)[0] == 403
    assert ask(port, "POST", "/control", {"action": "stop"}, evil)[0] == 403
    assert ask(port, path="/", headers={"Host": "evil.example"})[0] == 403
    text = {"Content-Type": "text/plain"}  # what a foreign form can send
    assert ask(port, "POST", "/control", {"action": "stop"}, text)[0] == 415
    assert ask(port, "POST", "/live")[0] == 405
    assert ask(port, "GET", "/control")[0] == 405
    for path in ("/../guard.py", "/static/app.js", "/%2e%2e/__init__.py", "/x"):
        assert ask(port, path=path)[0] == 404
    assert page.details()["refused"] == 10


def test_the_page_only_looks_unless_it_may_control(serve):
    view = FakeView()
    _, port = serve(view)
    assert ask(port, "POST", "/control", {"action": "stop"})[0] == 403
    assert view.sent == []


def test_control_reaches_the_recorder_and_is_told(serve):
    view = FakeView()
    _, port = serve(view, control=True)
    assert ask(port, "POST", "/control", {"action": "rotate"})[0] == 202
    assert view.sent == [("recorder", Control("rotate"))]
    assert view.reports[0][:3] == ("page", "control", "127.0.0.1 asked the recorder to rotate")
    for body in ({"action": "format"}, {"action": 1}, {"acton": "start"}, "[", "", b"\xff"):
        assert ask(port, "POST", "/control", body)[0] == 400, body
    assert len(view.sent) == 1
    view.recorder = False
    assert ask(port, "POST", "/control", {"action": "start"})[0] == 404


def test_every_answer_carries_the_policy(serve):
    _, port = serve(token=TOKEN)
    for path in [*STATIC, "/live", "/nothing"]:
        _, headers, body = ask(port, path=path)
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy and "unsafe" not in policy and "http" not in policy
        assert headers["x-content-type-options"] == "nosniff"
        assert headers["x-frame-options"] == "DENY"
        # Nothing is asked of another host, and no text ever becomes markup or code.
        text = body.decode().replace("http://www.w3.org/2000/svg", "")
        wrong = r"https?://|innerHTML|outerHTML|insertAdjacent|eval\(|document\.write"
        assert not re.findall(wrong, text), path


def test_at_most_so_many_browsers_and_a_flood_of_connections_ends_with_the_flood(serve):
    page, port = serve()
    streams = [Stream(port) for _ in range(MAX_STREAMS)]
    try:
        for stream in streams:
            stream.until("hello")
        late = Stream(port)
        assert late.status == 503
        late.close()
        flood = [socket.create_connection(("127.0.0.1", port), PATIENCE_S) for _ in range(200)]
        page.handle([decision()])  # returns at once whatever they do
        assert all(s.until("decision")["label"] == "y" for s in streams)
        until(lambda: page._server.connections <= LIMITS.connections)
        for line in flood:
            line.close()
    finally:
        for stream in streams:
            stream.close()
    until(lambda: page.details()["browsers"] == 0)
    until(lambda: not page._server.connections)
    assert ask(port)[0] == 200


def test_a_fault_of_the_page_is_told_in_the_log(serve):
    view = FakeView()
    view.streams = SimpleNamespace()  # not callable
    _, port = serve(view)
    Stream(port).close()
    until(lambda: view.reports)
    assert view.reports[0][:2] == ("page", "request") and "TypeError" in view.reports[0][2]
