"""What whoever teaches orders: by keys, by a page, by lines where stdin is no terminal."""

import os
import queue
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Self

import typer

if TYPE_CHECKING:
    from tactile_rt.teaching.page import TeachingPage
    from tactile_rt.teaching.teacher import Teacher

__all__ = ["HELP", "Buttons", "listening"]

HELP = "keys: 1 to 9 a class, n the next, a another one, u takes a touch back, q learns and leaves"
KEYS = {"n": "next", "u": "undo", "q": "done", "\x04": "done"}


class Buttons:
    """A page in a browser, if it is asked for, and what is ordered there.

    Args:
        at: host and port; None: no page.
        begins: what to do before there is a teacher.

    Attributes:
        orders: What is asked for, there and elsewhere.
        teacher: The teacher whose state is shown; None: there is none yet.
    """

    def __init__(self, at: tuple[str, int] | None, begins: str) -> None:
        self.orders: queue.Queue[str] = queue.Queue()
        self.teacher: Teacher | None = None
        self._at, self._begins = at, begins
        self._page: TeachingPage | None = None

    def __enter__(self) -> Self:
        if self._at is not None:
            from tactile_rt.teaching.page import TeachingPage

            self._page = TeachingPage(*self._at, self._state, self.orders.put)
            typer.echo(f"buttons: {self._page.url}")
        return self

    def __exit__(self, *why: object) -> None:
        if self._page is not None:
            self._page.close()

    def _state(self) -> dict[str, Any]:
        return self.teacher.state() if self.teacher else {"prompt": self._begins}


@contextmanager
def listening(orders: "queue.Queue[str]") -> Iterator[None]:
    """Take keys, or lines where stdin is no terminal, until the block ends."""
    terminal = sys.stdin is not None and sys.stdin.isatty()
    if sys.stdin is None or sys.stdin.closed:
        yield
        return
    if not terminal:
        threading.Thread(target=_take_lines, args=(orders,), daemon=True).start()
        yield
        return
    import termios
    import tty

    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    threading.Thread(target=_take_keys, args=(orders, descriptor, before), daemon=True).start()
    tty.setcbreak(descriptor)
    try:
        yield
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def _take_lines(orders: "queue.Queue[str]") -> None:
    try:
        for line in sys.stdin:
            if line.strip():
                orders.put(line.strip())
    except (OSError, ValueError):
        return  # closed


def _take_keys(orders: "queue.Queue[str]", descriptor: int, before: list[object]) -> None:
    import termios
    import tty

    from tactile_rt.teaching.lesson import ORDERS

    while True:
        try:
            key = os.read(descriptor, 1).decode(errors="replace")
        except OSError:
            return
        if not key:
            return
        if key == "a":
            termios.tcsetattr(descriptor, termios.TCSADRAIN, before)  # type: ignore[arg-type]
            typer.echo("name of the class: ", nl=False)
            name = bytearray()
            while (more := os.read(descriptor, 1)) not in (b"", b"\n"):
                name += more
            tty.setcbreak(descriptor)
            called = name.decode(errors="replace").strip()
            if called in ORDERS:
                typer.echo(f"{called!r} is an order: name the class otherwise")
            elif called:
                orders.put(called)
        elif key.isdigit():
            orders.put(key)
        elif key in KEYS:
            orders.put(KEYS[key])
