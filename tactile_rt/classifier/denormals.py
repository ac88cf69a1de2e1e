"""Denormal numbers count as zero while a network runs, and only then.

A decaying state ends in denormals, which cost a hundred times an ordinary number. ONNX Runtime's
own option (``session.set_denormal_as_zero``) changes the thread that opens the process's first
session for ever, numpy in it included, and without helper threads does nothing in any later
session. So the floating-point mode of the running thread is set here, and put back afterwards.
"""

import ctypes
import platform
import sys

__all__ = ["FlushDenormals"]

# (32-bit word of fenv_t, its bits): MXCSR's FTZ and DAZ; FPCR's FZ.
MODES = {"x86_64": (7, 0x8040), "aarch64": (0, 1 << 24)}
WORDS = 8


def _library() -> ctypes.PyDLL | None:
    if sys.platform != "linux" or platform.machine() not in MODES:
        return None
    # PyDLL keeps the interpreter's lock: the calls take less time than giving it away.
    library = ctypes.PyDLL(None)
    return library if hasattr(library, "fegetenv") and hasattr(library, "fesetenv") else None


LIBRARY = _library()


class FlushDenormals:
    """Context in which this thread's denormals are zero; use one object in one thread at a time.

    Leaving it restores the thread's mode and its floating-point exception flags. On systems other
    than Linux on x86-64 and aarch64 it does nothing.
    """

    def __init__(self) -> None:
        self._before = (ctypes.c_uint32 * WORDS)()
        self._within = (ctypes.c_uint32 * WORDS)()
        self._word, self._bits = MODES.get(platform.machine(), (0, 0))

    def __enter__(self) -> None:
        if LIBRARY is not None:
            LIBRARY.fegetenv(self._before)
            LIBRARY.fegetenv(self._within)
            self._within[self._word] |= self._bits
            LIBRARY.fesetenv(self._within)

    def __exit__(self, *_: object) -> None:
        if LIBRARY is not None:
            LIBRARY.fesetenv(self._before)
