import errno
import json
import os
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import onnx
import onnx.parser
import onnxruntime
import pytest
import torch

import tactile_rt
from bench.inference.full_size import random_model
from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.decision_rules import OpenSetRule, PredictionSetRule
from tactile_rt.classifier.model_file import ModelCard, file_outputs, hash_of, load_model
from tactile_rt.classifier.onnx_check import graph_sha256
from tactile_rt.classifier.stepper import Stepper
from tactile_rt.core.errors import ModelError
from tactile_rt.core.stream import MOUSE, ArraySpec
from tactile_rt.core.stream.sensor_spec import CHANNEL_FLOOR, channel_limits
from tactile_rt.export import onnx_step, streaming
from tactile_rt.export.onnx_step import (
    PARITY_BAR,
    export_checkpoint,
    export_step,
    parity,
    step_graph,
    write_model,
)
from tactile_rt.models.attenders import gpt
from tactile_rt.models.checkpoints import fill_checkpoint, load_checkpoint
from tactile_rt.models.datasets import windows
from tactile_rt.models.ead import EADConfig, TactileClassifier
from tactile_rt.models.onsets import find_onsets
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.testing import cut_chunks
from tests.helpers.tiny_sweeps import tiny_array

STEPS, SUBSTEPS = MOUSE.steps, MOUSE.substeps
PERIOD_NS = 9_000_000
CATEGORIES = ("bowl", "car", "lamp", "mug")
SPEC = tiny_array()
TYPICAL = np.array([1e-4] * 3 + [1e-6] * 3, dtype=np.float32)  # loads of a touching whisker, SI
# Every kind of state there is: convolutions, the transformer's cache, the running mean of logits.
NETWORK = EADConfig(classes=len(CATEGORIES), attender="gpt", width=1 / 32, readout="mean")


def build() -> TactileClassifier:
    """Untrained, but with no parameter at a value that hides a mistake, such as zero."""
    torch.manual_seed(0)
    model = TactileClassifier(SPEC, NETWORK, channel_limits(SPEC)).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return model


@pytest.fixture(scope="module", autouse=True)
def _cheap() -> Iterator[None]:
    """A transformer of two layers: the exporter takes seconds for each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gpt, "LAYERS", 2)
        yield


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """One checkpoint, exported once: the exporter takes its time."""
    folder = tmp_path_factory.mktemp("export")
    manifest = SweepManifest(
        spec=SPEC,
        period_ns=PERIOD_NS,
        lead=24,
        categories=CATEGORIES,
        split={"train": ("mug-0",), "validation": ("mug-1",), "test": ("mug-2", "car-2")},
        recipe={"seed": 5},
    )
    manifest.write(folder / "set")
    model = build()
    checkpoint = folder / "best.pt"
    config = {"data": str(folder / "set"), "epochs": 0}
    saved = fill_checkpoint(model, manifest, (), config, {}, {})
    torch.save(saved, checkpoint)
    programs = []
    export = torch.onnx.export

    def remember(*args, **options):
        programs.append(export(*args, **options))
        return programs[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(torch.onnx, "export", remember)
        card = export_checkpoint(
            checkpoint,
            load_checkpoint(checkpoint),
            [manifest],
            folder / "out" / "tiny.onnx",
            "tiny",
            temperature=1.25,
            figures={"validation_top1": 0.5},
        )
    return SimpleNamespace(
        path=folder / "out" / "tiny.onnx",
        card=card,
        model=model,
        checkpoint=checkpoint,
        manifest=manifest,
        proto=programs[0].model_proto,
    )


def metadata(path: Path) -> dict:
    """What the file says of itself, read with nothing of ours."""
    (entry,) = [p for p in onnx.load(path).metadata_props if p.key == "tactile_rt"]
    return json.loads(entry.value)


def episodes(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(n, step, sub-step, element, channel) loads, faint to beyond belief, baseline and noise."""
    rng = np.random.default_rng(seed)
    size = 10 ** rng.uniform(-2, 3, size=(n, 1, 1, 30, 1))
    samples = rng.normal(size=(n, STEPS, SUBSTEPS, 30, 6)) * TYPICAL * size
    offset = rng.normal(size=(n, 30, 6)) * TYPICAL
    sigma = rng.uniform(0.01, 0.5, size=(n, 30, 6)) * TYPICAL
    return tuple(a.astype(np.float32) for a in (samples, offset, sigma))


def in_torch(model: TactileClassifier, *arrays: np.ndarray) -> np.ndarray:
    with torch.inference_mode():
        return model(*(torch.from_numpy(a) for a in arrays)).numpy()


