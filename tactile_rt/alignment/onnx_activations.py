"""Activations of every layer of an ONNX file in response to the six stimuli.

Layers become further outputs of a copy of the graph in memory. The logits of the copy should be
bitwise the same: `onnx_layers` runs both and notes a difference. A step file is run for each of the
22 steps of a stimulus; a window file, which is a `Scan` over the same step, once.

Layers are found by the names of their parameters. Where the exporter folds weights, it keeps the
names of biases and norms (``model.network.attender.norm.bias``), and quantisation keeps these and
the names of tensors. A graph encoder's maps are its recurrent states.
"""

import hashlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.alignment.layers import PARTS, Layers, first_difference, table
from tactile_rt.alignment.stimuli_input import STEPS, StimuliInput
from tactile_rt.classifier.model_file import ModelCard, load_model
from tactile_rt.classifier.runtime import FlushDenormals
from tactile_rt.core.errors import ModelError, explain_errors

QUANTISED = {"MatMulInteger", "ConvInteger", "DynamicQuantizeLinear", "QLinearMatMul",
             "QLinearConv", "DequantizeLinear", "MatMulNBits", "MatMulIntegerToFloat"}  # fmt: skip
GRAPH_NODE = re.compile(r"encoder\.(convs\.|dense\.|drives\.|)(\w+)")
GRU_LAYERS = "encoder.layer*"  # all layers of a GRU are in one tensor (..., layer, feature)
PARAMETER = re.compile(r"(?:model\.)?(?:network\.)?((?:encoder|attender|decoder)(?:\..+)?)\.\w+$")
# (path of a parameter's module, name of the layer, position of the layer relative to the node that
# reads the parameter: its output, the output of the following ReLU or sum, or its input)
RULES = tuple(
    (re.compile(pattern), name, where)
    for pattern, name, where in (
        (r"encoder\.(?:dense|drives)\.(\w+)", "encoder.{}", "activation"),
        (r"encoder\.(fc[78])", "encoder.{}", "activation"),
        (r"encoder\.(embed|out|fc)", "encoder.{}", "output"),
        (r"encoder\.layers\.(fc)", "encoder.{}", "output"),
        (r"encoder\.(stem)\.norm|encoder\.layers\.(stem)", "encoder.stem", "activation"),
        (r"encoder\.blocks\.(\d+)\.second\.norm", "encoder.block{}", "sum"),
        (r"encoder\.layers\.(\d+)_second", "encoder.block{}", "sum"),
        (r"encoder\.(?:encoder\.)?blocks\.(\d+)\.norm", "encoder.block{}", "output"),
        (r"encoder\.encoder\.(embed|out)", "encoder.{}", "output"),
        (r"encoder\.stack\.norms\.([1-9]\d*)", "encoder.block{-1}", "input"),
        (r"encoder\.stack\.norm", "encoder.block3 encoder.norm", "both"),
        (r"attender\.blocks\.(\d+)\.mlp_out", "attender.block{}", "sum"),
        (r"attender\.norms\.([1-9]\d*)", "attender.block{-1}", "input"),
        (r"attender\.(norm|project_out)", "attender.{}", "output"),
        (r"decoder\.0", "decoder.fc1", "activation"),
        (r"decoder\.2", "decoder.fc2", "activation"),
        (r"decoder\.4", "decoder.logits", "output"),
        (r"decoder\.layer2", "decoder.fc2", "activation"),
        (r"decoder\.layer3", "decoder.logits", "output"),
        (r"decoder", "decoder.fc1 decoder.logits", "either"),
    )
)


def step_graph(model: onnx.ModelProto) -> tuple[onnx.GraphProto, onnx.NodeProto | None]:
    """Return the graph of one step and, in a window file, its `Scan` node."""
    for node in model.graph.node:
        if node.op_type == "Scan":
            return next(a.g for a in node.attribute if a.name == "body"), node
    return model.graph, None


