"""Model files: one ONNX file each, whose metadata holds everything needed to run it.

Inputs of the graph, one step of a stream, for a batch of independent streams:

    samples  (batch, sub-step, element, channel) float32, SI, as the array delivers them
    offset   (batch, element, channel) float32, SI: the baseline
    sigma    (batch, element, channel) float32, SI: noise per sample, measured with the baseline
    <state>  every tensor of `ModelCard.state`, all zeros when an episode begins

Outputs: ``logits (batch, class)``, ``embedding (batch, unit)`` (the input of the network's last
linear layer in this step, or, if it was trained to tell objects apart, a vector of length 1 from
all steps so far), ``names (batch, name)`` of models with `ModelCard.kinds` (logits; the softmax is
taken over the kinds of one class) and for every state tensor ``<name>_next``, its next value.
Units, clipping, scaling and the layout on the grid are inside the graph, where a sample that is NaN
or infinite counts as no load and leaves nothing in the state.

A file of kind "window" takes a whole episode instead: ``samples (batch, step, sub-step, element,
channel)``, no state, and gives the other outputs with a step axis after the batch's.
"""

import hashlib
import re
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_card import (
    Kind,
    ModelCard,
    StateTensor,
    element_order,
    fit_source,
    one_line,
    parse_card,
)
from tactile_rt.classifier.onnx_check import MAX_BYTES, BadModel, Contents, graph_sha256, read_onnx
from tactile_rt.classifier.runtime import FlushDenormals
from tactile_rt.core.errors import ConfigError, ModelError
from tactile_rt.core.files import POINTER, is_pointer

__all__ = [
    "METADATA_KEY",
    "ModelCard",
    "StateTensor",
    "element_order",
    "file_outputs",
    "fit_source",
    "hash_of",
    "load_model",
    "output_sizes",
    "probe_logits",
    "read_model",
    "shipped_model",
    "verify_model",
]

METADATA_KEY = "tactile_rt"
MESSAGE = 300  # characters quoted from a file or from onnxruntime
Described = tuple[tuple[Any, ...], str]
SHIPPED = Path(__file__).parents[1] / "assets" / "mouse13.onnx"


def shipped_model() -> Path:
    """Return the path of the packaged model: twelve shapes, on the right mouse array."""
    return SHIPPED


def hash_of(model: Path) -> str:
    """Return the SHA-256 (hex) of a model's file.

    Raises:
        ConfigError: The file cannot be read.
    """
    try:
        return hashlib.sha256(model.read_bytes()).hexdigest()
    except OSError as error:
        raise ConfigError(f"model {model} cannot be read: {error.strerror}") from None


def read_model(path: Path, kind: Kind | None = None) -> tuple[ModelCard, Contents, bytes]:
    """Read a model file without running it; return card, contents and bytes.

    Args:
        path: The ``.onnx`` file.
        kind: The required kind of model, or None for any.

    Raises:
        ModelError: The file is of another kind, missing, too large, not ONNX, refers to other files
            or exceeds the limits of `onnx_check`; or its metadata is missing, damaged, of another
            version, or names other inputs and outputs than the graph.
    """
    if not path.is_file():
        raise ModelError(f"no model file {path}")
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise ModelError(f"{path} is not a readable ONNX model: {size} bytes is too large")
    data = b""
    try:
        data = path.read_bytes()
        contents = read_onnx(data)
    except (BadModel, OSError) as error:
        reason = error.strerror if isinstance(error, OSError) else _describe_mistake(data) or error
        raise ModelError(f"{path} is not a readable ONNX model: {reason}") from None
    text = contents.metadata.get(METADATA_KEY)
    if text is None:
        raise ModelError(
            f"{path} is ONNX but not a tactile_rt model: no {METADATA_KEY!r} metadata "
            "(export it with `tactile-rt export`)"
        )
    card = parse_card(path, text)
    if kind is not None and card.kind != kind:
        raise ModelError(f"{path} is a model of kind {card.kind!r}; this needs {kind!r}")
    named = {"samples", "offset", "sigma", *(s.name for s in card.state)}
    if wrong := sorted(named ^ set(contents.inputs)):
        raise _make_input_error(path, wrong)
    for name in (*output_sizes(card), *(f"{s.name}_next" for s in card.state)):
        if name not in contents.outputs:
            raise ModelError(f"{path}: no output `{one_line(name)}`, which its metadata promises")
    return card, contents, data


