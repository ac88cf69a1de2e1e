"""The gate: what may be released, and the exported model beside the one it was made from."""

import itertools
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace as change
from scipy import stats

from tactile_rt.alignment import gate
from tactile_rt.alignment.scoring import score
from tactile_rt.alignment.strict import freeze_strict
from tests.helpers import brains

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from tactile_rt.alignment.activations import network_layers  # noqa: E402
from tactile_rt.alignment.fidelity import (  # noqa: E402
    check_fidelity,
    compare_layers,
    export_layers,
)
from tactile_rt.alignment.layers import Layers  # noqa: E402
from tactile_rt.alignment.onnx_activations import onnx_layers  # noqa: E402
from tactile_rt.alignment.stimuli_input import read_stimuli  # noqa: E402
from tactile_rt.classifier.model_file import METADATA_KEY, load_model, shipped_model  # noqa: E402
from tactile_rt.core.stream.sensor_spec import channel_limits  # noqa: E402
from tactile_rt.export.graph_forms import in_precision, window_graph  # noqa: E402
from tactile_rt.export.onnx_step import export_step  # noqa: E402
from tactile_rt.models.ead import EADConfig, TactileClassifier  # noqa: E402
from tests.helpers.small_networks import stir  # noqa: E402

FELT = read_stimuli()


@pytest.fixture(scope="module")
def world():
    """A geometry, a benchmark of six animals that share it, an aligned and a random model."""
    rng = np.random.default_rng(4)
    shared = brains.geometry(rng)
    benchmark = freeze_strict(brains.animals(rng, 6, shared=shared), 50)
    aligned = {f"encoder.{i}": brains.responses(rng, shared, 400) for i in range(2)}
    random = {f"encoder.{i}": rng.normal(size=(6, 60)) for i in range(2)}
    return benchmark, score(benchmark, aligned), score(benchmark, random)


def codes(checks):
    return {check.name: check.code for check in checks}


def test_an_aligned_model_passes_a_random_one_fails_and_chance_is_inconclusive(world):
    benchmark, aligned, random = world
    chance = change(aligned, p=0.06)
    for made, code in ((aligned, gate.PASS), (random, gate.FAIL), (chance, gate.INCONCLUSIVE)):
        checks = gate.neural_checks(made, benchmark)
        assert codes(checks) == {"validity": gate.PASS, "turing": code}
        assert gate.exit_code(checks) == code


def test_a_model_without_an_rdm_is_inconclusive(world):
    benchmark, aligned, _ = world
    flat = change(aligned, rdms=np.full((2, 15), np.nan))
    assert codes(gate.neural_checks(flat, benchmark))["turing"] == gate.INCONCLUSIVE
    one = change(aligned, rdms=np.stack([aligned.rdms[0], np.full(15, np.nan)]))
    assert codes(gate.neural_checks(one, benchmark))["turing"] == gate.PASS


def test_the_power_stands_beside_the_verdict(world):
    benchmark, aligned, _ = world
    power = gate.mice_of(benchmark).power()
    said = next(c for c in gate.neural_checks(aligned, benchmark) if c.name == "turing").why
    assert gate.turing(aligned, gate.mice_of(benchmark)).why in said
    assert f"{power.passes:.0%} pass" in said
    assert all(f"{share:.0%} at {lost:.0%}" in said for lost, share in power.fails.items())


def test_one_animal_is_inconclusive():
    rng = np.random.default_rng(4)
    shared = brains.geometry(rng)
    benchmark = freeze_strict(brains.animals(rng, 1, shared=shared), 50)
    made = score(benchmark, {"encoder.0": brains.responses(rng, shared, 60)})
    checks = gate.neural_checks(made, benchmark, made.rdms)
    assert codes(checks) == dict.fromkeys(("validity", "turing", "regression"), gate.INCONCLUSIVE)
    assert gate.exit_code(checks) == gate.INCONCLUSIVE


def test_a_model_is_no_worse_than_itself(world):
    benchmark, aligned, random = world
    mice = gate.mice_of(benchmark)
    assert gate.regression(aligned, mice, aligned.rdms).code == gate.PASS
    assert gate.regression(aligned, mice, random.rdms).code == gate.PASS
    assert gate.regression(random, mice, aligned.rdms).code == gate.FAIL
    assert gate.regression(random, mice, np.full((2, 15), np.nan)).code == gate.INCONCLUSIVE