def named_taps(model: onnx.ModelProto) -> dict[str, str]:
    """Find each layer's tensor, in the order of computation; skip layers without named weights."""
    graph, _ = step_graph(model)
    readers: dict[str, list[onnx.NodeProto]] = {}
    for node in graph.node:
        for source in node.input:
            readers.setdefault(source, []).append(node)
    place = {o: i for i, node in enumerate(graph.node) for o in node.output}
    # The node of a module is the last that reads one of its parameters: a sum after a product.
    # The exporter merges equal parameters, as in an untrained network, under one of their names:
    # a parameter that several nodes read identifies no module.
    modules: dict[str, onnx.NodeProto] = {}
    for initializer in (*model.graph.initializer, *graph.initializer):
        match = PARAMETER.match(initializer.name)
        reading = readers.get(initializer.name, [])
        while len(reading) == 1 and reading[0].op_type == "Cast":  # for weights in 16 bits
            reading = readers.get(reading[0].output[0], [])
        if match and len(reading) == 1:
            node = reading[0]
            known = modules.get(match[1])
            if known is None or place[node.output[0]] > place[known.output[0]]:
                modules[match[1]] = node
    taps: dict[str, str] = {}
    nodes = {m[2] for path in modules if (m := GRAPH_NODE.match(path))}
    for output in graph.output:
        name = output.name.removesuffix("_h_next")
        if output.name == "gru_h_next":
            taps[GRU_LAYERS] = output.name
        elif name != output.name and name in nodes:
            taps[f"encoder.{name}"] = output.name
    mamba = any(path.startswith("attender.norms.") for path in modules)
    for path, node in modules.items():
        for pattern, name, where in RULES:
            if match := pattern.fullmatch(path):
                number = next((g for g in match.groups() if g), "")
                if mamba and path == "attender.norm":
                    name, where = "attender.block3 attender.norm", "both"
                for layer, tensor in _find_tensors(name, number, where, node, readers):
                    taps.setdefault(layer, tensor)
    if "attender.norm" in taps and "attender.block7" in taps:
        # The last layer of a GPT has no bias to keep its name.
        if product := _find_reader(taps["attender.norm"], readers, "MatMul"):
            taps.setdefault("attender.project_out", product.output[0])
    part = PARTS.index
    return dict(
        sorted(taps.items(), key=lambda item: (part(item[0].split(".")[0]), place[item[1]]))
    )


def precision_of(model: onnx.ModelProto) -> str:
    """Return a model's precision by its operators and weights: int8, fp16, bf16 or fp32."""
    graph, _ = step_graph(model)
    if QUANTISED.intersection(node.op_type for node in graph.node):
        return "int8"
    types = {i.data_type for i in (*model.graph.initializer, *graph.initializer)}
    if onnx.TensorProto.FLOAT16 in types:
        return "fp16"
    return "bf16" if onnx.TensorProto.BFLOAT16 in types else "fp32"


def _find_tensors(
    name: str,
    number: str,
    where: str,
    node: onnx.NodeProto,
    readers: dict[str, list[onnx.NodeProto]],
) -> Iterable[tuple[str, str]]:
    """Yield the layers and tensors of a rule, given the node that reads the parameter."""
    out = node.output[0]
    if where == "input":
        yield f"{name.removesuffix('{-1}')}{int(number) - 1}", node.input[0]
    elif where == "both":
        before, after = name.split()
        yield from ((before, node.input[0]), (after, out))
    elif where == "sum":
        # After a product whose bias has lost its name, the next sum only adds that bias.
        total = None if node.op_type == "MatMul" else _find_reader(out, readers, "Add")
        if total is not None:
            yield name.format(number), _follow_activation(total.output[0], readers)
    elif where == "activation":
        yield name.format(number), _follow_activation(out, readers)
    elif where == "either":  # the first layer of a decoder over all steps, or the only one
        hidden, last = name.split()
        behind = _follow_activation(out, readers)
        yield (hidden, behind) if behind != out else (last, out)
    else:
        yield name.format(number), out


def _find_reader(
    tensor: str, readers: dict[str, list[onnx.NodeProto]], kind: str
) -> onnx.NodeProto | None:
    return next((n for n in readers.get(tensor, []) if n.op_type == kind), None)


def _follow_activation(tensor: str, readers: dict[str, list[onnx.NodeProto]]) -> str:
    """Return the output of the ReLU that follows a tensor, or the tensor itself."""
    at = tensor
    for _ in range(4):
        if (node := _find_reader(at, readers, "Relu")) is not None:
            return str(node.output[0])
        if (node := _find_reader(at, readers, "Add")) is None:
            break
        at = node.output[0]
    return tensor


Floats = NDArray[np.float32]
TOKENS = 2  # tokens per step of a GPT attender, the action token last
REASON = 120  # most characters of a quoted onnxruntime message
TAP = "tap:"  # prefix of the added outputs


