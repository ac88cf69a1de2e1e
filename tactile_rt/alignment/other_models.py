"""Layers of foreign models: ONNX files without our model card, and torch modules by name.

A layer is the output of a node with weights, after the bias and the activation that follow. The
input is the loads of the six stimuli in SI units, resampled in time if the model's length differs.
"""

import hashlib
import importlib
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import onnx
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.alignment.layers import Layers
from tactile_rt.alignment.stimuli_input import StimuliInput
from tactile_rt.classifier.onnx_check import BadModel, read_onnx
from tactile_rt.core.errors import ConfigError, ModelError, explain_errors

if TYPE_CHECKING:
    from torch import nn

Floats = NDArray[np.float32]
TYPES = {"tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16}
# Operators that only convert weights; that are whole layers; that belong to the layer before.
PASSING = {"Cast", "DequantizeLinear", "Identity", "Reshape", "Squeeze", "Transpose", "Unsqueeze"}
WHOLE = {"If", "Loop", "Scan"}
BEHIND = {"Add", "BatchNormalization", "Clip", "Elu", "Gelu", "HardSigmoid", "HardSwish",
          "LeakyRelu", "Mish", "PRelu", "Relu", "Selu", "Sigmoid", "Softplus", "Tanh"}  # fmt: skip
NUMBERED = re.compile(r"onnx::.*|val_\d+|\d+")  # names that an exporter generates
OTHERWISE = "compute its responses yourself, an .npz of (6, unit) by layer"
REASON = 80  # most characters of a quoted message of other software


def other_onnx_layers(path: Path, stimuli: StimuliInput, input_name: str = "") -> Layers:
    """Run a foreign ONNX file on the six stimuli and return its layers.

    Args:
        input_name: the name of the input for the loads; empty if the file has only one input.

    Raises:
        ConfigError: there is no such input, no input is named among several, or the loads do not
            fit its shape.
        ModelError: the file cannot be read or run.
    """
    data = path.read_bytes()
    try:
        read_onnx(data)
    except BadModel as error:
        raise ModelError(f"{path} is not a readable ONNX model: {error}") from None
    with explain_errors(ModelError, f"{path}: its layers cannot be read (", most=REASON):
        model = onnx.load_model_from_string(data)
        taps = _find_layers(model.graph)
        for name in set(taps.values()) - {o.name for o in model.graph.output}:
            model.graph.output.append(onnx.ValueInfoProto(name=name))
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 4
        session = ort.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )
    inputs = {i.name: i for i in session.get_inputs()}
    if not input_name and len(inputs) == 1:
        (input_name,) = inputs
    if input_name not in inputs:
        names = ", ".join(sorted(inputs))[:REASON]
        raise ConfigError(f"{path}: give --input, the input that takes the loads: {names}")
    given = inputs.pop(input_name)
    if given.type not in TYPES:
        raise ConfigError(f"{path}: input {input_name} is {given.type}, not of reals: {OTHERWISE}")
    feed = {other.name: _make_zeros(path, other) for other in inputs.values()}
    loads = fit_loads(stimuli, given.shape, f"{path}: input {input_name}")
    found: dict[str, list[NDArray[Any]]] = {layer: [] for layer in taps}
    with explain_errors(ModelError, f"{path}: does not run on the stimuli (", most=REASON):
        for one in loads:
            feed[input_name] = one[None].astype(TYPES[given.type])
            values = session.run(list(taps.values()), feed)
            for layer, value in zip(taps, values, strict=True):
                found[layer].append(np.asarray(value))
    samples = stimuli.samples.shape[1] * stimuli.samples.shape[2]
    weights = sum(int(np.prod(i.dims)) for i in model.graph.initializer if len(i.dims) > 1)
    layers = _make_layers(path.stem, found, samples, weights, hashlib.sha256(data).hexdigest())
    zeros = (f"zeros for its input {name}" for name in sorted(inputs))
    return replace(layers, notes=(*layers.notes, *zeros))


