"""tactile_rt: recognition of the objects that whisker and taxel arrays touch, in real time.

    from tactile_rt import Classifier, Session, open_source, shipped_model

    with open_source("sim:mouse?sweeps=4&pace=fast") as source:
        with Session(source, Classifier(shipped_model(), source.spec)) as session:
            for chunk, decisions in session:
                print([(decision.step, decision.label) for decision in decisions])

Each name of this module is imported when it is first used, so that a program loads only what it
needs: the sources need no ONNX Runtime, and reading a recording needs no serial port.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from tactile_rt.core.packages import VERSION as __version__

# From 1.29 on ONNX Runtime sends usage data to its maker, unless this is set before it loads.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")

if TYPE_CHECKING:
    from tactile_rt.classifier.classifier import Classification, Classifier, fuse
    from tactile_rt.classifier.model_file import load_model, shipped_model
    from tactile_rt.classifier.session import Session
    from tactile_rt.core.errors import (
        ConfigError,
        ModelError,
        RecordingError,
        SourceError,
        SpecMismatch,
        TactileError,
    )
    from tactile_rt.core.stream import ArraySpec, Chunk, EndOfStream, Source, SourceStats
    from tactile_rt.drivers.codec import Codec
    from tactile_rt.recording.reader import Recording
    from tactile_rt.sources.opening import open_source

__all__ = [
    "ArraySpec",
    "Chunk",
    "Classification",
    "Classifier",
    "Codec",
    "ConfigError",
    "EndOfStream",
    "ModelError",
    "Recording",
    "RecordingError",
    "Session",
    "Source",
    "SourceError",
    "SourceStats",
    "SpecMismatch",
    "TactileError",
    "__version__",
    "fuse",
    "load_model",
    "open_source",
    "shipped_model",
]

_STREAM, _ERRORS = "tactile_rt.core.stream", "tactile_rt.core.errors"
_WHERE = {
    "Classification": "tactile_rt.classifier.classifier",
    "Classifier": "tactile_rt.classifier.classifier",
    "Codec": "tactile_rt.drivers.codec",
    "ConfigError": _ERRORS,
    "ModelError": _ERRORS,
    "Recording": "tactile_rt.recording.reader",
    "RecordingError": _ERRORS,
    "Session": "tactile_rt.classifier.session",
    "SourceError": _ERRORS,
    "SpecMismatch": _ERRORS,
    "TactileError": _ERRORS,
    "fuse": "tactile_rt.classifier.classifier",
    "load_model": "tactile_rt.classifier.model_file",
    "open_source": "tactile_rt.sources.opening",
    "shipped_model": "tactile_rt.classifier.model_file",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(import_module(_WHERE.get(name, _STREAM)), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
