"""A trained network as one ONNX file: a streaming step with explicit state.

The graph and its metadata are specified in `tactile_rt.classifier.model_file`; the file alone
is enough to run the model. Before it is written, it is run against the torch window that was
trained.
"""

import hashlib
import logging
import platform
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
import onnx
import onnxruntime
import torch
from torch import Tensor, nn

from tactile_rt.classifier.decision_rules import OpenSetRule, PredictionSetRule
from tactile_rt.classifier.enrolment import IdentityRule
from tactile_rt.classifier.model_card import CARD_VERSION, Kind
from tactile_rt.classifier.model_file import (
    METADATA_KEY,
    ModelCard,
    StateTensor,
    file_outputs,
    load_model,
    probe_logits,
)
from tactile_rt.classifier.onnx_check import graph_sha256
from tactile_rt.core.errors import ModelError
from tactile_rt.core.files import write_whole
from tactile_rt.core.packages import VERSION
from tactile_rt.export.graph_forms import OUTPUTS, Precision, in_precision, window_graph
from tactile_rt.export.streaming import streaming
from tactile_rt.models.ead import TactileClassifier
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.splits import join_manifests, trained_objects

OPSET = 20
PARITY_BAR = 1e-5  # largest difference of logits between the file and the torch window


class StreamingStep(nn.Module):
    """Module that computes one step of a classifier, with its state as inputs and outputs.

    Args:
        integer: whether its products will be quantised, see `streaming`.
    """

    def __init__(self, model: TactileClassifier, integer: bool = False) -> None:
        super().__init__()
        self.inputs = model.inputs
        self.network = streaming(model.network, integer)
        self.names = list(self.network.initial_state(1))

    def forward(
        self, samples: Tensor, offset: Tensor, sigma: Tensor, *state: Tensor
    ) -> tuple[Tensor, ...]:
        """Return logits (batch, class), embedding (batch, unit), names (batch, name), next state.

        Samples are (batch, sub-step, element, channel), SI; some networks have no names output."""
        frame = self.inputs(samples, offset, sigma)
        outputs, following = self.network.step_outputs(
            frame, dict(zip(self.names, state, strict=True))
        )
        results = (outputs[name] for name in OUTPUTS if name in outputs)
        return (*results, *(following[name] for name in self.names))


def export_checkpoint(
    checkpoint: Path,
    trained: tuple[TactileClassifier, dict[str, Any]],
    manifests: Sequence[SweepManifest],
    path: Path,
    name: str,
    temperature: float = 1.0,
    rules: tuple[OpenSetRule | None, tuple[PredictionSetRule, ...]] = (None, ()),
    names: Mapping[str, tuple[PredictionSetRule, ...]] | None = None,
    identity: IdentityRule | None = None,
    figures: dict[str, Any] | None = None,
    precision: Precision = "fp32",
    kind: Kind = "step",
    licence: str = "",
) -> ModelCard:
    """Export a checkpoint of `training.loop.train` as a model file.

    Args:
        trained: the network of the checkpoint, and the checkpoint's contents.
        manifests: the manifests of the sets that it was trained on.
        temperature: divides the logits at run time.
        rules: the open-set rule, and the rules of the prediction sets.
        names: the rules of the prediction sets of kinds, by class.
        identity: the rule that matches touches to enrolled objects.
        kind: "step" or "window".

    Raises:
        ModelError: the exported graph misses the parity bar.
    """
    model, saved = trained
    manifest = join_manifests(manifests)
    refusals = tuple(saved["refusals"])
    engines = sorted({m.versions["engine"] for m in manifests if "engine" in m.versions})
    card = ModelCard(
        name=name,
        spec=saved["spec"],
        period_ns=manifest.period_ns,
        substeps=model.timing.substeps,
        steps=model.timing.steps,
        labels=(*manifest.categories, *refusals),
        refusals=refusals,
        unknown=rules[0],
        candidates=rules[1],
        kinds={name: tuple(kinds) for name, kinds in saved.get("kinds", {}).items()},
        names=dict(names or {}),
        identity=identity,
        state=(),
        clip=tuple(model.inputs.clip.tolist()),
        scale=tuple(model.inputs.scale.tolist()),
        floor=tuple(manifest.limits.floor.tolist()),
        sensor=msgspec.to_builtins(manifest.sensor) if manifest.sensor else {},
        temperature=temperature,
        provenance={
            "checkpoint_sha256": hashlib.sha256(checkpoint.read_bytes()).hexdigest(),
            "training": saved["config"],
            "network": msgspec.json.decode(msgspec.json.encode(saved["network"])),
            "sweep_set": manifest.recipe,
            **({"also": [other.recipe for other in manifests[1:]]} if manifests[1:] else {}),
            "unseen_objects": list(manifests[0].split["test"]),
            "trained_objects": trained_objects(manifests, saved),
            "tactile_rt": VERSION,
            **({"engine": ", ".join(engines)} if engines else {}),  # of the simulated sweeps
            "torch": str(torch.__version__),  # not a plain str, which msgspec insists on
            "onnx": onnx.__version__,
            "onnxruntime": onnxruntime.__version__,
            "python": platform.python_version(),
        },
        figures=dict(figures or {}),
        license=licence,
    )
    return export_step(model, card, path, precision, kind)


