"""Metrics, health and state over HTTP: ``/metrics`` for Prometheus, ``/health``, ``/state``.

The text is Prometheus' exposition format 0.0.4; names and units follow its conventions: base units,
``_total`` for counters. Only GET is served; a request has at most 8 KiB and two seconds, and beyond
16 connections a further one replaces the oldest.
"""

import resource
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec

from tactile_rt.core.errors import SourceError
from tactile_rt.daemon.config import MetricsConfig, is_loopback
from tactile_rt.daemon.consumer import Consumer, View
from tactile_rt.daemon.http import HttpLimits, HttpServer, Refused, Request, Response, listen
from tactile_rt.daemon.items import Item
from tactile_rt.daemon.messages import encode, state_message
from tactile_rt.daemon.states import Latency, ModelState, Snapshot, SourceState
from tactile_rt.daemon.trends import read_resident_bytes
from tactile_rt.drivers.health import State

ALERTS = Path(__file__).parents[1] / "assets" / "alerts.yml"

LIMITS = HttpLimits(connections=16, head_bytes=8192, head_s=2.0, send_s=2.0, newest_first=True)
HEADERS = {"cache-control": "no-store", "x-content-type-options": "nosniff"}
EXPOSITION, JSON = "text/plain; version=0.0.4; charset=utf-8", "application/json"
STATES = ("starting", "running", "degraded", "stopping")
PART_STATES = ("starting", "running", "stalled", "waiting", "failed", "ended", "stopped")

Labels = Mapping[str, str]
Row = tuple[str, str, str, Callable[[Any, int], Any]]


class Metrics(Consumer):
    """A consumer that serves metrics, health and state at the address in table ``[metrics]``."""

    wants = frozenset()
    tick_s = 1.0

    def __init__(self, name: str, config: MetricsConfig) -> None:
        self._name, self._config = name, config
        self._server: HttpServer | None = None

    def open(self, view: View) -> None:
        host, port = self._config.host, self._config.port
        self._view = view
        listening = listen(host, port, both=True)
        self._server = HttpServer(
            "tactile-rt metrics server", listening, self._answer, LIMITS, HEADERS, self._log_error
        )
        if not is_loopback(host):
            view.report(
                self._name, "exposed", f"anyone who can reach {host} can read the state", "warning"
            )

    def handle(self, items: list[Item]) -> None:
        if self._server is None or not self._server.alive:
            raise SourceError("the server's thread has ended")

    def close(self) -> None:
        if self._server is not None:
            self._server.close()

    def details(self) -> dict[str, str | int | float]:
        server = self._server
        return {
            "url": f"http://{self._config.host}:{self._config.port}/health",
            "requests": server.answered if server else 0,
            "refused": server.refused + server.dropped if server else 0,
        }

    async def _answer(self, request: Request) -> Response:
        if request.method != "GET":
            raise Refused(405, "only GET", {"allow": "GET"})
        # DNS rebinding: a foreign site may point its name at this address, and query from its page.
        if is_loopback(self._config.host) and not _is_own(request.headers.get("host", "localhost")):
            raise Refused(403, "this is served to its own computer, under localhost, only")
        if request.path == "/metrics":
            return Response(200, exposition(self._view.snapshot()), EXPOSITION)
        if request.path == "/state":
            return Response(200, encode(state_message(self._view.snapshot())), JSON)
        if request.path == "/health":
            snapshot = self._view.snapshot()
            body = {
                "state": snapshot.state,
                "degraded": snapshot.degraded,
                "diagnostics": snapshot.diagnostics,
                "soon": [one.line for one in snapshot.soon],
                "version": snapshot.version,
                "uptime_s": (snapshot.t_ns - snapshot.started_ns) / 1e9,
            }
            status = 200 if snapshot.state == "running" else 503
            return Response(status, msgspec.json.encode(body), JSON)
        raise Refused(404, "there are /metrics, /state and /health")

    def _log_error(self, reason: str) -> None:
        self._view.report(self._name, "request", reason, "error")


def _is_own(host: str) -> bool:
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False


def exposition(snapshot: Snapshot) -> bytes:
    """Return all metrics of the daemon in Prometheus' text format, as bytes."""
    lines = []
    for rows, labelled in _list_tables(snapshot):
        for name, label, about, value in rows:
            found: list[str] = []
            for labels, thing in labelled:
                given = value(thing, snapshot.t_ns)
                if isinstance(given, Latency):
                    found += _write_histogram(name, labels, given)
                elif label:
                    each = (given or {}).items()
                    found += [_write_sample(name, {**labels, label: k}, v) for k, v in each]
                elif given is not None:
                    found.append(_write_sample(name, labels, given))
            if found:
                kind = "histogram" if "_bucket{" in found[0] else "gauge"
                kind = "counter" if name.endswith("_total") else kind
                lines += [f"# HELP tactile_{name} {about}\n# TYPE tactile_{name} {kind}\n", *found]
    return "".join(lines).encode()


