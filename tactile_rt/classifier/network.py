"""What an engine gives: a graph that takes a step from one set of buffers to another.

Samples, tare and state are explicit: nothing is kept between steps but what the buffers hold, and
those are the user's.
"""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np
import onnxruntime as ort
from numpy.typing import DTypeLike, NDArray

from tactile_rt.classifier.runtime import PROVIDERS, device_of

__all__ = ["Network", "OnnxruntimeNetwork", "Tensor"]


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
        device: The device of the tensors, ``cpu`` or ``cuda``.
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
