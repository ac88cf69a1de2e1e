"""`tactile-rt import`: make recordings from logs, tables and bags of other programs."""

import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any, Final
from urllib.parse import parse_qsl

import typer

from tactile_rt.cli.app import app, check_is_mcap, check_new, check_output, needing, starting
from tactile_rt.cli.options import Force, Json, argument, option
from tactile_rt.cli.tables import progress_bar, told_as_json
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import refuse_lfs_pointer

if TYPE_CHECKING:
    from tactile_rt.recording.importing.report import Import

PICTURES: Final = (".png", ".svg", ".pdf")
ROWS, NAMED, NOTES = 12, 8, 4  # channels, elements in the legend, notes that are drawn
BINS, PAUSE = 2000, 5  # time bins, drawn by their extremes; usual periods that make a gap


@app.command("import", epilog="tactile-rt import capture.bin --as codec=bota")
def import_file(
    log: Annotated[Path, argument("Raw bytes, a CAN log, a table of numbers or a bag.")],
    output: Annotated[
        Path | None, argument("The recording. Default: LOG.mcap in this folder.")
    ] = None,
    decoded_as: Annotated[
        str, option("Codec of the device: codec=NAME&OPTION=VALUE.", "--as")
    ] = "",
    columns: Annotated[
        str, option("Columns to read: NAME=ELEMENT.CHANNEL*SCALE:UNIT,... or FILE.toml.")
    ] = "",
    topic: Annotated[str, option("Topic to read from a bag.")] = "",
    rate: Annotated[float, option("Samples per second, if the log has no times.", min=0)] = 0,
    bus: Annotated[str, option("Bus to read from a log of several, e.g. can0.")] = "",
    form: Annotated[
        str, option("Format, if detected wrongly: raw, hex, terminal, candump, asc, blf, ...")
    ] = "",
    delimiter: Annotated[str, option("Column delimiter: character, tab or space.")] = "",
    decimal: Annotated[str, option("Decimal mark of a table: a comma or a point.")] = "",
    skip: Annotated[int, option("Lines of a table to skip.", min=0)] = 0,
    lines: Annotated[int, option("Lines of text per row of a table.", min=1, max=1000)] = 1,
    plot: Annotated[Path | None, option("Picture of what came in: .png, .svg or .pdf.")] = None,
    strict: Annotated[
        bool, option("Write nothing if anything is odd; exit code 2.", "--strict")
    ] = False,
    force: Force = False,
    json: Json = None,
) -> None:
    """Make a recording from a log, a table or a ROS bag.

    `tactile-rt sniff` proposes the options.

    Raw bytes, hexadecimal text, logs of a terminal and logs of a CAN bus (candump, asc, blf, trc,
    SavvyCAN) are decoded --as a codec. Tables (CSV, output of a board or of yarpdatadumper) need
    --columns. Wrenches, arrays and our own messages of ROS 1 and ROS 2 bags (extra "import") need
    no option. gzip is unpacked.
    """

    if not log.exists():
        raise ConfigError(f"no file {log}")
    if log.is_file() and not log.stat().st_size:
        raise ConfigError(f"{log} is empty")
    refuse_lfs_pointer(log)
    output = output or Path(f"{log.name.partition('.')[0] or 'import'}.mcap")
    check_is_mcap(output)
    check_new(output, force)
    if plot is not None:
        check_output(plot)
        if plot.suffix.lower() not in PICTURES:
            raise ConfigError(f"{plot} is no picture: give --plot a {', '.join(PICTURES)}")
        with needing("view"):  # before anything is read
            import matplotlib  # noqa: F401
    if decimal not in ("", ",", "."):
        raise ConfigError(f"--decimal must be , or ., not {decimal!r}")
    with ExitStack() as stack:
        target = output
        if strict:  # hidden until it is known to be in order
            hidden = stack.enter_context(TemporaryDirectory(prefix=".", dir=output.parent))
            target = Path(hidden) / output.name
        with starting(), progress_bar(f"reading {log}"):
            from tactile_rt.drivers.logs import read_log
            from tactile_rt.recording.importing.bag import import_bag
            from tactile_rt.recording.importing.bag_file import is_bag
            from tactile_rt.recording.importing.report import report_lines
            from tactile_rt.recording.importing.table import import_table
            from tactile_rt.recording.importing.table_form import csv_form, read_table
            from tactile_rt.recording.importing.wire import import_wire

            if is_bag(log):
                if decoded_as:
                    raise ConfigError(
                        f"{log} is a bag: its messages are not bytes of a codec; leave out --as"
                    )
                made = import_bag(log, target, topic, columns, rate)
            elif decoded_as and columns:
                raise ConfigError("give --as, for what a device spoke, or --columns, for a table")
            elif decoded_as:
                packets = read_log(log, form, bus)
                made = import_wire(packets, target, codec_fields(decoded_as, "--as"), rate)
            elif columns:
                table = read_table(log, csv_form(log, delimiter, decimal, skip, lines))
                made = import_table(table, target, columns, rate)
            else:
                raise ConfigError(
                    f"{log}: say what it is: --as codec=NAME or --columns ...; "
                    f"`tactile-rt sniff {log}` tells which"
                )
        if rate and not decoded_as:
            made.said_hz = rate
            if abs((made.found_hz or 0) - rate) < 1e-9 * rate:
                made.found_hz = None  # no column is a time
        odd = _list_odd(made)
        for note in made.notes:
            typer.echo(f"{log}: {note}", err=True)
        if strict and odd:
            raise ConfigError(f"{log}: {odd[0]:.100}; nothing is written (--strict)")
        if plot is not None:
            draw_import(target, made, odd, plot)
        if strict:
            os.replace(target, output)
    if not told_as_json({"file": output, **vars(made), "odd": odd}, json):
        typer.echo(f"{output}: " + "\n  ".join(report_lines(made)))


