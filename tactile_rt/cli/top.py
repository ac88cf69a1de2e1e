"""`tactile-rt top`: show a running daemon in the terminal."""

import sys
import time
from collections.abc import Iterator
from datetime import timedelta
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tactile_rt.cli.app import app
from tactile_rt.cli.options import Json, argument, option
from tactile_rt.cli.tables import fitting, print_table, told_as_json
from tactile_rt.core.errors import ConfigError, SourceError

if TYPE_CHECKING:
    from tactile_rt.daemon.states import Latency, PartState, Snapshot

LARGEST = 16 << 20  # bytes of a state
EVERY_S = 1.0  # between requests
COLOURS = {
    "running": "green", "streaming": "green", "ended": "dim", "stopped": "dim",
    "starting": "yellow", "connecting": "yellow", "waiting": "red", "stalled": "red",
    "failed": "bold red", "stale": "red", "lost": "red", "degraded": "red", "stopping": "yellow",
}  # fmt: skip


@app.command(epilog="tactile-rt top --once")
def top(
    where: Annotated[
        str, argument("URL of the daemon's metrics, or - for its JSON lines on stdin.")
    ] = "http://127.0.0.1:9464",
    once: Annotated[bool, option("Print once and stop.", "--once")] = False,
    json: Json = None,
) -> None:
    """Show sources, models, losses and latencies of a daemon.

    It asks for /state of the daemon's metrics. Without metrics, give a jsonl publisher
    state_s = 1: tactile-rt run robot.toml | tactile-rt top -
    """
    if json is not None and not once:
        raise ConfigError("--json needs --once")
    console = Console()
    if once:
        found = next(_poll_snapshots(where))
        if not told_as_json(found, json):
            for part in picture(found).renderables:
                if isinstance(part, Table):
                    print_table(part, console)
                else:
                    console.print(part, soft_wrap=True)
        return
    with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
        for snapshot in _poll_snapshots(where):
            parts = picture(snapshot).renderables
            fit = [fitting(p, console) if isinstance(p, Table) else p for p in parts]
            live.update(Group(*fit), refresh=True)


def snapshot_at(url: str) -> "Snapshot":
    """Request the state of a daemon over HTTP, and return it.

    Raises:
        ConfigError: the URL is not http, or the answer is not a daemon's.
        SourceError: no daemon answers.
    """
    import http.client

    import msgspec

    from tactile_rt.daemon.messages import StateMessage

    try:
        parts = urlsplit(url if "//" in url else f"http://{url}")
        host, port = parts.hostname or "", parts.port or 9464
        host.encode("idna")
    except ValueError:  # raised for an invalid host name, too
        host = ""
    if not host or parts.scheme != "http":
        raise ConfigError(f"{url} is not like http://127.0.0.1:9464")
    connection = http.client.HTTPConnection(host, port, timeout=3)
    try:
        connection.request("GET", "/state")
        return msgspec.json.decode(
            connection.getresponse().read(LARGEST), type=StateMessage
        ).snapshot
    except msgspec.MsgspecError as error:
        raise ConfigError(
            f"http://{host}:{port}/state is not the state of a daemon: {error}"
        ) from None
    except (OSError, http.client.HTTPException) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise SourceError(
            f"no daemon at http://{host}:{port}: {why}; is that the port of its [metrics]?"
        ) from None
    finally:
        connection.close()


def read_snapshots(lines: Iterator[bytes]) -> "Iterator[Snapshot]":
    """Yield the state of each state message among lines of JSON; skip other lines."""
    import msgspec

    from tactile_rt.daemon.messages import StateMessage

    for line in lines:
        try:
            yield msgspec.json.decode(line, type=StateMessage).snapshot
        except msgspec.MsgspecError:
            continue


def _poll_snapshots(where: str) -> "Iterator[Snapshot]":
    if where == "-":
        found = False
        for snapshot in read_snapshots(iter(sys.stdin.buffer.readline, b"")):
            found = True
            yield snapshot
        if not found:
            raise ConfigError("no state on standard input: a jsonl publisher needs state_s = 1")
        return
    yield snapshot_at(where)
    while True:
        time.sleep(EVERY_S)
        try:
            yield snapshot_at(where)
        except SourceError:
            continue  # it is being restarted; the last state stays on the screen


def picture(now: "Snapshot") -> Group:
    """Draw a daemon's state as lines and tables, one below the other."""
    parts: list[RenderableType] = [_draw_head(now)]
    parts += [Text(f"  {line}", style="red", overflow="ellipsis") for line in now.degraded]
    for table in (_draw_sources(now), _draw_models(now), _draw_consumers(now)):
        if table.row_count:
            parts += [Text(), table]
    return Group(*parts)


