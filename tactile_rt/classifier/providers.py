"""Execution providers of ONNX Runtime: which there are, and an honest answer when one is not."""

from collections.abc import Sequence

import onnxruntime as ort

from tactile_rt.stream import ConfigError

__all__ = ["PROVIDERS", "available", "device_of", "onnxruntime_names"]

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


def available() -> tuple[str, ...]:
    """Names of the providers that the installed onnxruntime was built with."""
    built = ort.get_available_providers()
    return tuple(name for name, known in PROVIDERS.items() if known in built)


def onnxruntime_names(providers: Sequence[str]) -> list[str]:
    """Translate names, first choice first; what none of them can do, the CPU does.

    Raises:
        ConfigError: none, one that we do not know, or one that this onnxruntime lacks.
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
    """Where a session wants its state: ``cuda`` or ``cpu``."""
    first = session.get_providers()[0]
    return "cuda" if first in (PROVIDERS["cuda"], PROVIDERS["tensorrt"]) else "cpu"