def _list_tables(s: Snapshot) -> Iterator[tuple[tuple[Row, ...], list[tuple[Labels, Any]]]]:
    """Yield each table of metrics, with the (labels, state) pairs that it applies to."""
    things: tuple[Any, ...] = (*s.sources, *s.models, *s.consumers)
    yield DAEMON, [({}, s)]
    yield DIAGNOSTIC, [({"part": t.part, "what": t.what}, t) for t in s.diagnostics]
    yield SOON, [({"part": t.part, "what": t.what}, t) for t in s.soon]
    yield PART, [({"part": x.part.name}, x.part) for x in things]
    yield SOURCE, [({"source": _shorten_name(x)}, x) for x in s.sources]
    yield MODEL, [({"model": _shorten_name(x), "source": x.source}, x) for x in s.models]
    yield CONSUMER, [({"consumer": x.part.name, "kind": x.kind}, x) for x in s.consumers]
    yield DISK, [({"source": n}, d) for c in s.consumers for n, d in c.on_disk.items()]


def _shorten_name(thing: SourceState | ModelState) -> str:
    return thing.part.name.partition(".")[2]


def _since(t_ns: int, now_ns: int) -> float | None:
    """Return the time since a moment, s, or None if the moment is 0."""
    return (now_ns - t_ns) / 1e9 if t_ns else None


def _read_cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _list_queue_rows(name: str) -> tuple[Row, ...]:
    return (
        (f"{name}_put_total", "class", "Items for it.", lambda x, _: x.queue.put),
        (f"{name}_taken_total", "class", "Items it took.", lambda x, _: x.queue.taken),
        (f"{name}_dropped_total", "class", "Items it was too slow for.",
         lambda x, _: x.queue.dropped),
        (f"{name}_waiting", "class", "Items that wait for it.", lambda x, _: x.queue.waiting),
        (f"{name}_waiting_bytes", "", "Size of what waits.", lambda x, _: x.queue.waiting_bytes),
    )  # fmt: skip