@pytest.mark.parametrize(
    "drop, spread, code",
    [
        (0.2, 0.02, gate.FAIL),
        (0.03, 0.001, gate.PASS),  # certain, but small
        (0.06, 0.4, gate.INCONCLUSIVE),  # not to be told from none, nor from much
        (-0.2, 0.02, gate.PASS),
    ],
)
def test_regression(world, monkeypatch, drop, spread, code):
    """Fits as they may be; the tests are Student's, from another source."""
    benchmark, aligned, _ = world
    mice = gate.mice_of(benchmark)
    drops = drop + spread * np.array([1, -1, 1, -1, 1, -1])
    fits = {0: np.zeros(6) + drops * mice.ceiling, 1: np.zeros(6)}
    found = mice.compare(aligned.rdms[None])
    calls = iter((0, 1))
    monkeypatch.setattr(mice, "compare", lambda rdms: replace(found, fits=fits[next(calls)][None]))
    check = gate.regression(aligned, mice, aligned.rdms)
    assert check.code == code
    low, high = stats.t.interval(0.75, 5, drops.mean(), stats.sem(drops))
    assert f"[{low:+.3f}, {high:+.3f}]" in check.why
    assert (high < 0.05) == (code == gate.PASS)


def test_exit_code_of_every_combination():
    for these in itertools.product((gate.PASS, gate.FAIL, gate.INCONCLUSIVE), repeat=3):
        expected = gate.FAIL if gate.FAIL in these else max(these)
        assert gate.exit_code([gate.Check("x", code, "") for code in these]) == expected


