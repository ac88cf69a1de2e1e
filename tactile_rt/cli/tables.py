"""Tables that survive a pipe, a narrow terminal, and a program that reads them."""

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import typer
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from tactile_rt.cli.app import check_output
from tactile_rt.files import write_whole

__all__ = ["STDOUT", "Json", "print_table", "show_table", "write_json"]

Json = Annotated[
    Path | None,
    typer.Option("--json", help="Write it as JSON to this file; - prints that and nothing else."),
]
STDOUT = Path("-")
WIDE = 10_000  # columns: more than any table has


def show_table(
    records: Sequence[Mapping[str, Any]], headings: Mapping[str, str], json: Path | None = None
) -> None:
    """Print one line for each record, or write them all as JSON.

    Args:
        records: what there is to tell of each; may hold more than is printed.
        headings: the heading of every column, by the key of the records that it prints.
        json: where `Json` says.

    Raises:
        ConfigError: the file cannot be written.
    """
    if json is not None:
        write_json(list(records), json)
        if json == STDOUT:
            return
    table = Table(*headings.values(), box=None, header_style="bold", pad_edge=False)
    for record in records:
        table.add_row(*(escape(_text(record[key])) for key in headings))
    print_table(table)


def print_table(table: Table, console: Console | None = None) -> None:
    """Print a table: whole where nobody looks at it, one fact a line where it does not fit."""
    console = console or Console()
    needs = Measurement.get(console, console.options.update(max_width=WIDE), table)
    if not console.is_terminal:
        Console(file=console.file, width=max(needs.maximum, console.width)).print(table)
    elif needs.minimum <= console.width:
        console.print(table)
    else:
        _print_facts(table, console)


def write_json(what: Any, path: Path) -> None:
    """Write what msgspec can encode, a whole file or nothing; ``-`` is stdout.

    Raises:
        ConfigError: the file cannot be written.
    """
    text = msgspec.json.format(msgspec.json.encode(_plain(what)), indent=1) + b"\n"
    if path == STDOUT:
        sys.stdout.write(text.decode())
    else:
        check_output(path)
        write_whole(path, lambda file: file.write(text))


def _print_facts(table: Table, console: Console) -> None:
    """Each row as lines "heading: cell"."""
    columns = [(str(column.header), list(column.cells)) for column in table.columns]
    for row in range(table.row_count):
        for heading, cells in columns:
            cell = cells[row]
            text = cell if isinstance(cell, Text) else Text.from_markup(str(cell))
            if text.plain:
                name = ((f"{heading}: ", "bold"),) if heading else ()
                console.print(Text.assemble(*name, text), overflow="fold")
        console.print()


def _text(value: Any) -> str:
    """A cell: nothing for what is not known, four digits of a number, a list in a line."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_text, value))
    return str(value)


def _plain(value: Any) -> Any:
    """As JSON has it, which knows no NaN."""
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value
