"""Metrics, health and state over HTTP: ``/metrics`` for Prometheus, ``/health``, ``/state``.

The text is Prometheus' exposition format 0.0.4; names and units are as its conventions ask for:
base units, ``_total`` for what only grows. Only GET; at most 8 KiB a request, in two seconds, 16
at a time.
"""

import os
import resource
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgspec

from tactile_rt.daemon.config import MetricsConfig, is_loopback
from tactile_rt.daemon.consumer import TAKEN, Consumer, View
from tactile_rt.daemon.health import Latency, PartState, QueueState, Snapshot
from tactile_rt.daemon.http import HttpLimits, HttpServer, Refused, Request, Response, listen
from tactile_rt.daemon.items import Item
from tactile_rt.daemon.messages import encode, state_message
from tactile_rt.drivers.health import State
from tactile_rt.errors import SourceError

__all__ = ["ALERTS", "Metrics", "exposition"]

ALERTS = Path(__file__).parents[1] / "assets" / "alerts.yml"

LIMITS = HttpLimits(connections=16, head_bytes=8192, head_s=2.0, send_s=2.0)
HEADERS = {"cache-control": "no-store", "x-content-type-options": "nosniff"}
EXPOSITION, JSON = "text/plain; version=0.0.4; charset=utf-8", "application/json"
STATES = ("starting", "running", "degraded", "stopping")
PART_STATES = ("starting", "running", "stalled", "waiting", "failed", "ended", "stopped")

Labels = Mapping[str, str]
Rows = Iterable[tuple[Labels, float]]


class Metrics(Consumer):
    """Answers those who ask.

    Args:
        name: The name of the part.
        config: The table ``[metrics]``: where to listen.
    """

    wants = frozenset()
    tick_s = 1.0

    def __init__(self, name: str, config: MetricsConfig) -> None:
        self._name, self._config = name, config
        self._view: View | None = None
        self._server: HttpServer | None = None

    def open(self, view: View) -> None:
        host, port = self._config.host, self._config.port
        self._view = view
        listening = listen(host, port, both=True)
        self._server = HttpServer(
            "tactile-rt metrics server", listening, self._answer, LIMITS, HEADERS, self._failed
        )
        if not is_loopback(host):
            view.report(
                self._name, "exposed", f"whoever can reach {host} can read the state", "warning"
            )

    def handle(self, items: list[Item]) -> None:
        if self._server is None or not self._server.alive:
            raise SourceError("the server's thread has ended")

    def close(self) -> None:
        if self._server is not None:
            self._server.close()

    def trouble(self) -> str:
        server = self._server
        return TAKEN if server is not None and server.full else ""

    def details(self) -> dict[str, str | int | float]:
        server = self._server
        return {
            "url": f"http://{self._config.host}:{self._config.port}",
            "requests": server.answered if server else 0,
            "refused": server.refused + server.dropped if server else 0,
        }

    async def _answer(self, request: Request) -> Response:
        if request.method != "GET":
            raise Refused(405, "only GET", {"allow": "GET"})
        # A page of a foreign site may have its name resolve to us, and then ask from a browser.
        if is_loopback(self._config.host) and not _local(request.headers.get("host", "localhost")):
            raise Refused(403, "this is served to its own computer, under localhost, only")
        assert self._view is not None
        if request.path == "/metrics":
            return Response(200, exposition(self._view.snapshot()), EXPOSITION)
        if request.path == "/state":
            return Response(200, encode(state_message(self._view.snapshot())), JSON)
        if request.path == "/health":
            snapshot = self._view.snapshot()
            body = {
                "state": snapshot.state,
                "degraded": snapshot.degraded,
                "troubles": snapshot.troubles,
                "version": snapshot.version,
                "uptime_s": (snapshot.t_ns - snapshot.started_ns) / 1e9,
            }
            status = 200 if snapshot.state == "running" else 503
            return Response(status, msgspec.json.encode(body), JSON)
        raise Refused(404, "there are /metrics, /state and /health")

    def _failed(self, reason: str) -> None:
        assert self._view is not None
        self._view.report(self._name, "request", reason, "error")


def _local(host: str) -> bool:
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False


def exposition(snapshot: Snapshot) -> bytes:
    """All metrics of the daemon."""
    out = _Text()
    _daemon(out, snapshot)
    parts = [s.part for s in snapshot.sources] + [m.part for m in snapshot.models]
    _parts(out, parts + [c.part for c in snapshot.consumers])
    _sources(out, snapshot)
    _models(out, snapshot)
    _consumers(out, snapshot)
    return "".join(out.lines).encode()