def module_layers(reference: str, stimuli: StimuliInput) -> Layers:
    """Run a torch module on the six stimuli and return its layers.

    A layer is the output of a module with weights of its own.

    Args:
        reference: ``module:function``; the function, without arguments, returns a torch module that
            takes loads (1, sample, element, channel) float32, N and N m, every 9 ms.

    Raises:
        ConfigError: the function does not exist, or returns no torch module.
        ModelError: the module cannot be made or run.
    """
    import torch
    from torch import nn

    where, _, name = reference.partition(":")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())  # as `python -m` finds modules
    with explain_errors(ConfigError, f"{reference}: cannot be imported (", most=REASON):
        make: Callable[[], nn.Module] = getattr(importlib.import_module(where), name)
    with explain_errors(ModelError, f"{reference}: fails (", most=REASON):
        network = make()
    if not isinstance(network, nn.Module):
        raise ConfigError(f"{reference} makes a {type(network).__name__}, not a torch module")
    found: dict[str, list[NDArray[Any]]] = {}
    for layer, module in _find_weighted_modules(network):
        found[layer] = []

        def keep(_module: object, _given: object, out: Any, layer: str = layer) -> None:
            value = out[0] if isinstance(out, tuple | list) else out
            if isinstance(value, torch.Tensor):
                found[layer].append(value.detach().float().numpy())

        module.register_forward_hook(keep)
    samples = stimuli.samples.reshape(len(stimuli.samples), -1, *stimuli.samples.shape[3:])
    shape = (1, *samples.shape[1:])
    why = f"{reference}: fails on {shape} ("
    with torch.no_grad(), explain_errors(ModelError, why, most=REASON):
        network.eval()
        for one in samples:
            network(torch.from_numpy(one[None].copy()))
    once = {layer: values for layer, values in found.items() if len(values) == len(samples)}
    weights = sum(p.numel() for p in network.parameters())
    return _make_layers(name, once, samples.shape[1], weights, "")


