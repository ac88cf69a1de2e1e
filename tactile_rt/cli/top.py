"""`tactile-rt top`: a running daemon in the terminal."""

import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from tactile_rt.cli.app import app, check_output
from tactile_rt.cli.options import Json
from tactile_rt.cli.tables import fitting, print_table, told_as_json
from tactile_rt.errors import ConfigError, SourceError

if TYPE_CHECKING:
    from tactile_rt.daemon.health import Latency, PartState, QueueState, Snapshot

__all__ = ["picture", "read_snapshots", "snapshot_at"]

LARGEST = 16 << 20  # bytes of a state
EVERY_S = 1.0  # between looks
COLOURS = {
    "running": "green", "streaming": "green", "ended": "dim", "stopped": "dim",
    "starting": "yellow", "connecting": "yellow", "waiting": "red", "stalled": "red",
    "failed": "bold red", "stale": "red", "lost": "red", "degraded": "red", "stopping": "yellow",
}  # fmt: skip


@app.command()
def top(
    where: Annotated[
        str, typer.Argument(help="The daemon's [metrics], or - for its jsonl on standard input.")
    ] = "http://127.0.0.1:9464",
    once: Annotated[bool, typer.Option("--once", help="Look once, and print.")] = False,
    json: Json = None,
) -> None:
    """Show sources, models, consumers, losses and latencies of a running daemon.

    It asks for /state of [metrics]. Without that, let a jsonl publisher have state_s = 1:
    tactile-rt run robot.toml | tactile-rt top -
    """
    if json is not None and not once:
        raise ConfigError("--json is of one look: give --once, too")
    check_output(json)
    console = Console()
    if once:
        found = next(_looks(where))
        if not told_as_json(found, json):
            for part in picture(found, None).renderables:
                if isinstance(part, Table):
                    print_table(part, console)
                else:
                    console.print(part, soft_wrap=True)
        return
    before = None
    with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
        for snapshot in _looks(where):
            live.update(
                Group(
                    *(
                        fitting(part, console) if isinstance(part, Table) else part
                        for part in picture(snapshot, before).renderables
                    )
                ),
                refresh=True,
            )
            before = snapshot


def snapshot_at(url: str) -> "Snapshot":
    """The state that a daemon tells over HTTP.

    Raises:
        ConfigError: not an http URL, or not a daemon's.
        SourceError: nobody answers.
    """
    import http.client

    import msgspec

    from tactile_rt.daemon.messages import StateMessage

    try:
        parts = urlsplit(url if "//" in url else f"//{url}")
        scheme, host, port = parts.scheme, parts.hostname, parts.port or 9464
        (host or "").encode("idna")
    except ValueError:  # which a name that is none is, too
        scheme, host, port = "", None, 0
    if scheme not in ("", "http") or not host:
        raise ConfigError(f"{url} is not like http://127.0.0.1:9464")
    connection = http.client.HTTPConnection(host, port, timeout=3)
    try:
        connection.request("GET", "/state")
        answer = connection.getresponse()
        data = answer.read(LARGEST)
    except (OSError, http.client.HTTPException) as error:
        why = getattr(error, "strerror", None) or str(error) or type(error).__name__
        raise SourceError(
            f"no daemon at http://{host}:{port}: {why}; does its configuration have [metrics]?"
        ) from None
    finally:
        connection.close()
    try:
        return msgspec.json.decode(data, type=StateMessage).snapshot
    except msgspec.MsgspecError as error:
        raise ConfigError(f"http://{host}:{port}/state is not a daemon's: {error}") from None


def read_snapshots(lines: Iterator[bytes]) -> "Iterator[Snapshot]":
    """The state messages among lines of JSON; others are passed over."""
    import msgspec

    from tactile_rt.daemon.messages import StateMessage

    for line in lines:
        try:
            yield msgspec.json.decode(line, type=StateMessage).snapshot
        except msgspec.MsgspecError:
            continue


def _looks(where: str) -> "Iterator[Snapshot]":
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
            continue  # it is being restarted; what was true last stays on the screen


def picture(now: "Snapshot", before: "Snapshot | None") -> Group:
    """All of it, lines and tables, one below the other.

    Args:
        now: what to show.
        before: an earlier one of the same daemon; None: rates are not known.
    """
    if before is not None and (before.pid != now.pid or before.t_ns >= now.t_ns):
        before = None
    tables: list[RenderableType] = [_head(now)]
    tables += [Text(f"  {line}", style="red", overflow="ellipsis") for line in now.degraded]
    if now.sources:
        tables += [Text(), _sources(now, before)]
    if now.models:
        tables += [Text(), _models(now, before)]
    if now.consumers:
        tables += [Text(), _consumers(now, before)]
    return Group(*tables)


def _head(now: "Snapshot") -> Text:
    line = Text()
    line.append(f"tactile_rt {now.version} ", style="bold")
    line.append(now.state, style=COLOURS.get(now.state, ""))
    line.append(f"  up {_span((now.t_ns - now.started_ns) / 1e9)}  pid {now.pid}")
    if now.reloads:
        line.append(f"  reloaded {now.reloads}x")
    if now.clock_steps:
        line.append(f"  clock stepped {now.clock_steps}x", style="yellow")
    line.append(f"  {now.config}", style="dim")
    return line


