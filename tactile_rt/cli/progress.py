"""How far long work is: a bar on a terminal, a line now and then in a log file."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeRemainingColumn,
)

__all__ = ["progress_bar", "working"]

A_DAY_S = 86_400.0
LINE_S = 10.0  # between lines where there is no terminal

Clock = Callable[[], float]
Wait = Callable[[threading.Event], bool]


def _wait(done: threading.Event) -> bool:
    """Wait until a line is due; whether the work is done before."""
    return done.wait(LINE_S)


@contextmanager
def progress_bar(
    console: Console,
    what: str,
    total: float | None = None,
    completed: int = 0,
    counted: bool = False,
    *,
    wait: Wait = _wait,
    clock: Clock = time.monotonic,
) -> Iterator[Callable[..., None]]:
    """A bar with the time left, gone when it is done or fails: an error is one line alone.

    Where the console is no terminal a line every `LINE_S` seconds takes its place, so that who
    reads a log file sees that it goes on; what is done before then says nothing.

    Args:
        console: where.
        what: is going on.
        total: of the work; None until it is known.
        completed: was done before, and says nothing about the time left.
        counted: say how many of the total are done.
        wait: wait until a line is due, or the event is set; gives whether it is.
        clock: seconds, of which differences count.

    Yields:
        What to call as the work goes on: rich's `Progress.update` without the task
        (``advance=1``, ``completed=7``, ``total=9``, ``description="mug-1"``).
    """
    if not console.is_terminal:
        lines = _Lines(what, total, completed, counted, clock)
        with _every(lambda: console.print(lines.line(), **PLAIN), wait):  # type: ignore[arg-type]
            yield lines.update
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        *((MofNCompleteColumn(),) if counted else ()),
        TimeRemainingColumn(),
    )
    # Of rich's usual 30 s: a step may last minutes, and a rate takes two of them.
    with Progress(
        *columns, console=console, transient=True, speed_estimate_period=A_DAY_S
    ) as progress:
        yield partial(progress.update, progress.add_task(what, total=total, completed=completed))


@contextmanager
def working(
    console: Console, what: str, *, wait: Wait = _wait, clock: Clock = time.monotonic
) -> Iterator[Callable[..., None]]:
    """As `progress_bar`, of work that does not tell how far it is."""
    if not console.is_terminal:
        with progress_bar(console, what, wait=wait, clock=clock) as update:
            yield update
        return
    columns = SpinnerColumn(), TextColumn("{task.description}")
    with Progress(*columns, console=console, transient=True) as progress:
        yield partial(progress.update, progress.add_task(what, total=None))


PLAIN = {"highlight": False, "markup": False, "soft_wrap": True}


class _Lines:
    """What a line says of work under way.

    Args:
        what, total, completed, counted, clock: as `progress_bar` takes them.
    """

    def __init__(
        self, what: str, total: float | None, completed: float, counted: bool, clock: Clock
    ) -> None:
        self._what, self._now = what, ""
        self._total, self._first, self._done = total, completed, completed
        self._counted, self._clock, self._began = counted, clock, clock()

    def update(
        self,
        *,
        total: float | None = None,
        completed: float | None = None,
        advance: float = 0,
        description: str | None = None,
    ) -> None:
        """As rich's `Progress.update`."""
        self._total = self._total if total is None else total
        self._done = (self._done if completed is None else completed) + advance
        self._now = self._now if description is None else description

    def line(self) -> str:
        """What, how far, for how long, and how long it may take still."""
        total, done = self._total, self._done
        spent = self._clock() - self._began
        said = f"{self._now or self._what}:"
        if total and self._counted:
            said = f"{self._what}: {done:.0f} of {total:.0f},"
            said += f" {self._now}," if self._now else ""
        elif total:
            said += f" {100 * min(done / total, 1):.0f} %,"
        said += f" {_span(spent)} so far"
        new = done - self._first
        if total and new > 0 and total > done:
            said += f", about {_span(spent * (total - done) / new)} left"
        return said


def _span(seconds: float) -> str:
    """Seconds below two minutes, then minutes, then hours."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    if seconds < 7200:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.1f} h"


@contextmanager
def _every(tell: Callable[[], None], wait: Wait) -> Iterator[None]:
    """Tell whenever a wait is over, until the block is."""
    done = threading.Event()

    def go_on() -> None:
        while not wait(done):
            tell()

    thread = threading.Thread(target=go_on, name="progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
