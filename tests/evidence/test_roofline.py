"""The roofline: known products, and the hand-written graphs that measure the machine."""

from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest

from tactile_rt.classifier.onnx_check import read_onnx
from tactile_rt.evidence import roofline
from tactile_rt.evidence.roofline import (
    Machine,
    MatrixProduct,
    _product,
    measure_machine,
    products,
    roofline_s,
)

pytest.importorskip("onnx")

import onnx

from tests.helpers.tiny_model import write_model


def test_a_product_takes_its_arithmetic_or_its_weights_whichever_is_longer() -> None:
    machine = Machine(fp32=100e9, int8=400e9, memory=30e9)
    bound_by_arithmetic = MatrixProduct(1000, 1000, 1000, 4_000_000, integer=False)
    bound_by_memory = MatrixProduct(1, 1000, 1000, 4_000_000, integer=False)
    small = MatrixProduct(1000, 1000, 1000, 1_000_000, integer=True)
    assert roofline_s(machine, [bound_by_arithmetic]) == pytest.approx(2e9 / 100e9)
    assert roofline_s(machine, [bound_by_memory]) == pytest.approx(4e6 / 30e9)
    assert roofline_s(machine, [small, bound_by_memory]) == pytest.approx(2e9 / 400e9 + 4e6 / 30e9)


@pytest.mark.parametrize("integer", [False, True])
def test_the_measured_graph_is_onnx_and_multiplies(integer: bool) -> None:
    data = _product(5, 3, integer)
    onnx.checker.check_model(onnx.load_from_string(data), full_check=True)
    assert read_onnx(data).operators["MatMulInteger" if integer else "MatMul"] == 1
    session = ort.InferenceSession(data, providers=["CPUExecutionProvider"])
    out = session.run(None, {"x": np.ones((2, 5), dtype=np.float32)})[0]
    assert out.tolist() == [[5 * 255 if integer else 5] * 3] * 2


DENSE = """
<ir_version: 9, opset_import: ["" : 18]>
tiny (float[B,3,3,2] samples, float[B,3,2] offset, float[B,3,2] sigma) => (float[B,5] logits)
<int64[2] flat = {0, -1}>
{
  row = Reshape(samples, flat)
  logits = MatMul(row, weights)
}
"""


def test_the_products_of_a_model_are_counted(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.onnx", DENSE.replace(
        "{0, -1}>", "{0, -1}, float[18,5] weights = {" + ", ".join(["1"] * 90) + "}>"), state=(),
        version=2, embedding=0,
    )  # fmt: skip
    assert products(path) == [MatrixProduct(1, 18, 5, 360, integer=False)]


def test_the_machine_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(roofline, "WEIGHTS", (512, 512))  # in cache, for a test
    machine = measure_machine(1)
    assert machine.fp32 > 1e8
    assert machine.int8 > 1e8
    assert machine.memory > 1e8