def load_model(
    path: Path,
    providers: Sequence[str] = ("CPUExecutionProvider",),
    kind: Kind | None = "step",
) -> tuple[ort.InferenceSession, ModelCard]:
    """Open a model file for inference; return the session and the card.

    Args:
        path: The ``.onnx`` file.
        providers: onnxruntime's execution providers in the order of preference.
        kind: The required kind of model, or None for any.

    Raises:
        ModelError: See `read_model`; or onnxruntime cannot run the graph, or the graph disagrees
            with the card.
        ConfigError: This onnxruntime lacks a provider, or cannot use it here.
    """
    available = ort.get_available_providers()
    for provider in providers:
        if provider not in available:
            raise ConfigError(f"no {provider} in this onnxruntime: it has {', '.join(available)}")
    card, _, data = read_model(path, kind)
    options = ort.SessionOptions()
    # A 1 ms step gains nothing from more threads, and the robot has other work for its cores.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    # For helper threads. onnxruntime may change this thread's mode for good: see `FlushDenormals`.
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    options.log_severity_level = 4  # failures come as exceptions; the log would repeat them
    # Load as ONNX, as checked, whatever other format the first bytes suggest.
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        # Load the checked bytes, not the file, which may have changed by now.
        with FlushDenormals():  # restores the thread's mode on leaving
            session = ort.InferenceSession(data, options, providers=list(providers))
    except Exception as error:  # onnxruntime raises a dozen unrelated types for a bad file
        raise ModelError(f"{path} is not a readable ONNX model: {_shorten_reason(error)}") from None
    unused = [p for p in providers if p not in session.get_providers()]
    if unused:
        raise ConfigError(f"onnxruntime cannot use {', '.join(unused)} on this machine")
    inputs = {i.name: (tuple(i.shape), i.type) for i in session.get_inputs()}
    outputs = {o.name: (tuple(o.shape), o.type) for o in session.get_outputs()}
    check_graph(card, inputs, outputs, path)
    return session, card


def check_graph(
    card: ModelCard, inputs: Mapping[str, Described], outputs: Mapping[str, Described], path: Path
) -> None:
    """Check that a graph's inputs and outputs agree with the card of its file.

    Args:
        card: The card of the file.
        inputs: The shape and type of each input, the type in onnxruntime's form ``tensor(float)``;
            an unknown axis is not an int, and an unknown shape is empty.
        outputs: The shape and type of each output, in the same form.
        path: The path of the file, for the message.

    Raises:
        ModelError: The graph and the card disagree; the message names where.
    """
    window = card.kind == "window"
    # (shape without the batch axis, element type) of everything the classifier will feed
    without_batch = {name: (shape[1:], kind) for name, (shape, kind) in inputs.items()}
    elements, channels = card.array.shape
    sample = (card.substeps, elements, channels)
    expected: dict[str, tuple[tuple[Any, ...], str]] = {
        "samples": ((card.steps, *sample) if window else sample, _make_onnx_type("float32")),
        "offset": ((elements, channels), _make_onnx_type("float32")),
        "sigma": ((elements, channels), _make_onnx_type("float32")),
        **{s.name: (s.shape, _make_onnx_type(s.dtype)) for s in card.state},
    }
    if window and "samples" in inputs:
        steps = (without_batch["samples"][0] or (0,))[0]
        if not isinstance(steps, int):  # the graph takes any number of steps
            expected["samples"] = ((steps, *sample), _make_onnx_type("float32"))
    wrong = {k for k in without_batch | expected if without_batch.get(k) != expected.get(k)}
    wrong |= {name for name, (shape, _) in inputs.items() if not shape}  # not even a batch
    if wrong:
        raise _make_input_error(path, sorted(wrong))
    batches = {shape[0] for shape, _ in inputs.values()}
    if any(isinstance(batch, int) and batch != 1 for batch in batches):
        raise ModelError(f"{path}: the graph's batch size is fixed, but not to 1")
    for name, size in output_sizes(card).items():
        shape, kind = outputs.get(name, ((), ""))
        if shape[-1:] != (size,) or len(shape) != 2 + window or kind != "tensor(float)":
            what = {"logits": "classes", "embedding": "units", "names": "kinds"}[name]
            raise ModelError(f"{path}: no output `{name}` of {size} {what}")
    for state in card.state:
        shape, kind = outputs.get(f"{state.name}_next", ((), ""))
        # onnxruntime may not know every size before it runs.
        axes = zip(shape[1:], state.shape, strict=False)
        same = all(a == b or not isinstance(a, int) for a, b in axes)
        if not same or len(shape) != 1 + len(state.shape) or kind != _make_onnx_type(state.dtype):
            raise ModelError(f"{path}: no output `{state.name}_next` like `{state.name}`")


