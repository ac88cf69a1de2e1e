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


@app.command("import")
def import_file(
    log: Annotated[Path, typer.Argument(help="Bytes, a CAN log, a table of numbers, a bag.")],
    output: Annotated[
        Path | None, typer.Argument(help="The recording. Default: LOG.mcap, in this folder.")
    ] = None,
    decoded_as: Annotated[
        str, typer.Option("--as", help="What a device spoke: codec=NAME&OPTION=VALUE.")
    ] = "",
    columns: Annotated[
        str,
        typer.Option(help="Of a table or bag: NAME=ELEMENT.CHANNEL*SCALE:UNIT,... or FILE.toml."),
    ] = "",
    topic: Annotated[str, typer.Option(help="Of a bag: which topic.")] = "",
    rate: Annotated[
        float, typer.Option(min=0, help="Samples a second, Hz, where nothing tells the time.")
    ] = 0,
    bus: Annotated[str, typer.Option(help="Of a log of several buses: which, e.g. can0.")] = "",
    form: Annotated[str, typer.Option(help="Of the log, if it is taken for another.")] = "",
    delimiter: Annotated[str, typer.Option(help="Of a table: a character, tab or space.")] = "",
    decimal: Annotated[str, typer.Option(help="Of a table: , or . in numbers.")] = "",
    skip: Annotated[int, typer.Option(min=0, help="Of a table: lines to pass over.")] = 0,
    lines: Annotated[
        int, typer.Option(min=1, max=1000, help="Of a table: lines of text that are one row.")
    ] = 1,
    force: Force = False,
    json: Json = None,
) -> None:
    """Make a recording of what is on the disk; `tactile-rt sniff` tells how.

    Raw bytes, hexadecimal text, what a terminal logged, and logs of a CAN
    bus (candump, asc, blf, trc, SavvyCAN) are decoded --as a codec. Tables
    (CSV, what a board or yarpdatadumper printed) need --columns. Of ROS 1
    and ROS 2 bags (the extra "import") wrenches, arrays and our own
    messages need nothing more. gzip is unpacked.
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
