"""New classes for the shipped network: the graph is the formula, and what is known stays so."""

import msgspec
import numpy as np
import pytest

pytest.importorskip("onnx")

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_card import EmbeddingStatistics
from tactile_rt.classifier.model_file import file_outputs, load_model, shipped_model, verify_model
from tactile_rt.core.errors import ConfigError, ModelError
from tactile_rt.teaching.class_incremental import (
    fit_new_classes,
    join_features,
    leave_one_out_new_classes,
)
from tactile_rt.teaching.model import ClassIncremental
from tests.helpers import tiny_model

LABELS = ["goblet"] * 3 + ["teapot"] * 4


@pytest.fixture(scope="module")
def base():
    return ClassIncremental(shipped_model())


def touches(card, rng, count):
    """Touches (touch, unit and label) of nowhere in particular, and a network that is not sure."""
    means, _ = card.embeddings.arrays(len(card.classes), card.embedding)
    away = rng.normal(size=(count, card.embedding)) * means.std()
    return np.concatenate([means.mean(0) + away, rng.normal(size=(count, len(card.labels)))], 1)


@pytest.fixture(scope="module")
def taught(base, tmp_path_factory):
    rng = np.random.default_rng(3)
    path = tmp_path_factory.mktemp("taught") / "model.onnx"
    features = touches(base.card, rng, len(LABELS))
    base.learn(path, np.repeat(features[:, None], 2, axis=1), LABELS, "more", {"taught": {}})
    return path, fit_new_classes(base.card, features, LABELS)


def test_the_file_is_a_model_like_any_other(base, taught):
    path, _ = taught
    card = load_model(path)[1]
    assert card.labels == (*base.card.classes, "goblet", "teapot", *base.card.refusals)
    assert not card.candidates, "they were those of its own classes"
    assert any(line.startswith("parity") for line in verify_model(path))
    Classifier(path, base.spec)
    assert path.stat().st_size < 5e6


def test_the_graph_computes_the_scores_and_leaves_the_network_alone(base, taught):
    path, classes = taught
    rng = np.random.default_rng(0)
    card = base.card
    shape = (2, card.steps, card.substeps, *card.array.shape)
    samples = (rng.standard_normal(shape) * 20 * np.array(card.scale)).astype(np.float32)
    rest = np.zeros((2, *card.array.shape), np.float32)
    sigma = rest + np.array(card.floor, np.float32)
    session, own = load_model(shipped_model())
    before = file_outputs(session, own, samples, rest, sigma)
    session, more = load_model(path)
    after = file_outputs(session, more, samples, rest, sigma)["logits"]
    known = len(card.classes)
    np.testing.assert_array_equal(after[..., :known], before["logits"][..., :known])
    np.testing.assert_array_equal(after[..., known + 2 :], before["logits"][..., known:])
    unknown = card.labels.index("unknown")
    for logits, new, embeddings in zip(
        before["logits"], after[..., known : known + 2], before["embedding"], strict=True
    ):
        features = join_features(embeddings, logits)
        top = np.maximum(logits[:, :known].max(1), logits[:, unknown])[:, None]
        last = top[-1] + classes.scores(features)[-1]
        np.testing.assert_allclose(new[-1], last, rtol=1e-4, atol=1e-3)
        # before the last step a new class is farther away than the scores say
        assert (new[:-1] < (top + classes.scores(features))[:-1]).all()


def test_what_lies_where_a_class_was_taught_is_that_class_and_what_is_known_is_not(base, taught):
    _, classes = taught
    card = base.card
    means, _ = card.embeddings.arrays(len(card.classes), card.embedding)
    sure = np.full((len(means), len(card.labels)), 0.0)
    sure[np.arange(len(means)), np.arange(len(means))] = 8.0
    assert (classes.scores(np.concatenate([means, sure], axis=1)) < 0).all()
    features = touches(card, np.random.default_rng(3), len(LABELS))
    taught_means = np.stack([features[:3].mean(0), features[3:].mean(0)])
    assert (np.diag(classes.scores(taught_means)) > 0).all()


def test_touches_of_one_place_are_right_leave_one_out(base):
    rng = np.random.default_rng(1)
    two = touches(base.card, rng, 2)
    features = np.repeat(two, 4, axis=0) + rng.normal(size=(8, two.shape[1])) * 1e-3
    found = leave_one_out_new_classes(base.card, features, ["a"] * 4 + ["b"] * 4)
    assert found.right.all()
    swapped = leave_one_out_new_classes(base.card, features, ["a"] * 3 + ["b"] * 5)
    assert not swapped.right[3]


def test_what_cannot_be_taught_is_one_line(base, tmp_path):
    features = touches(base.card, np.random.default_rng(0), 2)
    with pytest.raises(ConfigError, match="knows 'mug' already"):
        fit_new_classes(base.card, features, ["mug", "mug"])
    with pytest.raises(ConfigError, match="one touch of 'teapot'"):
        fit_new_classes(base.card, features, ["teapot", "cup of tea"])
    with pytest.raises(ConfigError, match="does not tell where its classes lie"):
        ClassIncremental(tiny_model.write_model(tmp_path / "tiny.onnx"))
    with pytest.raises(ModelError, match="no model file"):
        ClassIncremental(tmp_path / "none.onnx")


def test_statistics_that_do_not_fit_are_refused(base):
    card = base.card
    assert card.embeddings is not None
    means, covariance = card.embeddings.arrays(len(card.classes), card.embedding)
    for wrong in (means[1:], means * np.nan):
        with pytest.raises(ValueError):
            EmbeddingStatistics.of(wrong, covariance).arrays(len(card.classes), card.embedding)
    assert msgspec.json.decode(msgspec.json.encode(card.embeddings), type=EmbeddingStatistics)