def _draw_head(now: "Snapshot") -> Text:
    up = timedelta(seconds=(now.t_ns - now.started_ns) // 1_000_000_000)
    line = Text.assemble(
        (f"tactile_rt {now.version} ", "bold"),
        (now.state, COLOURS.get(now.state, "")),
        f"  up {up}  pid {now.pid}",
    )
    if now.reloads:
        line.append(f"  reloaded {now.reloads}x")
    if now.clock_steps:
        line.append(f"  clock stepped {now.clock_steps}x", style="yellow")
    return line.append(f"  {now.config}", style="dim")


def _make_table(headings: str) -> Table:
    """Return an empty table; headings that begin with > are of right-aligned columns."""
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    *names, last = headings.split(", ")
    for name in names:
        right = name.startswith(">")
        table.add_column(name.lstrip(">"), justify="right" if right else "left", no_wrap=True)
    table.add_column(last)  # shrinks if the terminal is narrow
    return table


def _draw_sources(now: "Snapshot") -> Table:
    table = _make_table(
        "SOURCE, STATE, >HZ, >OF, >SAMPLES, >MISS, >BAD, >DROP, >DUP, >LOST/MIN, >AGE MS, ARRAY"
    )
    for s in now.sources:
        rate = f"{s.measured_hz:.0f}" if s.measured_hz else "-"
        state = _draw_state(s.part)
        if s.part.state == "running" and s.device is not None:
            state = Text(str(s.device.state), style=COLOURS.get(str(s.device.state), ""))
        shape = f"{len(s.elements)} x {len(s.channels)} {s.array}" if s.elements else ""
        why = s.part.reason or (s.device.reason if s.device is not None else "")
        age = f"{(now.t_ns - s.newest_ns) / 1e6:.0f}" if s.newest_ns else ""
        table.add_row(
            _name_part(s.part), state, rate, f"{s.rate_hz:g}" if s.rate_hz else "", f"{s.samples}",
            _draw_loss(s.stats.missing), _draw_loss(s.stats.corrupt), _draw_loss(s.stats.dropped),
            f"{s.stats.duplicates}", _draw_loss(s.losses.minute), age, _draw_line(shape, why),
        )  # fmt: skip
    return table


def _draw_models(now: "Snapshot") -> Table:
    table = _make_table(
        "MODEL, STATE, >DECISIONS, >FINAL, >P50 MS, >P99, >MAX, >STEP, >LATE, >SKIP, >DROP, NEWEST"
    )
    for m in now.models:
        what = f"{m.label} {m.probability:.0%}" if m.label else ""
        newest = _draw_line(f"{what}, object: {m.object}" if m.object else what, m.part.reason)
        if m.touching and not m.part.reason:
            newest.append(" touching", style="green")
        table.add_row(
            _name_part(m.part), _draw_state(m.part), f"{m.decisions}", f"{m.final}",
            *_format_latency(m.latency), f"{m.step.p50_ms:.1f}" if m.step.count else "",
            _draw_loss(m.late), _draw_loss(m.skipped), _draw_loss(sum(m.queue.dropped.values())),
            newest,
        )  # fmt: skip
    return table


def _draw_consumers(now: "Snapshot") -> Table:
    table = _make_table(
        "CONSUMER, STATE, >STARTS, >WAIT, >TAKEN, >DROP, >P50 MS, >P99, >MAX, TELLS"
    )
    for c in now.consumers:
        data = {k: f"{v:g}" if isinstance(v, float) else v for k, v in c.details.items() if v != ""}
        tells = ", ".join(f"{key} {value}" for key, value in data.items())
        table.add_row(
            c.part.name.removeprefix("publisher."), _draw_state(c.part), f"{c.part.starts}",
            f"{sum(c.queue.waiting.values())}", f"{sum(c.queue.taken.values())}",
            _draw_loss(sum(c.queue.dropped.values())), *_format_latency(c.latency),
            _draw_line(tells, c.part.reason or c.diagnostic),
        )  # fmt: skip
    return table


def _draw_state(part: "PartState") -> Text:
    text = part.state if part.failures == 0 else f"{part.state} ({part.failures}x)"
    return Text(text, style=COLOURS.get(part.state, ""))


def _format_latency(latency: "Latency") -> tuple[str, str, str]:
    if not latency.count:
        return "", "", ""
    return f"{latency.p50_ms:.1f}", f"{latency.p99_ms:.1f}", f"{latency.max_ms:.1f}"


def _draw_loss(count: int) -> Text:
    return Text(f"{count}", style="red" if count else "")


def _name_part(part: "PartState") -> str:
    return part.name.partition(".")[2]


def _draw_line(text: str, diagnostic: str = "") -> Text:
    """Draw a text or, if a diagnostic is given, the diagnostic in red instead."""
    style = "red" if diagnostic else ""
    return Text(diagnostic or text, style=style, no_wrap=True, overflow="ellipsis")