class _Text:
    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, name: str, kind: str, about: str, rows: Rows) -> None:
        """A metric, unless it has no rows."""
        found = [f"tactile_{name}{_labels(labels)} {_number(value)}\n" for labels, value in rows]
        if found:
            self.lines += [
                f"# HELP tactile_{name} {about}\n# TYPE tactile_{name} {kind}\n", *found
            ]  # fmt: skip

    def histogram(self, name: str, about: str, rows: Iterable[tuple[Labels, Latency]]) -> None:
        """Latencies; their buckets are not cumulative, those of Prometheus are."""
        found = []
        for labels, latency in rows:
            below = 0
            edges = [*(f"{e:g}" for e in latency.edges_s), "+Inf"]
            counts = latency.buckets or (0,)
            for edge, count in zip(edges, counts, strict=True):
                below += count
                found.append(
                    f"tactile_{name}_bucket{_labels({**labels, 'le': edge})} {below}\n"
                )  # fmt: skip
            found.append(f"tactile_{name}_sum{_labels(labels)} {_number(latency.sum_s)}\n")
            found.append(f"tactile_{name}_count{_labels(labels)} {below}\n")
        if found:
            self.lines += [
                f"# HELP tactile_{name} {about}\n# TYPE tactile_{name} histogram\n", *found
            ]  # fmt: skip


def _daemon(out: _Text, s: Snapshot) -> None:
    out.add("build_info", "gauge", "Version of tactile_rt.", [({"version": s.version}, 1)])
    started = (s.utc_ns - s.t_ns + s.started_ns) / 1e9
    out.add("start_time_seconds", "gauge", "When the daemon started, Unix time.", [({}, started)])
    out.add(
        "state", "gauge", "1 for the state the daemon is in.",
        [({"state": x}, x == s.state) for x in STATES],
    )  # fmt: skip
    out.add("degraded_parts", "gauge", "Things that do not work.", [({}, len(s.degraded))])
    out.add(
        "trouble", "gauge", "1 for each thing that does not work.",
        [({"part": t.part, "what": t.what}, 1) for t in s.troubles],
    )  # fmt: skip
    out.add("config_reloads_total", "counter", "Times it was reloaded.", [({}, s.reloads)])
    out.add("clock_steps_total", "counter", "Jumps of the wall clock.", [({}, s.clock_steps)])
    used = resource.getrusage(resource.RUSAGE_SELF)
    cpu = used.ru_utime + used.ru_stime
    out.add("cpu_seconds_total", "counter", "Processor time of the daemon.", [({}, cpu)])
    try:
        with open("/proc/self/statm") as file:
            resident = int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        out.add("resident_memory_bytes", "gauge", "Memory of the daemon.", [({}, resident)])
    except (OSError, ValueError, IndexError):
        pass  # not Linux


def _parts(out: _Text, parts: list[PartState]) -> None:
    out.add(
        "part_state", "gauge", "1 for the state a part is in.",
        [({"part": p.name, "state": x}, x == p.state) for p in parts for x in PART_STATES],
    )  # fmt: skip
    out.add(
        "part_starts_total", "counter", "Times a part was started.",
        [({"part": p.name}, p.starts) for p in parts],
    )  # fmt: skip
    out.add(
        "part_failures_total", "counter", "Times a part broke.",
        [({"part": p.name}, p.failures) for p in parts],
    )  # fmt: skip


def _sources(out: _Text, s: Snapshot) -> None:
    named = [(x.part.name.partition(".")[2], x) for x in s.sources]
    out.add(
        "source_samples_total", "counter", "Samples read.",
        [({"source": n}, x.samples) for n, x in named],
    )  # fmt: skip
    out.add(
        "source_lost_samples_total", "counter", "Samples lost, by where they were lost.",
        [
            ({"source": n, "reason": why}, getattr(x.stats, why))
            for n, x in named
            for why in ("corrupt", "missing", "dropped")
        ],
    )  # fmt: skip
    out.add(
        "source_duplicate_samples_total", "counter", "Samples that came twice, taken once.",
        [({"source": n}, x.stats.duplicates) for n, x in named],
    )  # fmt: skip
    out.add(
        "source_rate_hertz", "gauge", "Nominal sample rate.",
        [({"source": n}, x.rate_hz) for n, x in named],
    )  # fmt: skip
    out.add(
        "source_newest_sample_age_seconds", "gauge", "Since the newest sample was taken.",
        [({"source": n}, (s.t_ns - x.newest_ns) / 1e9) for n, x in named if x.newest_ns],
    )  # fmt: skip
    out.add(
        "source_bad_samples_total", "counter", "Samples of an element that were no number.",
        [({"source": n}, x.bad_samples) for n, x in named],
    )  # fmt: skip
    devices = [(n, x.device) for n, x in named if x.device is not None]
    out.add(
        "device_state", "gauge", "1 for the state a device's stream is in.",
        [({"source": n, "state": str(y)}, y == d.state) for n, d in devices for y in State],
    )  # fmt: skip
    out.add(
        "device_connections_total", "counter", "Times a device was connected since it was opened.",
        [({"source": n}, d.connections) for n, d in devices],
    )  # fmt: skip
    out.add(
        "device_clock_drift_ratio", "gauge", "How much faster the host's clock runs.",
        [({"source": n}, d.drift_ppm * 1e-6) for n, d in devices],
    )  # fmt: skip


