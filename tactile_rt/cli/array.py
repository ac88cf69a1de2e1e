"""`tactile-rt array`: list named arrays, and fit an array's file to measurements."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.markup import escape
from rich.table import Table

from tactile_rt.cli.app import add_group, check_output, needing, open_url
from tactile_rt.cli.options import STDOUT, Json, argument, option
from tactile_rt.cli.tables import print_table, show_table, told_as_json
from tactile_rt.core.errors import ConfigError

if TYPE_CHECKING:
    from tactile_rt.sim_backend.measuring.findings import ArrayFinding

array = add_group("array", "List named arrays, and fit an array's file to measurements.")


@array.command("list", epilog="tactile-rt array list")
def show(json: Json = None) -> None:
    """List the named arrays, for sim:NAME and new --array NAME.

    An animal's name takes a side: mouse-left, mouse-both.
    """
    with needing("sim"):
        from tactile_rt.core import packages
        from tactile_rt.sim_backend.arrays.files import ROBOTS, SPECIES, load_animals
        from tactile_rt.sim_backend.transducer import device_spec
    found = []
    for name in (*SPECIES, *ROBOTS, *packages.added_names(packages.ARRAYS)):
        spec = device_spec(load_animals(name))
        found.append(
            {
                "array": name,
                "whiskers": len(spec.elements),
                "channels": list(spec.channels),
                "units": list(dict.fromkeys(spec.units)),
                "rate_hz": spec.rate_hz,
                "reader": ROBOTS.get(name, "any device of such channels"),
            }
        )
    headings = {
        "array": "array", "whiskers": "whiskers", "channels": "channels", "units": "units",
        "rate_hz": "rate, Hz", "reader": "read by",
    }  # fmt: skip
    show_table(found, headings, json)


@array.command(epilog="tactile-rt array fit plucks.mcap --array array.toml --out fitted.toml")
def fit(
    recording: Annotated[str, argument("An .mcap file, or the URL of a source.")],
    described: Annotated[Path, option("TOML file of the array.", "--array")],
    out: Annotated[
        Path | None, option("File to write with the measured values; may be the array's.")
    ] = None,
    seconds: Annotated[float, option("Read at most this many seconds.", min=1, max=3600)] = 600.0,
    json: Json = None,
) -> None:
    """Compare an array at rest and plucked with its description.

    Record the array untouched for a minute or two, then bend each whisker and
    let it go, three times or more, with some seconds between.
    """
    check_output(out)
    from tactile_rt.sources.opening import check_source

    if not described.is_file():
        raise ConfigError(f"{described}: no such file")
    url = f"replay:{recording}?speed=0" if Path(recording).is_file() else recording
    check_source(url)
    with needing("sim"):
        from tactile_rt.sim_backend.measuring.fitting import fit_array, read_described
    from tactile_rt.calibration.tare_measurement import record
    from tactile_rt.core.files import write_whole
    from tactile_rt.core.stream import concatenate

    with open_url(url) as source:
        read_described(described, source.spec)  # reports a mistake before samples are read
        chunks = record(source, seconds)
        fitted = fit_array(described, source.spec, concatenate(chunks))
    if not told_as_json(
        [
            {key: value for key, value in vars(found).items() if key != "edits"}
            for found in fitted.findings
        ],
        json,
    ):
        _show(fitted.findings)
    if out is not None:
        write_whole(out, lambda file: file.write(fitted.text.encode()))
        values = sum(len(f.edits) for f in fitted.findings)
        typer.echo(f"{out}: {values} values set to the measured ones", err=json == STDOUT)
    else:
        typer.echo(
            "not written: give --out FILE to save them; the array's own file is allowed",
            err=json == STDOUT,
        )


def _show(findings: "list[ArrayFinding]") -> None:
    table = Table("quantity", "unit", "described", "measured", "ratio", box=None)
    for f in findings:
        table.add_row(*map(escape, f.words()))
    print_table(table)
    for f in findings:
        if f.note:
            typer.echo(f"{f.what}: {f.note}")
