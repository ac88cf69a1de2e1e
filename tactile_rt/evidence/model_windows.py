"""A model file over whole windows of many sweeps, stepped as on a robot."""

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.model_runs import file_outputs
from tactile_rt.models.evaluation import Step

__all__ = ["stepped"]


def stepped(
    session: ort.InferenceSession, card: ModelCard, output: str = "logits", refusals: bool = False
) -> Step:
    """A model file, as `load_model` gives it, as a function of windows.

    Args:
        session, card: the model, of kind "step".
        output: which of its outputs: "logits" (divided by the temperature) or "embedding".
        refusals: whether the logits are to have those of the refusals, too. Without, a posterior is
            what the model would say had it to name a class.

    Returns:
        (samples, offset, sigma) of windows to (batch, step, class or feature).
    """
    divisor, kept = np.float32(1), slice(None)
    if output == "logits":
        divisor = np.float32(card.temperature)
        kept = slice(len(card.labels) if refusals else len(card.classes))

    def run(
        samples: NDArray[np.float32], offset: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        found = file_outputs(session, card, samples, offset, sigma)[output]
        out: NDArray[np.float32] = found[..., kept] / divisor
        return out

    return run
