"""The window form: a whole episode in, the logits of every step out.

It is the streaming step, run by ONNX's own `Scan` over the steps of the window from a zero state:
so the two forms cannot differ, and the file is no larger than one step.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from tactile_rt.classifier.model_card import StateTensor

__all__ = ["window_graph"]


def window_graph(step: onnx.ModelProto, state: Sequence[StateTensor]) -> onnx.ModelProto:
    """A model of kind "window" from the step that `onnx_step.step_graph` made.

    samples (batch, step, sub-step, element, channel), offset and sigma as for the step
    -> logits (batch, step, class)
    """
    graph = step.graph
    values = {value.name: value for value in (*graph.input, *graph.output)}
    body_state = [f"scan_{s.name}" for s in state]
    # Inside the loop every name that is an input must be its own; what remains is seen from there.
    inside = {"samples": "scan_samples"} | {
        s.name: name for s, name in zip(state, body_state, strict=True)
    }
    nodes = []
    for node in graph.node:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        copy.input[:] = [inside.get(name, name) for name in node.input]
        copy.output[:] = ["scan_logits" if n == "logits" else n for n in node.output]
        nodes.append(copy)
    body = helper.make_graph(
        nodes,
        "step",
        [_named(values[s.name], f"scan_{s.name}") for s in state]
        + [_named(values["samples"], "scan_samples")],
        [values[f"{s.name}_next"] for s in state] + [_named(values["logits"], "scan_logits")],
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
            [*(f"{s.name}_last" for s in state), "logits"],
            body=body,
            num_scan_inputs=1,
            scan_input_axes=[1],
            scan_output_axes=[1],
        )
    )
    sample = values["samples"].type.tensor_type.shape.dim
    classes = values["logits"].type.tensor_type.shape.dim[1].dim_value
    sizes = [sample[i].dim_value for i in range(1, 4)]
    out = helper.make_graph(
        outer,
        "window",
        [
            helper.make_tensor_value_info("samples", TensorProto.FLOAT, ["batch", "step", *sizes]),
            values["offset"],
            values["sigma"],
        ],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, ["batch", "step", classes])],
        shapes,
    )
    model = helper.make_model(out, opset_imports=step.opset_import, ir_version=step.ir_version)
    model.producer_name, model.producer_version = step.producer_name, step.producer_version
    return model


def _named(value: onnx.ValueInfoProto, name: str) -> onnx.ValueInfoProto:
    copy = onnx.ValueInfoProto()
    copy.CopyFrom(value)
    copy.name = name
    return copy
