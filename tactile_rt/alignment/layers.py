"""Responses of a model's layers to the stimuli, from any kind of model file."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

PARTS = ("encoder", "attender", "decoder")  # every layer's name is PART.NAME
SAME = 1e-6  # relative difference that rounding may cause between equal inputs of a batch


@dataclass(frozen=True, eq=False)
class Layers:
    """The responses of a model's layers to the stimuli, with facts about the model."""

    name: str
    # responses of each layer, by name: (6, step, unit) float32
    traces: Mapping[str, NDArray[np.float32]]
    first: Mapping[str, int]  # first step that input can reach, by the name of the layer
    logits: NDArray[np.float32]  # (6, step, class) output of the model, float32
    parameters: int
    precision: str = "fp32"
    sha256: str = ""  # SHA-256 sum of the model's file, hex; empty for a network in memory
    network: Mapping[str, object] = field(default_factory=dict)
    training: Mapping[str, object] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @property
    def patterns(self) -> dict[str, NDArray[np.float64]]:
        """Mean responses (6, unit) by layer, over the steps that input can reach."""
        return {
            name: trace[:, self.first[name] :].mean(axis=1, dtype=np.float64)
            for name, trace in self.traces.items()
        }


def table(value: object) -> Mapping[str, object]:
    """Return a value if it is a dictionary, else an empty dictionary."""
    return value if isinstance(value, dict) else {}


def first_difference(trace: NDArray[np.float32]) -> int:
    """Find the first step of (6, step, unit) at which stimuli differ; 0 if none.

    Before that step no stimulus has reached the layer.
    """
    spread = np.ptp(trace, axis=0).max(axis=1, initial=0.0)
    differs = spread > SAME * np.abs(trace).max(initial=0.0)
    return int(differs.argmax())
