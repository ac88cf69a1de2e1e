"""`tactile-rt import`: logs, tables and bags of others, as recordings."""

from pathlib import Path
from typing import Annotated
from urllib.parse import parse_qsl

import typer
from rich.console import Console

from tactile_rt.cli.app import app, check_is_mcap, check_new, check_output, starting
from tactile_rt.cli.options import Force, Json
from tactile_rt.cli.progress import progress_bar
from tactile_rt.cli.tables import told_as_json
from tactile_rt.core.errors import ConfigError


@app.command("import", epilog="tactile-rt import capture.bin --as codec=bota")
def import_file(
    log: Annotated[Path, typer.Argument(help="Raw bytes, a CAN log, a table of numbers or a bag.")],
    output: Annotated[
        Path | None, typer.Argument(help="The recording. Default: LOG.mcap in this folder.")
    ] = None,
    decoded_as: Annotated[
        str, typer.Option("--as", help="Codec of the device: codec=NAME&OPTION=VALUE.")
    ] = "",
    columns: Annotated[
        str,
        typer.Option(help="Columns to read: NAME=ELEMENT.CHANNEL*SCALE:UNIT,... or FILE.toml."),
    ] = "",
    topic: Annotated[str, typer.Option(help="Topic to read from a bag.")] = "",
    rate: Annotated[
        float, typer.Option(min=0, help="Samples per second, if the log has no times.")
    ] = 0,
    bus: Annotated[str, typer.Option(help="Bus to read from a log of several, e.g. can0.")] = "",
    form: Annotated[str, typer.Option(help="Format of the log, if it is detected wrongly.")] = "",
    delimiter: Annotated[str, typer.Option(help="Column delimiter: character, tab or space.")] = "",
    decimal: Annotated[str, typer.Option(help="Decimal mark of a table: a comma or a point.")] = "",
    skip: Annotated[int, typer.Option(min=0, help="Lines of a table to skip.")] = 0,
    lines: Annotated[
        int, typer.Option(min=1, max=1000, help="Lines of text per row of a table.")
    ] = 1,
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
    output = output or Path(f"{log.name.partition('.')[0] or 'import'}.mcap")
    check_is_mcap(output)
    check_output(json)
    check_new(output, force)
    if decimal not in ("", ",", "."):
        raise ConfigError(f"--decimal is , or ., not {decimal!r}")
    with starting(), progress_bar(Console(stderr=True), f"reading {log}"):
        from tactile_rt.drivers.logs import read_log
        from tactile_rt.recording.importing.bag import import_bag, is_bag
        from tactile_rt.recording.importing.csv import csv_form, read_table
        from tactile_rt.recording.importing.table import import_table
        from tactile_rt.recording.importing.wire import import_wire

        if is_bag(log):
            if decoded_as:
                raise ConfigError(f"{log} is a bag: its messages are no bytes of a codec; no --as")
            made = import_bag(log, output, topic, columns, rate)
        elif decoded_as and columns:
            raise ConfigError("give --as, for what a device spoke, or --columns, for a table")
        elif decoded_as:
            packets = read_log(log, form, bus)
            made = import_wire(packets, output, codec_fields(decoded_as, "--as"), rate)
        elif columns:
            table = read_table(log, csv_form(log, delimiter, decimal, skip, lines))
            made = import_table(table, output, columns, rate)
        else:
            raise ConfigError(
                f"{log}: say what it is: --as codec=NAME or --columns ...; "
                f"`tactile-rt sniff {log}` tells which"
            )
    for note in made.notes:
        typer.echo(f"{log}: {note}", err=True)
    if not told_as_json({"file": output, **vars(made)}, json):
        typer.echo(f"{output}: {made.line()}")


def codec_fields(text: str, option: str) -> dict[str, str]:
    """The options of ``codec=NAME&OPTION=VALUE``, written as in a URL.

    Raises:
        ConfigError: one is given twice, or no codec.
    """
    pairs = parse_qsl(text.replace("+", "%2B"), keep_blank_values=True)
    fields = dict(pairs)
    if len(fields) < len(pairs) or not fields.get("codec"):
        raise ConfigError(f"{option} is codec=NAME&OPTION=VALUE..., each once, not {text!r}")
    return fields