def export_step(
    model: TactileClassifier,
    card: ModelCard,
    path: Path,
    precision: Precision = "fp32",
    kind: Kind = "step",
) -> ModelCard:
    """Write a classifier's streaming step, or a whole window, as a model file.

    The card's fields about the graph (state, embedding, kind, precision, hashes, parity, probe) are
    filled in. Parity is that of the graph's worst output in single precision; the effect of less
    precise weights on the same input is ``quantisation_logits``.

    Raises:
        ModelError: the exported graph misses the parity bar.
        ConfigError: no such precision.
    """
    proto, state = step_graph(model, card, integer=precision == "int8")
    return write_model(proto, state, model, card, path, precision, kind)


def step_graph(
    model: TactileClassifier, card: ModelCard, integer: bool = False
) -> tuple[onnx.ModelProto, tuple[StateTensor, ...]]:
    """Export a classifier's step; return its graph in single precision, and its state.

    Args:
        integer: whether its products will be quantised, see `streaming`.
    """
    step = StreamingStep(model.eval(), integer).eval()
    state = step.network.initial_state(2)
    elements, channels = card.array.shape
    arguments = (
        torch.zeros(2, card.substeps, elements, channels),
        torch.zeros(2, elements, channels),
        torch.zeros(2, elements, channels),
        *state.values(),
    )
    batch = torch.export.Dim("batch")
    shapes = [{0: batch} for _ in arguments]
    outputs = OUTPUTS if model.network.config.names else OUTPUTS[:2]
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
            output_names=[*outputs, *(f"{n}_next" for n in state)],
            dynamic_shapes=(shapes[0], shapes[1], shapes[2], tuple(shapes[3:])),
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    # The exporter records each node's place in the source, which only makes the file larger.
    for node in proto.graph.node:
        del node.metadata_props[:]
        node.doc_string = ""
    for value in (*proto.graph.value_info, *proto.graph.input, *proto.graph.output):
        del value.metadata_props[:]
    return proto, tuple(
        StateTensor(
            name,
            tuple(tensor.shape[1:]),
            str(tensor.dtype).removeprefix("torch."),
            in_place=_is_written_by_rows(proto.graph, name),
        )
        for name, tensor in state.items()
    )


def _is_written_by_rows(graph: onnx.GraphProto, state: str) -> bool:
    """Return whether a state is read only by the `ScatterND` that makes its next value."""
    readers = [n for n in graph.node if state in n.input and n.op_type != "Shape"]
    return (
        len(readers) == 1
        and readers[0].op_type == "ScatterND"
        and readers[0].input[0] == state
        and state not in readers[0].input[1:]
        and readers[0].output[0] == f"{state}_next"
    )


