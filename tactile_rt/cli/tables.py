"""Tables for pipes and narrow terminals, results as JSON, and progress bars."""

import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import typer
from rich import progress
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
A_DAY_S = 86_400.0
# Pause between progress lines without a terminal: first, longest, share of the time so far.
LINE_S, LONGEST_S, SHARE = 10.0, 120.0, 0.25

Update = Callable[..., None]


def show_table(
    records: Sequence[Mapping[str, Any]], headings: Mapping[str, str], json: Path | None = None
) -> None:
    """Print a table with a line for each record, or write the records as JSON.

    Args:
        records: mappings, which may have more keys than are printed.
        headings: heading of each printed column, by the key of its values in the records.
        json: file to write, `STDOUT`, or None for a printed table.
    """
    if told_as_json(list(records), json):
        return
    table = Table(*headings.values(), box=None, header_style="bold", pad_edge=False)
    for record in records:
        table.add_row(*(escape(_format_cell(record[key])) for key in headings))
    print_table(table)


def show_records(records: "list[Record]", json: Path | None) -> bool:
    """Print measured values beside their limits, or write them as JSON.

    Returns:
        True if the JSON went to stdout, where nothing else may be printed then.
    """
    from tactile_rt.models.evaluation.records import as_dicts, as_table

    if told_as_json(as_dicts(records), json):
        return True
    print_table(as_table(records))
    return False


def print_table(table: Table, console: Console | None = None) -> None:
    """Print a table in full width; on a narrow terminal, print a cell per line."""
    console = console or Console()
    if console.is_terminal:
        console.print(fitting(table, console))
        return
    needs = Measurement.get(console, console.options.update(max_width=WIDE), table)
    Console(file=console.file, width=max(needs.maximum, console.width)).print(table)


def fitting(table: Table, console: Console) -> RenderableType:
    """Return the table, or a line per cell if the console is too narrow."""
    needs = Measurement.get(console, console.options.update(max_width=WIDE), table)
    return table if needs.minimum <= console.width else _list_cells(table)


def told_as_json(what: Any, json: Path | None) -> bool:
    """Write a command's results as JSON; a file is written whole or not at all.

    Args:
        what: structs, dataclasses, mappings, sequences, arrays; NaN and infinity become null.
        json: file to write, `STDOUT`, or None to write nothing.

    Returns:
        True if the JSON went to stdout, where nothing else may be printed then.
    """
    if json is None:
        return False
    text = msgspec.json.format(msgspec.json.encode(what, enc_hook=_convert), indent=1) + b"\n"
    if json == STDOUT:
        typer.echo(text, nl=False)
        return True
    write_whole(json, lambda file: file.write(text))
    return False


def _list_cells(table: Table) -> Text:
    """Return a table's cells as text, a line ``heading: cell`` each."""
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


def _format_cell(value: Any) -> str:
    """Return a cell's text: "-" for None, four digits of a float, comma-separated lists."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_format_cell, value))
    return str(value)


def _convert(value: Any) -> Any:
    """Convert a path, mapping or NumPy value, which msgspec cannot encode."""
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return dict(value)
    return value.tolist()  # NumPy's array or scalar


@contextmanager
def progress_bar(
    what: str,
    total: float | None = None,
    completed: int = 0,
    counted: bool = False,
    timed: bool = True,
    console: Console | None = None,
) -> Iterator[Update]:
    """Show a progress bar with the time left while the block runs.

    Without a terminal, print a line after `LINE_S` seconds instead, and then ever more rarely, so
    that a log file shows that the work continues. Shorter work prints nothing.

    Args:
        total: amount of work; None if unknown.
        completed: amount that was done before and does not count for the time left.
        counted: show the number done of the total, not the share.
        timed: show the time left; False if the description contains it.
        console: console to draw on; None for standard error.

    Yields:
        The function that updates the bar: rich's `Progress.update` without the task
        (``advance=1``, ``completed=7``, ``total=9``, ``description="mug-1"``).
    """
    console = console or Console(stderr=True)
    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        *((progress.MofNCompleteColumn(),) if counted else ()),
        *((progress.TimeRemainingColumn(),) if timed else ()),
    )
    # Not rich's usual 30 s: a step may last minutes, and a rate needs two steps.
    with progress.Progress(
        *columns, console=console, transient=True, speed_estimate_period=A_DAY_S,
        disable=not console.is_terminal,
    ) as bar:  # fmt: skip
        task = bar.add_task(what, total=total, completed=completed)
        done = threading.Event()
        lines = threading.Thread(
            target=_print_lines, args=(console, bar.tasks[0], counted, timed, done),
            daemon=True,
        )  # fmt: skip
        if bar.disable:
            lines.start()
        try:
            yield partial(bar.update, task)
        finally:
            done.set()
            if bar.disable:
                lines.join()


@contextmanager
def share_bar(what: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar; yield a function that sets the finished share, 0 to 1."""
    with progress_bar(what, total=1.0) as update:
        yield lambda share: update(completed=share)


def _print_lines(
    console: Console, task: progress.Task, counted: bool, timed: bool, done: threading.Event
) -> None:
    pause = LINE_S
    while not done.wait(pause):
        line = describe_task(task, counted, timed)
        console.print(line, highlight=False, markup=False, soft_wrap=True)
        pause = min(max(LINE_S, SHARE * (task.elapsed or 0.0)), LONGEST_S)


def describe_task(task: progress.Task, counted: bool, timed: bool = True) -> str:
    """Return a line with a task's progress, the time so far and the time left."""
    line = f"{task.description}:"
    if task.total and counted:
        line += f" {task.completed:.0f} of {task.total:.0f},"
    elif task.total:
        line += f" {task.percentage:.0f} %,"
    line += f" {_format_time(task.elapsed or 0.0)} so far"
    left = task.time_remaining if timed else None
    return f"{line}, about {_format_time(left)} left" if left else line


def _format_time(seconds: float) -> str:
    """Format a time, given in s, in seconds, minutes or hours."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
