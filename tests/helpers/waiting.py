"""How a test waits: for what it expects, with a limit that a busy machine does not reach."""

import inspect
import textwrap
from collections.abc import Callable
from time import monotonic, sleep
from typing import Any

PATIENCE_S = 60.0  # a test that waits so long has failed, on any machine
LOOK_EVERY_S = 0.005


def until(
    condition: Callable[[], Any],
    timeout: float = PATIENCE_S,
    meanwhile: Callable[[], Any] | None = None,
) -> None:
    """Wait until a condition is true; an AssertionError says what was awaited in vain.

    Args:
        condition: Looked at again and again, in the caller's thread.
        timeout: The longest time to wait, in s.
        meanwhile: What to do between two looks, such as to read from a source; a short sleep
            unless given.
    """
    end = monotonic() + timeout
    while not condition():
        if monotonic() >= end:
            raise AssertionError(f"waited {timeout:g} s in vain for: {_words(condition)}")
        if meanwhile is None:
            sleep(LOOK_EVERY_S)
        else:
            meanwhile()


def read_chunks(source: Any, samples: int) -> list[Any]:
    """Read from a source until so many samples have come, and return their chunks."""
    chunks: list[Any] = []
    until(
        lambda: sum(map(len, chunks)) >= samples,
        meanwhile=lambda: chunks.extend(filter(None, [source.read(0.05)])),
    )
    return chunks


def _words(condition: Callable[[], Any]) -> str:
    try:
        return textwrap.dedent(inspect.getsource(condition)).strip()
    except (OSError, TypeError):  # a bound method of C, a partial function
        return repr(condition)
