"""Who computes a model's step: ONNX Runtime, or another runtime that a machine has.

    open_network(path, "openvino") -> Network, card;  Network.bind(inputs, outputs) -> step()

What is not ``onnxruntime`` is imported when it is chosen, never before.
"""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from tactile_rt.classifier import model_file
from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.network import Network, OnnxruntimeNetwork
from tactile_rt.classifier.runtime import PROVIDERS
from tactile_rt.errors import ConfigError
from tactile_rt.extras import install_extra

__all__ = ["DEFAULT", "ENGINES", "Engine", "check_engine", "import_engine", "open_network"]

DEFAULT = "onnxruntime"


@dataclass(frozen=True)
class Engine:
    """A runtime in one of its ways to compute.

    Attributes:
        package: The name of the package, to import and to install.
        extra: The extra of this package that installs the engine; empty if it is always there.
        exact: Whether the engine computes in the precision of the file.
    """

    package: str
    extra: str = ""
    exact: bool = True

    @property
    def version(self) -> str:
        """Its release; empty if it is not installed."""
        if importlib.util.find_spec(self.package) is None:
            return ""
        try:
            return metadata.version(self.package)
        except metadata.PackageNotFoundError:  # a build with another name, e.g. for a GPU
            return "unknown"


ENGINES = {
    DEFAULT: Engine("onnxruntime"),
    "openvino": Engine("openvino", "openvino"),
    "openvino-bf16": Engine("openvino", "openvino", exact=False),
}


def check_engine(name: str) -> str:
    """The name of an engine, if it can be used here.

    Raises:
        ConfigError: there is no such engine, or it is not installed; says what installs it.
    """
    if name not in ENGINES:
        raise ConfigError(f"no engine {name!r}; there are {', '.join(ENGINES)}")
    engine = ENGINES[name]
    if not engine.version:
        raise ConfigError(
            f"engine {name!r} needs the package {engine.package}, which is not installed: "
            + install_extra(engine.extra)
        )
    return name


def import_engine(name: str) -> None:
    """Import what an engine needs, which may take a second.

    Raises:
        ConfigError: the package cannot be imported.
    """
    if name != DEFAULT:
        from tactile_rt.classifier import openvino_engine  # noqa: F401


def open_network(
    path: Path,
    engine: str = DEFAULT,
    threads: int = 1,
    providers: Sequence[str] = (PROVIDERS["cpu"],),
) -> tuple[Network, ModelCard]:
    """Open a model file of kind ``step`` by an engine.

    Args:
        path: the ``.onnx`` file.
        engine: one of `ENGINES`.
        threads: that may share one operator.
        providers: onnxruntime's execution providers; other engines have none.

    Raises:
        ModelError: as `load_model`; or the engine cannot run this file.
        ConfigError: the engine, or a provider of onnxruntime, is not there.
    """
    if check_engine(engine) == DEFAULT:
        session, card = model_file.load_model(path, providers, threads)
        return OnnxruntimeNetwork(session), card
    from tactile_rt.classifier.openvino_engine import open_openvino

    return open_openvino(path, "f32" if ENGINES[engine].exact else "bf16", threads)
