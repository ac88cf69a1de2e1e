"""Networks that tell kinds apart within a class, and objects by an embedding."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn import functional as F

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.enrolment import EnrolledObject, identify
from tactile_rt.classifier.model_card import kind_columns
from tactile_rt.classifier.model_file import file_outputs, load_model, verify_model
from tactile_rt.core.errors import ConfigError, ModelError
from tactile_rt.core.stream import Chunk
from tactile_rt.export.decision_thresholds import fit_names
from tactile_rt.export.identity import fit_gaussians, identity_thresholds
from tactile_rt.export.release import release
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.datasets import SweepSet, read_splits, windows
from tactile_rt.models.evaluation.measures import cut_windows, macro_accuracy
from tactile_rt.models.evaluation.model_file import evaluate_model
from tactile_rt.models.training.batches import TrainingBatches, order_in_twos
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.loop import train
from tactile_rt.models.training.objectives import build_objective, identity_loss
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.splits import join_manifests
from tactile_rt.teaching.model import Enrolment
from tests.helpers.tiny_model import write_model
from tests.helpers.tiny_sweeps import write_tiny_set

KINDS = {"ball": ("globe", "rock"), "cube": ("globe", "rock")}
SMALL = {
    "encoder": "gru", "width": 1 / 32, "batch": 12, "updates": 60, "learning_rate": 0.01,
    "names": 0.5, "identity": 0.3, "dropout": 0.0,
}  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("named")
    write_tiny_set(
        folder, objects=10, sweeps=4, kinds=("rock", "globe"), held_out=2, outliers=3,
        faults={"implausible": 0.1},
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def trained(data, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    train(TrainingConfig(str(data), **SMALL), folder)
    return folder / "best.pt"


@pytest.fixture(scope="module")
def exported(trained, tmp_path_factory):
    path = tmp_path_factory.mktemp("file") / "model.onnx"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tactile_rt.export.identity.FEWEST", 6)  # there are six
        release(trained, path, "named")
    return path


def test_a_manifest_knows_the_kinds_of_each_category(data):
    manifest = SweepManifest.read(data)
    assert manifest.kinds == KINDS
    assert manifest.kind_of["ball-1"] == "globe"
    other = replace(manifest, kind_of={"ball-0": "pearl"})
    assert join_manifests([manifest, other]).kind_of["ball-0"] == "pearl"
    sweeps = SweepSet.read(data, "train")
    numbers = dict(zip(sweeps.sweeps.objects.tolist(), sweeps.kinds(KINDS).tolist(), strict=True))
    assert [numbers[name] for name in ("ball-0", "ball-1", "cube-0", "cone-0")] == [1, 0, 3, -1]
    assert kind_columns(KINDS) == {"ball": slice(0, 2), "cube": slice(2, 4)}


def test_sweeps_of_an_object_follow_each_other_in_twos():
    objects = np.repeat(["a", "b", "c"], [4, 5, 1])
    orders = [order_in_twos(objects, np.random.default_rng(seed)) for seed in range(20)]
    for order in orders:
        assert sorted(order) == list(range(10))
        found = objects[order].tolist()
        alone = [
            k for k in range(10) if found[k] not in found[max(k - 1, 0) : k] + found[k + 1 :][:1]
        ]
        assert len(alone) <= 2  # the fifth of b, and c
    assert len({tuple(order) for order in orders}) == 20


def test_labels_of_spoilt_windows_are_of_no_kind_and_no_object(data):
    training, _ = read_splits([data], True)
    batches = TrainingBatches(training, 10, 0, kinds=training.manifest.kinds)
    plain = torch.cat([labels for *_, labels in TrainingBatches(training, 10, 0).epoch(0)])
    labels = torch.cat([labels for *_, labels in batches.epoch(0)])
    assert plain.dim() == 1 and labels.shape[1] == 3
    spoilt = labels[:, 0] > 3  # behind the categories and unknown
    assert spoilt.any() and (labels[spoilt, 1:] == -1).all()
    assert (labels[~spoilt, 2] >= 0).all()
    assert set(labels[labels[:, 0] == 1, 1].tolist()) == {2, 3}
    assert (labels[labels[:, 0] == 3, 1] == -1).all()


def test_the_contrast_of_objects_is_that_of_a_plain_loop():
    rows = F.normalize(torch.randn(6, 5, generator=torch.Generator().manual_seed(0)), dim=1)
    objects = torch.tensor([4, 4, 4, 7, -1, -1])
    each = []
    for i in range(3):  # only these have another of their object
        odds = {k: math.exp(float(rows[i] @ rows[k]) / 0.5) for k in range(6) if k != i}
        others = [k for k in range(3) if k != i]
        each.append(-np.mean([math.log(odds[k] / sum(odds.values())) for k in others]))
    assert float(identity_loss(rows, objects, 0.5)) == pytest.approx(np.mean(each), rel=1e-5)


@pytest.mark.parametrize("loss", ["anytime", "last"])
def test_a_kind_is_learnt_among_those_of_its_class_alone(data, loss):
    training, _ = read_splits([data], True)
    weights = {**SMALL, "identity": 0.0, "precision": "fp32", "label_smoothing": 0.0}
    config = TrainingConfig(str(data), **weights, loss=loss)
    objective = build_objective(config, training).eval()
    *loads, _ = next(TrainingBatches(training, 4, 0).epoch(0))
    (seen,) = objective.see([loads], torch.Generator())
    logits = objective.model.network.split(objective.model.network.answer(seen))["names"]
    labels = torch.tensor([[0, 1, 0], [1, 2, 1], [2, -1, 2], [3, -1, -1]])
    steps = [
        torch.stack([F.log_softmax(logits[0, t, :2], 0)[1], F.log_softmax(logits[1, t, 2:], 0)[0]])
        for t in range(logits.shape[1])
    ]
    each = -torch.stack(steps)  # (step, sweep)
    expected = each[-1].mean()
    if loss == "anytime":
        expected = 0.5 * expected + 0.5 * each[objective.model.network.lag :].mean()
    plain, found = objective.loss([seen], labels[:, 0]), objective.loss([seen], labels)
    assert (found - plain).item() == pytest.approx(0.5 * expected.item(), rel=1e-4)
    nothing = torch.tensor([[0, -1, -1], [4, -1, -1], [2, -1, -1], [3, -1, -1]])
    assert torch.isfinite(objective.loss([seen], nothing))


def test_without_kinds_a_network_has_no_names(tmp_path):
    write_tiny_set(tmp_path, sweeps=2)
    training, _ = read_splits([tmp_path], True)
    config = build_objective(TrainingConfig(str(tmp_path), **SMALL), training).model.network.config
    assert (config.names, config.identity, config.outputs) == (0, 128, 3 + 128)
    with pytest.raises(ConfigError, match="supervised, not simclr"):
        TrainingConfig(str(tmp_path), objective="simclr", names=0.5)
    write_tiny_set(tmp_path / "one", sweeps=1)
    training, _ = read_splits([tmp_path / "one"], True)
    with pytest.raises(ConfigError, match="has two sweeps"):
        build_objective(TrainingConfig(str(tmp_path / "one"), **SMALL), training)


def test_a_network_learns_kinds_and_objects(data, trained):
    model, saved = load_checkpoint(trained)
    assert saved["kinds"] == KINDS
    network = model.network
    assert network.config.outputs == 3 + len(saved["refusals"]) + 4 + 128
    test = SweepSet.read(data, "test")
    found = test.onsets(test.sweeps.values)
    cut = windows(test.sweeps.values, found.start, test.timing)
    frames = model.inputs(*map(torch.from_numpy, (cut, found.offset, found.sigma)))
    with torch.inference_mode():
        out = network.split(network.answer(frames)[:, -1])
    numbers = test.kinds(KINDS)
    ball = numbers // 2 == 0
    assert (out["names"][ball][:, :2].argmax(1).numpy() == numbers[ball]).mean() > 0.8
    torch.testing.assert_close(out["embedding"].norm(dim=1), torch.ones(len(numbers)))
    likeness = (out["embedding"] @ out["embedding"].T).numpy()
    same = test.sweeps.objects[:, None] == test.sweeps.objects
    assert likeness[same].mean() > likeness[~same].mean() + 0.1


def test_steps_and_window_give_the_same_names_and_embedding(trained, exported, tmp_path):
    session, card = load_model(exported)
    assert (card.kinds, card.embedding) == (KINDS, 128)
    assert card.figures["parity"] < 1e-5
    assert any(line.startswith("embedding: 128") for line in verify_model(exported))
    release(trained, tmp_path / "window.onnx", "named", kind="window")
    rng = np.random.default_rng(0)
    samples = rng.normal(size=(2, card.steps, card.substeps, *card.array.shape)) * 1e-4
    rest = np.zeros((2, *card.array.shape), np.float32)
    loads = samples.astype(np.float32), rest, rest + 1e-6
    window = file_outputs(*load_model(tmp_path / "window.onnx", kind=None), *loads)
    steps = file_outputs(session, card, *loads)
    assert set(steps) == {"logits", "embedding", "names"}
    for name, values in steps.items():
        assert np.allclose(values, window[name], atol=1e-4), name


def test_a_release_measures_when_touches_are_of_an_enrolled_object(data, exported):
    rule = load_model(exported)[1].identity
    assert rule.objects == 6
    table = np.reshape(rule.thresholds, (4, 5, 2))
    assert (table[:, 3:] == table[:, 2:3]).all(), "there are four touches of an object"
    assert (table[1:] == table[0, 0, 0]).all(), "and no five objects in a half"
    assert np.isfinite(table).all() and len(rule.between) == 1, "of so few objects"
    found = Enrolment(exported)
    one = SweepSet.read(data, "test")
    cut_of = next(cut_windows(one))
    session, card = load_model(exported)
    loads = cut_of.samples, cut_of.offset, cut_of.sigma
    features = file_outputs(session, card, *loads)["embedding"][:, -1:].astype(float)
    right = found.leave_one_out(features, one.sweeps.objects.tolist()).right
    assert right.mean() > 0.3, "of six objects, of which pairs are of one kind"


def test_so_few_touches_of_enrolled_objects_are_refused_as_the_rule_says():
    rng = np.random.default_rng(0)
    places = np.repeat(rng.normal(size=(400, 16)), 7, axis=0)
    names = np.repeat(np.arange(400).astype(str), 7)
    touches = (places + rng.normal(size=places.shape)).astype(np.float32)
    table = identity_thresholds(touches[:1400], names[:1400])
    rule = fit_gaussians(touches[:1400], names[:1400], table)
    assert (np.diff(table[:, 0, 0]) > 0).all(), "one of many is always somewhat like it"
    rest = touches[1400:].reshape(200, 7, 16)
    for n, m, many in ((1, 1, 1), (3, 1, 20), (5, 2, 5), (1, 2, 100)):
        objects = [EnrolledObject.of(f"{k}", own[:n]) for k, own in enumerate(rest)]
        margins = [
            identify(rule, objects[k // many * many :][:many], own[n : n + m])[1]
            for k, own in enumerate(rest)
        ]
        assert 0.01 < np.mean(np.array(margins) < 0) < 0.12
    assert np.isnan(identity_thresholds(touches[:70], names[:70])).all()
    few = identity_thresholds(touches[: 7 * 20], np.repeat(np.arange(70).astype(str), 2))
    assert (few == few[:, :1, :1]).all() and (few[3] == few[2]).all()


def test_a_decision_carries_names_of_its_class(data, exported):
    manifest, test = SweepManifest.read(data), SweepSet.read(data, "test")
    spec = replace(manifest.spec, rate_hz=1e9 / manifest.period_ns)
    labels = set()
    for k in range(len(test.sweeps)):
        values = np.concatenate([np.zeros((60, *spec.shape)), test.sweeps.values[k]])
        times = (np.arange(len(values)) + 1) * manifest.period_ns
        good = np.ones(values.shape[:2], bool)
        values += np.random.default_rng(k).normal(size=values.shape) * test.noise * 0.1
        chunk = Chunk(np.arange(len(values)), times, values.astype(np.float32), good)
        for d in Classifier(exported, spec, embedding=True).push(chunk):
            labels.add(d.label)
            assert abs(np.square(d.embedding).sum() - 1) < 1e-4
            # with two objects of a class to fit on, all kinds are in the set
            assert sorted(d.names) == sorted(KINDS.get(d.label, ()))
            assert d.names_coverage == (0.9 if d.names else None)
    assert labels & set(KINDS)


def test_eval_tells_names_and_macro_accuracy(data, exported):
    found = {record.name: record for record in evaluate_model(exported, data, quick=True)}
    assert found["models.coverage of the names"].value == 100
    assert found["models.names at the last step"].value == 2
    assert "models.kind, top-1 within the true class at rated noise" in found
    assert found["models.coverage of the names of cube"].value == 100
    assert "models.coverage of the names of cone" not in found
    assert 0 <= found["models.top-1, macro"].value <= 100


def test_macro_accuracy_weighs_classes_alike():
    labels = np.array([0] * 8 + [3] * 2)
    right = np.array([True] * 8 + [False] * 2)
    estimate = macro_accuracy(right, labels, np.array([f"{k}" for k in range(10)]))
    assert estimate.value == 0.5
    assert estimate.low == 0.5  # a class that is not drawn does not count


def test_names_are_covered_in_each_class_of_each_set(data):
    """Kinds that a network tells apart in one set and guesses in the other, and the reverse."""
    objects = 400
    one = SweepSet.read(data, "train")
    names = [f"{c}-{k}" for c in ("ball", "cube") for k in range(objects)]
    rng = np.random.default_rng(0)
    kind_of = {name: KINDS["ball"][rng.integers(2)] for name in names}
    manifest = replace(one.manifest, kind_of=kind_of, split={"train": tuple(names)})
    at = np.zeros(len(names), np.int64)
    sweeps = replace(one.sweeps[at], objects=np.array(names), labels=np.repeat([0, 1], objects))
    many = replace(one, manifest=manifest, sweeps=sweeps)
    truth = many.kinds(KINDS)

    def draw(strength):
        logits = rng.normal(size=(len(names), 22, 4))
        logits[np.arange(len(names)), :, truth] += np.repeat(strength, objects)[:, None]
        return logits.astype(np.float32)

    strengths = (6.0, 0.3), (0.3, 6.0)
    batches = iter([
        batch for repeats in (2, 1, 1) for strength in strengths for _ in range(repeats)
        for batch in np.array_split(draw(strength), range(64, len(names), 64))
    ])  # fmt: skip
    rules = fit_names([many, many], lambda *_: next(batches), KINDS)
    assert [rule.noise for rule in rules["ball"]] == [0.3, 1.2, 2.2]
    for strength in strengths:
        logits, kept, size = draw(strength), [], []
        for k, row in enumerate(logits):
            name = "ball" if truth[k] < 2 else "cube"
            p = np.exp(row[:, kind_columns(KINDS)[name]])
            p /= p.sum(axis=1, keepdims=True)
            sets = [rules[name][0].prediction_set(v, t) for t, v in enumerate(p, start=1)]
            kept.append(all(truth[k] % 2 in one for one in sets))
            size.append(len(sets[-1]))
        kept, size = np.reshape(kept, (2, objects)), np.reshape(size, (2, objects))
        assert (kept.mean(axis=1) > 0.86).all()
        assert size[np.argmax(strength)].mean() < size[np.argmin(strength)].mean()


def test_a_network_begins_with_the_kinds_that_another_knew(data, trained, tmp_path):
    config = TrainingConfig(str(data), **{**SMALL, "updates": 1, "learning_rate": 1e-9})
    other = replace(config, begin=str(trained), identity=0.0)
    train(other, tmp_path)
    before, after = (load_checkpoint(p)[0].state_dict() for p in (trained, tmp_path / "best.pt"))
    weight = [name for name in before if name.startswith("network.decoder.")][-2]
    kept = len(after[weight])
    assert len(before[weight]) == kept + 128
    torch.testing.assert_close(before[weight][:kept], after[weight], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"kinds": {"pyramid": ("tent",)}}, "kinds of 'pyramid'"),
        ({"kinds": {"steps": ("a", "a")}}, "kinds of 'steps'"),
        ({"kinds": {"steps": ("a\n",)}}, "printable"),
        ({"names": {"steps": ()}}, "a class without kinds"),
        ({"kinds": {"steps": ("a", "b")}}, "no output `names`"),
    ],
)
def test_damaged_kinds_are_refused(tmp_path, change, said):
    with pytest.raises(ModelError, match=said):
        load_model(write_model(tmp_path / "model.onnx", **change))
