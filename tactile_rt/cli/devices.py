"""`tactile-rt list`, `doctor`, `codecs`, `describe`, `echo`, `hz`, `dump`: look at devices."""

import math
import re
import time
from contextlib import closing
from pathlib import Path
from typing import Annotated, Any

import typer

from tactile_rt.cli.app import app, check_output, leaving, open_url
from tactile_rt.cli.options import STDOUT, Json, Seconds, Url, argument, option
from tactile_rt.cli.tables import show_table, told_as_json

WINDOW_S = 1.0
LOG_BYTES = 1 << 16  # size of a log's end that is searched for the newest warning


@app.command("list", epilog="tactile-rt list")
def list_devices(json: Json = None) -> None:
    """List serial ports and CAN buses, and the URL of each sensor."""
    from tactile_rt.drivers.discovery import list_can_buses, serial_ports

    found = [
        {"device": port.path, "likely": port.likely, "url": port.url} for port in serial_ports()
    ]
    for bus in list_can_buses():
        rate = f", {bus.bitrate} bit/s" if bus.bitrate else ""
        likely = f"CAN bus, {'up' if bus.up else 'down'}{rate}"
        found.append({"device": bus.name, "likely": likely, "url": bus.url})
    if not found and json is None:
        typer.echo("no serial port and no CAN bus; `tactile-rt emulate native` makes a device")
        return
    show_table(found, {"device": "device", "likely": "likely", "url": "url"}, json)


@app.command(epilog="tactile-rt doctor --daemon http://127.0.0.1:9464")
def doctor(
    daemon: Annotated[
        str, option("Look at a running daemon instead: the URL of its metrics.")
    ] = "",
    udev: Annotated[Path | None, option("Write udev rules for the devices.")] = None,
    json: Json = None,
) -> None:
    """Find what keeps devices or a daemon from working, and how to fix it.

    Exit code 1 if there is anything to fix.
    """
    from rich.console import Console
    from rich.markup import escape

    from tactile_rt.core.files import write_whole
    from tactile_rt.drivers.discovery import diagnose, list_can_buses, serial_ports, udev_rules

    check_output(udev)
    ports = serial_ports()
    if daemon:
        findings = _look_at_daemon(daemon)
    else:
        findings = [*diagnose(ports, list_can_buses()), *_look_at_simulator()]
    alone = told_as_json(findings, json)
    console = Console(stderr=alone, soft_wrap=True, highlight=False)
    for finding in () if alone else findings:
        mark = "[green]ok [/]" if finding.good else "[red]bad[/]"
        console.print(f"{mark} [bold]{escape(finding.what)}[/]: {escape(finding.says)}")
        if finding.do:
            console.print(f"    -> {escape(finding.do)}")
    if udev is not None:
        write_whole(udev, lambda file: file.write(udev_rules(ports).encode()))
        console.print(
            f"udev rules written to {escape(str(udev))}: its first lines say how to install it"
        )
    if not all(f.good for f in findings):
        raise typer.Exit(1)


def _look_at_daemon(url: str) -> list[Any]:
    from tactile_rt.cli.top import snapshot_at
    from tactile_rt.core.errors import SourceError
    from tactile_rt.drivers.discovery import Finding

    try:
        now = snapshot_at(url)
    except SourceError as error:
        return [Finding("daemon", False, str(error), "Start it, or see `systemctl status`.")]
    says = f"{now.state}, version {now.version}, pid {now.pid}, {now.config}"
    found = [Finding("daemon", not now.diagnostics, says)]
    found += [Finding(one.part, False, one.says, one.do) for one in now.diagnostics]
    found += [Finding(one.part, True, one.says, one.do) for one in now.soon]
    for source in now.sources:
        gone = source.stats.corrupt + source.stats.missing + source.stats.dropped
        says = f"{source.samples} samples, {gone} lost, {source.part.failures} times broken so far"
        found.append(Finding(source.part.name, True, says))
    logs = (str(c.details.get("file", "")) for c in now.consumers if c.kind == "log")
    return [*found, *(Finding("log", True, _quote_log(file)) for file in logs)]


def _quote_log(name: str) -> str:
    """Return a log file's name with its newest warning or error."""
    if not name:
        return "on stderr, which systemd keeps: `journalctl -u tactile-rt`"
    try:
        with open(name, "rb") as file:
            file.seek(max(0, file.seek(0, 2) - LOG_BYTES))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError as error:
        return f"{name}: {error.strerror}"
    bad = re.compile(r' (warning|error) |"level":"(warning|error)"')
    return f"{name}: {next(filter(bad.search, reversed(lines)), 'no warning of late')}"


def _look_at_simulator() -> list[Any]:
    from importlib.util import find_spec

    from tactile_rt.drivers.discovery import Finding

    if not all(map(find_spec, ("numba", "mujoco", "trimesh"))):
        return []
    from tactile_rt.sim_backend.rods.compiled import is_kept
    from tactile_rt.sim_backend.rods.stepping import advance

    kept = is_kept(advance)
    says = "compiled" if kept else "not compiled yet: its first use on this machine takes a minute"
    return [Finding("simulator", True, says)]


