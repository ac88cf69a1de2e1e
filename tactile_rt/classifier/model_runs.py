"""Episodes run through a model file in one go: to measure it, and to see whether it is whole.

A robot runs a file by the `Stepper`, a step at a time as samples come. Here whole windows are
known beforehand, and all outputs are kept.
"""

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.model_file import load_model, read_model
from tactile_rt.classifier.onnx_check import graph_sha256
from tactile_rt.core.errors import ModelError

__all__ = ["file_outputs", "probe_logits", "verify_model"]

Floats = NDArray[np.float32]
# Of the probe's logits, over their spread: sums are rounded in another order on another processor,
# and int8 activations then fall on the other side of a step now and then.
PROBE_BARS = {"fp32": 1e-4, "fp16": 1e-2, "bf16": 1e-2, "int8": 0.1}


def file_outputs(
    session: ort.InferenceSession, card: ModelCard, samples: Floats, offset: Floats, sigma: Floats
) -> dict[str, Floats]:
    """What a file of either kind says of windows, each from a state of zeros.

    Args:
        session, card: the file, as `load_model` gives it.
        samples: (batch, step, sub-step, element, channel), SI.
        offset, sigma: (batch, element, channel), SI.

    Returns:
        ``logits`` (batch, step, class) and ``embedding`` (batch, step, unit).
    """
    wanted = ["logits", "embedding"]
    feed: dict[str, NDArray[Any]] = {"offset": offset, "sigma": sigma}
    if card.kind == "window":
        windows = session.run(wanted, {"samples": samples, **feed})
        return dict(zip(wanted, windows, strict=True))
    feed |= {s.name: np.zeros((len(samples), *s.shape), dtype=s.dtype) for s in card.state}
    names = [*wanted, *(f"{s.name}_next" for s in card.state)]
    kept: dict[str, list[Floats]] = defaultdict(list)
    for t in range(samples.shape[1]):
        out = dict(zip(names, session.run(names, {"samples": samples[:, t], **feed}), strict=True))
        feed |= {s.name: out[f"{s.name}_next"] for s in card.state}
        for name in wanted:
            kept[name].append(out[name])
    return {name: np.stack(steps, axis=1) for name, steps in kept.items()}


def probe_logits(session: ort.InferenceSession, card: ModelCard) -> Floats:
    """Run one episode of built-in input, the same on every machine: logits (step, class)."""
    logits: Floats = file_outputs(session, card, *_probe(card))["logits"][0]
    return logits


def verify_model(path: Path) -> list[str]:
    """Check a file against what it says of itself: one line for each thing checked.

    Raises:
        ModelError: as `load_model`; the graph is not the one that was exported, this machine
            computes other logits than those stored, or a sample that is no number outlives its
            step.
    """
    session, card = load_model(path, kind=None)
    said = []
    if stored := card.hashes.get("graph"):
        found = graph_sha256(read_model(path)[2])
        if found != stored:
            raise ModelError(f"{path}: the graph is another than was exported: sha256 {found}")
        said.append(f"graph: as it was exported, sha256 {found}")
    else:
        said.append("graph: the file stores no hash of it")
    samples, offset, sigma = _probe(card)
    outputs = file_outputs(session, card, samples, offset, sigma)
    if bad := [name for name, values in outputs.items() if not np.isfinite(values).all()]:
        raise ModelError(f"{path}: the probe episode gives `{bad[0]}` that is not finite")
    if not _same(outputs, file_outputs(session, card, samples, offset, sigma)):
        raise ModelError(f"{path}: the probe episode gives other logits when run again")
    said.append(f"probe: {card.steps} finite steps, the same again after a reset")
    said.append(f"embedding: {card.embedding} units, finite")
    samples[:, 0] = offset[:, None]
    at_rest = file_outputs(session, card, samples, offset, sigma)
    samples[:, 0] = np.resize((np.nan, np.inf, -np.inf), samples[:, 0].shape)
    if not _same(file_outputs(session, card, samples, offset, sigma), at_rest):
        raise ModelError(f"{path}: a sample that is no number is not taken for no load")
    said.append("bad samples: NaN and infinity are no load")
    if not card.probe:
        return [*said, "parity: the file stores no logits to compare with"]
    logits, expected = outputs["logits"][0], np.array(card.probe)
    bar = PROBE_BARS[card.precision] * max(1.0, float(expected.std()))
    worst = float(abs(logits - expected).max())
    if worst > bar:
        raise ModelError(
            f"{path}: logits of the probe episode differ by {worst:.1e} from those stored "
            f"(at most {bar:.1e} is allowed): damage, or arithmetic unlike where it was made"
        )
    return [*said, f"parity: logits within {worst:.1e} of those stored (bar {bar:.1e})"]


def _same(found: dict[str, Floats], expected: dict[str, Floats]) -> bool:
    return all(np.array_equal(found[name], expected[name]) for name in expected)


def _probe(card: ModelCard) -> tuple[Floats, Floats, Floats]:
    """Samples, offset and sigma of the probe episode, a batch of one.

    Made by integer and exact arithmetic only: a heavy-tailed sequence that reaches from below the
    scale of the input compression to above its clip.
    """
    elements, channels = card.array.shape
    shape = (card.steps + 2, card.substeps, elements, channels)
    index = np.arange(np.prod(shape), dtype=np.uint64)
    mixed = (index + np.uint64(1)) * np.uint64(2654435761) % np.uint64(2**32)
    for shift, factor in ((15, 2246822519), (13, 3266489917), (16, 1)):  # as xxHash ends
        mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor) % np.uint64(2**32)
    uniform = mixed.astype(np.float64) / 2**31 - 1  # [-1, 1)
    values = (uniform / (1.001 - abs(uniform))).reshape(shape) * np.array(card.scale)
    samples = values[: card.steps].astype(np.float32)[None]
    offset = values[card.steps, 0].astype(np.float32)[None]
    sigma = np.maximum(abs(values[card.steps + 1, 0]), card.floor).astype(np.float32)[None]
    return samples, offset, sigma
