"""The window form: a whole episode in, logits and embedding of every step out.

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

OUTPUTS = ("logits", "embedding")


def window_graph(step: onnx.ModelProto, state: Sequence[StateTensor]) -> onnx.ModelProto:
    """A model of kind "window" from the step that `onnx_step.step_graph` made.

    samples (batch, step, sub-step, element, channel), offset and sigma as for the step
    -> logits (batch, step, class), embedding (batch, step, unit)
    """
    graph = step.graph
    values = {value.name: value for value in (*graph.input, *graph.output)}
    # The loop's body sees offset and sigma from outside; other names it may not share with outside.
    inside = {name: f"scan_{name}" for name in ("samples", *OUTPUTS, *(s.name for s in state))}
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
        [_named(values[name], inside[name]) for name in (*(s.name for s in state), "samples")],
        [values[f"{s.name}_next"] for s in state]
        + [_named(values[name], inside[name]) for name in OUTPUTS],
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
            [*(f"{s.name}_last" for s in state), *OUTPUTS],
            body=body,
            num_scan_inputs=1,
            scan_input_axes=[1],
            scan_output_axes=[1] * len(OUTPUTS),
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
        [_of_every_step(values[name]) for name in OUTPUTS],
        shapes,
    )
    model = helper.make_model(out, opset_imports=step.opset_import, ir_version=step.ir_version)
    model.producer_name, model.producer_version = step.producer_name, step.producer_version
    return model


def _of_every_step(value: onnx.ValueInfoProto) -> onnx.ValueInfoProto:
    """(batch, number) -> (batch, step, number)"""
    number = value.type.tensor_type.shape.dim[1].dim_value
    return helper.make_tensor_value_info(value.name, TensorProto.FLOAT, ["batch", "step", number])


def _named(value: onnx.ValueInfoProto, name: str) -> onnx.ValueInfoProto:
    copy = onnx.ValueInfoProto()
    copy.CopyFrom(value)
    copy.name = name
    return copy