def output_sizes(card: ModelCard) -> dict[str, int]:
    """Return the size of each output of the graph except states, by name."""
    sizes = {"logits": len(card.labels), "embedding": card.embedding}
    names = sum(map(len, card.kinds.values()))
    return {**sizes, "names": names} if names else sizes


def _make_input_error(path: Path, wrong: Sequence[str]) -> ModelError:
    names = one_line(", ".join(wrong))[:MESSAGE]
    return ModelError(f"{path}: the graph's inputs disagree with its metadata at {names}")


def _describe_mistake(data: bytes) -> str:
    """Describe a file that is not a model, from its first bytes; "" if unknown."""
    if not data:
        return "it is empty"
    if is_pointer(data):
        return f"it {POINTER}"
    if data.startswith(b"PK\x03\x04"):
        return "it is a zip archive, as checkpoints are; `tactile-rt export` makes a model of one"
    head = data[:100].decode("latin-1")
    if head.isascii() and all(c.isprintable() or c in "\t\r\n" for c in head):
        return "it is text"
    return ""


def _shorten_reason(error: Exception) -> str:
    """Return onnxruntime's message without the locations in onnxruntime's source."""
    text = re.sub(r"^\[ONNXRuntimeError\] : \d+ : \w+ : ", "", one_line(error))
    if newest := re.search(r"Opset (\d+) is .* is till opset (\d+)", text):
        return (
            f"it uses opset {newest[1]}, and onnxruntime {ort.__version__} reads {newest[2]} at "
            "most: update onnxruntime"
        )
    if where := re.match(r"\S+\.(?:cc|h):\d+ [^(]*", text):  # then the function's arguments
        depth = 0
        for at in range(where.end(), len(text)):
            depth += (text[at] == "(") - (text[at] == ")")
            if depth == 0:
                text = text[at + 1 :].strip() or text
                break
    return text[:MESSAGE]


def _make_onnx_type(dtype: str) -> str:
    name = {"float32": "float", "float64": "double"}.get(dtype, dtype)
    return f"tensor({name})"


Floats = NDArray[np.float32]
# Tolerances of the probe's logits, relative to their spread: another processor rounds sums in
# another order, which sometimes moves an int8 activation by one level.
PROBE_BARS = {"fp32": 1e-4, "fp16": 1e-2, "bf16": 1e-2, "int8": 0.1}