def fit_loads(stimuli: StimuliInput, shape: Sequence[int | str | None], what: str) -> Floats:
    """Arrange the loads (6, ...) in an input's shape, resampled to its time axis.

    Args:
        shape: the input's shape, batch first; an axis of any length is not a number. The other axes
            are time, elements and channels in any order; or time, and the last two flattened; or
            all three flattened.
        what: the file and the input, for error messages.

    Raises:
        ConfigError: the shape has other axes, or a batch larger than 1.
    """
    loads = stimuli.samples.reshape(len(stimuli.samples), -1, *stimuli.samples.shape[3:])
    _, samples, elements, channels = loads.shape
    batch, *axes = [n if isinstance(n, int) and n > 0 else None for n in shape] or [0]
    both = loads.reshape(len(loads), samples, -1)
    forms = [  # arrays of the loads, and the orders of their axes
        *((loads, order) for order in permutations(range(3))), (both, (0, 1)), (both, (1, 0))
    ]  # fmt: skip
    for values, order in forms if batch in (None, 1) else []:
        if len(order) != len(axes):
            continue
        length = axes[order.index(0)] or samples
        lengths = [(length, *values.shape[2:])[k] for k in order]
        if all(n in (None, m) for n, m in zip(axes, lengths, strict=True)):
            resampled = _resample(values, length)
            return np.ascontiguousarray(resampled.transpose(0, *(1 + k for k in order)))
    if len(axes) == 1 and axes[0] and axes[0] % both.shape[2] == 0 and batch in (None, 1):
        return _resample(both, axes[0] // both.shape[2]).reshape(len(both), -1)
    raise ConfigError(
        f"{what} is {list(shape)}, not a batch of {samples} samples of {elements} x {channels} "
        f"loads: {OTHERWISE}"
    )


def _make_zeros(path: Path, given: ort.NodeArg) -> NDArray[Any]:
    """Return zeros for an input other than the loads, such as an initial state."""
    kind = re.sub(r"tensor\((\w+)\)", r"\1", given.type).replace("float16", "half")
    try:
        dtype = np.dtype({"float": "f4", "half": "f2", "double": "f8"}.get(kind, kind))
    except TypeError:
        raise ConfigError(f"{path}: input {given.name} is {given.type}: {OTHERWISE}") from None
    return np.zeros([n if isinstance(n, int) else 1 for n in given.shape], dtype)


def _resample(values: Floats, length: int) -> Floats:
    """Interpolate (6, sample, ...) linearly to `length` samples over the same time."""
    if length == values.shape[1]:
        return values
    at = np.clip((np.arange(length) + 0.5) * values.shape[1] / length - 0.5, 0, values.shape[1] - 1)
    low = np.minimum(at.astype(int), values.shape[1] - 2)
    share = (at - low).reshape(-1, *(1,) * (values.ndim - 2)).astype(np.float32)
    return np.asarray(values[:, low] * (1 - share) + values[:, low + 1] * share)


def _find_layers(graph: onnx.GraphProto) -> dict[str, str]:
    """Find the output tensor of each layer, by layer name, in the order of computation."""
    weights = {i.name: i.name for i in graph.initializer if len(i.dims) > 1}
    readers: dict[str, list[onnx.NodeProto]] = {}
    for node in graph.node:
        for source in node.input:
            readers.setdefault(source, []).append(node)
    taps: dict[str, str] = {}
    for node in graph.node:
        own = next((weights[name] for name in node.input if name in weights), "")
        if own and node.op_type in PASSING:
            weights[node.output[0]] = own
        elif own or node.op_type in WHOLE:
            tensor = node.output[0]
            while (after := readers.get(tensor, [])) and len(after) == 1:
                if after[0].op_type not in BEHIND:
                    break
                tensor = after[0].output[0]
            if tensor not in taps.values():
                taps[_name_layer(own, node, taps)] = tensor
    return taps


def _name_layer(weight: str, node: onnx.NodeProto, taken: Collection[str]) -> str:
    """Name a layer after its weight or, if that name is generated, after its node."""
    name = weight if weight and not NUMBERED.fullmatch(weight) else node.name.rpartition("/")[0]
    name = re.sub(r"\.?(weight\w*|kernel|W)$", "", name.strip("/").replace("/", "."))
    name = f"encoder.{name or node.op_type.lower()}"
    before = sum(other.partition(" ")[0] == name for other in taken)
    return f"{name} {before + 1}" if before else name


def _find_weighted_modules(network: "nn.Module") -> Iterator[tuple[str, "nn.Module"]]:
    for name, module in network.named_modules():
        if any(True for _ in module.parameters(recurse=False)):
            yield f"encoder.{name or type(module).__name__.lower()}", module


def _make_layers(
    name: str, found: dict[str, list[NDArray[Any]]], samples: int, parameters: int, sha256: str
) -> Layers:
    """Make `Layers` from the outputs of each layer, one array per stimulus."""
    traces = {}
    for layer, values in found.items():
        trace = np.stack([_arrange_by_step(value, samples) for value in values]).astype(np.float32)
        if trace.shape[-1] > 1:
            traces[layer] = trace
    if not traces:
        raise ModelError(f"{name}: no node with weights has an output of two units or more")
    if bad := next((layer for layer, t in traces.items() if not np.isfinite(t).all()), ""):
        raise ModelError(f"{name}: layer {bad.removeprefix('encoder.')} is not finite")
    return Layers(
        name=name, traces=traces, first=dict.fromkeys(traces, 0),
        logits=np.zeros((len(next(iter(traces.values()))), 1, 0), dtype=np.float32),
        parameters=parameters, sha256=sha256, notes=("a model made elsewhere",),
    )  # fmt: skip


def _arrange_by_step(value: NDArray[Any], samples: int) -> NDArray[Any]:
    """Reshape a layer's output to (step, unit), with one step per sample if possible."""
    if value.ndim > 2 and value.shape[:2] in ((1, samples), (samples, 1)):
        return value.reshape(samples, -1)
    return value.reshape(1, -1)