def write_model(
    proto: onnx.ModelProto,
    state: tuple[StateTensor, ...],
    model: TactileClassifier,
    card: ModelCard,
    path: Path,
    precision: Precision = "fp32",
    kind: Kind = "step",
) -> ModelCard:
    """Write a graph of `step_graph` as a model file; see `export_step`.

    Raises:
        OSError: the folder cannot be written into, or the medium is full; it names `path`.
    """
    (embedding,) = (o.type.tensor_type.shape for o in proto.graph.output if o.name == "embedding")
    card = msgspec.structs.replace(
        card,
        version=CARD_VERSION,
        state=state,
        embedding=embedding.dim[1].dim_value,
        kind="step",
        precision="fp32",
        opset=OPSET,
    )
    path.parent.mkdir(parents=True, exist_ok=True)

    def fill(file: BinaryIO) -> None:
        nonlocal card
        partial = Path(file.name)  # written again whenever the card has grown
        if kind == "window":
            card = msgspec.structs.replace(card, state=(), kind="window")
        form = window_graph(proto, state) if kind == "window" else proto
        _write(form, card, partial)
        worst = parity(model, partial)
        for name, difference in worst.items():
            if not difference <= PARITY_BAR:  # NaN misses it too
                raise ModelError(
                    f"{path}: {name} of the exported graph: numbers differ by {difference:.1e} "
                    f"from torch's (at most {PARITY_BAR:.0e} is allowed); nothing was written"
                )
        figures = {**card.figures, "parity": max(worst.values())}
        if precision != "fp32":
            form = in_precision(proto, precision)
            form = window_graph(form, state) if kind == "window" else form
            card = msgspec.structs.replace(card, precision=precision)
            _write(form, card, partial)
            figures["quantisation_logits"] = parity(model, partial)["logits"]
        session, _ = load_model(partial, kind=None)
        probe = tuple(tuple(row) for row in probe_logits(session, card).tolist())
        del session
        hashes = {**card.hashes, "graph": graph_sha256(partial.read_bytes())}
        card = msgspec.structs.replace(card, figures=figures, probe=probe, hashes=hashes)
        _write(form, card, partial)

    write_whole(path, fill)
    return card


def _write(proto: onnx.ModelProto, card: ModelCard, path: Path) -> None:
    onnx.helper.set_model_props(proto, {METADATA_KEY: msgspec.json.encode(card).decode()})
    onnx.save(proto, path)


def parity(
    model: TactileClassifier, path: Path, episodes: int = 3, seed: int = 0
) -> dict[str, float]:
    """Return each output's largest difference, over all steps, between a file and torch's window.

    A difference is divided by the output's largest number if that is over 1, as in `align gate`:
    single precision rounds a sum like its largest part. NaN if either output contains NaN.
    """
    session, card = load_model(path, kind=None)
    elements, channels = card.array.shape
    rng = np.random.default_rng(seed)
    scale = np.array(card.scale, dtype=np.float32)
    shape = (episodes, card.steps, card.substeps, elements, channels)
    samples = (rng.standard_cauchy(shape) * scale).astype(np.float32)
    offset = (rng.normal(size=(episodes, elements, channels)) * scale).astype(np.float32)
    sigma = np.abs(offset)
    arrays = [torch.from_numpy(a) for a in (samples, offset, sigma)]
    with torch.inference_mode():
        network, frames = model.eval().network, model.inputs(*arrays)
        expected = {k: v.numpy() for k, v in network.split(network.answer(frames)).items()}
        expected["embedding"] = network.embed(frames).numpy()
    found = file_outputs(session, card, samples, offset, sigma)
    return {
        name: float(np.abs(found[name] - v).max() / max(1.0, float(np.abs(v).max())))
        for name, v in expected.items()
    }
