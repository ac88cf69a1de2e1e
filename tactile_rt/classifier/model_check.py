"""Does a model file compute here what it did where it was made?"""

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_file import ModelCard, load_model, read_model
from tactile_rt.classifier.onnx_check import graph_sha256
from tactile_rt.stream import ModelError

__all__ = ["probe_logits", "verify_model"]

# Of the probe's logits, over their spread: sums are rounded in another order on another processor,
# and int8 activations then fall on the other side of a step now and then.
PROBE_BARS = {"fp32": 1e-4, "fp16": 1e-2, "bf16": 1e-2, "int8": 0.1}


def probe_logits(session: ort.InferenceSession, card: ModelCard) -> NDArray[np.float32]:
    """Run one episode of built-in input, the same on every machine: logits (step, class).

    The input is made by integer and exact arithmetic only: a heavy-tailed sequence that reaches
    from below the scale of the input compression to above its clip.
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
    feed: dict[str, NDArray[Any]] = {"offset": offset, "sigma": sigma}
    if card.kind == "window":
        window: NDArray[np.float32] = session.run(["logits"], {"samples": samples, **feed})[0][0]
        return window
    feed |= {s.name: np.zeros((1, *s.shape), dtype=s.dtype) for s in card.state}
    names = [o.name for o in session.get_outputs()]
    logits = []
    for t in range(card.steps):
        out = dict(zip(names, session.run(names, {"samples": samples[:, t], **feed}), strict=True))
        feed |= {s.name: out[f"{s.name}_next"] for s in card.state}
        logits.append(out["logits"][0])
    return np.stack(logits)


def verify_model(path: Path) -> list[str]:
    """Check a file against what it says of itself: one line for each thing checked.

    Raises:
        ModelError: as `load_model`; the graph is not the one that was exported, or this machine
            computes other logits than those stored.
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
    logits = probe_logits(session, card)
    if not np.isfinite(logits).all():
        raise ModelError(f"{path}: the probe episode gives logits that are not finite")
    if not np.array_equal(logits, probe_logits(session, card)):
        raise ModelError(f"{path}: the probe episode gives other logits when run again")
    said.append(f"probe: {card.steps} finite steps, the same again after a reset")
    if not card.probe:
        return [*said, "parity: the file stores no logits to compare with"]
    expected = np.array(card.probe)
    bar = PROBE_BARS[card.precision] * max(1.0, float(expected.std()))
    worst = float(abs(logits - expected).max())
    if worst > bar:
        raise ModelError(
            f"{path}: logits of the probe episode differ by {worst:.1e} from those stored "
            f"(at most {bar:.1e} is allowed): damage, or arithmetic unlike where it was made"
        )
    return [*said, f"parity: logits within {worst:.1e} of those stored (bar {bar:.1e})"]
