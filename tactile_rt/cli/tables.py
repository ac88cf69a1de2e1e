"""Tables that survive a pipe and a narrow terminal, results as JSON, and bars of long work."""

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
# Between lines where there is no terminal: at first, and at most; a fourth of the time so far.
LINE_S, LONGEST_S, SHARE = 10.0, 120.0, 0.25

Update = Callable[..., None]


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


@contextmanager
def progress_bar(
    what: str,
    total: float | None = None,
    completed: int = 0,
    counted: bool = False,
    timed: bool = True,
    console: Console | None = None,
) -> Iterator[Update]:
    """Show a bar with the time left, gone when the block is done or fails.

    Where the console is no terminal a line takes its place after `LINE_S` seconds, and then more
    and more seldom, so that who reads a log file sees that it goes on; what is done before then
    says nothing.

    Args:
        total: of the work; None where its end is not known.
        completed: was done before, and says nothing about the time left.
        counted: show how many of the total are done, not what share.
        timed: show the time left; False where the description says it.
        console: where to; None: standard error.

    Yields:
        What to call as the work goes on: rich's `Progress.update` without the task
        (``advance=1``, ``completed=7``, ``total=9``, ``description="mug-1"``).
    """
    console = console or Console(stderr=True)
    columns = (
        progress.TextColumn("{task.description}"),
        progress.BarColumn(),
        *((progress.MofNCompleteColumn(),) if counted else ()),
        *((progress.TimeRemainingColumn(),) if timed else ()),
    )
    # Of rich's usual 30 s: a step may last minutes, and a rate takes two of them.
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
    """Show the share of work that is done, 0 to 1, as a bar."""
    with progress_bar(what, total=1.0) as update:
        yield lambda share: update(completed=share)


def _print_lines(
    console: Console, task: progress.Task, counted: bool, timed: bool, done: threading.Event
) -> None:
    pause = LINE_S
    while not done.wait(pause):
        said = describe_task(task, counted, timed)
        console.print(said, highlight=False, markup=False, soft_wrap=True)
        pause = min(max(LINE_S, SHARE * (task.elapsed or 0.0)), LONGEST_S)


def describe_task(task: progress.Task, counted: bool, timed: bool = True) -> str:
    """Return a line that says how far the work is and how long it takes."""
    said = f"{task.description}:"
    if task.total and counted:
        said += f" {task.completed:.0f} of {task.total:.0f},"
    elif task.total:
        said += f" {task.percentage:.0f} %,"
    said += f" {_span(task.elapsed or 0.0)} so far"
    left = task.time_remaining if timed else None
    return f"{said}, about {_span(left)} left" if left else said


def _span(seconds: float) -> str:
    """Seconds below two minutes, then minutes, then hours."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"
