"""A trained network as one ONNX file: a streaming step with explicit state.

The graph and its metadata are specified in `tactile_rt.model_file`; the file alone is enough to
run the model. Before it is written, it is run against the torch window that was trained.
"""

import hashlib
import logging
import os
import platform
import tempfile
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import onnxruntime
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from tactile_rt import __version__
from tactile_rt.contact import CHANNEL_FLOOR
from tactile_rt.model_file import METADATA_KEY, ModelCard, StateTensor, load_model
from tactile_rt.models.datasets import STEPS, SUBSTEPS, channel_values
from tactile_rt.models.training import TactileClassifier, load_checkpoint
from tactile_rt.recording import SweepManifest
from tactile_rt.stream import ModelError

__all__ = ["OPSET", "PARITY_BAR", "StreamingStep", "export_checkpoint", "export_step", "parity"]

OPSET = 20
PARITY_BAR = 1e-5  # largest difference of logits between the file and the torch window


class StreamingStep(nn.Module):
    """One 45 ms step of a classifier with its state as arguments and results."""

    def __init__(self, model: TactileClassifier) -> None:
        super().__init__()
        self.model = model
        self.names = list(model.network.initial_state(1))

    def forward(
        self, samples: Tensor, offset: Tensor, sigma: Tensor, *state: Tensor
    ) -> tuple[Tensor, ...]:
        """(batch, sub-step, element, channel) SI and state -> logits (batch, class) and state."""
        frame = self.model.inputs(samples, offset, sigma)
        logits, following = self.model.network.step(
            frame, dict(zip(self.names, state, strict=True))
        )
        return (logits, *(following[name] for name in self.names))


def export_checkpoint(
    checkpoint: Path,
    path: Path,
    name: str,
    temperature: float = 1.0,
    figures: dict[str, Any] | None = None,
    commands: Sequence[str] = (),
) -> ModelCard:
    """Export what `training.train` saved.

    Args:
        checkpoint: a ``best.pt``.
        path: the ``.onnx`` file to write.
        name: of the model.
        temperature: divides the logits at run time.
        figures: measured accuracies to store in the file.
        commands: that remake the file.

    Raises:
        ModelError: the checkpoint cannot be read, or the exported graph misses the parity bar.
    """
    model, saved = load_checkpoint(checkpoint)
    manifest = SweepManifest.read(Path(saved["config"]["data"]))
    card = ModelCard(
        name=name,
        spec=saved["spec"],
        period_ns=manifest.period_ns,
        substeps=SUBSTEPS,
        steps=STEPS,
        labels=manifest.categories,
        state=(),
        clip=tuple(model.inputs.clip.tolist()),
        scale=tuple(model.inputs.scale.tolist()),
        floor=tuple(channel_values(manifest.spec, CHANNEL_FLOOR).tolist()),
        temperature=temperature,
        provenance={
            "checkpoint_sha256": hashlib.sha256(checkpoint.read_bytes()).hexdigest(),
            "training": saved["config"],
            "network": saved["network"],
            "sweep_set": manifest.recipe,
            "unseen_objects": list(manifest.split["test"]),
            "commands": list(commands),
            "tactile_rt": __version__,
            "torch": str(torch.__version__),  # not a plain str, which msgspec insists on
            "onnx": onnx.__version__,
            "onnxruntime": onnxruntime.__version__,
            "python": platform.python_version(),
        },
        figures=dict(figures or {}),
    )
    return export_step(model, card, path)


def export_step(model: TactileClassifier, card: ModelCard, path: Path) -> ModelCard:
    """Write a classifier's streaming step; `card.state` is filled in.

    Raises:
        ModelError: the exported graph misses the parity bar.
    """
    model = model.eval()
    step = StreamingStep(model).eval()
    state = model.network.initial_state(2)
    card = msgspec.structs.replace(
        card,
        state=tuple(
            StateTensor(n, tuple(t.shape[1:]), str(t.dtype).removeprefix("torch."))
            for n, t in state.items()
        ),
    )
    elements, channels = card.array.shape
    arguments = (
        torch.zeros(2, card.substeps, elements, channels),
        torch.zeros(2, elements, channels),
        torch.zeros(2, elements, channels),
        *state.values(),
    )
    batch = torch.export.Dim("batch")
    shapes = [{0: batch} for _ in arguments]
    with warnings.catch_warnings():
        # The exporter's own deprecations, and that torchvision is missing, are not the user's.
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        program = torch.onnx.export(
            step,
            arguments,
            dynamo=True,
            opset_version=OPSET,
            input_names=["samples", "offset", "sigma", *state],
            output_names=["logits", *(f"{n}_next" for n in state)],
            dynamic_shapes=(shapes[0], shapes[1], shapes[2], tuple(shapes[3:])),
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, partial = tempfile.mkstemp(dir=path.parent, suffix=".partial")
    os.close(handle)
    try:
        _write(proto, card, Path(partial))
        worst = parity(model, Path(partial))
        if not worst <= PARITY_BAR:  # NaN misses it too
            raise ModelError(
                f"{path}: logits of the exported graph differ by {worst:.1e} from torch's "
                f"(at most {PARITY_BAR:.0e} is allowed); nothing was written"
            )
        card = msgspec.structs.replace(card, figures={**card.figures, "parity": worst})
        _write(proto, card, Path(partial))
        os.chmod(partial, 0o644)
        os.replace(partial, path)
    finally:
        Path(partial).unlink(missing_ok=True)
    return card


def _write(proto: onnx.ModelProto, card: ModelCard, path: Path) -> None:
    onnx.helper.set_model_props(proto, {METADATA_KEY: msgspec.json.encode(card).decode()})
    # The exporter records where in the source each node came from: weight without use here.
    for node in proto.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*proto.graph.value_info, *proto.graph.input, *proto.graph.output):
        del value.metadata_props[:]
    onnx.save(proto, path)


def parity(model: TactileClassifier, path: Path, episodes: int = 3, seed: int = 0) -> float:
    """Largest difference of logits, over every step, between a file and the torch window.

    NaN if either computes one.
    """
    session, card = load_model(path)
    elements, channels = card.array.shape
    rng = np.random.default_rng(seed)
    scale = np.array(card.scale, dtype=np.float32)
    shape = (episodes, card.steps, card.substeps, elements, channels)
    samples = (rng.standard_cauchy(shape) * scale).astype(np.float32)
    offset = (rng.normal(size=(episodes, elements, channels)) * scale).astype(np.float32)
    sigma = np.abs(offset)
    with torch.inference_mode():
        expected = model.eval()(*(torch.from_numpy(a) for a in (samples, offset, sigma))).numpy()
    names = [o.name for o in session.get_outputs()]
    feed: dict[str, NDArray[Any]] = {
        s.name: np.zeros((episodes, *s.shape), dtype=s.dtype) for s in card.state
    }
    differences = []
    for t in range(card.steps):
        feed |= {"samples": samples[:, t], "offset": offset, "sigma": sigma}
        out = dict(zip(names, session.run(None, feed), strict=True))
        feed |= {s.name: out[f"{s.name}_next"] for s in card.state}
        differences.append(np.abs(out["logits"] - expected[:, t]).max())
    return float(np.max(differences))  # which keeps a NaN, as Python's own max may not
