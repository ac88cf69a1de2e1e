"""Layers of networks and of files, for the six stimuli."""

import msgspec
import numpy as np
import pytest

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")

from tactile_rt.alignment.activations import (  # noqa: E402
    network_layers,
    reach,
    untrained_card_layers,
    untrained_layers,
)
from tactile_rt.alignment.layers import first_difference  # noqa: E402
from tactile_rt.alignment.loading import load_untrained  # noqa: E402
from tactile_rt.alignment.onnx_activations import onnx_layers  # noqa: E402
from tactile_rt.alignment.rdm import rdm  # noqa: E402
from tactile_rt.alignment.stimuli_input import SHIPPED, read_stimuli  # noqa: E402
from tactile_rt.classifier.model_file import load_model, read_model, shipped_model  # noqa: E402
from tactile_rt.core.errors import ConfigError  # noqa: E402
from tactile_rt.core.stream.sensor_spec import channel_limits  # noqa: E402
from tactile_rt.core.stream.stimuli import STIMULI  # noqa: E402
from tactile_rt.models.ead import EADConfig, TactileClassifier  # noqa: E402
from tactile_rt.models.encoders.graph_encoder import draw_as_published  # noqa: E402
from tactile_rt.models.encoders.zhuang import zhuang_graph  # noqa: E402
from tests.helpers.source_tree import ROOT  # noqa: E402

FELT = read_stimuli()
SPEC = load_model(shipped_model())[1].array
LIMITS = channel_limits(SPEC)
# Steps from the frame to each map, counted by hand from the paper's graph.
STEPS_TO = {"conv1": 0, "conv2": 1, "conv3": 2, "conv4": 3, "conv5": 4, "conv6": 5, "fc7": 2,
            "fc8": 3}  # fmt: skip
MAMBA = [f"block{i}" for i in range(4)]
GPT = [f"block{i}" for i in range(8)]
LAYERS = {
    "zhuang-ugrnn": list(STEPS_TO),
    "resnet18": ["stem", *(f"block{i}" for i in range(8)), "fc"],
    "s4": ["embed", "block0", "block1", "block2", "block3", "out"],
    "mamba": ["embed", *MAMBA, "norm"],
    "gru": ["layer0", "layer1"],
    "gpt": [*GPT, "norm", "project_out"],
    "none": [],
    "linear": ["logits"],
    "mlp": ["fc1", "fc2", "logits"],
    "mlp-all": ["fc1", "fc2", "logits"],
}


def build(encoder, attender="none", decoder="linear", seed=0):
    torch.manual_seed(seed)
    config = EADConfig(7, encoder, attender, decoder, width=1 / 32)
    return TactileClassifier(SPEC, config, LIMITS)


def test_shipped_input():
    assert SHIPPED.stat().st_size < 300_000
    assert FELT.samples.shape == (6, 22, 5, 30, 6)
    felt = (np.abs(FELT.samples) > 1e-7).any(axis=(1, 2, 4)).sum(axis=1)
    assert (felt > 0).all()  # every stimulus is touched
    assert np.isfinite(rdm(FELT.raw())).all()