def _models(out: _Text, s: Snapshot) -> None:
    named = [
        ({"model": x.part.name.partition(".")[2], "source": x.source}, x) for x in s.models
    ]  # fmt: skip
    out.add(
        "model_info", "gauge", "The model that runs.",
        [({**n, "sha256": x.sha256}, 1) for n, x in named if x.sha256],
    )  # fmt: skip
    out.add(
        "model_decisions_total", "counter", "Decisions made.",
        [(n, x.decisions) for n, x in named],
    )  # fmt: skip
    out.add(
        "model_final_decisions_total", "counter", "Last decisions of a contact.",
        [(n, x.final) for n, x in named],
    )  # fmt: skip
    out.add(
        "model_contact", "gauge", "Whether there is contact.", [(n, x.touching) for n, x in named]
    )
    out.add(
        "model_skips_total", "counter", "Times it was behind and skipped to the newest sample.",
        [(n, x.skipped) for n, x in named],
    )  # fmt: skip
    out.add(
        "model_late_steps_total",
        "counter",
        "Steps that were late.",
        [(n, x.late) for n, x in named],
    )
    out.add(
        "model_behind_seconds", "gauge", "How long the oldest samples wait to be classified.",
        [(n, x.behind_s) for n, x in named],
    )  # fmt: skip
    out.add(
        "model_decision_age_seconds", "gauge",
        "Age of the newest decision's newest sample when the decision was there.",
        [(n, x.decision_age_ms / 1e3) for n, x in named if x.decisions],
    )  # fmt: skip
    out.histogram(
        "model_latency_seconds", "From the sample that completes a step to the decision.",
        [(n, x.latency) for n, x in named],
    )  # fmt: skip
    out.histogram(
        "model_step_seconds", "Time of the network alone.", [(n, x.step) for n, x in named]
    )
    _queues(out, "model_queue", [(n, x.queue) for n, x in named])


def _consumers(out: _Text, s: Snapshot) -> None:
    named = [({"consumer": x.part.name, "kind": x.kind}, x) for x in s.consumers]
    out.histogram(
        "publish_latency_seconds", "From the sample that completes a step to its publication.",
        [(n, x.latency) for n, x in named if x.latency.count],
    )  # fmt: skip
    out.add(
        "consumer_behind_seconds", "gauge", "How long the oldest item waits to be handled.",
        [(n, x.behind_s) for n, x in named],
    )  # fmt: skip
    out.add(
        "decision_age_seconds", "gauge",
        "Age of the newest decision's newest sample when it had been published.",
        [(n, x.decision_age_ms / 1e3) for n, x in named if x.latency.count],
    )  # fmt: skip
    _recorded(out, s)
    _queues(out, "consumer_queue", [(n, x.queue) for n, x in named])
    out.add(
        "consumer_detail", "gauge", "What a consumer tells of itself, as it names it.",
        [
            ({**n, "detail": key}, value)
            for n, x in named
            for key, value in sorted(x.details.items())
            if not isinstance(value, str)
        ],
    )  # fmt: skip


def _recorded(out: _Text, s: Snapshot) -> None:
    disks = [({"source": name}, d) for c in s.consumers for name, d in c.on_disk.items()]
    out.add(
        "recorded_samples_total", "counter", "Samples that are in a recording.",
        [(n, d.samples) for n, d in disks],
    )  # fmt: skip
    out.add(
        "recorder_lost_samples_total", "counter", "Samples that should be in a recording.",
        [(n, d.lost_samples) for n, d in disks],
    )  # fmt: skip
    out.add(
        "recorder_written_sample_age_seconds", "gauge",
        "Since the newest sample that the system has of the recording, while it is recorded.",
        [(n, (s.t_ns - d.written_ns) / 1e9) for n, d in disks if d.meant_ns and d.written_ns],
    )  # fmt: skip
    out.add(
        "recorder_synced_sample_age_seconds", "gauge",
        "Since the newest sample of the recording that is on the medium, while it is recorded.",
        [(n, (s.t_ns - d.synced_ns) / 1e9) for n, d in disks if d.meant_ns and d.synced_ns],
    )  # fmt: skip


def _queues(out: _Text, name: str, rows: list[tuple[dict[str, str], QueueState]]) -> None:
    def by_class(what: str) -> list[tuple[Labels, float]]:
        return [
            ({**n, "class": c}, count) for n, q in rows for c, count in getattr(q, what).items()
        ]

    out.add(f"{name}_put_total", "counter", "Items for it.", by_class("put"))
    out.add(f"{name}_taken_total", "counter", "Items it took.", by_class("taken"))
    out.add(f"{name}_dropped_total", "counter", "Items it was too slow for.", by_class("dropped"))
    out.add(f"{name}_waiting", "gauge", "Items that wait for it.", by_class("waiting"))
    out.add(
        f"{name}_waiting_bytes", "gauge", "Size of what waits.",
        [(n, q.waiting_bytes) for n, q in rows],
    )  # fmt: skip


def _labels(labels: Labels) -> str:
    if not labels:
        return ""
    return "{" + ",".join(f'{k}="{_escaped(v)}"' for k, v in labels.items()) + "}"


def _escaped(text: str) -> str:
    return text.replace("\\", r"\\").replace("\n", r"\n").replace('"', r"\"")


def _number(value: Any) -> str:
    return repr(int(value)) if isinstance(value, bool | int) else repr(float(value))
