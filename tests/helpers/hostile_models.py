"""Model files that are whole and say what a model says, and ask for more than a robot has."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from tests.helpers.tiny_model import write_model

Burden = Callable[[list[onnx.NodeProto], list[onnx.TensorProto]], str]


def write_burdened(path: Path, burden: Burden, base: Path | None = None) -> Path:
    """A model, by default the tiny one, with a burden: the scalar that it makes, times zero, is
    added to the logits."""
    model = onnx.load(base or write_model(path))
    graph = model.graph
    for node in graph.node:
        for i, name in enumerate(node.output):
            if name == "logits":
                node.output[i] = "logits_before"
    nodes: list[onnx.NodeProto] = []
    tensors = [numpy_helper.from_array(np.zeros((), np.float32), "nothing")]
    # of an input, so that onnxruntime computes nothing beforehand
    nodes.append(helper.make_node("ReduceMax", ["sigma"], ["live"], keepdims=0))
    scalar = burden(nodes, tensors)
    nodes.append(helper.make_node("Mul", [scalar, "nothing"], ["burden"]))
    nodes.append(helper.make_node("Add", ["logits_before", "burden"], ["logits"]))
    graph.node.extend(nodes)
    graph.initializer.extend(tensors)
    onnx.save(model, path)
    return path


def _most(nodes: list[onnx.NodeProto], name: str) -> str:
    nodes.append(helper.make_node("ReduceMax", [name], [f"{name}_most"], keepdims=0))
    return f"{name}_most"


def _outer_product(size: int) -> Burden:
    def burden(nodes, tensors):  # type: ignore[no-untyped-def]
        tensors.append(numpy_helper.from_array(np.ones((size, 1), np.float32), "tall"))
        tensors.append(numpy_helper.from_array(np.ones((1, size), np.float32), "flat"))
        nodes.append(helper.make_node("Mul", ["tall", "live"], ["tall_live"]))
        nodes.append(helper.make_node("MatMul", ["tall_live", "flat"], ["product"]))
        return _most(nodes, "product")

    return burden


def _expand(nodes, tensors):  # type: ignore[no-untyped-def]
    nodes.append(helper.make_node("Cast", ["live"], ["size"], to=TensorProto.INT64))
    tensors.append(numpy_helper.from_array(np.array([1], np.int64), "single"))
    nodes.append(helper.make_node("Reshape", ["size", "single"], ["shape"]))
    nodes.append(helper.make_node("Expand", ["live", "shape"], ["wide"]))
    return _most(nodes, "wide")


def _non_zero(nodes, tensors):  # type: ignore[no-untyped-def]
    """What its output is as large as is not known, and then no shape of it is."""
    nodes.append(helper.make_node("NonZero", ["samples"], ["touched"]))
    nodes.append(helper.make_node("Shape", ["touched"], ["many"]))
    nodes.append(helper.make_node("ConstantOfShape", ["many"], ["filled"]))
    return _most(nodes, "filled")


def _slice_in_a_scan(nodes, tensors):  # type: ignore[no-untyped-def]
    """Hidden in a graph within the graph, which takes it from one turn to the next."""
    body = helper.make_graph(
        [helper.make_node("Cast", ["ends"], ["stop"], to=TensorProto.INT64),
         helper.make_node("Slice", ["row", "first", "stop"], ["some"]),
         helper.make_node("ReduceMax", ["some"], ["most"], keepdims=0),
         helper.make_node("ReduceMax", ["samples"], ["ends_next"], keepdims=0)], "body",
        [helper.make_tensor_value_info("ends", TensorProto.FLOAT, [1]),
         helper.make_tensor_value_info("row", TensorProto.FLOAT, None)],
        [helper.make_tensor_value_info("ends_next", TensorProto.FLOAT, [1]),
         helper.make_tensor_value_info("most", TensorProto.FLOAT, None)],
    )  # fmt: skip
    tensors.append(numpy_helper.from_array(np.zeros(1, np.int64), "first"))
    tensors.append(numpy_helper.from_array(np.zeros(1, np.float32), "none_yet"))
    tensors.append(numpy_helper.from_array(np.zeros((2, 9), np.float32), "rows"))
    nodes.append(
        helper.make_node("Scan", ["none_yet", "rows"], ["", "scan"], body=body, num_scan_inputs=1)
    )
    return _most(nodes, "scan")


def _doubling(nodes, tensors):  # type: ignore[no-untyped-def]
    """Forty times twice as long."""
    tensors.append(numpy_helper.from_array(np.array([1], np.int64), "single"))
    nodes.append(helper.make_node("Reshape", ["live", "single"], ["twice_0"]))
    for n in range(40):
        nodes.append(helper.make_node("Concat", [f"twice_{n}"] * 2, [f"twice_{n + 1}"], axis=0))
    return _most(nodes, "twice_40")


def _kept(nodes, tensors):  # type: ignore[no-untyped-def]
    """Five hundred tensors of 4 MB that are all needed until the end."""
    tensors.append(numpy_helper.from_array(np.ones((1000, 1), np.float32), "tall"))
    tensors.append(numpy_helper.from_array(np.ones((1, 1000), np.float32), "flat"))
    names = []
    for n in range(500):
        tensors.append(numpy_helper.from_array(np.array(n, np.float32), f"n{n}"))
        nodes.append(helper.make_node("Add", ["live", f"n{n}"], [f"live_{n}"]))
        nodes.append(helper.make_node("Mul", ["tall", f"live_{n}"], [f"tall_{n}"]))
        nodes.append(helper.make_node("MatMul", [f"tall_{n}", "flat"], [f"kept_{n}"]))
        names.append(f"kept_{n}")
    nodes.append(helper.make_node("Max", names, ["all"]))
    return _most(nodes, "all")


def _products(count: int, wide: int, live: bool) -> Burden:
    def burden(nodes, tensors):  # type: ignore[no-untyped-def]
        matrix = np.eye(wide, dtype=np.float32)
        tensors.append(numpy_helper.from_array(matrix, "matrix"))
        if live:
            nodes.append(helper.make_node("Mul", ["matrix", "live"], ["product_0"]))
        else:  # all of it is known beforehand: to load it is to compute it
            nodes.append(helper.make_node("Identity", ["matrix"], ["product_0"]))
        for n in range(count):
            nodes.append(
                helper.make_node("MatMul", [f"product_{n}", "matrix"], [f"product_{n + 1}"])
            )
        return _most(nodes, f"product_{count}")

    return burden


def no_number(nodes, tensors):  # type: ignore[no-untyped-def]
    """Finite at rest and where all elements are loaded, as on trial; not of a touch by a few."""
    tensors.append(numpy_helper.from_array(np.array([1], np.int64), "sub_step"))
    tensors.append(numpy_helper.from_array(np.array(0, np.int64), "channel"))
    tensors.append(numpy_helper.from_array(np.array(0.05, np.float32), "part"))
    nodes.append(helper.make_node("Unsqueeze", ["offset", "sub_step"], ["base"]))
    nodes.append(helper.make_node("Sub", ["samples", "base"], ["loads"]))
    nodes.append(helper.make_node("Gather", ["loads", "channel"], ["of_channel"], axis=3))
    nodes.append(helper.make_node("Abs", ["of_channel"], ["sizes"]))
    nodes.append(helper.make_node("ReduceMin", ["sizes"], ["least"], keepdims=0))
    nodes.append(helper.make_node("Mul", [_most(nodes, "sizes"), "part"], ["a_part"]))
    nodes.append(helper.make_node("Sub", ["least", "a_part"], ["evenness"]))
    nodes.append(helper.make_node("Sqrt", ["evenness"], ["root"]))
    return "root"


# They ask for more memory than they may.
GREEDY: dict[str, Burden] = {
    "outer_product_40_GB": _outer_product(100_000),
    "outer_product_1.3_GB": _outer_product(18_000),
    "doubling": _doubling,
    "kept_2_GB": _kept,
}
# They ask for as much as what is measured says: of a trial for little, of a touch for all there is.
SHAPED: dict[str, Burden] = {
    "Expand": _expand,
    "NonZero": _non_zero,
    "Slice": _slice_in_a_scan,
}
# They take longer than they may.
BURNERS: dict[str, Burden] = {
    "chained_products": _products(4000, 900, live=True),
    "products_at_load": _products(4000, 900, live=False),
}


def _truncated(path: Path) -> None:
    data = write_model(path).read_bytes()
    path.write_bytes(data[: len(data) // 2])


def _loop(path: Path) -> None:
    """A loop without end."""
    write_model(path)
    model = onnx.load(path)
    body = helper.make_graph(
        [helper.make_node("Identity", ["go_on"], ["go_on_next"])], "body",
        [helper.make_tensor_value_info("i", TensorProto.INT64, []),
         helper.make_tensor_value_info("go_on", TensorProto.BOOL, [])],
        [helper.make_tensor_value_info("go_on_next", TensorProto.BOOL, [])],
    )  # fmt: skip
    model.graph.initializer.append(numpy_helper.from_array(np.array(True), "true"))
    model.graph.node.append(helper.make_node("Loop", ["", "true"], [], body=body))
    onnx.save(model, path)


def _elsewhere(path: Path) -> None:
    """Weights that are to be read from another file."""
    write_model(path)
    model = onnx.load(path)
    tensor = TensorProto(name="outside", data_type=TensorProto.FLOAT, dims=[1])
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "/dev/zero"
    model.graph.initializer.append(tensor)
    onnx.save(model, path)


# What is seen without running them.
UNSOUND: dict[str, Callable[[Path], None]] = {
    "truncated": _truncated,
    "endless_loop": _loop,
    "external_weights": _elsewhere,
}
