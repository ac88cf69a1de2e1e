"""A classifier at rest: one ONNX file whose metadata says everything needed to run it.

Inputs of the graph, one step of a stream, for a batch of independent streams:

    samples  (batch, sub-step, element, channel) float32, SI, as the array delivers them
    offset   (batch, element, channel) float32, SI: the tare
    sigma    (batch, element, channel) float32, SI: noise per sample, measured with the tare
    <state>  every tensor of `ModelCard.state`, all zeros when an episode begins

Outputs: ``logits (batch, class)`` and for every state tensor ``<name>_next``, its next value.
Units, clipping, scaling and the layout on the grid are inside the graph.

A file of kind "window" takes a whole episode instead: ``samples (batch, step, sub-step, element,
channel)``, no state, and gives ``logits (batch, step, class)``.

Versions: a release reads every version of the metadata that an older one wrote, and passes over
fields that it does not know; a version is raised only when an older reader would misread a file.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.inference.denormals import FlushDenormals
from tactile_rt.onnx_reading import MAX_BYTES, MAX_ELEMENTS, BadModel, Contents, read_onnx
from tactile_rt.stream import ArraySpec, ConfigError, ModelError, SpecMismatch

__all__ = [
    "METADATA_KEY",
    "ModelCard",
    "StateTensor",
    "element_order",
    "load_model",
    "probe_logits",
    "read_model",
    "shipped_model",
]

METADATA_KEY = "tactile_rt"
CARD_VERSION = 2
CARD_VERSIONS = (1, 2)  # 1: without what `ModelCard` says is since 2
SHIPPED = Path(__file__).parent / "assets" / "mouse24.onnx"
STATE_TYPES = ("bool", "float16", "float32", "float64", "int32", "int64", "int8", "uint8")
MAX_STEPS = 1_000_000
MAX_PERIOD_NS = 10**12
FEEDS = ("samples", "offset", "sigma")

Kind = Literal["step", "window"]


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

    Since version 2:
        kind: "step" or "window", see the module's docstring.
        precision: how weights are stored and multiplied.
        opset: version of ONNX's operators.
        hashes: SHA-256, hex; "graph" is `onnx_reading.graph_sha256` of the file.
        thresholds: posteriors from which a decision may be taken early, by what they promise.
        decision: defaults of the decision modes.
        probe: (step, class) logits of the built-in probe episode, by which `tactile-rt model
            verify` tells whether another machine computes the same.
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
    kind: Kind = "step"
    precision: Literal["fp32", "fp16", "bf16", "int8"] = "fp32"
    opset: int | None = None
    hashes: dict[str, str] = {}
    thresholds: dict[str, float] = {}
    decision: dict[str, Any] = {}
    probe: tuple[tuple[float, ...], ...] = ()

    @property
    def array(self) -> ArraySpec:
        """The array that the model was trained on."""
        return ArraySpec.from_json(self.spec)


def shipped_model() -> Path:
    """The model that comes with the package: 24 categories on the right mouse array."""
    return SHIPPED


def element_order(card_spec: ArraySpec, source_spec: ArraySpec) -> NDArray[np.intp]:
    """Where the source has each element of the model: ``samples[..., order, :]`` feeds the model.

    Name, rate and the order of elements may differ; nothing else may.

    Returns:
        (element,) indices into the source's elements, 0, 1, 2, ... when the order is the same.

    Raises:
        SpecMismatch: the two are different arrays; the message says exactly where.
    """
    mine, theirs = card_spec.elements, source_spec.elements
    if set(mine) == set(theirs):
        order = np.array([theirs.index(element) for element in mine], dtype=np.intp)
        per_element = ("elements", "grid", "positions", "orientations")
        fields = {f: getattr(source_spec, f) for f in source_spec.__dataclass_fields__}
        fields |= {f: tuple(fields[f][i] for i in order) for f in per_element}
        differences = card_spec.differences(ArraySpec(**fields), ignore=("name", "rate_hz"))
    else:
        lacking = [e for e in mine if e not in theirs]
        foreign = [e for e in theirs if e not in mine]
        differences = [f"elements: lacks {', '.join(lacking)}"] if lacking else []
        differences += [f"elements: {', '.join(foreign)} unknown to the model"] if foreign else []
        rest = ("name", "rate_hz", "elements", "grid", "positions", "orientations")
        differences += card_spec.differences(source_spec, ignore=rest)
    if differences:
        raise SpecMismatch("; ".join(differences))
    return order


def read_model(path: Path) -> tuple[ModelCard, Contents, bytes]:
    """Read a model file without running it: its card, what else it holds, its bytes.

    Raises:
        ModelError: not there, too large, not ONNX, reaching outside the file or past the limits
            of `onnx_reading`, without our metadata, or with metadata that is damaged or of
            another version.
    """
    if not path.is_file():
        raise ModelError(f"no model file {path}")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ModelError(f"{path} is not a readable ONNX model: {size} bytes is too large")
    try:
        data = path.read_bytes()
        contents = read_onnx(data)
    except (BadModel, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ModelError(f"{path} is not a readable ONNX model: {reason}") from None
    text = contents.metadata.get(METADATA_KEY)
    if text is None:
        raise ModelError(
            f"{path} is ONNX but not a tactile_rt model: no {METADATA_KEY!r} metadata "
            "(export it with `tactile-rt export`)"
        )
    return _read_card(path, text), contents, data


def load_model(
    path: Path,
    providers: Sequence[str] = ("CPUExecutionProvider",),
    threads: int = 1,
    kind: Kind | None = "step",
) -> tuple[ort.InferenceSession, ModelCard]:
    """Open a model file for inference and read its card.

    Args:
        path: the ``.onnx`` file.
        providers: onnxruntime's execution providers in the order of preference.
        threads: of the CPU's provider. A 1 ms step gains nothing from more than one, and the
            robot has other work for its cores.
        kind: the kind of model that is needed; None takes any.

    Raises:
        ModelError: as `read_model`; or not of this kind, not run by onnxruntime, or the graph
            disagrees with the card.
        ConfigError: this onnxruntime lacks a provider, or cannot use it here.
    """
    available = ort.get_available_providers()
    for provider in providers:
        if provider not in available:
            raise ConfigError(f"no {provider} in this onnxruntime: it has {', '.join(available)}")
    card, _, data = read_model(path)
    if kind is not None and card.kind != kind:
        raise ModelError(f"{path} is a model of kind {card.kind!r}; this needs {kind!r}")
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # For helper threads; this one's mode onnxruntime may change for ever: `FlushDenormals`.
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    options.log_severity_level = 4  # failures come as exceptions; the log would repeat them
    # What was read as ONNX is not to be taken for another format by its first bytes.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        # The bytes that were checked, not the file, which may be another by now.
        with FlushDenormals():  # which in the end puts the thread's mode back
            session = ort.InferenceSession(data, options, providers=list(providers))
    except Exception as error:  # onnxruntime raises a dozen unrelated types for a bad file
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise ModelError(f"{path} is not a readable ONNX model: {reason}") from None
    unused = [p for p in providers if p not in session.get_providers()]
    if unused:
        raise ConfigError(f"onnxruntime cannot use {', '.join(unused)} on this machine")
    return session, _checked(card, session, path)


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


def _read_card(path: Path, text: str) -> ModelCard:
    def damaged(why: object) -> ModelError:
        return ModelError(f"{path} has damaged metadata: {why}")

    try:
        version = msgspec.json.decode(text, type=dict[str, Any]).get("version")
        if version not in CARD_VERSIONS:
            raise ModelError(
                f"{path} has metadata of version {repr(version)[:40]}; this release reads "
                f"{' and '.join(map(str, CARD_VERSIONS))}"
            )
        card = msgspec.json.decode(text, type=ModelCard)
        elements, channels = card.array.shape
    except (msgspec.MsgspecError, ConfigError) as error:
        raise damaged(error) from None
    except RecursionError:
        raise damaged("nested too deeply") from None
    for what in ("clip", "scale", "floor"):
        if len(getattr(card, what)) != channels:
            raise damaged(f"{len(getattr(card, what))} values of {what} for {channels} channels")
    for what in ("period_ns", "substeps", "steps", "temperature", "clip", "scale", "floor"):
        values = np.asarray(getattr(card, what), dtype=np.float64)
        if not (np.all(values > 0) and np.all(np.isfinite(values))):
            raise damaged(f"{what} must be positive")
    if card.steps > MAX_STEPS or card.period_ns > MAX_PERIOD_NS:
        raise damaged(f"{card.steps} steps of {card.substeps} sub-steps of {card.period_ns} ns")
    if not card.labels or len(set(card.labels)) != len(card.labels):
        raise damaged("labels are missing or repeat")
    names = [*FEEDS, *(s.name for s in card.state)]
    if len(set(names)) != len(names):
        raise damaged("names of the state repeat")
    if card.kind == "window" and card.state:
        raise damaged("a window has no state")
    shapes = {s.name: s.shape for s in card.state}
    window = (card.steps,) if card.kind == "window" else ()
    shapes["samples"] = (*window, card.substeps, elements, channels)
    for name, shape in shapes.items():
        # Python's integers: a product of int64 may come round to something small.
        if min(shape, default=1) < 1 or math.prod(shape) > MAX_ELEMENTS:
            raise damaged(f"{name[:40]} of shape {'x'.join(map(str, shape))[:80]}")
    if sum(math.prod(shape) for shape in shapes.values()) > MAX_ELEMENTS:
        raise damaged("its state is larger than any robot's memory should hold")
    for state in card.state:
        if state.dtype not in STATE_TYPES:
            raise damaged(f"{state.name[:40]} of type {state.dtype[:40]!r}")
    if card.probe and [len(row) for row in card.probe] != [len(card.labels)] * card.steps:
        raise damaged(f"the probe is not {card.steps} steps of {len(card.labels)} logits")
    return card


def _checked(card: ModelCard, session: ort.InferenceSession, path: Path) -> ModelCard:
    window = card.kind == "window"
    # (shape without the batch axis, element type) of everything the classifier will feed
    inputs = {i.name: (tuple(i.shape[1:]), i.type) for i in session.get_inputs()}
    elements, channels = card.array.shape
    sample = (card.substeps, elements, channels)
    expected: dict[str, tuple[tuple[Any, ...], str]] = {
        "samples": ((card.steps, *sample) if window else sample, _onnx_type("float32")),
        "offset": ((elements, channels), _onnx_type("float32")),
        "sigma": ((elements, channels), _onnx_type("float32")),
        **{s.name: (s.shape, _onnx_type(s.dtype)) for s in card.state},
    }
    if window and "samples" in inputs and not isinstance((inputs["samples"][0] or (0,))[0], int):
        # A window may be made for any number of steps.
        expected["samples"] = ((inputs["samples"][0][0], *sample), _onnx_type("float32"))
    if inputs != expected:
        wrong = sorted(k for k in inputs | expected if inputs.get(k) != expected.get(k))
        raise ModelError(
            f"{path}: the graph's inputs disagree with its metadata at {', '.join(wrong)}"
        )
    batches = {i.shape[0] for i in session.get_inputs()}
    if any(isinstance(batch, int) and batch != 1 for batch in batches):
        raise ModelError(f"{path}: the graph's batch size is fixed to another than 1")
    outputs = {o.name: (tuple(o.shape[1:]), o.type) for o in session.get_outputs()}
    shape, kind = outputs.get("logits", ((), ""))
    if shape[-1:] != (len(card.labels),) or len(shape) != 1 + window or kind != "tensor(float)":
        raise ModelError(f"{path}: no output `logits` of {len(card.labels)} classes")
    for state in card.state:
        shape, kind = outputs.get(f"{state.name}_next", ((), ""))
        # onnxruntime may not know every size before it runs.
        sizes = zip(shape, state.shape, strict=False)
        same = all(a == b or not isinstance(a, int) for a, b in sizes)
        if not same or len(shape) != len(state.shape) or kind != _onnx_type(state.dtype):
            raise ModelError(f"{path}: no output `{state.name}_next` like `{state.name}`")
    return card


def _onnx_type(dtype: str) -> str:
    name = {"float32": "float", "float64": "double"}.get(dtype, dtype)
    return f"tensor({name})"