@app.command(epilog="tactile-rt codecs xela")
def codecs(
    codec: Annotated[str, argument("Describe this codec.")] = "",
    frame: Annotated[str, option("Print the TOML description of this device's frame.")] = "",
    json: Json = None,
) -> None:
    """List the device protocols, or describe one of them."""
    from tactile_rt.core.errors import ConfigError
    from tactile_rt.core.settings import no_such
    from tactile_rt.drivers.catalogue import CODECS, FRAMES

    if frame:
        frames = {path.stem: path for path in sorted(FRAMES.glob("*.toml"))}
        if frame not in frames:
            raise ConfigError(no_such("described frame", frame, frames))
        typer.echo(frames[frame].read_text("utf-8"), nl=False)
        return
    names = sorted({name for _, name in CODECS})
    if codec and codec not in names:
        raise ConfigError(no_such("codec", codec, names))
    found: list[dict[str, Any]] = [
        {"codec": name, "wire": wire, "device": CODECS[wire, name].device}
        for wire, name in sorted(CODECS, key=lambda key: key[::-1])
        if codec in ("", name)
    ]
    if codec or json is not None:  # imports the classes of the codecs
        from tactile_rt.drivers.codec import codec_class

        for one in found:
            kind = codec_class(one["wire"], one["codec"])
            one["options"] = list(kind.Options.__dataclass_fields__)
            one["cannot_detect"] = kind.cannot_detect
    show_table(found, {"codec": "codec", "wire": "wire", "device": "device"}, json)
    for one in found if codec and json is None else ():
        typer.echo(f"\noptions over {one['wire']}: {', '.join(one['options']) or 'none'}")
        typer.echo(f"cannot detect: {one['cannot_detect']}")


@app.command(epilog="tactile-rt describe replay:demo")
def describe(
    source: Url,
    out: Annotated[Path | None, option("File to write. Default: stdout.")] = None,
) -> None:
    """Write a source's elements, channels, units and rate as JSON."""
    import msgspec

    from tactile_rt.core.files import write_whole

    check_output(out)
    with open_url(source) as opened:
        text = msgspec.json.format(opened.spec.to_json().encode(), indent=1) + b"\n"
    if out is None:
        typer.echo(text, nl=False)
    else:
        write_whole(out, lambda file: file.write(text))


@app.command(epilog="tactile-rt echo replay:demo --seconds 1")
def echo(source: Url, seconds: Seconds = None) -> None:
    """Print every sample as a line of JSON.

    Fields: seq; t_ns; values, element by channel; valid, of each element.
    """
    import msgspec

    with open_url(source) as opened, leaving(seconds):
        for chunk in opened:
            for k in range(len(chunk)):
                line = {
                    "seq": int(chunk.seq[k]),
                    "t_ns": int(chunk.t_ns[k]),
                    "values": [[float(f"{x:.6g}") for x in row] for row in chunk.values[k]],
                    "valid": chunk.valid[k].tolist(),
                }
                typer.echo(msgspec.json.encode(line))


@app.command(epilog="tactile-rt hz replay:demo --seconds 3")
def hz(source: Url, seconds: Seconds = None, json: Json = None) -> None:
    """Print rate, jitter, losses and device state every second."""
    import numpy as np

    from tactile_rt.core.stream import EndOfStream

    looks: list[dict[str, Any]] = []
    with open_url(source) as opened, leaving(None):
        spec = opened.spec
        shape = f"{spec.shape[0]} elements x {spec.shape[1]} channels"
        typer.echo(f"{spec.name}: {shape}, nominally {spec.rate_hz:g} Hz", err=json == STDOUT)
        np.quantile([0.0], 0.5)  # the first call is slow, and samples would wait for it
        ends, ended = time.monotonic() + (seconds or math.inf), False
        while not ended and (began := time.monotonic()) < ends:
            until, n, late = min(began + WINDOW_S, ends), 0, []
            try:
                while (left := until - time.monotonic()) > 0:
                    chunk = opened.read(left)
                    if chunk is not None:
                        n += len(chunk)
                        late.append((time.monotonic_ns() - int(chunk.t_ns[-1])) / 1e6)
            except EndOfStream:
                ended = True
            spread = np.quantile(late, (0.5, 0.99)) - min(late) if late else (0.0, 0.0)
            health = getattr(opened, "health", None)
            look: dict[str, Any] = {
                "rate_hz": n / (time.monotonic() - began), "jitter_p50_ms": float(spread[0]),
                "jitter_p99_ms": float(spread[1]), "missing": opened.stats.missing,
                "corrupt": opened.stats.corrupt, "duplicates": opened.stats.duplicates,
                "state": health.state if health else None,
            }  # fmt: skip
            looks.append(look)
            line = (
                "{rate_hz:8.1f} Hz, jitter p50 {jitter_p50_ms:.2f} p99 {jitter_p99_ms:.2f} ms, "
                "missing {missing}, corrupt {corrupt}, duplicates {duplicates}"
            ).format(**look)
            why = ": ".join(filter(None, (health.state, health.reason))) if health else ""
            typer.echo(", ".join(filter(None, (line, why))), err=json == STDOUT)
    told_as_json(looks, json)


@app.command(epilog="tactile-rt dump 'serial:/dev/ttyUSB0?baud=115200'")
def dump(
    line: Annotated[str, argument("serial:PORT?baud=115200 or can:INTERFACE:CHANNEL.")],
    seconds: Seconds = None,
) -> None:
    """Print the raw bytes or CAN frames of a line."""
    from tactile_rt.drivers.opening import open_line

    start = time.monotonic_ns()
    with closing(open_line(line)) as link, leaving(seconds):
        while True:
            packet, t_ns = link.receive(0.2) or ([], 0)
            at = f"{(t_ns - start) / 1e6:12.3f} ms"
            if isinstance(packet, bytes):
                for k in range(0, len(packet), 16):
                    row = packet[k : k + 16]
                    text = "".join(chr(b) if 32 <= b < 127 else "." for b in row)
                    typer.echo(f"{at}  {row.hex(' '):<47}  {text}")
                continue
            for f in packet:
                kind = "R" if f.remote else "F" if f.fd else " "
                name = f"{f.id:0{8 if f.extended else 3}X}"
                typer.echo(f"{at}  {name} {kind} [{len(f.data)}] {f.data.hex(' ')}")
