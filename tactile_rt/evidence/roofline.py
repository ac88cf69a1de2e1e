"""The least time in which this machine could do a model's matrix products, measured here and now.

A product of ``rows x inner`` activations with ``inner x columns`` weights takes at least its
arithmetic at the machine's best rate, and at least the reading of its weights from memory
(Williams et al. 2009, "Roofline", Commun. ACM 52(4)). A model's roofline is the sum over its
products; everything else that a step does counts as overhead. One thread, CPU time.
"""

import json
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from tactile_rt.classifier.model_file import ModelCard, read_model

__all__ = ["Machine", "MatrixProduct", "measure_machine", "products", "roofline_s"]

ROWS, INNER, COLUMNS = 256, 1024, 1024  # of the product for the rate of arithmetic
WEIGHTS = (4096, 8192)  # of the product for the rate of memory: 134 MB, larger than any cache
FLOAT, INT8, INT32 = 1, 3, 6  # onnx.TensorProto.DataType
OPSET, IR_VERSION = 20, 10
# MatMulNBits as we export it: 8 bits.
INTEGER = (
    "MatMulInteger", "MatMulIntegerToFloat", "MatMulNBits", "DynamicQuantizeMatMul", "QGemm",
)  # fmt: skip
PRODUCTS = ("MatMul", "FusedMatMul", "Gemm", "FusedGemm", "Conv", "FusedConv", *INTEGER)


@dataclass(frozen=True)
class Machine:
    """Measured best rates of one core: float and int8 arithmetic, operations/s; memory, bytes/s."""

    fp32: float
    int8: float
    memory: float


@dataclass(frozen=True)
class MatrixProduct:
    """One matrix product of a step; `weights` in bytes."""

    rows: int
    inner: int
    columns: int
    weights: int
    integer: bool

    @property
    def operations(self) -> int:
        return 2 * self.rows * self.inner * self.columns


def roofline_s(machine: Machine, work: list[MatrixProduct]) -> float:
    """The least time for these products, s."""
    return sum(
        max(
            p.operations / (machine.int8 if p.integer else machine.fp32), p.weights / machine.memory
        )
        for p in work
    )


def measure_machine(repetitions: int = 30) -> Machine:
    """Measure this core in this process, with the kernels that models run on."""
    rows = np.ones((ROWS, INNER), dtype=np.float32)
    rates = []
    for integer in (False, True):
        session = _session(_product(INNER, COLUMNS, integer))
        best = _best(lambda s=session: s.run(None, {"x": rows}), repetitions)  # type: ignore[misc]
        rates.append(2 * ROWS * INNER * COLUMNS / best)
    inner, columns = WEIGHTS
    plain = np.ones(inner * columns, dtype=np.float32)
    seconds = _best(plain.max, max(3, repetitions // 3))
    del plain  # which is as large as what follows
    row = np.ones((1, inner), dtype=np.float32)
    reading = _session(_product(inner, columns, False))
    seconds = min(seconds, _best(lambda: reading.run(None, {"x": row}), max(3, repetitions // 3)))
    return Machine(rates[0], rates[1], 4 * inner * columns / seconds)


def products(path: Path) -> list[MatrixProduct]:
    """The matrix products of one run of a model, as onnxruntime carries them out.

    Raises:
        ModelError: the file cannot be read.
    """
    card, _, data = read_model(path)
    with tempfile.TemporaryDirectory() as folder:
        options = _options()
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(folder) / "profile")
        session = ort.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        session.run(None, _untouched(card))
        events = json.loads(Path(session.end_profiling()).read_text())
    found = []
    for event in events:
        arguments = event.get("args", {})
        operator = arguments.get("op_name", "")
        if operator in PRODUCTS and event["name"].endswith("kernel_time"):
            found.append(_from_profile(operator, arguments))
    return found


def _untouched(card: ModelCard) -> dict[str, NDArray[Any]]:
    """Inputs of one run at batch 1: untouched, at the beginning of an episode."""
    sample = card.array.shape
    window = (card.steps,) if card.kind == "window" else ()
    return {
        "samples": np.zeros((1, *window, card.substeps, *sample), dtype=np.float32),
        "offset": np.zeros((1, *sample), dtype=np.float32),
        "sigma": np.zeros((1, *sample), dtype=np.float32),
        **{s.name: np.zeros((1, *s.shape), dtype=s.dtype) for s in card.state},
    }


def _from_profile(operator: str, arguments: dict[str, Any]) -> MatrixProduct:
    inputs = [next(iter(i.values())) for i in arguments["input_type_shape"]]
    output = next(iter(arguments["output_type_shape"][0].values()))
    if operator in ("Conv", "FusedConv"):
        columns, inner = output[1], math.prod(inputs[1][1:])
    else:
        columns, inner = output[-1], inputs[0][-1]
    integer = operator in INTEGER
    # Weights that were packed are not listed: one matrix, at least. They may also stand first.
    weights = max(inner * columns, math.prod(inputs[0])) * (1 if integer else 4)
    return MatrixProduct(math.prod(output) // columns, inner, columns, weights, integer)


def _best(run: Callable[[], Any], repetitions: int) -> float:
    taken = []
    for _ in range(repetitions + 1):  # the first allocates
        began = time.thread_time()
        run()
        taken.append(time.thread_time() - began)
    return min(taken[1:])


def _options() -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    return options


def _session(model: bytes) -> ort.InferenceSession:
    return ort.InferenceSession(model, _options(), providers=["CPUExecutionProvider"])


# ---- a product as an ONNX file, without the onnx package, which robots do not have


def _product(inner: int, columns: int, integer: bool) -> bytes:
    """x (rows, inner) -> y (rows, columns), its weights inside."""
    if integer:
        nodes = [
            _node("DynamicQuantizeLinear", ["x"], ["q", "scale", "zero"]),
            _node("MatMulInteger", ["q", "w", "zero"], ["y"]),
        ]
        weights = np.ones((inner, columns), dtype=np.int8)
    else:
        nodes = [_node("MatMul", ["x", "w"], ["y"])]
        weights = np.ones((inner, columns), dtype=np.float32)
    kind = INT8 if integer else FLOAT
    tensor = _field(1, inner) + _field(1, columns) + _field(2, kind) + _field(8, b"w")
    graph = b"".join(_field(1, node) for node in nodes) + _field(2, b"product")
    graph += _field(5, tensor + _field(9, weights.tobytes()))
    graph += _field(11, _value("x", FLOAT, inner))
    graph += _field(12, _value("y", INT32 if integer else FLOAT, columns))
    return _field(1, IR_VERSION) + _field(7, graph) + _field(8, _field(2, OPSET))


def _node(operator: str, inputs: list[str], outputs: list[str]) -> bytes:
    names = [_field(1, i.encode()) for i in inputs] + [_field(2, o.encode()) for o in outputs]
    return b"".join(names) + _field(4, operator.encode())


def _value(name: str, kind: int, columns: int) -> bytes:
    shape = _field(1, _field(2, b"rows")) + _field(1, _field(1, columns))
    return _field(1, name.encode()) + _field(2, _field(1, _field(1, kind) + _field(2, shape)))


def _field(number: int, value: int | bytes) -> bytes:
    """One protobuf field: a number as a varint, bytes with their length."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes(out + bytes([value]))
