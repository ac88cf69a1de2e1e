"""Compilation of the inner loops to machine code, cached on disk for the next process.

If nothing can be cached (a folder of another user, no home, a full disk), or the cache is damaged,
each process compiles for itself, which takes half a minute. A compilation that lasts more than ten
seconds is reported as a warning of this module's logger.
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

_caching: Any = caching  # has no types

# Numba checks only a function's own file, not the files of the functions that it calls: this
# stamp invalidates the cache when any of these files changes.
STAMP = tuple(
    (file.name, status.st_mtime_ns, status.st_size)
    for file in sorted(Path(__file__).parent.glob("*.py"))
    for status in [file.stat()]
)


class _DiskCache(_caching.FunctionCache):  # type: ignore[misc]
    """Numba's disk cache of a function; failures to read or write it are ignored."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _caching.IndexDataCacheFile(
            self.cache_path, self._impl.filename_base, STAMP
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        found = None
        try:
            found = super().load_overload(sig, target_context)
        except Exception:  # a damaged cache raises many kinds of error
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
_compiling: set[_DiskCache] = set()  # caches of the functions that are being compiled now


@cache
def _watch_once() -> None:
    """Start a timer, once, that warns if compilation takes more than `PATIENCE_S`."""
    timer = threading.Timer(PATIENCE_S, _warn_of_compilation)
    timer.daemon = True
    timer.start()


def _warn_of_compilation() -> None:
    if _compiling:
        _LOG.warning("compiling the simulator, once on this machine: half a minute more or less")


@cache
def _warn_uncached_once() -> None:
    _LOG.warning(
        "the simulator is compiled anew, which takes half a minute: there is no folder to keep it "
        "in; NUMBA_CACHE_DIR can name one"
    )


def compile_cached(function: Function) -> Function:
    """Return a function that is compiled when first called, and cached on disk.

    The function releases the interpreter lock, and its sums keep the order of the source, so that
    results are the same on every machine.
    """
    made: Any = numba.njit(nogil=True, error_model="numpy")(function)
    try:
        made._cache = _DiskCache(function)
    except RuntimeError:  # no folder to keep it in
        _warn_uncached_once()
    return cast(Function, made)


def is_kept(function: Callable[..., Any]) -> bool:
    """Return whether a compiled function is cached on disk, for other processes to load."""
    cache: Any = getattr(function, "_cache", None)
    try:
        return isinstance(cache, _DiskCache) and bool(cache._cache_file._load_index())
    except Exception:  # a damaged cache, as in `load_overload`
        return False
