"""`tactile-rt top`: a running daemon in the terminal."""

import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlsplit

import typer

from tactile_rt.cli.app import app
from tactile_rt.stream import ConfigError, SourceError

if TYPE_CHECKING:
    from tactile_rt.daemon.health import Snapshot

__all__ = ["read_snapshots", "snapshot_at"]

LARGEST = 16 << 20  # bytes of a state


@app.command()
def top(
    where: Annotated[
        str, typer.Argument(help="The daemon's [metrics], or - for its jsonl on standard input.")
    ] = "http://127.0.0.1:9464",
    every: Annotated[float, typer.Option(min=0.1, max=60, help="Seconds between looks.")] = 1.0,
    once: Annotated[bool, typer.Option("--once", help="Look once, and print.")] = False,
) -> None:
    """Show sources, models, consumers, losses and latencies of a running daemon.

    It asks for /state of [metrics]. Without that, let a jsonl publisher have state_s = 1:
    tactile-rt run robot.toml | tactile-rt top -
    """
    from rich.console import Console
    from rich.live import Live

    from tactile_rt.cli.top_view import picture

    console = Console()
    if once:
        console.print(picture(next(_looks(where, every)), None))
        return
    before = None
    with Live(console=console, screen=console.is_terminal, auto_refresh=False) as live:
        for snapshot in _looks(where, every):
            live.update(picture(snapshot, before), refresh=True)
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

    parts = urlsplit(url if "//" in url else f"//{url}")
    try:
        host, port = parts.hostname, parts.port or 9464
    except ValueError:
        host, port = None, 0
    if parts.scheme not in ("", "http") or not host:
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


def _looks(where: str, every: float) -> "Iterator[Snapshot]":
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
        time.sleep(every)
        try:
            yield snapshot_at(where)
        except SourceError:
            continue  # it is being restarted; what was true last stays on the screen
