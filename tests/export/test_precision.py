"""Files in fewer bits, and the window form: what they hold, and how far their logits are off."""

from collections import Counter
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper

from bench.inference.full_size import random_model
from tactile_rt.classifier.model_file import (
    file_outputs,
    load_model,
    read_model,
    shipped_model,
    verify_model,
)
from tactile_rt.core.errors import ConfigError
from tactile_rt.export.graph_forms import CONTRIB, PRECISIONS, in_precision
from tactile_rt.export.onnx_step import PARITY_BAR, parity, step_graph, write_model
from tactile_rt.models.ead import EADConfig

CLASSES = 6
# Largest difference of logits, of a spread of about 1, that a precision may make.
TOLERANCE = {"fp32": PARITY_BAR, "fp16": 5e-3, "bf16": 5e-2, "int8": 1e-1}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """One network, traced once, in every precision and in both forms."""
    folder = tmp_path_factory.mktemp("precision")
    spec = read_model(shipped_model())[0].array
    config = EADConfig(CLASSES, attender="gpt", width=1 / 16, readout="mean")
    model, card = random_model(spec, config, "small")
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.endswith("bias"):  # at zero it would not be missed
                parameter += 0.1 * torch.randn_like(parameter)
        model.network.decoder.weight *= 8  # logits of a spread of about 1
    proto, state = step_graph(model, card, integer=True)
    cards, paths = {}, {}
    forms = [(p, p, "step") for p in PRECISIONS]
    for name, *form in (*forms, *((f"window {p}", p, "window") for p in ("fp32", "int8"))):
        paths[name] = folder / f"{name}.onnx"
        cards[name] = write_model(proto, state, model, card, paths[name], *form)
    return SimpleNamespace(model=model, proto=proto, state=state, cards=cards, paths=paths)


def windows(card, batch: int, steps: int = 22, seed: int = 3) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    elements, channels = card.array.shape
    scale = np.array(card.scale)
    samples = rng.standard_cauchy((batch, steps, card.substeps, elements, channels)) * scale
    offset = rng.normal(size=(batch, elements, channels)) * scale
    return tuple(a.astype(np.float32) for a in (samples, offset, abs(offset)))


@pytest.mark.parametrize("precision", PRECISIONS)
def test_logits_are_the_network_s_within_what_the_precision_allows(
    files: SimpleNamespace, precision: str
) -> None:
    found = parity(files.model, files.paths[precision], episodes=2, seed=5)
    assert set(found) == {"logits", "embedding"}
    assert max(found.values()) <= TOLERANCE[precision]
    worst = min(found.values())
    if precision != "fp32":
        assert worst > PARITY_BAR, "nothing was rounded"
        assert files.cards[precision].figures["quantisation_logits"] <= TOLERANCE[precision]
    assert files.cards[precision].figures["parity"] <= PARITY_BAR
    assert files.cards[precision].precision == precision


def test_smaller_files(files: SimpleNamespace) -> None:
    weights = {p: read_model(files.paths[p])[1].weights for p in PRECISIONS}
    assert weights["fp16"] < 0.55 * weights["fp32"]
    assert weights["bf16"] < 0.55 * weights["fp32"]
    assert weights["int8"] < 0.4 * weights["fp32"]


def test_int8_leaves_no_large_product_in_floats_and_norms_and_states_alone(
    files: SimpleNamespace,
) -> None:
    proto = onnx.load(files.paths["int8"])
    count, before = Counter(), Counter(n.op_type for n in files.proto.graph.node)
    weights = {w.name: w for w in proto.graph.initializer}
    for node in proto.graph.node:
        count[node.op_type] += 1
        if node.op_type in ("MatMul", "Gemm") and node.input[1] in weights:
            assert np.prod(weights[node.input[1]].dims) < 1024
    assert count["MatMulIntegerToFloat"] == 5 + 6  # drives and cells; conv1 is small here
    assert count["DynamicQuantizeLinear"] <= count["MatMulIntegerToFloat"]
    # Every convolution has a bias, which its product adds by itself.
    assert count["Add"] == before["Add"] - count["MatMulIntegerToFloat"]
    for node in proto.graph.node:
        if node.op_type == "MatMulIntegerToFloat":
            assert len(node.input) == 7 and np.any(numpy_helper.to_array(weights[node.input[6]]))
    assert count["LayerNormalization"] == before["LayerNormalization"]
    for value in (*proto.graph.input, *proto.graph.output):
        kind = value.type.tensor_type.elem_type
        assert kind in (onnx.TensorProto.FLOAT, onnx.TensorProto.INT64), value.name
    assert {o.domain for o in proto.opset_import} == {"", CONTRIB}


