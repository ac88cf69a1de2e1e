"""Activations of every layer of an ONNX file, for the six stimuli.

Layers become further outputs of a copy of the graph in memory; the file stays as it is, and so,
bitwise, does what it decides: `onnx_layers` runs both and says if not. A step is run for the 22
steps of a stimulus, a window, which is a `Scan` over the same step, once.
"""

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.alignment.layers import Layers, first_difference, table
from tactile_rt.alignment.onnx_taps import (
    GRU_LAYERS,
    named_taps,
    precision_of,
    step_graph,
)
from tactile_rt.alignment.stimuli_input import STEPS, StimuliInput
from tactile_rt.classifier.model_file import ModelCard, load_model
from tactile_rt.classifier.runtime import FlushDenormals
from tactile_rt.core.errors import ModelError, TactileError

__all__ = ["onnx_layers", "with_outputs"]

Floats = NDArray[np.float32]
TOKENS = 2  # of a GPT attender's step, the action token last
REASON = 120  # characters of what onnxruntime says
TAP = "tap:"  # prefix of the outputs that are added


def onnx_layers(path: Path, stimuli: StimuliInput) -> tuple[Layers, ModelCard]:
    """Read the layers of a step or window file, and its card."""
    with _readable(path):
        plain, card, model = _opened(path, stimuli)
        taps = named_taps(model)
        tensors = list(dict.fromkeys(taps.values()))
        logits, _ = _run(plain, stimuli, card, ())
        session = _session(with_outputs(model, tensors))
        tapped, found = _run(session, stimuli, card, tensors)
        traces = _traces(taps, found)
        unlike, found = _run(session, _unlike(stimuli), card, tensors)
        others = _traces(taps, found)
    notes = []
    if not np.array_equal(logits, tapped):
        worst = float(np.abs(logits - tapped).max())
        notes.append(f"taps changed the logits by up to {worst:.1e}: the runtime fuses otherwise")
    if not traces:
        traces["decoder.logits"], others["decoder.logits"] = logits, unlike
        notes.append("no layer but the logits: the graph's parameters have lost their names")
    return Layers(
        name=card.name,
        traces=traces,
        first={k: first_difference(np.concatenate([t, others[k]])) for k, t in traces.items()},
        logits=logits,
        parameters=sum(int(np.prod(i.dims)) for i in model.graph.initializer if len(i.dims) > 1),
        precision=precision_of(model),
        sha256=hashlib.sha256(path.read_bytes()).hexdigest(),
        network=table(card.provenance.get("network")),
        training=table(card.provenance.get("training")),
        notes=tuple(notes),
    ), card


def with_outputs(model: onnx.ModelProto, tensors: Iterable[str]) -> onnx.ModelProto:
    """A copy whose tensors are outputs too, ``tap:`` and their name; of a window for every step."""
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    graph, scan = step_graph(copy)
    known = {v.name: v.type for v in (*graph.value_info, *graph.output)}
    for name in tensors:
        # By a node of its own: a tensor that is an output already may not be one again.
        graph.node.append(onnx.helper.make_node("Identity", [name], [f"{TAP}{name}"]))
        # Without a type the runtime infers it, as it must for tensors of a quantised graph.
        graph.output.append(onnx.ValueInfoProto(name=f"{TAP}{name}", type=known.get(name)))
        if scan is not None:
            scan.output.append(f"{TAP}{name}_steps")
            copy.graph.output.append(onnx.ValueInfoProto(name=f"{TAP}{name}_steps"))
            for axes in (a for a in scan.attribute if a.name == "scan_output_axes"):
                axes.ints.append(0)  # as it is unless told
    return copy


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    """Say of which file it is that onnxruntime cannot run it, or that it is not as ours are."""
    try:
        yield
    except TactileError:
        raise
    except Exception as error:  # onnxruntime raises a dozen unrelated types
        reason = " ".join(str(error).split())[:REASON] or type(error).__name__
        raise ModelError(f"{path}: its layers cannot be read ({reason})") from None


