"""`tactile-rt hil`: hardware in the loop, with an emulated device."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated
from urllib.parse import parse_qsl

import typer
from rich.table import Table

from tactile_rt.cli.app import INTERRUPTED, app, leaving, open_url
from tactile_rt.cli.emulate import codec_options, open_project
from tactile_rt.cli.options import Faults, Json, Model, ProjectFolder, set_option
from tactile_rt.cli.progress import progress_bar
from tactile_rt.cli.tables import print_table, told_as_json
from tactile_rt.core.errors import ConfigError

if TYPE_CHECKING:
    from tactile_rt.project.folder import Project
    from tactile_rt.sources.hil import LoopReport

SWEEPS = 6  # unless told otherwise


@app.command(epilog="tactile-rt hil --wire slcan --sweeps 3")
def hil(
    source: Annotated[
        str | None,
        typer.Option(help="What the device measures. Default: sim:mouse, new objects."),
    ] = None,
    wire: Annotated[
        str | None,
        typer.Option(help="Wire: serial, slcan or virtual (CAN). Default: serial, or a project's."),
    ] = None,
    codec: Annotated[
        str | None, typer.Option(help="Protocol of the device. Default: native, or a project's.")
    ] = None,
    sets: Annotated[list[str] | None, set_option("An option of the codec: format=int16")] = None,
    faults: Faults = None,
    sweeps: Annotated[
        int | None, typer.Option(min=1, help=f"Objects that pass, with sim:. Default: {SWEEPS}.")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(min=0.001, max=1e9, help="Stop after this many seconds of the stream."),
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
        raise ConfigError("--sweeps is of a sim: source; of others give --seconds")
    opened = open_url(source)
    try:
        loop = Loop(opened, file, wire, codec, fields, schedule, seconds)
    except BaseException:
        opened.close()
        raise
    with leaving(None), progress_bar(f"{codec} over {wire}"):
        loop.run()
    report = loop.report()
    told = {
        "source": source, "wire": wire, "codec": codec, "complete": loop.complete,
        "failure": report.failure, **vars(report),
    }  # fmt: skip
    if not told_as_json(told, json):
        print_table(_make_table(report, source, f"{codec} over {wire}"))
    if not loop.complete:
        typer.echo("interrupted: what was on its way is missing above", err=True)
        raise typer.Exit(INTERRUPTED)
    if report.failure:
        typer.secho(f"tactile-rt: {report.failure}", err=True, fg="red")
        raise typer.Exit(1)


def _find_model(project: "Project") -> Path:
    """Find the model that a project has made; say if its array has changed since."""
    from tactile_rt.project.budget import read_budget

    if not project.model.exists():
        raise ConfigError(f"{project.folder} has no model yet: `tactile-rt make {project.folder}`")
    try:
        read_budget(project)
    except ConfigError as error:  # as when the array has been fitted to the device since
        typer.echo(f"{error}; until then the model is the one made before", err=True)
    return project.model


def _add_option(url: str, name: str, value: str) -> str:
    """The URL with this option, unless it has one."""
    _, mark, query = url.partition("?")
    if any(key == name for key, _ in parse_qsl(query, keep_blank_values=True)):
        return url
    return f"{url}{'&' if mark else '?'}{name}={value}"


def _make_table(report: "LoopReport", source: str, title: str) -> Table:
    decisions = max(report.direct, report.wire)
    stats, health = report.stats, report.health

    def share(n: int, of: int) -> str:
        return f"{n} of {of}" + (f" ({100 * n / of:.2f} %)" if of else "")

    rows = {
        "source": source.partition("?")[0],
        "samples": f"{report.samples}, {stats.delivered} through the driver",
        "identical samples": share(report.identical_samples, report.samples),
        "decisions": f"{report.direct} direct, {report.wire} through the driver",
        "identical decisions": share(report.identical, decisions),
        "same labels": share(report.same_label, decisions),
        "same final labels": share(report.finals_same, report.finals),
        "objects named right": share(report.right, report.passed) if report.passed else "",
        "lost": f"{stats.missing} missing, {stats.corrupt} corrupt, {stats.dropped} dropped, "
        f"{stats.duplicates} duplicates; {'all' if report.accounted else 'NOT all'} accounted for",
        "clock": f"{health.clock_steps} steps, {health.counter_resets} resets of the counter",
    }
    table = Table("", "", title=title, show_header=False, title_justify="left")
    for what, text in rows.items():
        if text:
            table.add_row(what, text)
    return table
