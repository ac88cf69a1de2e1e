"""The whole daemon under way for long, with faults every few seconds: what it loses and costs.

python -m bench.daemon.soak --seconds 3600 --json soak.json
"""

import argparse
import os
import signal
import threading
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from rich.console import Console

from bench.daemon.accounts import account
from bench.daemon.latencies import latencies
from bench.daemon.models import finger_array, whisker_array
from bench.daemon.soak_rig import EVERY_S, WHOLE_S, WIRES, Soak, soak
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.core.stream import NS_PER_S
from tactile_rt.models.evaluation.records import Record, show, write

WARM_S = 300.0  # from then on nothing is excused
WARM_SHARE = 0.15  # of a shorter run
STEADY_S = 600.0  # a shorter run cannot tell a leak from warming up
GROWTH = 10.0  # %
TOOK = "array's write of the sample that completes a step to the decision in zmq's peer's hand"


def soak_records(result: Soak) -> list[Record]:
    """The figures of a soak."""
    return [
        *_losses(result), *_queues(result), *_latency(result), *_memory(result),
        *_processor(result), *_end(result),
    ]  # fmt: skip


def _losses(result: Soak) -> list[Record]:
    records = []
    for source in result.state["sources"]:
        name = source["part"]["name"].partition(".")[2]
        found = account(
            WIRES[name], result.played[name], source["stats"], result.recorded[name].seq
        )
        records += [
            Record(
                f"daemon.soak.{name}_unbalanced", found.unbalanced, "samples", "== 0",
                "sent + duplicated = delivered + corrupt + missing + dropped + duplicates",
                found.told,
            ),
            Record(
                f"daemon.soak.{name}_unexplained", found.unexplained, "samples", "== 0",
                "sent whole over a line that was up, and not in the recording, or the reverse",
            ),
            Record(
                f"daemon.soak.{name}_miscounted", found.miscounted, "samples", "== 0",
                "each cause by itself, beside what the array did",
            ),
        ]  # fmt: skip
    return records


def _queues(result: Soak) -> list[Record]:
    wrong = dropped = 0
    for part in [*result.state["models"], *result.state["consumers"]]:
        queue = part["queue"]
        for kind, put in queue["put"].items():
            gone = queue["taken"][kind] + queue["dropped"][kind] + queue["waiting"][kind]
            wrong += abs(put - gone)
            dropped += queue["dropped"][kind]
    made = {m["source"]: m["decisions"] for m in result.state["models"]}
    lost = 0
    for heard in result.heard.values():
        for source, count in made.items():
            number = heard.sources.index(source) if source in heard.sources else -1
            lost += abs(count - int((heard.source == number).sum()))
    return [
        Record(
            "daemon.soak.queues_unbalanced", wrong, "items", "== 0",
            "put = taken + dropped + waiting", "every mailbox, every class",
        ),
        Record(
            "daemon.soak.queues_dropped", dropped, "items", "== 0", "", "of all mailboxes",
        ),
        Record(
            "daemon.soak.decisions_lost", lost, "decisions", "== 0",
            f"made: {', '.join(f'{n} of {s}' for s, n in made.items())}",
            f"by any of {', '.join(result.heard)}",
        ),
        Record(
            "daemon.soak.page_updates", result.heard["page"].frames / result.seconds, "1/s",
            ">= 20", "what to draw, silences of the array included", "one open page",
        ),
    ]  # fmt: skip


def _latency(result: Soak) -> list[Record]:
    records = []
    _, card = load_model(shipped_model())
    heard = result.heard["zmq"]
    pings = np.percentile(result.ping.took_ms, (50, 99, 100)).tolist()
    beside = "eight bytes over a bare pty: p50 {:.1f}, p99 {:.1f}, worst {:.1f} ms".format(*pings)
    for name, spec in (("whiskers", whisker_array()), ("finger", finger_array())):
        if name not in heard.sources:
            continue
        mine = heard.source == heard.sources.index(name)
        half_ns = max(card.period_ns, round(NS_PER_S / spec.rate_hz))
        found = latencies(
            half_ns, result.recorded[name], result.played, name, heard.t_ns[mine],
            heard.at_ns[mine], result.ping, [(a, b) for _, a, b in result.disturbed],
        )  # fmt: skip
        worst = "worst: " + ", ".join(
            f"{fault} {ms.max():.0f}" for fault, ms in found.kinds.items() if len(ms)
        )
        calm = ""
        if found.calm.any():
            p99 = np.percentile(found.quiet[found.calm], 99)
            calm = f"; p99 {p99:.1f} of the {found.calm.sum()} beside which none took over 2 ms"
        for kind, took, bar in (("quiet", found.quiet, 15), ("faulty", found.faulty, 45)):
            if not len(took):
                continue
            p50, p99, far, most = np.percentile(took, (50, 99, 99.9, 100)).tolist()
            records.append(
                Record(
                    f"daemon.soak.{name}_{kind}_p99", p99, "ms", f"<= {bar}",
                    f"p50 {p50:.1f}, p99.9 {far:.1f}, worst {most:.1f}, jitter (standard "
                    f"deviation) {took.std():.1f} ms; {beside}{calm if kind == 'quiet' else ''}",
                    f"{TOOK}; {len(took)} decisions, "
                    + ("undisturbed" if kind == "quiet" else f"to 1 s after a fault; {worst}"),
                )
            )  # fmt: skip
    return records