def _opened(
    path: Path, stimuli: StimuliInput
) -> tuple[ort.InferenceSession, ModelCard, onnx.ModelProto]:
    session, card = load_model(path, kind=None)
    stimuli.check(card.array, card.steps, card.substeps, str(path), card.period_ns)
    model = onnx.load(path, load_external_data=False)
    if card.kind == "window" and step_graph(model)[1] is None:
        raise ModelError(f"{path} is a window that is no Scan over a step: its layers are unknown")
    return session, card, model


def _session(model: onnx.ModelProto) -> ort.InferenceSession:
    """With the options of `load_model`, so that it computes the same."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    options.log_severity_level = 4
    with FlushDenormals():
        return ort.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )


def _run(
    session: ort.InferenceSession,
    loads: StimuliInput,
    card: ModelCard,
    tensors: Sequence[str],
) -> tuple[Floats, dict[str, Floats]]:
    """Logits (stimulus, step, class) and tensors (stimulus, step, ...).

    One stimulus at a time, so that no axis is taken for the batch's.
    """
    window = card.kind == "window"
    end = "_steps" if window else ""
    wanted = [f"{TAP}{name}{end}" for name in tensors]
    states = [f"{s.name}_next" for s in card.state]
    logits: list[Floats] = []
    found: dict[str, list[Floats]] = {name: [] for name in tensors}
    for i in range(len(loads.samples)):
        feed: dict[str, NDArray[Any]] = {
            "offset": loads.offset[i : i + 1],
            "sigma": loads.sigma[i : i + 1],
            **{s.name: np.zeros((1, *s.shape), dtype=s.dtype) for s in card.state},
        }
        if window:
            feed["samples"] = loads.samples[i : i + 1]
            first, *rest = session.run(["logits", *wanted], feed)
            logits.append(first[0])
            for name, values in zip(tensors, rest, strict=True):
                found[name].append(values)
            continue
        steps: list[list[Floats]] = []
        for t in range(STEPS):
            feed["samples"] = loads.samples[i : i + 1, t]
            out = session.run(["logits", *wanted, *states], feed)
            steps.append(out[: 1 + len(wanted)])
            following = out[1 + len(wanted) :]
            feed |= {s.name: v for s, v in zip(card.state, following, strict=True)}
        logits.append(np.concatenate([step[0] for step in steps]))
        for k, name in enumerate(tensors):
            found[name].append(np.stack([step[1 + k] for step in steps]))
    return np.stack(logits), {name: np.stack(values) for name, values in found.items()}


def _unlike(stimuli: StimuliInput) -> StimuliInput:
    """Input that differs from the first step on: loads at random, as high as those of the stimuli.

    Stimuli may begin alike, and which steps input can reach is a matter of the network alone.
    """
    highest = np.abs(stimuli.samples).max(axis=(0, 1, 2))
    drawn = np.random.default_rng(0).uniform(-1, 1, stimuli.samples.shape)
    return replace(stimuli, samples=(drawn * highest).astype(np.float32))


def _traces(taps: Mapping[str, str], found: Mapping[str, Floats]) -> dict[str, Floats]:
    """By layer, (stimulus, step, unit)."""
    traces: dict[str, Floats] = {}
    for layer, tensor in taps.items():
        values = found[tensor]
        if layer == GRU_LAYERS:
            traces |= {f"encoder.layer{i}": values[:, :, 0, i] for i in range(values.shape[3])}
        else:
            traces[layer] = _trace(layer, values)
    return traces


def _trace(layer: str, values: Floats) -> Floats:
    """(stimulus, step, 1, ...) -> (stimulus, step, unit); of a GPT's tokens the action token.

    The exporter may have made one axis of batch and token.
    """
    if layer.startswith("attender."):
        rows = values.reshape(*values.shape[:2], -1, values.shape[-1])
        values = rows[:, :, -1] if rows.shape[2] == TOKENS else values
    return values.reshape(*values.shape[:2], -1)
