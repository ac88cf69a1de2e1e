"""ONNX Runtime as used here: the choice of execution providers, and the floating-point mode.

Two things are not left to ONNX Runtime. A requested provider that is missing is an error that names
what to install, not a silent fallback to the CPU. And denormal numbers count as zero while a
network runs, and only then: a decaying state ends in denormals, which cost a hundred times an
ordinary number.

ONNX Runtime's own option for the latter (``session.set_denormal_as_zero``) permanently changes the
thread that opens the process's first session, numpy included, and without helper threads has no
effect in later sessions. So this module sets the floating-point mode of the running thread, and
restores it afterwards.
"""

import ctypes
import platform
import sys
from collections.abc import Sequence

import onnxruntime as ort

from tactile_rt.core.errors import ConfigError

PROVIDERS = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
    "openvino": "OpenVINOExecutionProvider",
    "coreml": "CoreMLExecutionProvider",
}
COMES_WITH = {
    "cuda": "onnxruntime-gpu",
    "tensorrt": "onnxruntime-gpu",
    "openvino": "onnxruntime-openvino",
    "coreml": "onnxruntime for macOS",
}
# (32-bit word of fenv_t, its bits): MXCSR's FTZ and DAZ; FPCR's FZ.
MODES = {"x86_64": (7, 0x8040), "aarch64": (0, 1 << 24)}
WORDS = 8


def available() -> tuple[str, ...]:
    """Return the short names of the execution providers that this onnxruntime has."""
    built = ort.get_available_providers()
    return tuple(name for name, known in PROVIDERS.items() if known in built)


def onnxruntime_names(providers: Sequence[str]) -> list[str]:
    """Translate short provider names to onnxruntime's, with the CPU as the last choice.

    Raises:
        ConfigError: No name is given, or a name is unknown or missing in this onnxruntime.
    """
    if isinstance(providers, str):
        providers = (providers,)
    if not providers:
        raise ConfigError(f"providers: name at least one of {', '.join(PROVIDERS)}")
    for name in providers:
        if name not in PROVIDERS:
            raise ConfigError(f"no execution provider {name!r}; there are {', '.join(PROVIDERS)}")
        if name not in available():
            raise ConfigError(
                f"execution provider {name!r} is not in the installed onnxruntime (it has "
                f"{', '.join(available())}); it comes with {COMES_WITH.get(name, 'onnxruntime')}"
            )
    return [PROVIDERS[name] for name in dict.fromkeys((*providers, "cpu"))]


def device_of(session: ort.InferenceSession) -> str:
    """Return the device on which a session keeps its state: ``cuda`` or ``cpu``."""
    first = session.get_providers()[0]
    return "cuda" if first in (PROVIDERS["cuda"], PROVIDERS["tensorrt"]) else "cpu"


def _load_libc() -> ctypes.PyDLL | None:
    if sys.platform != "linux" or platform.machine() not in MODES:
        return None
    # PyDLL keeps the interpreter's lock: the calls take less time than releasing it.
    library = ctypes.PyDLL(None)
    return library if hasattr(library, "fegetenv") and hasattr(library, "fesetenv") else None


LIBRARY = _load_libc()


class FlushDenormals:
    """Context manager in which this thread's denormals count as zero.

    Leaving it restores the thread's mode and its floating-point exception flags. Use an object in
    one thread at a time. On systems other than Linux on x86-64 and aarch64 it does nothing.
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
