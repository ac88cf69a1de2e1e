"""Other forms of an exported step: its weights in fewer bits, and a whole window at once.

window: a whole episode in, logits and embedding of every step out. ONNX's own `Scan` runs the
streaming step over the steps of the window from a zero state: so the two forms cannot differ, and
the file is no larger than that of one step.

fp16, bf16: the weights of products are stored in 16 bits and cast back when the file is loaded:
half the size, the same speed.

int8: products are computed in integers; weights are quantised at export, activations at run time.
Products of one or a few rows (dense layers, attention) read their weights in blocks of their
inputs, each with a scale of its own (`MatMulNBits`); convolutions, with a row per site, have one
scale per output channel (`MatMulInteger`), and their activations are quantised once per map, before
the taps are gathered. States, norms, biases and sums stay in single precision.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Literal

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from tactile_rt.classifier.model_card import StateTensor
from tactile_rt.core.errors import ConfigError

Precision = Literal["fp32", "fp16", "bf16", "int8"]
PRECISIONS: tuple[Precision, ...] = ("fp32", "fp16", "bf16", "int8")
BLOCK, LEAST_BLOCK = 128, 16  # inputs that share a scale; onnxruntime wants a power of two
SMALL = 1024  # weights of fewer numbers stay as they are
OUTPUTS = ("logits", "embedding", "names")  # the last: of networks that distinguish kinds
CONTRIB = "com.microsoft"  # onnxruntime's own operators, which every build of it has


def in_precision(proto: onnx.ModelProto, precision: Precision) -> onnx.ModelProto:
    """Return a copy of a graph in another precision.

    Raises:
        ConfigError: no such precision.
    """
    if precision not in PRECISIONS:
        raise ConfigError(f"precision is {precision!r}, not one of {', '.join(PRECISIONS)}")
    out = onnx.ModelProto()
    out.CopyFrom(proto)
    if precision in ("fp16", "bf16"):
        _store_16_bits(out, precision)
    elif precision == "int8":
        _quantise(out)
    return out


def _store_16_bits(proto: onnx.ModelProto, precision: Precision) -> None:
    """Store weights in 16 bits, each with a Cast that is folded on loading."""
    casts = []
    for weight in proto.graph.initializer:
        if weight.data_type != TensorProto.FLOAT or np.prod(weight.dims) < SMALL:
            continue
        values = numpy_helper.to_array(weight)
        name = weight.name
        if precision == "fp16":
            limit = np.finfo(np.float16).max
            half = np.clip(values, -limit, limit).astype(np.float16)
            weight.CopyFrom(numpy_helper.from_array(half, f"{name}_16"))
        else:
            weight.CopyFrom(_to_bfloat16(values, f"{name}_16"))
        casts.append(
            helper.make_node("Cast", [weight.name], [name], f"{name}_cast", to=TensorProto.FLOAT)
        )
    nodes = [*casts, *proto.graph.node]
    del proto.graph.node[:]
    proto.graph.node.extend(nodes)


def _to_bfloat16(values: NDArray[np.float32], name: str) -> TensorProto:
    """Return values as bfloat16, rounded to nearest, ties to even."""
    bits = np.ascontiguousarray(values).view(np.uint32)
    rounded = (bits + 0x7FFF + ((bits >> 16) & 1)) >> 16
    tensor = TensorProto(name=name, data_type=TensorProto.BFLOAT16, dims=values.shape)
    tensor.raw_data = rounded.astype("<u2").tobytes()
    return tensor


def _quantise(proto: onnx.ModelProto) -> None:
    graph = proto.graph
    weights = {w.name: w for w in graph.initializer}
    makers = {output: node for node in graph.node for output in node.output}
    nodes: list[onnx.NodeProto] = []
    biases = _find_biases(graph, weights)
    added: dict[str, TensorProto] = {}
    gathered: dict[str, tuple[str, str, str]] = {}
    for node in graph.node:
        weight = weights.get(node.input[1]) if node.op_type in ("MatMul", "Gemm") else None
        if weight is None or len(weight.dims) != 2 or np.prod(weight.dims) < SMALL:
            nodes.append(node)
            continue
        values = numpy_helper.to_array(weight)
        if node.op_type == "Gemm" and any(a.name == "transB" and a.i for a in node.attribute):
            values = values.T
        taps = _find_taps(node.input[0], makers)
        replaced = (
            _quantise_blocks(node, values, added)
            if taps is None
            else _quantise_taps(node, values, taps, added, gathered, biases.get(node.output[0]))
        )
        nodes.extend(replaced)
    # A quantised product may add the bias itself: drop the Add with the same output.
    made = {output for node in nodes if node.domain == CONTRIB for output in node.output}
    nodes = [n for n in nodes if n.domain == CONTRIB or not made.intersection(n.output)]
    del graph.node[:]
    graph.node.extend(_select_used(nodes, {o.name for o in graph.output}))
    needed = {name for node in graph.node for name in node.input}
    kept = [w for w in (*graph.initializer, *added.values()) if w.name in needed]
    del graph.initializer[:]
    graph.initializer.extend(kept)
    del graph.value_info[:]  # some describe values that no longer exist
    if all(o.domain != CONTRIB for o in proto.opset_import):
        proto.opset_import.append(helper.make_opsetid(CONTRIB, 1))


def _quantise_blocks(
    node: onnx.NodeProto, values: NDArray[np.float32], added: dict[str, TensorProto]
) -> Iterator[onnx.NodeProto]:
    """Yield nodes that multiply x, (..., inputs), by weights quantised in blocks of inputs."""
    inputs, outputs = values.shape
    block = min(BLOCK, max(LEAST_BLOCK, 1 << (inputs - 1).bit_length()))
    count = -(-inputs // block)
    blocks = np.zeros((outputs, count * block), dtype=np.float32)
    blocks[:, :inputs] = values.T
    blocks = blocks.reshape(outputs, count, block)
    scale = np.abs(blocks).max(-1) / 127
    scale[scale == 0] = 1.0
    codes = (np.rint(blocks / scale[..., None]) + 128).astype(np.uint8)  # 128 stands for zero
    name = node.input[1]
    for part, array in ((f"{name}_int8", codes), (f"{name}_scale", scale.astype(np.float32))):
        added[part] = numpy_helper.from_array(array, part)
    product = node.output[0] if len(node.input) < 3 else f"{node.output[0]}_product"
    yield helper.make_node(
        "MatMulNBits",
        [node.input[0], f"{name}_int8", f"{name}_scale"],
        [product],
        f"{node.name}_int8",
        domain=CONTRIB,
        K=inputs,
        N=outputs,
        bits=8,
        block_size=block,
        accuracy_level=4,  # integer products
    )
    if len(node.input) == 3:  # a Gemm has a bias
        yield helper.make_node(
            "Add", [product, node.input[2]], [node.output[0]], f"{node.name}_add"
        )


def _quantise_taps(
    node: onnx.NodeProto,
    values: NDArray[np.float32],
    taps: tuple[onnx.NodeProto, ...],
    added: dict[str, TensorProto],
    gathered: dict[str, tuple[str, str, str]],
    bias: tuple[str, str] | None,
) -> Iterator[onnx.NodeProto]:
    """Yield nodes that quantise a map, gather its taps, and multiply them by weights.

    `bias` holds the names of the vector to add and of the sum.
    """
    final = taps[0].output[0]
    if final not in gathered:
        source = taps[-1].input[0]
        value, scale, zero = (f"{source}_{part}" for part in ("int8", "scale", "zero"))
        if not any(done[1] == scale for done in gathered.values()):
            yield helper.make_node(
                "DynamicQuantizeLinear", [source], [value, scale, zero], f"{source}_quantise"
            )
        for step in reversed(taps):
            inputs = [value, *step.input[1:]]
            if step.op_type == "Pad":  # a padded site has the code of zero
                inputs = [value, step.input[1], zero]
            output = f"{step.output[0]}_int8"
            copy = helper.make_node(step.op_type, inputs, [output], f"{step.name}_int8")
            copy.attribute.extend(step.attribute)
            yield copy
            value = output
        gathered[final] = (value, scale, zero)
    value, scale, zero = gathered[final]
    name = node.input[1]
    channel = np.abs(values).max(0) / 127
    channel[channel == 0] = 1.0
    codes = np.rint(values / channel).astype(np.int8)
    for part, array in ((f"{name}_int8", codes), (f"{name}_scale", channel.astype(np.float32))):
        added[part] = numpy_helper.from_array(array, part)
    yield helper.make_node(
        "MatMulIntegerToFloat",
        [value, f"{name}_int8", scale, f"{name}_scale", zero, *(("", bias[0]) if bias else ())],
        [bias[1] if bias else node.output[0]],
        f"{node.name}_int8",
        domain=CONTRIB,
    )


def _find_biases(
    graph: onnx.GraphProto, weights: dict[str, TensorProto]
) -> dict[str, tuple[str, str]]:
    """Map each product that only an Add reads to (added vector, sum), by name."""
    uses = Counter(name for node in graph.node for name in node.input)
    uses.update(output.name for output in graph.output)
    found = {}
    for node in graph.node:
        if node.op_type == "Add":
            for value, other in (node.input, reversed(node.input)):
                vector = other in weights and len(weights[other].dims) == 1
                if vector and uses[value] == 1:
                    found[value] = (other, node.output[0])
    return found


def _find_taps(name: str, makers: dict[str, onnx.NodeProto]) -> tuple[onnx.NodeProto, ...] | None:
    """Return the nodes that gather a convolution's taps, last first; None without any."""
    chain = []
    while (node := makers.get(name)) is not None:
        if node.op_type not in ("Reshape", "Gather", "Pad"):
            break
        chain.append(node)
        name = node.input[0]
        if node.op_type == "Pad":
            break
    if not any(node.op_type == "Gather" for node in chain):
        return None
    while chain[-1].op_type == "Reshape":
        chain.pop()
    return tuple(chain)