def embedded(model: TactileClassifier, *arrays: np.ndarray) -> np.ndarray:
    """What goes into the network's last linear layer, caught where it does."""
    *_, last = (m for m in model.network.decoder.modules() if isinstance(m, torch.nn.Linear))
    caught = []
    with last.register_forward_pre_hook(lambda _, inputs: caught.append(inputs[0])):
        in_torch(model, *arrays)
    return caught[0].numpy()


def follow(path: Path, model: TactileClassifier, batch: int) -> None:
    """A stream loop as a stranger would write it, from the file's metadata."""
    card = metadata(path)
    samples, offset, sigma = episodes(batch, seed=batch)
    expected = in_torch(model, samples, offset, sigma)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    state = {s["name"]: np.zeros((batch, *s["shape"]), s["dtype"]) for s in card["state"]}
    outputs = ["logits", "embedding", *(f"{name}_next" for name in state)]
    assert card["steps"] == STEPS
    hidden = embedded(model, samples, offset, sigma)
    assert hidden.shape[2] == card["embedding"]
    for t in range(card["steps"]):
        feed = {"samples": samples[:, t], "offset": offset, "sigma": sigma, **state}
        logits, embedding, *following = session.run(outputs, feed)
        state = dict(zip(state, following, strict=True))
        assert abs(logits - expected[:, t]).max() <= 1e-5, f"step {t}"
        assert abs(embedding - hidden[:, t]).max() <= 1e-5, f"step {t}"
    assert np.ptp(expected) > 0.5, "logits that say nothing would agree in any graph"
    assert all(np.any(value) for value in state.values()), "a state that is never written"


@pytest.mark.parametrize("batch", [1, 3])
def test_the_file_alone_gives_the_trained_window_s_logits(
    exported: SimpleNamespace, batch: int
) -> None:
    follow(exported.path, exported.model, batch)


def test_so_it_does_in_the_forms_of_a_wide_network(
    exported: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streaming, "LARGE", 0)
    monkeypatch.setattr(streaming, "WIDE", 0)
    path = tmp_path / "wide.onnx"
    export_step(exported.model, exported.card, path)
    wide, narrow = (
        [node.op_type for node in onnx.load(file).graph.node].count("Conv")
        for file in (path, exported.path)
    )
    assert wide >= narrow + 4 * gpt.LAYERS, "each layer has four products"
    for batch in (1, 3):
        follow(path, exported.model, batch)


def test_parity_tells_another_network_from_the_file_s(exported: SimpleNamespace) -> None:
    other = build()
    with torch.no_grad():
        next(other.parameters()).mul_(1.01)
    assert min(parity(other, exported.path, episodes=1).values()) > PARITY_BAR


def test_the_metadata_says_everything_needed(exported: SimpleNamespace) -> None:
    card = metadata(exported.path)
    assert set(card) == set(ModelCard.__struct_fields__)
    assert ArraySpec.from_json(card["spec"]) == SPEC
    assert card["name"] == "tiny"
    assert card["version"] == 3
    places = {"sensor": {}, "unknown": None, "candidates": []}
    assert {name: card[name] for name in places} == places
    assert (card["kind"], card["precision"], card["opset"]) == ("step", "fp32", onnx_step.OPSET)
    assert card["hashes"]["graph"] == graph_sha256(exported.path.read_bytes())
    assert card["period_ns"] == PERIOD_NS
    assert (card["substeps"], card["steps"]) == (5, 22)
    assert card["labels"] == list(CATEGORIES)
    assert card["temperature"] == 1.25
    assert card["floor"] == pytest.approx([CHANNEL_FLOOR[u] for u in SPEC.units])
    for name in ("clip", "scale"):
        assert card[name] == pytest.approx(getattr(exported.model.inputs, name).tolist())
    assert card["figures"]["validation_top1"] == 0.5
    assert 0 < card["figures"]["parity"] <= PARITY_BAR <= 1e-5
    provenance = card["provenance"]
    assert provenance["checkpoint_sha256"] == hash_of(exported.checkpoint)
    assert provenance["unseen_objects"] == ["mug-2", "car-2"]
    assert provenance["sweep_set"] == {"seed": 5}
    assert provenance["network"] == {**asdict(NETWORK), "frame": list(NETWORK.frame)}
    assert provenance["training"]["epochs"] == 0
    for package in ("torch", "onnx", "onnxruntime"):
        assert provenance[package] == __import__(package).__version__
    assert provenance["tactile_rt"] == tactile_rt.__version__


