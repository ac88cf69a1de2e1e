"""The bar that every long command shows."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

__all__ = ["progress_bar"]

A_DAY_S = 86_400.0


@contextmanager
def progress_bar(
    console: Console,
    what: str,
    total: float | None = None,
    completed: int = 0,
    counted: bool = False,
) -> Iterator[Callable[..., None]]:
    """A bar with the time left, gone when it is done or fails: an error is one line alone.

    Where the console is no terminal nothing is shown: a log file keeps clean.

    Args:
        console: where.
        what: is going on.
        total: of the work; None until it is known.
        completed: was done before, and says nothing about the time left.
        counted: say how many of the total are done.

    Yields:
        What to call as the work goes on: rich's `Progress.update` without the task
        (``advance=1``, ``completed=7``, ``total=9``, ``description="mug-1"``).
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        *((MofNCompleteColumn(),) if counted else ()),
        TimeRemainingColumn(),
    )
    # Of rich's usual 30 s: a step may last minutes, and a rate takes two of them.
    with Progress(
        *columns,
        console=console,
        transient=True,
        disable=not console.is_terminal,
        speed_estimate_period=A_DAY_S,
    ) as progress:
        yield partial(progress.update, progress.add_task(what, total=total, completed=completed))
