"""Who computes a model's step: ONNX Runtime, or another runtime that a machine has.

    open_network(path, "openvino") -> Network, card;  Network.bind(inputs, outputs) -> step()

An engine opens a file that was checked and binds it to memory that its user owns: samples, tare
and state are explicit, nothing is kept between steps but what the buffers hold. What is not
``onnxruntime`` is imported when it is chosen, never before.
"""

import importlib
import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import onnxruntime as ort
from numpy.typing import DTypeLike, NDArray

from tactile_rt.classifier import model_file
from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.runtime import PROVIDERS, device_of
from tactile_rt.extras import install_extra
from tactile_rt.stream import ConfigError

__all__ = [
    "DEFAULT",
    "ENGINES",
    "Engine",
    "Network",
    "OnnxruntimeNetwork",
    "Tensor",
    "check_engine",
    "import_engine",
    "open_network",
]

DEFAULT = "onnxruntime"


@dataclass(frozen=True)
class Engine:
    """A runtime in one of its ways to compute.

    Attributes:
        package: What it is imported as, and installed by.
        extra: The extra of this package that installs it; empty: it is always there.
        exact: Whether it computes in the precision of the file.
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


class Tensor:
    """An array, and what onnxruntime sees: the same memory on the CPU, else a copy on a device."""

    def __init__(self, shape: tuple[int, ...], dtype: DTypeLike, device: str) -> None:
        self.array: NDArray[Any] = np.zeros(shape, dtype=dtype)
        self.value = ort.OrtValue.ortvalue_from_numpy(self.array, device, 0)
        self._apart = device != "cpu"

    def send(self) -> None:
        """Let the device have what was written to the array."""
        if self._apart:
            self.value.update_inplace(self.array)

    def zero(self, lane: int | None = None) -> None:
        """Zero one lane, or all."""
        if lane is None:
            self.array.fill(0)
        else:
            if self._apart:
                self.array[:] = self.value.numpy()
            self.array[lane] = 0
        self.send()


class Network(Protocol):
    """A graph that an engine has opened.

    Attributes:
        batch: The number of lanes that the graph is fixed to; None if it takes any.
        device: Where its tensors are to be: ``cpu`` or ``cuda``.
        in_place: Whether a cache may be input and output in one memory.
        providers: Names of onnxruntime's execution providers in use; of other engines none.
    """

    batch: int | None
    device: str
    in_place: bool
    providers: tuple[str, ...]

    def bind(
        self, inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor]
    ) -> Callable[[], object]:
        """A call that takes a step from these inputs to these outputs, again and again. All
        bindings of a network have tensors of the same shapes."""
        ...


class OnnxruntimeNetwork:
    """A session of onnxruntime as a `Network`."""

    def __init__(self, session: ort.InferenceSession) -> None:
        self._session = session
        batch = session.get_inputs()[0].shape[0]
        self.batch = batch if isinstance(batch, int) else None
        self.device = device_of(session)
        self.providers = tuple(session.get_providers())
        # How other providers than onnxruntime's own write rows is not known.
        self.in_place = self.providers == (PROVIDERS["cpu"],)

    def bind(
        self, inputs: Mapping[str, Tensor], outputs: Mapping[str, Tensor]
    ) -> Callable[[], object]:
        binding = self._session.io_binding()
        for name, tensor in inputs.items():
            binding.bind_ortvalue_input(name, tensor.value)
        for name, tensor in outputs.items():
            binding.bind_ortvalue_output(name, tensor.value)
        run = self._session.run_with_iobinding
        return lambda: run(binding)


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
    """Import the package of an engine, which may take a second."""
    importlib.import_module(ENGINES[name].package)


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
