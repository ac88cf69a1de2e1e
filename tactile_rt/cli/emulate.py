"""`tactile-rt emulate` and `hil`: a device without hardware, on a real line."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from urllib.parse import parse_qsl

import typer
from rich.console import Console
from rich.table import Table

from tactile_rt.cli.app import INTERRUPTED, app, leaving, needing, open_url
from tactile_rt.cli.options import Fast, Json, Model, argument, option, set_option
from tactile_rt.cli.tables import print_table, progress_bar, told_as_json
from tactile_rt.core.errors import ConfigError

if TYPE_CHECKING:
    from tactile_rt.drivers.emulation.device import EmulatedDevice
    from tactile_rt.project.folder import Project
    from tactile_rt.sources.hil import LoopReport

Faults = Annotated[Path | None, option("TOML file of the faults to inject.")]
ProjectFolder = Annotated[
    Path | None, option("Folder of `tactile-rt new`: its array, device and model.")
]

LOOK_S = 0.25  # between updates of the count
SWEEPS = 6  # default of `hil`
LINGER_S = 0.5  # for the host to read the last samples before the port disappears


@app.command(epilog="tactile-rt emulate native --source replay:demo --link /tmp/whisker0")
def emulate(
    codec: Annotated[
        str | None, argument("Protocol of the device: native, bota, xela, ...")
    ] = None,
    source: Annotated[
        str | None, option("What the device measures, e.g. replay:FILE. Default: made-up presses.")
    ] = None,
    project: ProjectFolder = None,
    wire: Annotated[
        str | None, option("Wire: serial, slcan or can. Default: serial, else slcan.")
    ] = None,
    link: Annotated[Path | None, option("Link to make to the port, e.g. /tmp/whisker0.")] = None,
    bus: Annotated[
        str | None, option("For --wire can: INTERFACE:CHANNEL, e.g. socketcan:vcan0.")
    ] = None,
    faults: Faults = None,
    sets: Annotated[
        list[str] | None,
        set_option("An option of the codec or line: format=int16, baud=9600, bitrate=0 (no speed)"),
    ] = None,
    fast: Fast = False,
    seconds: Annotated[
        float | None, option("Stop after this many seconds of samples.", min=0.001, max=1e9)
    ] = None,
) -> None:
    """Emulate a device on a serial port or CAN bus.

    It prints its port, and sends once a program has opened it and, where the protocol demands
    that, has asked for samples. Each fault of --faults has a kind (bit_flip, truncate, duplicate,
    burst, stall, drop, clock_drift, clock_jump, sequence_reset, unplug, gather, can_error), a rate
    per second or at_s, and, where the kind has them, duration_s and amount. Ctrl-C ends it.
    """
    from tactile_rt.drivers.catalogue import CODECS
    from tactile_rt.drivers.codec import codec_class
    from tactile_rt.drivers.emulation.device import EmulatedCan, EmulatedSerial
    from tactile_rt.drivers.emulation.faults import read_faults
    from tactile_rt.drivers.opening import make_codec

    fields = codec_options(sets or [])
    if project is not None:
        made = open_project(project)
        codec, fields = made.spoken(codec, fields)
        source = source or made.source_url(made.unseen())
        line = made.line()
        wire = wire or ("serial" if line.wire == "serial" else None)
        if line.wire == "serial" and link is None and not line.port.startswith("/dev/"):
            link = Path(line.port)
    elif codec is None:
        raise ConfigError("name a CODEC (`tactile-rt codecs` lists them), or a --project")
    source = source or "synthetic:"
    if wire is None:
        only_can = ("can", codec) in CODECS and ("serial", codec) not in CODECS
        wire = "can" if bus else "slcan" if only_can or project is not None else "serial"
    if wire not in ("serial", "slcan", "can"):
        raise ConfigError(f"--wire must be serial, slcan or can, not {wire!r}")
    if (wire == "can") != (bus is not None):
        raise ConfigError("--bus INTERFACE:CHANNEL goes with --wire can: give both or neither")
    if bus is not None and link is not None:
        raise ConfigError("--link names a port; a --bus has none")
    speed = "baud" if wire == "serial" else "bitrate"  # of the line, unless the codec has it, too
    known = codec_class("serial" if wire == "serial" else "can", codec).Options
    own = {k: v for k, v in fields.items() if k != speed or k in known.__dataclass_fields__}
    make_codec("serial" if wire == "serial" else "can", codec, own)  # refuses wrong options early
    further: dict[str, Any] = {
        "options": fields,
        "faults": read_faults(faults) if faults else None,
        "pace": "fast" if fast else "realtime",
        "seconds": seconds,
        "log": False,
    }
    opened = open_url(source)
    device: EmulatedDevice | None = None
    with leaving(None), opened:
        if wire == "serial":
            device = EmulatedSerial(opened, codec, link=link, **further)
        else:
            device = EmulatedCan(opened, codec, bus=bus, link=link, **further)
        with device:
            typer.echo(f"connect to {device.url}")
            if (bus or "").startswith("virtual:"):
                typer.echo("a virtual bus is seen inside its own process only", err=True)
            _watch(device)
    if device is not None:
        typer.echo(_describe_counts(device), err=True)


def open_project(folder: Path) -> "Project":
    """Return the project in a folder.

    Raises:
        TactileError: the folder is no project, or the needed extra is not installed.
    """
    with needing("sim"):
        from tactile_rt.project.folder import Project
    return Project(folder)


def codec_options(given: list[str]) -> dict[str, str]:
    """Split ``KEY=VALUE`` options of a codec into a dict."""
    fields = {}
    for pair in given:
        name, equals, value = pair.partition("=")
        if not equals or not name:
            raise ConfigError(f"--set {pair}: an option must be KEY=VALUE")
        if name in fields:
            raise ConfigError(f"--set {name}=... is given twice")
        fields[name] = value
    return fields


def _watch(device: "EmulatedDevice") -> None:
    console = Console(stderr=True)
    if console.is_terminal:
        with console.status("") as status:
            while not device.wait(LOOK_S):
                note = "" if device.endpoint.heard else ", no host listens"
                status.update(_describe_counts(device) + note)
    else:
        device.wait()
    time.sleep(LINGER_S)


def _describe_counts(device: "EmulatedDevice") -> str:
    log = device.log
    counts = {fate.name.lower(): n for fate, n in sorted(log.counts.items()) if n}
    counts |= {"copies": log.duplicated} if log.duplicated else {}
    rest = ", ".join(f"{n} {name}" for name, n in counts.items())
    return f"{log.sent} samples{': ' + rest if rest else ''}"


@app.command(epilog="tactile-rt hil --wire slcan --sweeps 3")
def hil(
    source: Annotated[
        str | None, option("What the device measures. Default: sim:mouse, new objects.")
    ] = None,
    wire: Annotated[
        str | None, option("Wire: serial, slcan or virtual (CAN). Default: serial, or a project's.")
    ] = None,
    codec: Annotated[
        str | None, option("Protocol of the device. Default: native, or a project's.")
    ] = None,
    sets: Annotated[list[str] | None, set_option("An option of the codec: format=int16")] = None,
    faults: Faults = None,
    sweeps: Annotated[
        int | None, option(f"Objects to sweep past, for a sim: source. Default: {SWEEPS}.", min=1)
    ] = None,
    seconds: Annotated[
        float | None, option("Stop after this many seconds of the stream.", min=0.001, max=1e9)
    ] = None,
    model: Model = None,
    project: ProjectFolder = None,
    json: Json = None,
) -> None:
    """Test decisions through an emulated device and a real driver.

    The decisions on the driver's samples are compared with those on the same samples without device
    and wire. Native float32 must be equal in every bit; with a format that rounds, 99 % of the
    decisions must keep their label; with --faults, each loss must be counted. Exit code 1 if not.
    """
    from tactile_rt.classifier.model_file import load_model, shipped_model
    from tactile_rt.drivers.emulation.faults import read_faults
    from tactile_rt.sources.hil import Loop, check_line

    fields = codec_options(sets or [])
    if project is not None:
        made = open_project(project)
        model = model or _find_model(made)
        codec, fields = made.spoken(codec, fields)
        wire = wire or ("serial" if made.line().wire == "serial" else "slcan")
        source = source or made.source_url(made.unseen())
    wire, codec = wire or "serial", codec or "native"
    file = model or shipped_model()
    schedule = read_faults(faults) if faults else None
    check_line(wire, codec, fields)
    if source is None:
        unseen = load_model(file)[1].provenance.get("unseen_objects", [])
        source = "sim:mouse" + (f"?objects={','.join(unseen)}" if unseen else "")
    if source.startswith(("sim:", "whisking:")):
        source = _add_option(source, "pace", "fast")
    if source.startswith("sim:"):
        if sweeps is not None or seconds is None:
            source = _add_option(source, "sweeps", str(sweeps or SWEEPS))
    elif sweeps is not None:
        raise ConfigError("--sweeps needs a sim: source; for others give --seconds")
    opened = open_url(source)
    try:
        loop = Loop(opened, file, wire, codec, fields, schedule, seconds)
    except BaseException:
        opened.close()
        raise
    with leaving(None), progress_bar(f"{codec} over {wire}"):
        loop.run()
    report = loop.report()
    results = {
        "source": source, "wire": wire, "codec": codec, "complete": loop.complete,
        "failure": report.failure, **vars(report),
    }  # fmt: skip
    if not told_as_json(results, json):
        print_table(_make_table(report, source, f"{codec} over {wire}"))
    if not loop.complete:
        typer.echo("interrupted: samples still in transit are not counted above", err=True)
        raise typer.Exit(INTERRUPTED)
    if report.failure:
        typer.secho(f"tactile-rt: {report.failure}", err=True, fg="red")
        raise typer.Exit(1)


def _find_model(project: "Project") -> Path:
    """Return a project's model file; print a note if the project's array has changed."""
    from tactile_rt.project.budget import read_budget

    if not project.model.exists():
        raise ConfigError(f"{project.folder} has no model yet: `tactile-rt make {project.folder}`")
    try:
        read_budget(project)
    except ConfigError as error:  # such as: the array has since been fitted to the device
        typer.echo(f"{error}; until then the model is the one made before", err=True)
    return project.model


def _add_option(url: str, name: str, value: str) -> str:
    """Add an option to a URL, unless the URL has it; return the URL."""
    _, mark, query = url.partition("?")
    if any(key == name for key, _ in parse_qsl(query, keep_blank_values=True)):
        return url
    return f"{url}{'&' if mark else '?'}{name}={value}"


def _make_table(report: "LoopReport", source: str, title: str) -> Table:
    decisions = max(report.direct, report.wire)
    stats, health = report.stats, report.health

    def format_share(n: int, of: int) -> str:
        return f"{n} of {of}" + (f" ({100 * n / of:.2f} %)" if of else "")

    rows = {
        "source": source.partition("?")[0],
        "samples": f"{report.samples}, {stats.delivered} through the driver",
        "identical samples": format_share(report.identical_samples, report.samples),
        "decisions": f"{report.direct} direct, {report.wire} through the driver",
        "identical decisions": format_share(report.identical, decisions),
        "same labels": format_share(report.same_label, decisions),
        "same final labels": format_share(report.finals_same, report.finals),
        "objects named right": format_share(report.right, report.passed) if report.passed else "",
        "lost": f"{stats.missing} missing, {stats.corrupt} corrupt, {stats.dropped} dropped, "
        f"{stats.duplicates} duplicates; {'all' if report.accounted else 'NOT all'} accounted for",
        "clock": f"{health.clock_steps} steps, {health.counter_resets} resets of the counter",
    }
    table = Table("", "", title=title, show_header=False, title_justify="left")
    for what, text in rows.items():
        if text:
            table.add_row(what, text)
    return table