def test_int8_weights_are_rounded_by_at_most_half_a_step(files: SimpleNamespace) -> None:
    proto = onnx.load(files.paths["int8"])
    now = {w.name: numpy_helper.to_array(w) for w in proto.graph.initializer}
    checked = 0
    for weight in files.proto.graph.initializer:
        codes, scale = (now.get(f"{weight.name}_{part}") for part in ("int8", "scale"))
        if codes is None:
            continue
        values = numpy_helper.to_array(weight)
        if codes.dtype == np.int8:
            error, step = abs(codes * scale - values), scale
        else:
            outputs, count, block = codes.shape
            back = ((codes.astype(np.float32) - 128) * scale.reshape(outputs, count, 1)).reshape(
                outputs, -1
            )
            values = values if values.shape[0] == outputs != values.shape[1] else values.T
            if values.shape[0] != outputs:
                values = values.T
            error = abs(back[:, : values.shape[1]] - values)
            step = np.repeat(scale.reshape(outputs, count), block, 1)[:, : values.shape[1]]
            if error.max() > step.max():  # a square one may be stored either way
                error = abs(back[:, : values.shape[1]] - values.T)
        assert (error <= 0.501 * step).all(), weight.name
        checked += 1
    assert checked > 40


@pytest.mark.parametrize("precision", ["fp32", "int8"])
@pytest.mark.parametrize("steps", [1, 22])
def test_a_window_is_its_steps(files: SimpleNamespace, precision: str, steps: int) -> None:
    session, card = load_model(files.paths[f"window {precision}"], kind="window")
    step, step_card = load_model(files.paths[precision])
    assert card.kind == "window" and card.state == ()
    for batch in (1, 2):
        arrays = windows(card, batch, steps)
        expected = file_outputs(step, step_card, *arrays)
        found = file_outputs(session, card, *arrays)
        for name, size in (("logits", CLASSES), ("embedding", card.embedding)):
            assert found[name].shape == expected[name].shape == (batch, steps, size)
            assert abs(found[name] - expected[name]).max() <= 1e-6
    # A window without a batch or with too many steps is onnxruntime's to refuse.
    assert {i.name for i in session.get_inputs()} == {"samples", "offset", "sigma"}


def test_in_every_form_a_sample_that_is_no_number_is_gone_with_its_step(
    files: SimpleNamespace,
) -> None:
    for name, path in files.paths.items():
        session, card = load_model(path, kind=None)
        samples, offset, sigma = windows(card, batch=1)
        struck, rest = samples.copy(), samples.copy()
        struck[:, 3, :, ::2], rest[:, 3, :, ::2] = np.nan, offset[:, None, ::2]
        struck[:, 9, :, 1], rest[:, 9, :, 1] = np.inf, offset[:, None, 1]
        found, expected = (file_outputs(session, card, s, offset, sigma) for s in (struck, rest))
        for output, values in found.items():
            assert np.isfinite(values).all(), (name, output)
            assert np.array_equal(values, expected[output]), (name, output)
        other = file_outputs(session, card, samples, offset, sigma)["logits"]
        assert not np.array_equal(other[:, -1], found["logits"][:, -1]), "nothing was felt there"


def test_every_file_verifies_and_is_plain_onnx(files: SimpleNamespace) -> None:
    for name, path in files.paths.items():
        said = " ".join(verify_model(path))
        for line in ("parity: logits within", "embedding: 32 units, finite", "bad samples: NaN"):
            assert line in said, name
        if "int8" not in name:  # the checker does not know onnxruntime's own operators
            onnx.checker.check_model(onnx.load(path), full_check=True)


def test_a_precision_that_does_not_exist_is_refused(files: SimpleNamespace) -> None:
    with pytest.raises(ConfigError, match="precision is 'int4', not one of fp32"):
        in_precision(files.proto, "int4")  # type: ignore[arg-type]


def test_weights_are_rounded_to_the_nearest_bf16(files: SimpleNamespace) -> None:
    proto = in_precision(files.proto, "bf16")
    now = {w.name: w for w in proto.graph.initializer}
    for weight in files.proto.graph.initializer:
        if f"{weight.name}_16" in now:
            values = torch.from_numpy(numpy_helper.to_array(weight).copy())
            found = np.frombuffer(now[f"{weight.name}_16"].raw_data, np.uint16)
            expected = values.bfloat16().view(torch.uint16).numpy().ravel()
            assert np.array_equal(found, expected), weight.name