@pytest.mark.parametrize(
    "encoder, attender, decoder",
    [
        ("zhuang-ugrnn", "gpt", "mlp"),
        ("resnet18", "none", "mlp-all"),
        ("s4", "mamba", "linear"),
        ("mamba", "gpt", "linear"),
        ("gru", "mamba", "mlp"),
    ],
)
def test_every_layer_of_every_kind(encoder, attender, decoder):
    model = build(encoder, attender, decoder)
    found = network_layers(model, FELT)
    # "mamba" is the name of an encoder and of an attender, which alone has no embedding.
    expected = [f"encoder.{n}" for n in LAYERS[encoder]]
    names = [*MAMBA, "norm"] if attender == "mamba" else LAYERS[attender]
    expected += [f"attender.{n}" for n in names] + [f"decoder.{n}" for n in LAYERS[decoder]]
    assert list(found.traces) == expected
    for name, trace in found.traces.items():
        assert trace.shape[:2] == (6, 22), name
        # Independent of the graph: the first step at which the stimuli differ.
        assert found.first[name] == first_difference(trace), name
    model.eval()
    with torch.no_grad():
        frames = model.inputs(*(map(torch.from_numpy, (FELT.samples, FELT.offset, FELT.sigma))))
        features = model.network.encoder(frames)
        attended = model.network.attender(features)
        logits = model.network(frames)
    last = [n for n in expected if n.startswith("encoder.")][-1]
    np.testing.assert_allclose(found.traces[last], features.numpy(), atol=2e-6)
    if attender != "none":
        last = [n for n in expected if n.startswith("attender.")][-1]
        np.testing.assert_allclose(found.traces[last], attended.numpy(), atol=2e-6)
    np.testing.assert_allclose(found.traces["decoder.logits"], logits.numpy(), atol=2e-6)
    np.testing.assert_array_equal(found.logits, logits.numpy())


def test_only_steps_that_input_can_reach_count():
    assert reach(zhuang_graph()) == STEPS_TO
    found = network_layers(build("zhuang-ugrnn"), FELT)
    trace = found.traces["encoder.conv6"]
    assert not np.ptp(trace[:, :5], axis=0).any()
    np.testing.assert_allclose(found.patterns["encoder.conv6"], trace[:, 5:].mean(axis=1), 1e-5)


@pytest.mark.parametrize("encoder, attender", [("resnet18", "none"), ("gru", "gpt")])
def test_batch_norm_and_dropout_are_off_and_the_mode_is_kept(encoder, attender):
    model = build(encoder, attender)
    quiet = network_layers(model.eval(), FELT)
    assert not model.training
    loud = network_layers(model.train(), FELT)
    assert model.training
    assert all(np.array_equal(quiet.traces[n], loud.traces[n]) for n in quiet.traces)


def test_untrained_networks_are_of_a_seed_and_leave_the_generator_alone():
    network = {"classes": 7, "encoder": "gru", "width": 1 / 32}
    weights = TactileClassifier(SPEC, EADConfig(**network), LIMITS).state_dict()
    saved = {"spec": SPEC.to_json(), "network": network, "model": weights}
    torch.manual_seed(5)
    before = torch.random.get_rng_state()
    one, again, other = (untrained_layers(saved, FELT, seed) for seed in (1, 1, 2))
    assert torch.equal(before, torch.random.get_rng_state())
    name = "encoder.layer1"
    np.testing.assert_array_equal(one.traces[name], again.traces[name])
    assert not np.allclose(one.traces[name], other.traces[name])


def test_taps_of_the_shipped_step_leave_its_output_bitwise_unchanged():
    found, card = onnx_layers(shipped_model(), FELT)
    assert found.notes == ()  # which would say that the logits changed
    encoder = [f"encoder.{n}" for n in LAYERS["gru"]]
    assert list(found.traces) == [*encoder, *(f"decoder.{n}" for n in LAYERS["mlp"])]
    assert {found.first[n] for n in encoder} == {0}
    session, _ = load_model(shipped_model())
    state = {s.name: np.zeros((1, *s.shape), dtype=s.dtype) for s in card.state}
    names = [o.name for o in session.get_outputs()]
    quiet = {"offset": FELT.offset[3:4], "sigma": FELT.sigma[3:4]}
    for t in range(22):
        made = session.run(None, {**state, **quiet, "samples": FELT.samples[3:4, t]})
        out = dict(zip(names, made, strict=True))
        state = {s.name: out[f"{s.name}_next"] for s in card.state}
        np.testing.assert_array_equal(found.logits[3, t], out["logits"][0])
        np.testing.assert_array_equal(found.traces["encoder.layer1"][3, t], state["gru_h"][0, 1])


