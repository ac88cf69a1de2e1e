"""Which tensors of an exported graph are layers, by the names of the parameters that made them.

The exporter keeps the names of biases and norms (``model.network.attender.norm.bias``) where it
folds weights, and quantisation keeps both those and every tensor's name. A graph encoder's maps
are its recurrent states.
"""

import re
from collections.abc import Iterable

import onnx

from tactile_rt.alignment.layers import PARTS

__all__ = ["GRU_LAYERS", "named_taps", "precision_of", "step_graph"]

QUANTISED = {"MatMulInteger", "ConvInteger", "DynamicQuantizeLinear", "QLinearMatMul",
             "QLinearConv", "DequantizeLinear", "MatMulNBits", "MatMulIntegerToFloat"}  # fmt: skip
GRAPH_NODE = re.compile(r"encoder\.(convs\.|dense\.|drives\.|)(\w+)")
GRU_LAYERS = "encoder.layer*"  # all in one tensor (..., layer, feature)
PARAMETER = re.compile(r"(?:model\.)?(?:network\.)?((?:encoder|attender|decoder)(?:\..+)?)\.\w+$")
# (path of a parameter's module, name of the layer, where the layer is from the node that reads the
# parameter: its output, behind the ReLU or sum that follows, or its input)
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
    """The graph of one step, and the `Scan` that runs it if the file is a window of steps."""
    for node in model.graph.node:
        if node.op_type == "Scan":
            return next(a.g for a in node.attribute if a.name == "body"), node
    return model.graph, None


def named_taps(model: onnx.ModelProto) -> dict[str, str]:
    """Tensors by layer, in the order of computation; layers whose names are lost are missing."""
    graph, _ = step_graph(model)
    readers: dict[str, list[onnx.NodeProto]] = {}
    for node in graph.node:
        for source in node.input:
            readers.setdefault(source, []).append(node)
    place = {o: i for i, node in enumerate(graph.node) for o in node.output}
    # The node of a module is the last that reads one of its parameters: a sum after a product.
    # Parameters that are equal, as an untrained network's are, are one to the exporter, under the
    # name of any of them: what several nodes read tells nothing.
    modules: dict[str, onnx.NodeProto] = {}
    for initializer in (*model.graph.initializer, *graph.initializer):
        match = PARAMETER.match(initializer.name)
        reading = readers.get(initializer.name, [])
        while len(reading) == 1 and reading[0].op_type == "Cast":  # of weights stored in 16 bits
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
                for layer, tensor in _found(name, number, where, node, readers):
                    taps.setdefault(layer, tensor)
    if "attender.norm" in taps and "attender.block7" in taps:
        # Of a GPT, whose last layer has no bias to keep a name.
        if product := _next(taps["attender.norm"], readers, "MatMul"):
            taps.setdefault("attender.project_out", product.output[0])
    part = PARTS.index
    return dict(
        sorted(taps.items(), key=lambda item: (part(item[0].split(".")[0]), place[item[1]]))
    )


def precision_of(model: onnx.ModelProto) -> str:
    """``int8``, ``fp16``, ``bf16`` or ``fp32``, by what the graph computes and stores."""
    graph, _ = step_graph(model)
    if QUANTISED.intersection(node.op_type for node in graph.node):
        return "int8"
    types = {i.data_type for i in (*model.graph.initializer, *graph.initializer)}
    if onnx.TensorProto.FLOAT16 in types:
        return "fp16"
    return "bf16" if onnx.TensorProto.BFLOAT16 in types else "fp32"


def _found(
    name: str,
    number: str,
    where: str,
    node: onnx.NodeProto,
    readers: dict[str, list[onnx.NodeProto]],
) -> Iterable[tuple[str, str]]:
    out = node.output[0]
    if where == "input":
        yield f"{name.removesuffix('{-1}')}{int(number) - 1}", node.input[0]
    elif where == "both":
        before, after = name.split()
        yield from ((before, node.input[0]), (after, out))
    elif where == "sum":
        # Behind a product whose bias is lost comes that bias, not the sum.
        total = None if node.op_type == "MatMul" else _next(out, readers, "Add")
        if total is not None:
            yield name.format(number), _activated(total.output[0], readers)
    elif where == "activation":
        yield name.format(number), _activated(out, readers)
    elif where == "either":  # the first layer of a decoder over all steps, or the only one
        hidden, last = name.split()
        behind = _activated(out, readers)
        yield (hidden, behind) if behind != out else (last, out)
    else:
        yield name.format(number), out


def _next(
    tensor: str, readers: dict[str, list[onnx.NodeProto]], kind: str
) -> onnx.NodeProto | None:
    return next((n for n in readers.get(tensor, []) if n.op_type == kind), None)


def _activated(tensor: str, readers: dict[str, list[onnx.NodeProto]]) -> str:
    """Behind the activation function that follows, at once or after a cell's few sums."""
    at = tensor
    for _ in range(4):
        if (node := _next(at, readers, "Relu")) is not None:
            return str(node.output[0])
        if (node := _next(at, readers, "Add")) is None:
            break
        at = node.output[0]
    return tensor
