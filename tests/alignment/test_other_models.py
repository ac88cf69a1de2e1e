"""Models made elsewhere: any ONNX file of one input, and torch modules."""

import numpy as np
import onnx
import pytest
import torch
from onnx import TensorProto, helper, numpy_helper

from tactile_rt.alignment.loading import check_models, load_layers
from tactile_rt.alignment.other_models import fit_loads
from tactile_rt.alignment.stimuli_input import read_stimuli
from tactile_rt.core.errors import ConfigError

FELT = read_stimuli()
LOADS = FELT.samples.reshape(6, 110, len(FELT.elements), 6)
FEATURES = LOADS.shape[2] * 6


def write_model(path, shape, units=5, weights=None):
    """A product with weights, a bias, a ReLU; another product, over the axis of the loads."""
    rng = np.random.default_rng(0)
    first = rng.normal(size=(shape[-1] if weights is None else weights, units)).astype("f4")
    second = rng.normal(size=(units, 3)).astype("f4")
    nodes = [
        helper.make_node("MatMul", ["x", "cell.weight"], ["a"]),
        helper.make_node("Add", ["a", "cell.bias"], ["b"]),
        helper.make_node("Relu", ["b"], ["c"]),
        helper.make_node("MatMul", ["c", "onnx::MatMul_7"], ["y"], name="/head/MatMul"),
    ]
    stored = {"cell.weight": first, "cell.bias": np.ones(units, "f4"), "onnx::MatMul_7": second}
    graph = helper.make_graph(
        nodes, "g", [helper.make_tensor_value_info("x", TensorProto.FLOAT, shape)],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(a, name) for name, a in stored.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(model, path)
    return first, second


def test_layers_of_an_onnx_file_are_its_products_behind_bias_and_relu(tmp_path):
    path = tmp_path / "mine.onnx"
    first, second = write_model(path, ["batch", "time", FEATURES])
    assert check_models([path]) == ("mine",)
    layers, accuracy = load_layers(path, FELT)
    assert accuracy is None and list(layers.traces) == ["encoder.cell", "encoder.head"]
    hidden = np.maximum(LOADS.reshape(6, 110, -1) @ first + 1, 0)
    np.testing.assert_allclose(layers.traces["encoder.cell"], hidden, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(layers.traces["encoder.head"], hidden @ second, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "shape, order",
    [
        (("n", "t", len(FELT.elements), 6), (0, 1, 2)),
        ((1, 6, len(FELT.elements), 110), (2, 1, 0)),
        ((None, 6, 110, len(FELT.elements)), (2, 0, 1)),
    ],
)
def test_loads_are_put_in_the_order_of_an_inputs_axes(shape, order):
    fitted = fit_loads(FELT, shape, "x")
    np.testing.assert_array_equal(fitted, LOADS.transpose(0, *(1 + k for k in order)))


def test_loads_are_resampled_to_an_inputs_length():
    ramp = np.broadcast_to(np.arange(110.0)[:, None, None], LOADS.shape[1:]).astype("f4")
    ramps = np.stack([ramp] * 6).reshape(FELT.samples.shape)
    from dataclasses import replace

    twice = fit_loads(replace(FELT, samples=ramps), (1, 55, FEATURES), "x")
    np.testing.assert_allclose(twice[0, :, 0], np.arange(55) * 2 + 0.5, rtol=1e-6)
    assert fit_loads(FELT, (1, 220 * FEATURES), "x").shape == (6, 220 * FEATURES)


@pytest.mark.parametrize("shape", [(1, 3, 224, 224), (4, 110, FEATURES), (1, 110), ()])
def test_an_input_that_the_loads_do_not_fit_is_refused_with_the_npz_way(shape):
    with pytest.raises(ConfigError, match=r"an \.npz of \(6, unit\)"):
        fit_loads(FELT, shape, "m.onnx: input x")


def test_a_torch_module_is_scored_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_network.py").write_text(
        "from torch import nn\n"
        f"def make(): return nn.Sequential(nn.Flatten(2), nn.Linear({FEATURES}, 4), nn.Tanh())\n"
    )
    from pathlib import Path

    path = Path("my_network:make")
    assert check_models([path]) == ("make",)
    torch.manual_seed(0)
    layers, _ = load_layers(path, FELT)
    torch.manual_seed(0)
    linear = torch.nn.Linear(FEATURES, 4)
    expected = linear(torch.from_numpy(LOADS.reshape(6, 110, -1).copy())).detach().numpy()
    np.testing.assert_allclose(layers.traces["encoder.1"], expected, rtol=1e-5, atol=1e-7)
    with pytest.raises(ConfigError, match="other: cannot be imported"):
        load_layers(Path("my_network:other"), FELT)