def _memory(result: Soak) -> list[Record]:
    at, resident = np.array(result.usage.at), np.array(result.usage.resident, float)
    at -= at[0]
    warm = WARM_S if result.seconds >= 2 * WARM_S else WARM_SHARE * result.seconds
    tenth = max(3.0, min(60.0, 0.1 * (result.seconds - warm)))
    early = np.median(resident[(at >= warm) & (at < warm + tenth)])
    late = np.median(resident[(at >= result.seconds - tenth) & (at <= result.seconds)])
    most = ", ".join(f"{n} {a}, {b}" for n, (a, b) in result.waiting.items() if a or b)
    steady = result.seconds >= STEADY_S
    first = result.usage.at[0]
    between = ", ".join(
        f"{what} from {a - first:.0f} to {b - first:.0f} s" for what, a, b in result.disturbed
    )
    return [
        Record(
            "daemon.soak.memory_growth", 100 * (late / early - 1), "%",
            f"<= {GROWTH:g}" if steady else "",
            f"{early / 1e6:.1f} MB after {warm:.0f} s, {late / 1e6:.1f} MB at the end, at most "
            f"{resident.max() / 1e6:.1f} MB",
            f"resident; in between: {between or 'nothing but faults of the arrays'}",
        ),
        Record(
            "daemon.soak.waiting_most", max(map(max, result.waiting.values()), default=0) / 1e3,
            "kB", "", f"first half, second half: {most or 'nothing'}",
            "bytes that waited for a part",
        ),
    ]  # fmt: skip


def _processor(result: Soak) -> list[Record]:
    cores = result.usage.cores
    whole = sum(cores.values()) or 1.0
    shares = ", ".join(
        f"core {core}: {100 * result.usage.share * used / whole:.0f} %"
        for core, used in sorted(cores.items())
    )
    how = (
        "35 x 6 at 1 kHz over a pty, 30 x 6 at 110 Hz over slcan, a model on each, recorder, "
        f"jsonl, zmq, zenoh and the page with a peer each, a fault every {EVERY_S:g} s on each "
        f"array, {result.seconds:g} s; load {os.getloadavg()[1]:.1f} on {os.cpu_count()} cores"
    )
    return [Record("daemon.soak.cpu", 100 * result.usage.share, "% of a core", "", shares, how)]


def _end(result: Soak) -> list[Record]:
    state: dict[str, Any] = result.state
    parts = [p["part"] for k in ("sources", "models", "consumers") for p in state[k]]
    broke = ", ".join(f"{p['name']} {p['failures']}x" for p in parts if p["failures"])
    again = sum(heard.connections - 1 for heard in result.heard.values())
    apart = ", ".join(
        f"{n}: {h.messages} messages, at most {h.longest_s:.2f} s apart"
        for n, h in result.heard.items()
    )
    failures, lines = sum(p["failures"] for p in parts), len(result.log.splitlines())
    return [
        Record("daemon.soak.parts_broken", failures, "times", "== 0", broke),
        Record("daemon.soak.peers_cut", again, "times", "== 0", apart),
        Record("daemon.soak.unfinished", result.unfinished, "recordings", "== 0"),
        Record(
            "daemon.soak.tracebacks", result.log.count("Traceback"), "", "== 0",
            f"{lines} lines in the log",
        ),
        Record("daemon.soak.stop", result.stop_s, "s", "<= 2", f"exit code {result.code}"),
    ]  # fmt: skip


def main() -> None:
    """A soak of any length; SIGTERM ends it earlier, with the figures so far."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=WHOLE_S)
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    enough = threading.Event()
    signal.signal(signal.SIGTERM, lambda number, frame: enough.set())
    result = soak(given.seconds, enough=enough)
    records = soak_records(result)
    show(records, Console())
    if given.json:
        write(records, given.json)
        usage = {"at": result.usage.at, "resident": result.usage.resident, "log": result.log}
        given.json.with_suffix(".usage.json").write_bytes(msgspec.json.encode(usage))


if __name__ == "__main__":
    main()
