"""Tables that survive a pipe, a narrow terminal, and a program that reads them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import typer
from rich.console import Console, RenderableType
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from tactile_rt.cli.options import STDOUT
from tactile_rt.core.files import write_whole

if TYPE_CHECKING:
    from tactile_rt.models.evaluation.records import Record

WIDE = 10_000  # columns: more than any table has


def show_table(
    records: Sequence[Mapping[str, Any]], headings: Mapping[str, str], json: Path | None = None
) -> None:
    """Print one line for each record, or write them all as JSON.

    Args:
        records: what there is to tell of each; may hold more than is printed.
        headings: the heading of every column, by the key of the records that it prints.
        json: the file to write; `STDOUT`; or None, not to.
    """
    if told_as_json(list(records), json):
        return
    table = Table(*headings.values(), box=None, header_style="bold", pad_edge=False)
    for record in records:
        table.add_row(*(escape(_text(record[key])) for key in headings))
    print_table(table)


def show_records(records: "list[Record]", json: Path | None) -> bool:
    """Print figures beside their bars, or write them as JSON.

    Returns:
        Whether stdout took the JSON, and nothing else may go there.
    """
    from tactile_rt.models.evaluation.records import as_dicts, as_table

    if told_as_json(as_dicts(records), json):
        return True
    print_table(as_table(records))
    return False


def print_table(table: Table, console: Console | None = None) -> None:
    """Print a table: whole where nobody looks at it, one fact a line where it does not fit."""
    console = console or Console()
    if console.is_terminal:
        console.print(fitting(table, console))
        return
    needs = Measurement.get(console, console.options.update(max_width=WIDE), table)
    Console(file=console.file, width=max(needs.maximum, console.width)).print(table)


def fitting(table: Table, console: Console) -> RenderableType:
    """The table, or where a terminal is too narrow for its longest words, a fact a line."""
    needs = Measurement.get(console, console.options.update(max_width=WIDE), table)
    return table if needs.minimum <= console.width else _facts(table)


def told_as_json(what: Any, json: Path | None) -> bool:
    """Write what a command has to tell as JSON, where that is asked for: whole or not at all.

    Args:
        what: structs, dataclasses, mappings, sequences, arrays; a number that is none becomes null.
        json: the file to write; `STDOUT`; or None, not to.

    Returns:
        Whether it went to stdout, where nothing else may go then.
    """
    if json is None:
        return False
    text = msgspec.json.format(msgspec.json.encode(what, enc_hook=_plain), indent=1) + b"\n"
    if json == STDOUT:
        typer.echo(text, nl=False)
        return True
    write_whole(json, lambda file: file.write(text))
    return False


def _facts(table: Table) -> Text:
    """Each row as lines "heading: cell"."""
    columns = [(str(column.header), list(column.cells)) for column in table.columns]
    lines = [Text(str(table.title), style="bold")] if table.title else []
    for row in range(table.row_count):
        for heading, cells in columns:
            cell = cells[row]
            text = cell if isinstance(cell, Text) else Text.from_markup(str(cell))
            if text.plain:
                name = ((f"{heading}: ", "bold"),) if heading else ()
                lines.append(Text.assemble(*name, text))
        lines.append(Text())
    return Text("\n", overflow="fold").join(lines)


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
    """As JSON has it what msgspec does not know."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return dict(value)
    return value.tolist()  # of numpy
