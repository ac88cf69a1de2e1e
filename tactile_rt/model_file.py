"""A classifier at rest: one ONNX file whose metadata says everything needed to run it.

Inputs of the graph, one step of a stream, for a batch of independent streams:

    samples  (batch, sub-step, element, channel) float32, SI, as the array delivers them
    offset   (batch, element, channel) float32, SI: the tare
    sigma    (batch, element, channel) float32, SI: noise per sample, measured with the tare
    <state>  every tensor of `ModelCard.state`, all zeros when an episode begins

Outputs: ``logits (batch, class)`` and for every state tensor ``<name>_next``, its next value.
Units, clipping, scaling and the layout on the grid are inside the graph.
"""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnxruntime as ort

from tactile_rt.stream import ArraySpec, ConfigError, ModelError

__all__ = ["METADATA_KEY", "ModelCard", "StateTensor", "load_model", "shipped_model"]

METADATA_KEY = "tactile_rt"
CARD_VERSION = 1
SHIPPED = Path(__file__).parent / "assets" / "mouse24.onnx"


class StateTensor(msgspec.Struct, frozen=True):
    """One recurrent state: its name, shape without the batch axis, and element type."""

    name: str
    shape: tuple[int, ...]
    dtype: str


class ModelCard(msgspec.Struct, frozen=True):
    """The metadata of a model file, stored as JSON under ``tactile_rt``.

    Attributes:
        name: of the model.
        spec: JSON of the `ArraySpec` that it was trained on.
        period_ns: sub-step period, ns; the stream is resampled to it.
        substeps: sub-steps per step.
        steps: steps of one episode.
        labels: class names in the order of the logits.
        state: recurrent state tensors.
        clip, scale: (channel,) limits and smallest scale of the input compression, SI.
        floor: (channel,) smallest sigma that the contact detector assumes, SI.
        temperature: divides the logits, fitted on validation sweeps so that probabilities mean
            what they say.
        provenance: what made the file: network, training, data set, hashes, commands.
        figures: what was measured on it: parity, accuracy.
        version: of this schema.
    """

    name: str
    spec: str
    period_ns: int
    substeps: int
    steps: int
    labels: tuple[str, ...]
    state: tuple[StateTensor, ...]
    clip: tuple[float, ...]
    scale: tuple[float, ...]
    floor: tuple[float, ...]
    temperature: float = 1.0
    provenance: dict[str, Any] = {}
    figures: dict[str, Any] = {}
    version: int = CARD_VERSION

    @property
    def array(self) -> ArraySpec:
        """The array that the model was trained on."""
        return ArraySpec.from_json(self.spec)


def shipped_model() -> Path:
    """The model that comes with the package: 12 categories on the right mouse array."""
    return SHIPPED


def load_model(path: Path) -> tuple[ort.InferenceSession, ModelCard]:
    """Open a model file for one-threaded inference and read its card.

    Raises:
        ModelError: not there, not ONNX, without our metadata, of another version, or the graph
            disagrees with the card.
    """
    if not path.is_file():
        raise ModelError(f"no model file {path}")
    options = ort.SessionOptions()
    # One thread: a 1 ms step gains nothing from more, and the robot has other work for its cores.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # failures come as exceptions; the log would repeat them
    try:
        session = ort.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises a dozen unrelated types for a bad file
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ModelError(f"{path} is not a readable ONNX model: {reason}") from None
    text = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY)
    if text is None:
        raise ModelError(
            f"{path} is ONNX but not a tactile_rt model: no {METADATA_KEY!r} metadata "
            "(export it with `tactile-rt export`)"
        )
    return session, _checked(_read_card(path, text), session, path)


def _read_card(path: Path, text: str) -> ModelCard:
    try:
        version = msgspec.json.decode(text, type=dict[str, Any]).get("version")
        if version != CARD_VERSION:
            raise ModelError(
                f"{path} has metadata of version {version!r}; this release reads {CARD_VERSION}"
            )
        card = msgspec.json.decode(text, type=ModelCard)
        channels = card.array.shape[1]
    except (msgspec.MsgspecError, ConfigError) as error:
        raise ModelError(f"{path} has damaged metadata: {error}") from None
    for what in ("clip", "scale", "floor"):
        if len(getattr(card, what)) != channels:
            raise ModelError(
                f"{path} has damaged metadata: {len(getattr(card, what))} values of {what} "
                f"for {channels} channels"
            )
    for what in ("period_ns", "substeps", "steps", "temperature", "clip", "scale", "floor"):
        if not np.all(np.asarray(getattr(card, what)) > 0):
            raise ModelError(f"{path} has damaged metadata: {what} must be positive")
    return card


def _checked(card: ModelCard, session: ort.InferenceSession, path: Path) -> ModelCard:
    # (shape without the batch axis, element type) of everything the classifier will feed
    inputs = {i.name: (tuple(i.shape[1:]), i.type) for i in session.get_inputs()}
    elements, channels = card.array.shape
    expected: dict[str, tuple[tuple[int, ...], str]] = {
        "samples": ((card.substeps, elements, channels), _onnx_type("float32")),
        "offset": ((elements, channels), _onnx_type("float32")),
        "sigma": ((elements, channels), _onnx_type("float32")),
        **{s.name: (s.shape, _onnx_type(s.dtype)) for s in card.state},
    }
    if inputs != expected:
        wrong = sorted(k for k in inputs | expected if inputs.get(k) != expected.get(k))
        raise ModelError(
            f"{path}: the graph's inputs disagree with its metadata at {', '.join(wrong)}"
        )
    batches = {i.shape[0] for i in session.get_inputs()}
    if any(isinstance(batch, int) and batch != 1 for batch in batches):
        raise ModelError(f"{path}: the graph's batch size is fixed to another than 1")
    outputs = {o.name: tuple(o.shape[1:]) for o in session.get_outputs()}
    if outputs.get("logits") != (len(card.labels),):
        raise ModelError(f"{path}: no output `logits` of {len(card.labels)} classes")
    for state in card.state:
        if f"{state.name}_next" not in outputs:
            raise ModelError(f"{path}: no output `{state.name}_next`")
    return card


def _onnx_type(dtype: str) -> str:
    name = {"float32": "float", "float64": "double"}.get(dtype, dtype)
    return f"tensor({name})"