def _table(*columns: str) -> Table:
    table = Table(box=None, header_style="bold", pad_edge=False, padding=(0, 2, 0, 0))
    for column in columns:
        # The last one gives way where the terminal is narrow.
        right, last = column.startswith(">"), column == columns[-1]
        table.add_column(
            column.removeprefix(">"), justify="right" if right else "left", no_wrap=not last
        )
    return table


def _sources(now: "Snapshot", before: "Snapshot | None") -> Table:
    table = _table(
        "SOURCE", "STATE", ">HZ", ">OF", ">SAMPLES", ">MISS", ">BAD", ">DROP", ">DUP",
        ">LOST/MIN", ">AGE MS", "ARRAY",
    )  # fmt: skip
    old = {s.part.name: s.samples for s in before.sources} if before is not None else {}
    for s in now.sources:
        rate = "-"  # of one look it is not known
        if before is not None and s.part.name in old:
            rate = f"{(s.samples - old[s.part.name]) / ((now.t_ns - before.t_ns) / 1e9):.0f}"
        state = _state(s.part)
        if s.part.state == "running" and s.device is not None:
            state = Text(str(s.device.state), style=COLOURS.get(str(s.device.state), ""))
        shape = f"{len(s.elements)} x {len(s.channels)} {s.array}" if s.elements else ""
        why = s.part.reason or (s.device.reason if s.device is not None else "")
        age = f"{(now.t_ns - s.newest_ns) / 1e6:.0f}" if s.newest_ns else ""
        table.add_row(
            _name(s.part), state, rate, f"{s.rate_hz:g}" if s.rate_hz else "", f"{s.samples}",
            _bad(s.stats.missing), _bad(s.stats.corrupt), _bad(s.stats.dropped),
            f"{s.stats.duplicates}", _bad(s.losses.minute), age,
            _line(why, "red") if why else _line(shape),
        )  # fmt: skip
    return table


def _models(now: "Snapshot", before: "Snapshot | None") -> Table:
    table = _table(
        "MODEL", "STATE", ">DECISIONS", ">FINAL", ">P50 MS", ">P99", ">MAX", ">STEP", ">LATE",
        ">SKIP", ">DROP", "NEWEST",
    )  # fmt: skip
    for m in now.models:
        newest = _line(f"{m.label} {m.probability:.0%}" if m.label else "")
        if m.touching:
            newest.append(" touching", style="green")
        if m.part.reason:
            newest = _line(m.part.reason, "red")
        table.add_row(
            _name(m.part), _state(m.part), f"{m.decisions}", f"{m.final}", *_latency(m.latency),
            f"{m.step.p50_ms:.1f}" if m.step.count else "", _bad(m.late), _bad(m.skipped),
            _bad(_dropped(m.queue)), newest,
        )  # fmt: skip
    return table


def _consumers(now: "Snapshot", before: "Snapshot | None") -> Table:
    table = _table(
        "CONSUMER", "STATE", ">STARTS", ">WAIT", ">TAKEN", ">DROP", ">P50 MS", ">P99", ">MAX",
        "TELLS",
    )  # fmt: skip
    for c in now.consumers:
        said = ", ".join(f"{k} {_value(v)}" for k, v in c.details.items() if v != "")
        why = c.part.reason or c.trouble
        tells = _line(why, "red") if why else _line(said)
        name = c.part.name.removeprefix("publisher.")
        table.add_row(
            name, _state(c.part), f"{c.part.starts}", f"{sum(c.queue.waiting.values())}",
            f"{sum(c.queue.taken.values())}", _bad(_dropped(c.queue)), *_latency(c.latency), tells,
        )  # fmt: skip
    return table


def _state(part: "PartState") -> Text:
    text = part.state if part.failures == 0 else f"{part.state} ({part.failures}x)"
    return Text(text, style=COLOURS.get(part.state, ""))


def _latency(latency: "Latency") -> tuple[str, str, str]:
    if not latency.count:
        return "", "", ""
    return f"{latency.p50_ms:.1f}", f"{latency.p99_ms:.1f}", f"{latency.max_ms:.1f}"


def _bad(count: int) -> Text:
    return Text(f"{count}", style="red" if count else "")


def _dropped(queue: "QueueState") -> int:
    return sum(queue.dropped.values())


def _name(part: "PartState") -> str:
    return part.name.partition(".")[2]


def _line(text: str, style: str = "") -> Text:
    return Text(text, style=style, no_wrap=True, overflow="ellipsis")


def _value(value: str | int | float) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


def _span(seconds: float) -> str:
    minutes, s = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    days, hours = divmod(hours, 24)
    if days:
        return f"{days}d {hours:02}:{minutes:02}"
    return f"{hours}:{minutes:02}:{s:02}"
