"""A model file over whole windows of many sweeps, stepped as on a robot."""

import numpy as np
import onnxruntime as ort

from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.model_file import file_outputs
from tactile_rt.models.evaluation.measures import Floats, Step

__all__ = ["stepped"]


def stepped(session: ort.InferenceSession, card: ModelCard, refusals: bool = False) -> Step:
    """A model file, as `load_model` gives it, as a function of windows.

    Args:
        refusals: whether the logits are to have those of the refusals, too. Without, a posterior is
            what the model would say had it to name a class.

    Returns:
        (samples, offset, sigma) of windows to (batch, step, class) logits, divided by the
            temperature.
    """
    divisor = np.float32(card.temperature)
    kept = len(card.labels) if refusals else len(card.classes)

    def run(samples: Floats, offset: Floats, sigma: Floats) -> Floats:
        found = file_outputs(session, card, samples, offset, sigma)["logits"]
        return found[..., :kept] / divisor

    return run