def test_the_file_is_read_back_as_the_card_that_was_returned(exported: SimpleNamespace) -> None:
    session, card = load_model(exported.path)
    assert card == exported.card
    assert [i.name for i in session.get_inputs()] == [
        "samples", "offset", "sigma", *(s.name for s in card.state)
    ]  # fmt: skip
    assert [o.name for o in session.get_outputs()] == [
        "logits", "embedding", *(f"{s.name}_next" for s in card.state)
    ]  # fmt: skip


def test_the_graph_is_plain_and_clean(exported: SimpleNamespace) -> None:
    proto = onnx.load(exported.path)
    onnx.checker.check_model(proto, full_check=True)
    assert [(o.domain, o.version) for o in proto.opset_import] == [("", onnx_step.OPSET)]
    content = exported.path.read_bytes()
    for trace in (b"site-packages", str(Path(tactile_rt.__file__).parent).encode()):
        assert trace not in content, "where it was exported is nobody's business"


def test_only_the_file_is_left_and_others_may_read_it(exported: SimpleNamespace) -> None:
    assert [p.name for p in exported.path.parent.iterdir()] == ["tiny.onnx"]
    assert exported.path.stat().st_mode & 0o777 == 0o644


def test_the_robot_decides_as_training_saw_it(exported: SimpleNamespace) -> None:
    """The live path (resampler, onset, baseline, steps) against windows cut from the signal."""
    rng = np.random.default_rng(3)
    n = 60 + STEPS * SUBSTEPS + 20
    values = rng.normal(size=(n, 30, 6)) * TYPICAL * 0.05
    push = np.sin(np.linspace(0, 3, n - 60))[:, None, None] * TYPICAL
    values[60:, 4:9] += push * rng.normal(size=(5, 6))
    values = values.astype(np.float32)

    onsets = find_onsets(values[None], np.array([CHANNEL_FLOOR[u] for u in SPEC.units], np.float32))
    assert onsets.start[0] > 60
    window = windows(values[None], onsets.start)
    logits = in_torch(exported.model, window, onsets.offset, onsets.sigma)[0] / 1.25
    expected = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)

    rate_hz = 1e9 / PERIOD_NS
    live = cut_chunks(np.concatenate([values[:1], values, values[-1:]]), rate_hz, 7)  # none is lost
    classifier = Classifier(exported.path, SPEC.__class__(**{**asdict(SPEC), "rate_hz": rate_hz}))
    decisions = [d for chunk in live for d in classifier.push(chunk)]
    assert [d.step for d in decisions] == list(range(1, STEPS + 1))
    assert decisions[-1].final
    for d, posterior in zip(decisions, expected, strict=True):
        assert d.probabilities == pytest.approx(posterior, abs=2e-6)
        assert d.labels == CATEGORIES


def test_the_cache_is_written_in_place_with_the_same_result(exported: SimpleNamespace) -> None:
    """Through the stepper, begun anew after any number of steps, against plain onnxruntime."""
    session, card = load_model(exported.path)
    marked = {s["name"] for s in metadata(exported.path)["state"] if s["in_place"]}
    assert marked == {s.name for s in card.state if s.name.startswith("gpt_")} != set()
    samples, offset, sigma = episodes(1, seed=4)
    stepper = Stepper(session, card)
    for name in (s.name for s in card.state):
        assert (stepper._states[0][name] is stepper._states[1][name]) == (name in marked)
    outputs = file_outputs(session, card, samples, offset, sigma)
    expected, embedding = outputs["logits"][0], outputs["embedding"][0]
    for steps in (*range(1, STEPS + 1), STEPS):
        stepper.begin(offset[0], sigma[0])
        for step in range(steps):
            stepper.samples[:] = samples[:, step]
            assert np.array_equal(stepper.run()[0], expected[step]), (steps, step)
            assert np.array_equal(stepper.embedding[0], embedding[step]), (steps, step)


@pytest.mark.parametrize(
    ("other", "marked"),
    [("", True), ("size = Shape(cache)", True), ("twice = Add(cache, cache)", False)],
)
def test_a_state_that_something_else_reads_is_not_written_in_place(other, marked) -> None:
    graph = onnx.parser.parse_graph(
        "g (float[B,4,2] cache, int64[B,1,2] rows, float[B,1,2] new) => (float[B,4,2] cache_next)"
        f"{{ {other}\n cache_next = ScatterND(cache, rows, new) }}"
    )
    assert onnx_step._is_written_by_rows(graph, "cache") == marked


