"""The network's step, bound once to buffers that are made once.

The state lives in two sets of buffers; a step reads the one and writes the other, by turns. So a
step allocates nothing, and with a GPU the state never leaves it. A cache of which a step writes a
few rows is in both sets the same buffer: onnxruntime then copies nothing.
"""

from collections.abc import Callable

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.network import Network, OnnxruntimeNetwork, Tensor
from tactile_rt.classifier.runtime import FlushDenormals
from tactile_rt.errors import ConfigError

__all__ = ["Stepper"]

WARM_UP = 4  # runs, two of each binding: the first ones allocate, and may even compile


class Stepper:
    """A model file's graph, run step by step in so many lanes at once.

    Args:
        network: the opened graph: of an engine, or a session of onnxruntime.
        card: its metadata.
        lanes: independent streams, the batch axis.

    Attributes:
        samples: (lane, sub-step, element, channel) SI: write the step's input here.
        embedding: (lane, unit) The embedding of the last step, which the next one overwrites; of no
            units if the file has none.

    Raises:
        ConfigError: the graph's batch is fixed to another number than `lanes`.
    """

    def __init__(
        self, network: Network | ort.InferenceSession, card: ModelCard, lanes: int = 1
    ) -> None:
        if isinstance(network, ort.InferenceSession):
            network = OnnxruntimeNetwork(network)
        if network.batch not in (None, lanes):
            raise ConfigError(
                f"model {card.name!r} has a batch fixed to {network.batch}, and {lanes} lanes are "
                "needed: export it with a dynamic batch, or decide by episodes"
            )
        self._network = network
        device = network.device
        elements, channels = card.array.shape
        shape = (lanes, elements, channels)
        self._samples = Tensor((lanes, card.substeps, elements, channels), np.float32, device)
        self._offset = Tensor(shape, np.float32, device)
        self._sigma = Tensor(shape, np.float32, device)
        self._logits = Tensor((lanes, len(card.labels)), np.float32, "cpu")
        self._embedding = Tensor((lanes, card.embedding), np.float32, "cpu")
        first = {s.name: Tensor((lanes, *s.shape), s.dtype, device) for s in card.state}
        second = {
            s.name: first[s.name]
            if s.in_place and network.in_place
            else Tensor((lanes, *s.shape), s.dtype, device)
            for s in card.state
        }
        self._states = (first, second)
        self.samples = self._samples.array
        self.embedding = self._embedding.array
        self._steps = tuple(
            self._bound(self._states[now], self._states[1 - now]) for now in range(2)
        )
        self._now = 0
        self._flush = FlushDenormals()
        self._sigma.array[:] = np.array(card.floor, dtype=np.float32)
        self._sigma.send()
        for _ in range(WARM_UP):
            self.run()
        self.begin(self._offset.array[0], self._sigma.array[0])

    def begin(self, offset: NDArray[np.float32], sigma: NDArray[np.float32]) -> None:
        """Zero the state of every lane, and take a tare (element, channel), SI."""
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
        """Take a step; return (lane, class) logits, a buffer that the next step overwrites."""
        self._samples.send()
        with self._flush:
            self._steps[self._now]()
        self._now = 1 - self._now
        logits: NDArray[np.float32] = self._logits.array
        return logits

    def _bound(self, before: dict[str, Tensor], after: dict[str, Tensor]) -> Callable[[], object]:
        inputs = {
            "samples": self._samples, "offset": self._offset, "sigma": self._sigma, **before,
        }  # fmt: skip
        outputs = {"logits": self._logits, **{f"{k}_next": v for k, v in after.items()}}
        if self.embedding.size:
            outputs["embedding"] = self._embedding
        return self._network.bind(inputs, outputs)
