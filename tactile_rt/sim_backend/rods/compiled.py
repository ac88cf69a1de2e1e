"""Compilation of the inner loops to machine code."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

__all__ = ["compiled"]

Function = TypeVar("Function", bound=Callable[..., Any])


def _forget_what_is_old() -> None:
    """Drop what was compiled before one of these files changed.

    Numba looks only at the file of a function, not at those of the functions that it calls.
    """
    folder = Path(__file__).parent
    newest = max(file.stat().st_mtime for file in folder.glob("*.py"))
    for kept in (folder / "__pycache__").glob("*.nbi"):
        with contextlib.suppress(OSError):
            if kept.stat().st_mtime < newest:
                kept.unlink()


_forget_what_is_old()


def compiled(function: Function) -> Function:
    """A function that is compiled when first called, and kept on disk for the next process.

    It lets other threads run, and its sums are in the order in which they are written: the same
    numbers on every machine.
    """
    return cast(Function, numba.njit(cache=True, nogil=True, error_model="numpy")(function))