def file_outputs(
    session: ort.InferenceSession, card: ModelCard, samples: Floats, offset: Floats, sigma: Floats
) -> dict[str, Floats]:
    """Run a model file of either kind on windows, each from a zero state.

    Args:
        session, card: The model, as `load_model` returns it.
        samples: (batch, step, sub-step, element, channel) The windows, SI.
        offset, sigma: (batch, element, channel) The baseline and its noise, SI.

    Returns:
        ``logits`` (batch, step, class), ``embedding`` (batch, step, unit) and, of a model with
            kinds, ``names`` (batch, step, name).
    """
    outputs = list(output_sizes(card))
    feed: dict[str, NDArray[Any]] = {"offset": offset, "sigma": sigma}
    if card.kind == "window":
        windows = session.run(outputs, {"samples": samples, **feed})
        return dict(zip(outputs, windows, strict=True))
    feed |= {s.name: np.zeros((len(samples), *s.shape), dtype=s.dtype) for s in card.state}
    names = [*outputs, *(f"{s.name}_next" for s in card.state)]
    kept: dict[str, list[Floats]] = defaultdict(list)
    for t in range(samples.shape[1]):
        out = dict(zip(names, session.run(names, {"samples": samples[:, t], **feed}), strict=True))
        feed |= {s.name: out[f"{s.name}_next"] for s in card.state}
        for name in outputs:
            kept[name].append(out[name])
    return {name: np.stack(steps, axis=1) for name, steps in kept.items()}


def probe_logits(session: ort.InferenceSession, card: ModelCard) -> Floats:
    """Run a model on the probe episode, equal on all machines; return logits (step, class)."""
    logits: Floats = file_outputs(session, card, *_make_probe(card))["logits"][0]
    return logits


def verify_model(path: Path) -> list[str]:
    """Check a model file against its metadata; return a line of text for each check.

    Raises:
        ModelError: See `load_model`; or the graph is not the exported one, this machine computes
            other logits than those stored, or a NaN sample affects later steps.
    """
    session, card = load_model(path, kind=None)
    lines = []
    if stored := card.hashes.get("graph"):
        found = graph_sha256(read_model(path)[2])
        if found != stored:
            raise ModelError(f"{path}: the graph is not the exported one: sha256 {found}")
        lines.append(f"graph: as it was exported, sha256 {found}")
    else:
        lines.append("graph: the file stores no hash of it")
    samples, offset, sigma = _make_probe(card)
    outputs = file_outputs(session, card, samples, offset, sigma)
    if bad := [name for name, values in outputs.items() if not np.isfinite(values).all()]:
        raise ModelError(f"{path}: the probe episode gives `{bad[0]}` that is not finite")
    if not _are_equal(outputs, file_outputs(session, card, samples, offset, sigma)):
        raise ModelError(f"{path}: the probe episode gives different logits when run again")
    lines.append(f"probe: {card.steps} finite steps, the same again after a reset")
    lines.append(f"embedding: {card.embedding} units, finite")
    samples[:, 0] = offset[:, None]
    at_rest = file_outputs(session, card, samples, offset, sigma)
    samples[:, 0] = np.resize((np.nan, np.inf, -np.inf), samples[:, 0].shape)
    if not _are_equal(file_outputs(session, card, samples, offset, sigma), at_rest):
        raise ModelError(f"{path}: an invalid (NaN) sample must count as no load")
    lines.append("bad samples: NaN and infinity are no load")
    if not card.probe:
        return [*lines, "parity: the file stores no logits to compare with"]
    logits, expected = outputs["logits"][0], np.array(card.probe)
    bar = PROBE_BARS[card.precision] * max(1.0, float(expected.std()))
    worst = float(abs(logits - expected).max())
    if worst > bar:
        raise ModelError(
            f"{path}: logits of the probe episode differ by {worst:.1e} from those stored "
            f"(at most {bar:.1e} is allowed): damage, or arithmetic unlike where it was made"
        )
    return [*lines, f"parity: logits within {worst:.1e} of those stored (bar {bar:.1e})"]


def _are_equal(found: dict[str, Floats], expected: dict[str, Floats]) -> bool:
    return all(np.array_equal(found[name], expected[name]) for name in expected)


def _make_probe(card: ModelCard) -> tuple[Floats, Floats, Floats]:
    """Return samples, offset and sigma of the probe episode, a batch of one.

    Only integer and exact arithmetic is used, for a heavy-tailed sequence that reaches from below
    the scale of the input compression to above its clip.
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
