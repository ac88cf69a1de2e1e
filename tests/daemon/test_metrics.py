"""Metrics, health and state over real HTTP; read by Prometheus' own parser."""

import dataclasses
import http.client
import json
import socket
import urllib.request
from contextlib import ExitStack

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families

from bench.daemon.process import free_port
from tactile_rt.core.errors import SourceError
from tactile_rt.daemon import metrics as module
from tactile_rt.daemon.config import MetricsConfig
from tactile_rt.daemon.messages import StateMessage
from tactile_rt.daemon.metrics import Metrics, exposition
from tactile_rt.daemon.states import SourceState
from tests.helpers.published import View, busy_snapshot, part, running
from tests.helpers.waiting import PATIENCE_S, until

pytestmark = pytest.mark.usefixtures("no_thread_left")


@pytest.fixture
def served():
    """(port, view, consumer)"""
    port = free_port()
    consumer = Metrics("metrics", MetricsConfig(port=port))
    with running(consumer, View(snapshot=busy_snapshot())) as view:
        yield port, view, consumer


def get(port, path, method="GET", **headers):
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
    try:
        connection.request(method, path, headers={k.title(): v for k, v in headers.items()})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read()
    finally:
        connection.close()


def parsed(text):
    """{(name, labels): value}, {family: kind}"""
    families = list(text_string_to_metric_families(text))
    values = {
        (s.name, frozenset(s.labels.items())): s.value for f in families for s in f.samples
    }  # fmt: skip
    assert len(values) == sum(len(f.samples) for f in families), "a sample is told twice"
    return values, {f.name: f.type for f in families}


def test_prometheus_reads_what_the_daemon_tells(served):
    port, _, _ = served
    status, headers, body = get(port, "/metrics")
    assert status == 200
    assert headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
    assert int(headers["Content-Length"]) == len(body)
    values, kinds = parsed(body.decode())

    def value(name, **labels):
        return values[name, frozenset(labels.items())]

    assert value("tactile_build_info", version="1.2.3") == 1
    assert value("tactile_state", state="degraded") == 1
    assert value("tactile_state", state="running") == 0
    assert value("tactile_start_time_seconds") == pytest.approx(1_700_000_002)
    assert value("tactile_clock_steps_total") == 2
    assert value("tactile_source_samples_total", source="whiskers") == 5000
    lost = {
        why: value("tactile_source_lost_samples_total", source="whiskers", reason=why)
        for why in ("corrupt", "missing", "dropped")
    }
    assert lost == {"corrupt": 4, "missing": 3, "dropped": 2}
    assert value("tactile_source_newest_sample_age_seconds", source="whiskers") == 0.004
    assert value("tactile_device_state", source="finger", state="lost") == 1
    assert value("tactile_device_clock_drift_ratio", source="whiskers") == pytest.approx(12.5e-6)
    assert value("tactile_part_state", part="recorder", state="waiting") == 1
    assert value("tactile_part_failures_total", part="recorder") == 9
    model = {"model": "whiskers", "source": "whiskers"}
    assert value("tactile_model_contact", **model) == 1
    assert value("tactile_model_info", sha256="ab" * 32, **model) == 1
    # Prometheus counts all that is below an edge, the daemon what is between two.
    buckets = [
        value("tactile_model_latency_seconds_bucket", le=edge, **model)
        for edge in ("0.001", "0.005", "0.01", "+Inf")
    ]
    assert buckets == [1, 3, 6, 6]
    assert value("tactile_model_latency_seconds_count", **model) == 6
    assert value("tactile_model_latency_seconds_sum", **model) == 0.035
    zmq = {"consumer": "publisher.zmq", "kind": "zmq"}
    put, taken, dropped, waiting = (
        value(f"tactile_consumer_queue_{what}", **zmq, **{"class": "samples"})
        for what in ("put_total", "taken_total", "dropped_total", "waiting")
    )
    assert put == taken + dropped + waiting == 10
    assert value("tactile_consumer_detail", detail="messages", **zmq) == 40
    assert value("tactile_resident_memory_bytes") > 1e6
    assert kinds["tactile_source_samples"] == "counter"
    assert kinds["tactile_model_latency_seconds"] == "histogram"