def test_what_the_card_says_of_sensor_and_rules_is_in_the_file(
    exported: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay(monkeypatch, exported.proto)
    given = {
        "sensor": {"rate_hz": 80.0, "noise_density": [1e-6] * 6},
        "unknown": OpenSetRule("entropy", "embedding", (0.5,) * STEPS),
        "candidates": (PredictionSetRule("rank", 0.95, (2.5,) * STEPS, 200),),
        "license": "Apache-2.0 OR MIT",
    }
    card = msgspec.structs.replace(exported.card, **given)
    export_step(exported.model, card, tmp_path / "m.onnx")
    found = load_model(tmp_path / "m.onnx")[1]
    assert {name: getattr(found, name) for name in given} == given


# Every encoder, attender and decoder at least once.
KINDS = [
    ("zhuang-timedecay-ln", "mamba", "linear"),
    ("zhuang-vanilla-ln", "none", "linear"),
    ("zhuang-ugrnn", "gpt", "mlp-all"),
    ("zhuang-gru", "none", "mlp-all"),
    ("zhuang-lstm", "none", "linear"),
    ("resnet18", "none", "mlp"),
    ("s4", "gpt", "mlp"),
    ("mamba", "none", "linear"),
    ("gru", "none", "linear"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("encoder", "attender", "decoder"), KINDS)
def test_files_of_every_network_give_its_embedding_and_forget_bad_samples(
    tmp_path: Path, encoder: str, attender: str, decoder: str
) -> None:
    config = EADConfig(4, encoder, attender, decoder, width=1 / 4 if encoder == "gru" else 1 / 32)
    model, card = random_model(SPEC, config, encoder)
    proto, state = step_graph(model, card)
    samples, offset, sigma = episodes(2)
    expected = embedded(model, samples, offset, sigma)
    rest = samples.copy()
    samples[0, 3, :, ::3], rest[0, 3, :, ::3] = np.nan, offset[0, ::3]
    for kind in ("step", "window"):
        path = tmp_path / f"{kind}.onnx"
        write_model(proto, state, model, card, path, kind=kind)  # refused if past the bar
        opened = load_model(path, kind=None)
        struck, rested = (file_outputs(*opened, s, offset, sigma) for s in (samples, rest))
        for name, values in struck.items():
            assert np.isfinite(values).all()
            assert np.array_equal(values, rested[name])
        gap = abs(struck["embedding"][1] - expected[1]).max()
        assert gap <= 1e-5 * max(1, expected.std())


# What goes wrong


def replay(monkeypatch: pytest.MonkeyPatch, proto: object) -> None:
    monkeypatch.setattr(torch.onnx, "export", lambda *_, **__: SimpleNamespace(model_proto=proto))


def spoilt(exported: SimpleNamespace, change) -> object:
    """The graph with the decoder's weights changed, as a broken exporter might."""
    proto = onnx.ModelProto()
    proto.CopyFrom(exported.proto)
    changed = 0
    for tensor in proto.graph.initializer:
        values = onnx.numpy_helper.to_array(tensor)
        if values.dtype == np.float32 and values.shape[:1] == (len(CATEGORIES),):
            tensor.CopyFrom(onnx.numpy_helper.from_array(change(values), tensor.name))
            changed += 1
    assert changed
    return proto


@pytest.mark.parametrize(
    ("change", "figure"), [(lambda w: w * 1.001, r"\de-0\d"), (lambda w: w * np.nan, "nan")]
)
def test_a_graph_that_computes_something_else_is_not_written(
    exported: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, change, figure
) -> None:
    replay(monkeypatch, spoilt(exported, change))
    path = tmp_path / "m.onnx"
    path.write_bytes(b"an older model")
    with pytest.raises(ModelError, match=rf"^{path}: logits .* differ by .*{figure} .*nothing was"):
        export_step(exported.model, exported.card, path)
    assert [p.name for p in tmp_path.iterdir()] == ["m.onnx"]
    assert path.read_bytes() == b"an older model"


def test_a_disk_that_fills_up_leaves_nothing(
    exported: SimpleNamespace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replay(monkeypatch, exported.proto)

    def fail(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # which names no file

    monkeypatch.setattr(onnx, "save", fail)
    path = tmp_path / "m.onnx"
    with pytest.raises(OSError, match="No space left on device") as full:
        export_step(exported.model, exported.card, path)
    assert full.value.filename == str(path)
    assert list(tmp_path.iterdir()) == []