def test_another_array_is_refused(tmp_path):
    arrays = dict(np.load(SHIPPED))
    arrays["elements"] = np.array([f"x{i}" for i in range(30)])
    path = tmp_path / "other.npz"
    np.savez(path, **arrays)
    with pytest.raises(ConfigError, match=r"other.npz has the elements x0, .*was trained on A0"):
        onnx_layers(shipped_model(), read_stimuli(path))


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda a: a | {"stimuli": np.array([*STIMULI[:5], "mug"])}, "lacks the stimuli concave-f"),
        (lambda a: a | {"values": a["values"][:, :50]}, "values are"),
        (lambda a: a | {"values": a["values"] * np.nan}, "not finite"),
        (lambda a: a | {"units": np.array(["N"] * 5 + ["K"])}, "channels in K cannot be scored"),
        (lambda a: {"values": a["values"]}, "no model input"),
    ],
)
def test_damaged_input_is_refused(tmp_path, change, said):
    path = tmp_path / "input.npz"
    np.savez(path, **change(dict(np.load(SHIPPED))))
    with pytest.raises(ConfigError, match=said):
        read_stimuli(path)


def test_stimuli_are_taken_by_name_not_by_place(tmp_path):
    arrays = dict(np.load(SHIPPED))
    order = [3, 1, 5, 0, 2, 4]
    path = tmp_path / "shuffled.npz"
    np.savez(path, **arrays | {name: arrays[name][order] for name in ("stimuli", "values")})
    again = read_stimuli(path)
    np.testing.assert_array_equal(again.samples, FELT.samples)
    assert again.sha256 == FELT.sha256


def test_a_file_knows_the_network_that_it_was_before_training():
    """The card's architecture gives what the checkpoint's does, bit for bit."""
    file = load_untrained(shipped_model(), FELT, 3)
    checkpoint = load_untrained(ROOT / "bench" / "shipped" / "mouse13.pt", FELT, 3)
    assert file.parameters == checkpoint.parameters
    assert list(file.traces) == list(checkpoint.traces)
    for layer, trace in file.traces.items():
        np.testing.assert_array_equal(trace, checkpoint.traces[layer])


def test_a_card_that_names_no_network_has_no_control():
    card = read_model(shipped_model())[0]
    for network in (None, {"of": "another program"}):
        other = msgspec.structs.replace(card, provenance={"network": network})
        assert untrained_card_layers(other, FELT) is None


def test_a_twin_has_the_first_weights_that_its_network_had():
    """As the paper draws them, where training did: evenly, within 1 / sqrt(fan-in)."""
    config = EADConfig(7, "zhuang-ugrnn", "none", width=1 / 32)
    weights = TactileClassifier(SPEC, config, LIMITS).state_dict()
    network = msgspec.to_builtins(config)
    card = read_model(shipped_model())[0]
    for first, others in (("paper", "kaiming"), ("kaiming", "paper")):
        training = {"first_weights": first}
        saved = {"spec": SPEC.to_json(), "network": network, "model": weights, "config": training}
        twin = untrained_layers(saved, FELT, 3)
        torch.manual_seed(3)
        model = TactileClassifier(SPEC, config, LIMITS)
        if first == "paper":
            draw_as_published(model.network.encoder)
        expected = network_layers(model, FELT).traces["encoder.conv1"]
        np.testing.assert_array_equal(twin.traces["encoder.conv1"], expected)
        other = untrained_layers({**saved, "config": {"first_weights": others}}, FELT, 3)
        assert not np.allclose(other.traces["encoder.conv1"], expected)
        said = {"network": network, "training": training}
        file = untrained_card_layers(msgspec.structs.replace(card, provenance=said), FELT, 3)
        assert not np.allclose(file.traces["encoder.conv1"], other.traces["encoder.conv1"])


@pytest.mark.parametrize(
    "change",
    [{"encoder": "of-a-later-release"}, {"frame": [30, 2, 2]}, {"max_steps": 3}],
)
def test_a_card_whose_network_cannot_be_built_has_no_control(change):
    card = read_model(shipped_model())[0]
    said = {**card.provenance, "network": {**card.provenance["network"], **change}}
    assert untrained_card_layers(msgspec.structs.replace(card, provenance=said), FELT) is None