def _select_used(nodes: list[onnx.NodeProto], outputs: set[str]) -> list[onnx.NodeProto]:
    """Return the nodes on which the outputs depend, in order."""
    needed, kept = set(outputs), []
    for node in reversed(nodes):
        if needed.intersection(node.output):
            kept.append(node)
            needed.update(node.input)
    return kept[::-1]


def window_graph(step: onnx.ModelProto, state: Sequence[StateTensor]) -> onnx.ModelProto:
    """Make a model of kind "window" from a step that `onnx_step.step_graph` made.

    Inputs: samples (batch, step, sub-step, element, channel); offset and sigma as for the step.
    Outputs: logits (batch, step, class), embedding (batch, step, unit), names (batch, step, name).
    """
    graph = step.graph
    values = {value.name: value for value in (*graph.input, *graph.output)}
    outputs = [name for name in OUTPUTS if name in values]
    # The body of the loop reads offset and sigma from outside; its other names must be unique.
    inside = {name: f"scan_{name}" for name in ("samples", *outputs, *(s.name for s in state))}
    nodes = []
    for node in graph.node:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        copy.input[:] = [inside.get(name, name) for name in node.input]
        copy.output[:] = [inside.get(name, name) for name in node.output]
        nodes.append(copy)
    body = helper.make_graph(
        nodes,
        "step",
        [_rename(values[name], inside[name]) for name in (*(s.name for s in state), "samples")],
        [values[f"{s.name}_next"] for s in state]
        + [_rename(values[name], inside[name]) for name in outputs],
        list(graph.initializer),
        value_info=list(graph.value_info),
    )
    outer = [
        helper.make_node("Shape", ["offset"], ["batch_size"], start=0, end=1),
    ]
    shapes = []
    for s in state:
        shapes.append(numpy_helper.from_array(np.array(s.shape, dtype=np.int64), f"{s.name}_size"))
        outer.append(
            helper.make_node(
                "Concat", ["batch_size", f"{s.name}_size"], [f"{s.name}_shape"], axis=0
            )
        )
        zero = numpy_helper.from_array(np.zeros(1, dtype=s.dtype))
        outer.append(
            helper.make_node(
                "ConstantOfShape", [f"{s.name}_shape"], [f"{s.name}_start"], value=zero
            )
        )
    outer.append(
        helper.make_node(
            "Scan",
            [*(f"{s.name}_start" for s in state), "samples"],
            [*(f"{s.name}_last" for s in state), *outputs],
            body=body,
            num_scan_inputs=1,
            scan_input_axes=[1],
            scan_output_axes=[1] * len(outputs),
        )
    )
    sample = values["samples"].type.tensor_type.shape.dim
    sizes = [sample[i].dim_value for i in range(1, 4)]
    out = helper.make_graph(
        outer,
        "window",
        [
            helper.make_tensor_value_info("samples", TensorProto.FLOAT, ["batch", "step", *sizes]),
            values["offset"],
            values["sigma"],
        ],
        [_add_step_axis(values[name]) for name in outputs],
        shapes,
    )
    model = helper.make_model(out, opset_imports=step.opset_import, ir_version=step.ir_version)
    model.producer_name, model.producer_version = step.producer_name, step.producer_version
    return model


def _add_step_axis(value: onnx.ValueInfoProto) -> onnx.ValueInfoProto:
    """Return an output, (batch, number), with a step axis: (batch, step, number)."""
    number = value.type.tensor_type.shape.dim[1].dim_value
    return helper.make_tensor_value_info(value.name, TensorProto.FLOAT, ["batch", "step", number])


def _rename(value: onnx.ValueInfoProto, name: str) -> onnx.ValueInfoProto:
    copy = onnx.ValueInfoProto()
    copy.CopyFrom(value)
    copy.name = name
    return copy