def test_names_follow_the_conventions():
    _, kinds = parsed(exposition(busy_snapshot()).decode())
    for line in exposition(busy_snapshot()).decode().splitlines():
        if line.startswith("# TYPE"):
            _, _, name, kind = line.split()
            assert name.startswith("tactile_") and name == name.lower()
            assert name.endswith("_total") == (kind == "counter")
            assert not name.endswith(("_ms", "_ns", "_mb", "_s", "_ppm", "_hz"))
    assert len(kinds) > 25


def test_what_a_name_may_hold_does_not_break_the_text():
    evil = 'a"b\\c\nd'
    source = SourceState(part(f"source.{evil}"), "url")
    changed = dataclasses.replace(busy_snapshot(), sources=(source,))
    values, _ = parsed(exposition(changed).decode())
    assert values["tactile_source_samples_total", frozenset({("source", evil)})] == 0


def test_health_is_the_status_and_state_is_everything(served):
    port, view, _ = served
    status, _, body = get(port, "/health")
    found = json.loads(body)
    assert (status, found["state"], found["uptime_s"]) == (503, "degraded", 8.0)
    assert found["degraded"] == ["no samples: source.finger: the device is lost"]
    assert found["soon"] == ["disk full soon: recorder: it is full within 3 h"]
    view.shown = busy_snapshot(state="running")
    status, headers, body = get(port, "/health?x=1")
    assert (status, headers["Content-Type"]) == (200, "application/json")
    status, _, body = get(port, "/state")
    assert status == 200
    assert msgspec.json.decode(body, type=StateMessage).snapshot == view.shown
    # The way of most programs.
    with urllib.request.urlopen(f"http://localhost:{port}/health") as answer:
        assert answer.status == 200


@pytest.mark.parametrize(
    ("method", "path", "host", "status"),
    [
        ("POST", "/metrics", "localhost", 405),
        ("GET", "/../../etc/passwd", "localhost", 404),
        ("GET", "/state", "evil.example", 403),
        ("GET", "/health", "[::1]:80", 503),
    ],
)
def test_whatever_is_asked_gets_an_answer_of_its_own(served, method, path, host, status):
    port, _, _ = served
    assert get(port, path, method, host=host)[0] == status
    assert get(port, "/state")[0] == 200  # and it goes on


def test_slow_connections_keep_nobody_away(served):
    port, _, consumer = served
    with ExitStack() as stack:
        for _ in range(100):
            line = stack.enter_context(socket.create_connection(("127.0.0.1", port)))
            line.sendall(b"GET /heal")
        assert get(port, "/health")[0] == 503 and get(port, "/metrics")[0] == 200
        assert consumer._server.connections <= module.LIMITS.connections
    assert consumer._server.answered == 1 and not consumer.diagnose()


def test_closing_waits_for_nobody_and_frees_the_port(monkeypatch):
    monkeypatch.setattr(module, "LIMITS", dataclasses.replace(module.LIMITS, head_s=600.0))
    port = free_port()
    consumer = Metrics("metrics", MetricsConfig(port=port))
    consumer.open(View())
    with socket.create_connection(("127.0.0.1", port)):  # which asks for nothing
        until(lambda: consumer._server.connections)
        consumer.close()
        assert not consumer._server.alive
    other = Metrics("metrics", MetricsConfig(port=port))
    with running(other):
        with pytest.raises(SourceError, match=f"cannot listen at 127.0.0.1:{port}: Address"):
            consumer.open(View())
        consumer.close()
    with pytest.raises(SourceError, match="has ended"):
        other.handle([])


def test_beyond_loopback_only_if_asked_and_then_it_is_told():
    assert MetricsConfig().host == "127.0.0.1"
    port = free_port()
    with running(Metrics("metrics", MetricsConfig(host="0.0.0.0", port=port))) as view:
        assert view.reports == [("metrics", "exposed", "warning")]
        assert get(port, "/state", host="robot.lan")[0] == 200
