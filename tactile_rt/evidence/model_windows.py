"""A model file over whole windows of many sweeps, stepped as on a robot."""

from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_card import ModelCard
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
    names = [o.name for o in session.get_outputs()]
    divisor, kept = np.float32(1), slice(None)
    if output == "logits":
        divisor = np.float32(card.temperature)
        kept = slice(len(card.labels) if refusals else len(card.classes))

    def run(
        samples: NDArray[np.float32], offset: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        feed: dict[str, NDArray[Any]] = {"offset": offset, "sigma": sigma}
        feed |= {s.name: np.zeros((len(samples), *s.shape), dtype=s.dtype) for s in card.state}
        steps = []
        for t in range(samples.shape[1]):
            feed["samples"] = samples[:, t]
            out = dict(zip(names, session.run(None, feed), strict=True))
            feed |= {s.name: out[f"{s.name}_next"] for s in card.state}
            steps.append(out[output][:, kept] / divisor)
        return np.stack(steps, axis=1)

    return run