def onnx_layers(path: Path, stimuli: StimuliInput) -> tuple[Layers, ModelCard]:
    """Run a step or window file on the stimuli; return its layers and its card."""
    with explain_errors(ModelError, f"{path}: its layers cannot be read (", most=REASON):
        plain, card, model = _open_model(path, stimuli)
        taps = named_taps(model)
        tensors = list(dict.fromkeys(taps.values()))
        logits, _ = _run_stimuli(plain, stimuli, card, ())
        session = _make_session(with_outputs(model, tensors))
        tapped, found = _run_stimuli(session, stimuli, card, tensors)
        traces = _collect_traces(taps, found)
        other, found = _run_stimuli(session, _randomise_loads(stimuli), card, tensors)
        others = _collect_traces(taps, found)
    notes = []
    if not np.array_equal(logits, tapped):
        worst = float(np.abs(logits - tapped).max())
        notes.append(f"taps changed the logits by up to {worst:.1e}: the runtime fuses otherwise")
    if not traces:
        traces["decoder.logits"], others["decoder.logits"] = logits, other
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
    """Return a copy of a model with tensors as further outputs ``tap:NAME``, for every step."""
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    graph, scan = step_graph(copy)
    known = {v.name: v.type for v in (*graph.value_info, *graph.output)}
    for name in tensors:
        # Through an extra node, since a tensor cannot be an output twice.
        graph.node.append(onnx.helper.make_node("Identity", [name], [f"{TAP}{name}"]))
        # The runtime infers a missing type, as for the tensors of a quantised graph.
        graph.output.append(onnx.ValueInfoProto(name=f"{TAP}{name}", type=known.get(name)))
        if scan is not None:
            scan.output.append(f"{TAP}{name}_steps")
            copy.graph.output.append(onnx.ValueInfoProto(name=f"{TAP}{name}_steps"))
            for axes in (a for a in scan.attribute if a.name == "scan_output_axes"):
                axes.ints.append(0)  # the default
    return copy


def _open_model(
    path: Path, stimuli: StimuliInput
) -> tuple[ort.InferenceSession, ModelCard, onnx.ModelProto]:
    session, card = load_model(path, kind=None)
    stimuli.check(card.array, card.steps, card.substeps, str(path), card.period_ns)
    model = onnx.load(path, load_external_data=False)
    if card.kind == "window" and step_graph(model)[1] is None:
        raise ModelError(
            f"{path} is a window model without a Scan over a step: its layers are unknown"
        )
    return session, card, model


def _make_session(model: onnx.ModelProto) -> ort.InferenceSession:
    """Make a session with the options of `load_model`, so that results are the same."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.add_session_config_entry("session.set_denormal_as_zero", "1")
    options.log_severity_level = 4
    with FlushDenormals():
        return ort.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )


def _run_stimuli(
    session: ort.InferenceSession,
    loads: StimuliInput,
    card: ModelCard,
    tensors: Sequence[str],
) -> tuple[Floats, dict[str, Floats]]:
    """Run all stimuli; return logits (stimulus, step, class) and tensors (stimulus, step, ...).

    Stimuli run separately, so that no other axis can be mistaken for the batch's.
    """
    window = card.kind == "window"
    end = "_steps" if window else ""
    outputs = [f"{TAP}{name}{end}" for name in tensors]
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
            first, *rest = session.run(["logits", *outputs], feed)
            logits.append(first[0])
            for name, values in zip(tensors, rest, strict=True):
                found[name].append(values)
            continue
        steps: list[list[Floats]] = []
        for t in range(STEPS):
            feed["samples"] = loads.samples[i : i + 1, t]
            out = session.run(["logits", *outputs, *states], feed)
            steps.append(out[: 1 + len(outputs)])
            following = out[1 + len(outputs) :]
            feed |= {s.name: v for s, v in zip(card.state, following, strict=True)}
        logits.append(np.concatenate([step[0] for step in steps]))
        for k, name in enumerate(tensors):
            found[name].append(np.stack([step[1 + k] for step in steps]))
    return np.stack(logits), {name: np.stack(values) for name, values in found.items()}


def _randomise_loads(stimuli: StimuliInput) -> StimuliInput:
    """Return random loads in the stimuli's range, which differ from the first step on.

    They reveal the first step that input reaches in each layer, even if stimuli begin alike.
    """
    highest = np.abs(stimuli.samples).max(axis=(0, 1, 2))
    drawn = np.random.default_rng(0).uniform(-1, 1, stimuli.samples.shape)
    return replace(stimuli, samples=(drawn * highest).astype(np.float32))


def _collect_traces(taps: Mapping[str, str], found: Mapping[str, Floats]) -> dict[str, Floats]:
    """Collect the responses (stimulus, step, unit) of each layer from the tensors."""
    traces: dict[str, Floats] = {}
    for layer, tensor in taps.items():
        values = found[tensor]
        if layer == GRU_LAYERS:
            traces |= {f"encoder.layer{i}": values[:, :, 0, i] for i in range(values.shape[3])}
        else:
            traces[layer] = _reshape_trace(layer, values)
    return traces


def _reshape_trace(layer: str, values: Floats) -> Floats:
    """Reshape a layer's tensor (stimulus, step, 1, ...) to a trace (stimulus, step, unit).

    Of a GPT's tokens only the action token stays; the exporter may merge batch and token axes.
    """
    if layer.startswith("attender."):
        rows = values.reshape(*values.shape[:2], -1, values.shape[-1])
        values = rows[:, :, -1] if rows.shape[2] == TOKENS else values
    return values.reshape(*values.shape[:2], -1)
