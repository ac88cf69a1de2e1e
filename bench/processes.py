"""Devices and readers, each in a process of its own: what one costs is not on another's bill."""

import multiprocessing
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

PATIENCE_S = 30.0  # beyond what it was asked to take; a helper that needs longer is stuck


class Helper:
    """A function in a process of its own, at the other end of a pipe; a context manager.

    Args:
        work: module-level function; called with its end of the pipe, then `arguments`.
        arguments: what can be pickled.

    Raises:
        EOFError: from `hear`: it has ended without a word; its traceback is on stderr.
    """

    def __init__(self, work: Callable[..., None], *arguments: Any) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=work, args=(theirs, *arguments), daemon=True)
        self._process.start()
        theirs.close()

    @property
    def pid(self) -> int:
        """Number of its process."""
        return self._process.pid or 0

    def hear(self, seconds: float = 0.0) -> Any:
        """What it says next.

        Args:
            seconds: what that may take, beyond the time to start a process.

        Raises:
            TimeoutError: it says nothing.
        """
        if not self._pipe.poll(seconds + PATIENCE_S):
            raise TimeoutError(f"{self._process.name} said nothing in {seconds + PATIENCE_S:g} s")
        return self._pipe.recv()

    def tell(self, word: Any) -> None:
        """Say something to it."""
        self._pipe.send(word)

    def ask(self, word: Any, seconds: float = 0.0) -> Any:
        """Say something to it and hear what it answers."""
        self.tell(word)
        return self.hear(seconds)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._pipe.close()  # which ends those that wait for a word
        self._process.join(2.0)
        if self._process.is_alive():
            self._process.terminate()
            self._process.join()
