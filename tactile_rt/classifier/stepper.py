"""The network's step, bound once to preallocated buffers.

The state lives in two sets of buffers; steps alternately read one and write the other. So a step
allocates nothing, and the state never leaves a GPU. If a step writes only a few rows of a cache,
both sets have the same buffer for the cache: onnxruntime then copies nothing.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import DTypeLike, NDArray

from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.model_file import output_sizes
from tactile_rt.classifier.runtime import PROVIDERS, FlushDenormals, device_of
from tactile_rt.core.errors import ConfigError

WARM_UP = 4  # runs, two of each binding: the first runs allocate, and may even compile


class Tensor:
    """A host array that onnxruntime uses directly, or that is copied to its device."""

    def __init__(self, shape: tuple[int, ...], dtype: DTypeLike, device: str) -> None:
        self.array: NDArray[Any] = np.zeros(shape, dtype=dtype)
        self.value = ort.OrtValue.ortvalue_from_numpy(self.array, device, 0)
        self._on_device = device != "cpu"

    def send(self) -> None:
        """Copy the host array to the device, if it is not the CPU."""
        if self._on_device:
            self.value.update_inplace(self.array)

    def zero(self, lane: int | None = None) -> None:
        """Set one lane of the array to zero, or all lanes if `lane` is None."""
        if lane is None:
            self.array.fill(0)
        else:
            if self._on_device:
                self.array[:] = self.value.numpy()
            self.array[lane] = 0
        self.send()


class Stepper:
    """A runner of a model's graph, step by step, in several lanes at once.

    Attributes:
        samples: (lane, sub-step, element, channel) The next step's input, SI; write it here.
        embedding: (lane, unit) The embedding of the last step, which the next step overwrites.
        names: (lane, name) The logits of kinds, likewise; no columns for a model without kinds.

    Raises:
        ConfigError: The graph's batch is fixed to another number than `lanes`.
    """

    def __init__(self, session: ort.InferenceSession, card: ModelCard, lanes: int = 1) -> None:
        batch = session.get_inputs()[0].shape[0]
        if isinstance(batch, int) and batch != lanes:
            raise ConfigError(
                f"model {card.name!r} has a batch fixed to {batch}, and {lanes} lanes are "
                "needed: export it with a dynamic batch, or decide by episodes"
            )
        self._session = session
        device = device_of(session)
        # It is unknown whether providers other than onnxruntime's own can write in place.
        in_place = session.get_providers() == [PROVIDERS["cpu"]]
        elements, channels = card.array.shape
        shape = (lanes, elements, channels)
        self._samples = Tensor((lanes, card.substeps, elements, channels), np.float32, device)
        self._offset = Tensor(shape, np.float32, device)
        self._sigma = Tensor(shape, np.float32, device)
        self._outputs = {
            name: Tensor((lanes, size), np.float32, "cpu")
            for name, size in output_sizes(card).items()
        }
        first = {s.name: Tensor((lanes, *s.shape), s.dtype, device) for s in card.state}
        second = {
            s.name: first[s.name]
            if s.in_place and in_place
            else Tensor((lanes, *s.shape), s.dtype, device)
            for s in card.state
        }
        self._states = (first, second)
        self.samples = self._samples.array
        self.embedding = self._outputs["embedding"].array
        self.names = self._outputs["names"].array if card.kinds else self.embedding[:, :0]
        self._steps = tuple(
            self._bind(self._states[now], self._states[1 - now]) for now in range(2)
        )
        self._now = 0
        self._flush = FlushDenormals()
        self._sigma.array[:] = np.array(card.floor, dtype=np.float32)
        self._sigma.send()
        for _ in range(WARM_UP):
            self.run()
        self.begin(self._offset.array[0], self._sigma.array[0])

    def begin(self, offset: NDArray[np.float32], sigma: NDArray[np.float32]) -> None:
        """Zero the state of every lane, and set the baseline (element, channel), SI."""
        self._offset.array[:] = offset
        self._sigma.array[:] = sigma
        self._offset.send()
        self._sigma.send()
        for state in self._states[self._now].values():
            state.zero()

    def reset(self, lane: int) -> None:
        """Zero the state of one lane."""
        for state in self._states[self._now].values():
            state.zero(lane)

    def run(self) -> NDArray[np.float32]:
        """Run one step; return (lane, class) logits, a buffer that the next step overwrites."""
        self._samples.send()
        with self._flush:
            self._session.run_with_iobinding(self._steps[self._now])
        self._now = 1 - self._now
        logits: NDArray[np.float32] = self._outputs["logits"].array
        return logits

    def _bind(self, before: Mapping[str, Tensor], after: Mapping[str, Tensor]) -> Any:
        """Bind the buffers of a step that reads `before` and writes `after`."""
        inputs = {
            "samples": self._samples, "offset": self._offset, "sigma": self._sigma, **before,
        }  # fmt: skip
        outputs = {**self._outputs, **{f"{k}_next": v for k, v in after.items()}}
        binding = self._session.io_binding()
        for name, tensor in inputs.items():
            binding.bind_ortvalue_input(name, tensor.value)
        for name, tensor in outputs.items():
            binding.bind_ortvalue_output(name, tensor.value)
        return binding