# For each kind of thing: name, the label that distinguishes several values, help, and its value at
# a host time in ns: a number, a `Latency`, numbers by that label, or None without a value.
DAEMON: tuple[Row, ...] = (
    ("build_info", "version", "Version of tactile_rt.", lambda s, _: {s.version: 1}),
    ("start_time_seconds", "", "When the daemon started, Unix time.",
     lambda s, now: (s.utc_ns - now + s.started_ns) / 1e9),
    ("state", "state", "1 for the state the daemon is in.",
     lambda s, _: {x: x == s.state for x in STATES}),
    ("degraded_parts", "", "Things that do not work.", lambda s, _: len(s.degraded)),
    ("config_reloads_total", "", "Times it was reloaded.", lambda s, _: s.reloads),
    ("clock_steps_total", "", "Jumps of the wall clock.", lambda s, _: s.clock_steps),
    ("cpu_seconds_total", "", "Processor time of the daemon.", lambda s, _: _read_cpu_s()),
    ("resident_memory_bytes", "", "Memory of the daemon.", lambda s, _: read_resident_bytes()),
)  # fmt: skip
DIAGNOSTIC: tuple[Row, ...] = (
    ("diagnostic", "", "1 for each thing that does not work.", lambda t, _: 1),
)
SOON: tuple[Row, ...] = (
    ("soon", "", "1 for each thing that will not work soon if it goes on so.", lambda t, _: 1),
)
PART: tuple[Row, ...] = (
    ("part_state", "state", "1 for the state a part is in.",
     lambda p, _: {x: x == p.state for x in PART_STATES}),
    ("part_starts_total", "", "Times a part was started.", lambda p, _: p.starts),
    ("part_failures_total", "", "Times a part broke.", lambda p, _: p.failures),
)  # fmt: skip
SOURCE: tuple[Row, ...] = (
    ("source_samples_total", "", "Samples read.", lambda x, _: x.samples),
    ("source_lost_samples_total", "reason", "Samples lost, by where they were lost.",
     lambda x, _: {why: getattr(x.stats, why) for why in ("corrupt", "missing", "dropped")}),
    ("source_duplicate_samples_total", "", "Samples that came twice, taken once.",
     lambda x, _: x.stats.duplicates),
    ("source_rate_hertz", "", "Nominal sample rate.", lambda x, _: x.rate_hz),
    ("source_measured_rate_hertz", "", "Rate of the newest second, with what was lost.",
     lambda x, _: x.measured_hz or None),
    ("source_newest_sample_age_seconds", "", "Since the newest sample was taken.",
     lambda x, now: _since(x.newest_ns, now)),
    ("source_bad_samples_total", "", "Samples of an element that were no number.",
     lambda x, _: x.bad_samples),
    ("device_state", "state", "1 for the state a device's stream is in.",
     lambda x, _: x.device and {str(y): y == x.device.state for y in State}),
    ("device_info", "identity", "1 for its serial number, or that of its USB port.",
     lambda x, _: x.device and {x.device.identity: 1}),
    ("device_status", "status", "1 for what a device says of itself.",
     lambda x, _: x.device and dict.fromkeys((*x.device.faults, *x.device.status), 1)),
    ("device_connections_total", "", "Times a device was connected since it was opened.",
     lambda x, _: x.device and x.device.connections),
    ("device_clock_drift_ratio", "", "How much faster the host's clock runs.",
     lambda x, _: x.device and x.device.drift_ppm * 1e-6),
)  # fmt: skip
MODEL: tuple[Row, ...] = (
    ("model_info", "sha256", "The model that runs.",
     lambda x, _: {x.sha256: 1} if x.sha256 else None),
    ("model_decisions_total", "", "Decisions made.", lambda x, _: x.decisions),
    ("model_final_decisions_total", "", "Last decisions of a contact.", lambda x, _: x.final),
    ("model_contact", "", "Whether there is contact.", lambda x, _: x.touching),
    ("model_skips_total", "", "Times it was behind and skipped to the newest sample.",
     lambda x, _: x.skipped),
    ("model_late_steps_total", "", "Steps that were late.", lambda x, _: x.late),
    ("model_bad_steps_total", "", "Steps whose answer was no number.", lambda x, _: x.bad_steps),
    ("model_behind_seconds", "", "How long the oldest samples wait to be classified.",
     lambda x, _: x.behind_s),
    ("model_decision_age_seconds", "",
     "Age of the newest decision's newest sample when the decision was there.",
     lambda x, _: x.decision_age_ms / 1e3 if x.decisions else None),
    ("model_latency_seconds", "", "From the sample that completes a step to the decision.",
     lambda x, _: x.latency),
    ("model_step_seconds", "", "Time of the network alone.", lambda x, _: x.step),
    *_list_queue_rows("model_queue"),
)  # fmt: skip
CONSUMER: tuple[Row, ...] = (
    ("publish_latency_seconds", "",
     "From the sample that completes a step to its publication.",
     lambda x, _: x.latency if x.latency.count else None),
    ("consumer_behind_seconds", "", "How long the oldest item waits to be handled.",
     lambda x, _: x.behind_s),
    ("decision_age_seconds", "",
     "Age of the newest decision's newest sample when it had been published.",
     lambda x, _: x.decision_age_ms / 1e3 if x.latency.count else None),
    *_list_queue_rows("consumer_queue"),
    ("consumer_detail", "detail", "Details that a consumer reports, by its own names.",
     lambda x, _: {k: v for k, v in sorted(x.details.items()) if not isinstance(v, str)}),
)  # fmt: skip
DISK: tuple[Row, ...] = (
    ("recorded_samples_total", "", "Samples that are in a recording.", lambda d, _: d.samples),
    ("recorder_lost_samples_total", "", "Samples that should be in a recording.",
     lambda d, _: d.lost_samples),
    ("recorder_written_sample_age_seconds", "",
     "Since the newest sample that the system has of the recording, while it is recorded.",
     lambda d, now: _since(d.written_ns, now) if d.meant_ns else None),
    ("recorder_synced_sample_age_seconds", "",
     "Since the newest sample of the recording that is on the medium, while it is recorded.",
     lambda d, now: _since(d.synced_ns, now) if d.meant_ns else None),
)  # fmt: skip


def _write_histogram(name: str, labels: Labels, latency: Latency) -> Iterator[str]:
    """Yield a histogram's lines, with the cumulative buckets that Prometheus expects."""
    below = 0
    edges = [*(f"{e:g}" for e in latency.edges_s), "+Inf"]
    for edge, count in zip(edges, latency.buckets or (0,), strict=True):
        below += count
        yield _write_sample(f"{name}_bucket", {**labels, "le": edge}, below)
    yield _write_sample(f"{name}_sum", labels, latency.sum_s)
    yield _write_sample(f"{name}_count", labels, below)


def _write_sample(name: str, labels: Labels, value: float) -> str:
    text = ",".join(f'{k}="{_escape(v)}"' for k, v in labels.items())
    number = int(value) if isinstance(value, bool | int) else float(value)
    return f"tactile_{name}{{{text}}} {number!r}\n" if text else f"tactile_{name} {number!r}\n"


def _escape(text: str) -> str:
    return text.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")