def _list_odd(made: "Import") -> list[str]:
    odd = [note for note in made.notes if not note.startswith("left out: ")]
    if made.corrupt and not any("corrupt" in note for note in odd):
        odd.append(f"{made.corrupt} corrupt {made.unit}")
    if made.missing:
        odd.append(f"{made.missing} missing, the first after sample {made.first_missing}")
    return odd


def codec_fields(text: str, option: str) -> dict[str, str]:
    """Split ``codec=NAME&OPTION=VALUE``, written as in a URL, into a dict.

    Raises:
        ConfigError: an option is given twice, or the codec is missing.
    """
    pairs = parse_qsl(text.replace("+", "%2B"), keep_blank_values=True)
    fields = dict(pairs)
    if len(fields) < len(pairs) or not fields.get("codec"):
        raise ConfigError(f"{option} is codec=NAME&OPTION=VALUE..., each once, not {text!r}")
    return fields


def draw_import(path: Path, made: "Import", odd: Sequence[str], out: Path) -> None:
    """Draw an imported recording with gaps, invalid samples and notes into a picture file."""
    import numpy as np
    from matplotlib.figure import Figure

    from tactile_rt.core.files import write_whole
    from tactile_rt.core.stream import NS_PER_S, concatenate
    from tactile_rt.recording.importing.report import report_lines
    from tactile_rt.recording.reader import Recording

    stored = Recording(path)
    spec, chunk = stored.spec, concatenate(list(stored))
    t_s = chunk.t_ns / NS_PER_S
    values = np.where(chunk.valid[..., None], chunk.values, np.nan)
    steps = np.diff(t_s)
    usual = float(np.median(steps)) if len(steps) else 1.0
    lost = np.flatnonzero((np.diff(chunk.seq) > 1) | (steps > PAUSE * usual))
    bad = np.concatenate([[False], ~chunk.valid.all(axis=1), [False]])
    spans = np.flatnonzero(np.diff(bad)).reshape(-1, 2)  # start and end of invalid stretches
    marks = {
        "invalid": ("tab:red", [(t_s[a], t_s[b - 1] + usual - t_s[a]) for a, b in spans.tolist()]),
        "missing": ("tab:orange", [(t_s[k], t_s[k + 1] - t_s[k]) for k in lost.tolist()]),
    }
    rows = spec.channels[:ROWS]
    figure = Figure((10, 1.4 + 1.5 * len(rows)), layout="constrained")
    axes: Any = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    edges = np.unique(np.linspace(0, len(t_s) - 1, min(BINS, len(t_s))).astype(int))
    at = np.repeat(t_s[edges], 2)
    for c, axis in enumerate(axes):
        for e, name in enumerate(spec.elements):
            both = [f.reduceat(values[:, e, c], edges) for f in (np.fmin, np.fmax)]
            axis.plot(at, np.stack(both, 1).ravel(), lw=0.8, marker=".", ms=2, label=name)
        for what, (color, bars) in marks.items():
            if bars:
                whole = {"transform": axis.get_xaxis_transform(), "alpha": 0.3, "label": what}
                axis.broken_barh(bars, (0, 1), color=color, **whole)
        axis.set_ylabel(f"{spec.channels[c]} [{spec.units[c]}]")
        axis.grid(alpha=0.3)
    labels = dict(zip(*axes[0].get_legend_handles_labels()[::-1], strict=True))
    shown = [n for n in (*spec.elements[:NAMED], "invalid", "missing") if n in labels]
    axes[0].legend([labels[n] for n in shown], shown, loc="upper right", fontsize="small", ncols=5)
    rest = ((len(odd) - NOTES, "notes"), (len(spec.channels) - ROWS, "channels"))
    notes = [*odd[:NOTES], *(f"and {n} {what} more" for n, what in rest if n > 0)]
    axes[-1].set_xlabel("\n".join(["time [s]", *notes]), parse_math=False)
    figure.suptitle(f"{stored.description.source}: {report_lines(made)[0]}", parse_math=False)
    write_whole(out, lambda file: figure.savefig(file, format=out.suffix[1:].lower(), dpi=120))
