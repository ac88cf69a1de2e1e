"""How far long work is: a bar on a terminal, a line now and then in a log file."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    Task,
    TextColumn,
    TimeRemainingColumn,
)

A_DAY_S = 86_400.0
# Between lines where there is no terminal: at first, and at most; a fourth of the time so far.
LINE_S, LONGEST_S, SHARE = 10.0, 120.0, 0.25

Update = Callable[..., None]


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
        TextColumn("{task.description}"),
        BarColumn(),
        *((MofNCompleteColumn(),) if counted else ()),
        *((TimeRemainingColumn(),) if timed else ()),
    )
    # Of rich's usual 30 s: a step may last minutes, and a rate takes two of them.
    with Progress(
        *columns, console=console, transient=True, speed_estimate_period=A_DAY_S,
        disable=not console.is_terminal,
    ) as progress:  # fmt: skip
        task = progress.add_task(what, total=total, completed=completed)
        done = threading.Event()
        lines = threading.Thread(
            target=_print_lines, args=(console, progress.tasks[0], counted, timed, done),
            daemon=True,
        )  # fmt: skip
        if progress.disable:
            lines.start()
        try:
            yield partial(progress.update, task)
        finally:
            done.set()
            if progress.disable:
                lines.join()


@contextmanager
def share_bar(what: str) -> Iterator[Callable[[float], None]]:
    """Show a bar of work that tells which share of it is done, 0 to 1."""
    with progress_bar(what, total=1.0) as update:
        yield lambda share: update(completed=share)


def _print_lines(
    console: Console, task: Task, counted: bool, timed: bool, done: threading.Event
) -> None:
    pause = LINE_S
    while not done.wait(pause):
        said = describe_task(task, counted, timed)
        console.print(said, highlight=False, markup=False, soft_wrap=True)
        pause = min(max(LINE_S, SHARE * (task.elapsed or 0.0)), LONGEST_S)


def describe_task(task: Task, counted: bool, timed: bool = True) -> str:
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