def written(path, encoder, attender, decoder, width=1 / 32, trained=True):
    """A small network whose export is at a path now."""
    torch.manual_seed(2)
    card = load_model(shipped_model())[1]
    config = EADConfig(len(card.labels), encoder, attender, decoder, width=width)
    model = TactileClassifier(card.array, config, channel_limits(card.array)).eval()
    if trained:
        stir(model)
    plain = change(card, provenance={}, figures={}, kinds={}, names={}, identity=None)
    export_step(model, plain, path)
    return model


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A small network and its export."""
    path = tmp_path_factory.mktemp("gate") / "step.onnx"
    model = written(path, "gru", "none", "mlp", width=1 / 16)
    return network_layers(model, FELT), path


@pytest.fixture(scope="module")
def quantised(exported):
    """The same, quantised to int8."""
    quantization = pytest.importorskip("onnxruntime.quantization")
    path = exported[1].with_name("int8.onnx")
    model = onnx.load(exported[1])
    del model.graph.value_info[:]  # the exporter's and the quantiser's differ
    quantization.quantize_dynamic(model, path)
    return path


def damaged(source, path, matching):
    """A copy in which the units of some weights are shuffled."""
    model = onnx.load(source)
    rng = np.random.default_rng(0)
    changed = 0
    for tensor in model.graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.ndim == 2 and matching(tensor.name, values):
            mixed = rng.permuted(values, axis=0)
            tensor.CopyFrom(onnx.numpy_helper.from_array(mixed, tensor.name))
            changed += 1
    assert changed
    onnx.save(model, path)
    return path


def test_a_faithful_export_passes(exported):
    reference, path = exported
    check, rows = check_fidelity(reference, export_layers(path, FELT, reference))
    assert check.code == gate.PASS
    assert [row.layer for row in rows] == [*reference.traces, "output"]
    assert min(row.pearson for row in rows) >= 0.9999
    assert max(row.difference for row in rows) <= 1e-5


def test_a_window_gives_the_layers_of_its_step(exported):
    reference, path = exported
    card = load_model(path)[1]
    window = window_graph(onnx.load(path), card.state)
    text = msgspec.json.encode(change(card, kind="window", state=(), probe=()))
    onnx.helper.set_model_props(window, {METADATA_KEY: text.decode()})
    other = path.with_name("window.onnx")
    onnx.save(window, other)
    step, _ = onnx_layers(path, FELT)
    whole, _ = onnx_layers(other, FELT)
    assert whole.notes == step.notes == ()
    assert list(whole.traces) == list(step.traces) == list(reference.traces)
    for name, trace in step.traces.items():
        np.testing.assert_allclose(whole.traces[name], trace, atol=1e-6)


@pytest.mark.parametrize(
    "encoder, attender, decoder",
    [
        ("gru", "none", "mlp"),
        ("gru", "gpt", "mlp"),
        pytest.param("zhuang-ugrnn", "none", "linear", marks=pytest.mark.slow),
    ],
)
def test_a_file_averages_the_steps_of_its_checkpoint(tmp_path, encoder, attender, decoder):
    """Whatever is felt: here three steps of nothing come first."""
    path = tmp_path / "step.onnx"
    model = written(path, encoder, attender, decoder)
    samples = FELT.samples.copy()
    samples[:, :3] = 0
    late = replace(FELT, samples=samples)
    reference = network_layers(model, late)
    for felt in (FELT, late):
        assert onnx_layers(path, felt)[0].first == reference.first
    found = export_layers(path, late, reference)
    assert {name: found.first[name] for name in reference.first} == reference.first
    assert check_fidelity(reference, found)[0].code == gate.PASS


def test_the_checkpoint_says_which_steps_count(exported, monkeypatch):
    """Where a network hardly responds, a file seems to hear its input later than it does."""
    reference, path = exported

    def late(*asked):
        layers, card = onnx_layers(*asked)
        return replace(layers, first=dict.fromkeys(layers.first, 9)), card

    monkeypatch.setattr("tactile_rt.alignment.onnx_activations.onnx_layers", late)
    found = export_layers(path, FELT, reference)
    assert {name: found.first[name] for name in reference.first} == reference.first
    assert check_fidelity(reference, found)[0].code == gate.PASS


@pytest.mark.parametrize("precision", ["fp16", "bf16"])
def test_a_gpt_of_weights_in_16_bits_passes(tmp_path, precision):
    """A weight that is stored in 16 bits is no response of the layer that it is of."""
    path = tmp_path / "step.onnx"
    model = written(path, "gru", "gpt", "linear", width=1 / 16)
    onnx.save(in_precision(onnx.load(path), precision), path)
    reference = network_layers(model, FELT)
    layers = export_layers(path, FELT, reference)
    assert layers.precision == precision
    assert check_fidelity(reference, layers)[0].code == gate.PASS


def test_layers_that_are_alike_in_an_export_are_not_compared_and_it_says_so(tmp_path):
    """An untrained network's norms are one to the exporter, under the last one's name."""
    path = tmp_path / "step.onnx"
    model = written(path, "gru", "gpt", "linear", trained=False)
    reference = network_layers(model, FELT)
    check, rows = check_fidelity(reference, export_layers(path, FELT, reference))
    assert check.code == gate.PASS and "layers could not be compared" in check.why
    assert "attender.block0" not in {row.layer for row in rows}


def test_an_int8_export_passes_and_a_damaged_one_fails(exported, quantised, tmp_path):
    reference, _ = exported
    layers = export_layers(quantised, FELT, reference)
    assert layers.precision == "int8"
    check, rows = check_fidelity(reference, layers)
    assert check.code == gate.PASS
    assert len(rows) == len(reference.traces) + 1
    assert min(row.pearson for row in rows) >= 0.98

    bad = damaged(quantised, tmp_path / "bad.onnx", lambda name, v: v.dtype in (np.int8, np.uint8))
    check, _ = check_fidelity(reference, export_layers(bad, FELT, reference))
    assert check.code == gate.FAIL


def test_one_damaged_layer_is_named(exported, tmp_path):
    reference, path = exported
    last = reference.logits.shape[-1]
    bad = damaged(path, tmp_path / "bad.onnx", lambda name, v: last in v.shape)
    check, rows = check_fidelity(reference, export_layers(bad, FELT, reference))
    assert check.code == gate.FAIL
    assert {row.layer for row in rows if not row.kept} == {"decoder.logits", "output"}
    assert "decoder.logits" in check.why or "output" in check.why


def test_another_network_fails(exported):
    reference, _ = exported
    check, _ = check_fidelity(reference, onnx_layers(shipped_model(), FELT)[0])
    assert check.code == gate.FAIL


def test_a_small_difference_misses_single_precision_but_not_int8(exported):
    reference, path = exported
    same, _ = onnx_layers(path, FELT)
    rng = np.random.default_rng(0)
    moved = {
        n: (t + 1e-4 * np.abs(t).max() * rng.normal(size=t.shape[2:])).astype(np.float32)
        for n, t in same.traces.items()
    }
    other = replace(same, traces=moved)
    assert check_fidelity(reference, other)[0].code == gate.FAIL
    assert check_fidelity(reference, replace(other, precision="int8"))[0].code == gate.PASS


def test_an_rdm_that_says_nothing_is_not_compared():
    """Of two classes the patterns of the output are all alike or opposite: an RDM of rounding."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 1.5, size=(6, 22, 1))
    rounded = 1e-8 * rng.normal(size=(2, 6, 22, 2))
    a, b = (
        Layers(n, {"encoder.0": trace}, {"encoder.0": 0}, np.float32(depth * (1, -0.97) + error), 1)
        for n, error, trace in zip("ab", rounded, [rng.normal(size=(6, 22, 9))] * 2, strict=True)
    )
    check, rows = check_fidelity(a, b)
    assert check.verdict == "pass" and "least alike encoder.0" in check.why
    output = next(row for row in rows if row.layer == "output")
    assert output.kept and np.isnan(output.pearson)
    # one that is not flat any more is compared, and found to be another
    turned = replace(b, logits=b.logits * np.float32([1, -1]))
    assert not next(r for r in compare_layers(a, turned) if r.layer == "output").kept
