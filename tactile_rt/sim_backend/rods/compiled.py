"""Compilation of the inner loops to machine code, which is kept for the next process.

Where nothing can be kept (a folder that belongs to another, no home, a full disk), or what is kept
is damaged, a process compiles for itself: that takes it half a minute, and no more. Work that
takes so long says so after ten seconds, as a warning of this module's logger.
"""

import contextlib
import logging
import threading
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, TypeVar, cast

import numba
from numba.core import caching

Function = TypeVar("Function", bound=Callable[..., Any])

_caching: Any = caching  # which has no types

# Numba looks only at the file of a function, not at those of the functions that it calls: what was
# compiled before one of these files changed is old.
STAMP = tuple(
    (file.name, status.st_mtime_ns, status.st_size)
    for file in sorted(Path(__file__).parent.glob("*.py"))
    for status in [file.stat()]
)


class _Kept(_caching.FunctionCache):  # type: ignore[misc]
    """What numba keeps of a function, and lives without."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _caching.IndexDataCacheFile(
            self.cache_path, self._impl.filename_base, STAMP
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = None
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # damage shows itself in a dozen ways
            with contextlib.suppress(OSError):
                self.flush()
        if found is None:
            _compiling.add(self)
            _watch_once()
        return found

    def save_overload(self, sig: Any, data: Any) -> None:
        _compiling.discard(self)
        with contextlib.suppress(OSError):
            super().save_overload(sig, data)


_LOG = logging.getLogger(__name__)
PATIENCE_S = 10.0
_compiling: set[_Kept] = set()  # the functions that are being compiled now


@cache
def _watch_once() -> None:
    """Warn if compilation still goes on after `PATIENCE_S`."""
    timer = threading.Timer(PATIENCE_S, _warn_of_compilation)
    timer.daemon = True
    timer.start()


def _warn_of_compilation() -> None:
    if _compiling:
        _LOG.warning("compiling the simulator, once on this machine: half a minute more or less")


@cache
def _tell_once() -> None:
    _LOG.warning(
        "the simulator is compiled anew, which takes half a minute: there is no folder to keep it "
        "in; NUMBA_CACHE_DIR can name one"
    )


def compiled(function: Function) -> Function:
    """A function that is compiled when first called, and kept on disk for the next process.

    It lets other threads run, and its sums are in the order in which they are written: the same
    numbers on every machine.
    """
    made: Any = numba.njit(nogil=True, error_model="numpy")(function)
    try:
        made._cache = _Kept(function)
    except RuntimeError:  # no folder to keep it in
        _tell_once()
    return cast(Function, made)


def is_kept(function: Callable[..., Any]) -> bool:
    """Return True if other processes find this version of a function compiled."""
    cache: Any = getattr(function, "_cache", None)
    try:
        return isinstance(cache, _Kept) and bool(cache._cache_file._load_index())
    except Exception:  # as when one is loaded
        return False
