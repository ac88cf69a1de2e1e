"""Class-incremental learning: new classes for a network, few-shot and without its data.

The network's file tells where touches of its own classes lie in its embedding, and how touches of
one class differ. Where touches of a new class lie is their mean. A touch is of the new class if it
is nearer to that than to any known one, by so much that a sure network is believed: so what is
known stays so. The network's own logits stay as they are, beside those of the new classes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.decision_rules import UNKNOWN
from tactile_rt.classifier.model_card import ModelCard, StateTensor
from tactile_rt.core.errors import ConfigError
from tactile_rt.teaching.head import FEWEST, LeaveOneOut, check_enough
from tactile_rt.teaching.onnx_bytes import OPSET, OnnxGraph

__all__ = [
    "IncrementalClasses",
    "check_new_classes",
    "extend_card",
    "extend_graph",
    "fit_new_classes",
    "join_features",
    "leave_one_out_new_classes",
]

# Chosen on the four kinds that the shipped model has never met, five touches of each:
NEARER = 0.8  # share of the distance from a known class within which a new one must be
SURE = 0.12  # of the usual distance, by which a touch is farther for each nat of the network's odds
SOFT = 0.22  # of the usual distance, that makes a nat
EARLY = 0.25  # farther, at the first step, is a new class: little has been felt yet
MOST = 10.0  # nats to which the network's odds count
SUM, COUNT = "taught_sum", "taught_count"  # states

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class IncrementalClasses:
    """What tells new classes from those that a network knows.

    Attributes:
        whitening: (unit, unit) The map by which differences within a class become alike in all
            directions.
        known, new: (class, unit) The means of touches of the classes, whitened.
        share: (class,) The part of the squared distance from a new class that is left when what
            comes from its mean of few touches is taken off.
        usual: The mean squared distance of a touch from its class.
        knows: The number of the network's classes, of its labels, and where `unknown` is among
            the latter; -1 if it is not.
    """

    labels: tuple[str, ...]
    whitening: Floats
    known: Floats
    new: Floats
    share: Floats
    usual: float
    knows: tuple[int, int, int]

    def scores(self, features: Floats) -> Floats:
        """(touch, class) above 0 where a touch is of a new class, from (touch, unit and label)."""
        units = len(self.whitening)
        at = features[:, :units] @ self.whitening
        near = np.square(at[:, None] - self.known).sum(-1).min(axis=1, keepdims=True)
        new = self.share * np.square(at[:, None] - self.new).sum(-1)
        logits = features[:, units : units + self.knows[0]]
        ranked = np.sort(logits, axis=1)
        others = np.exp(ranked[:, :-1] - ranked[:, -1:]).sum(axis=1, keepdims=True)
        odds = np.clip(-np.log(others + 1e-9), -MOST, MOST)
        return np.asarray((near - NEARER * new - SURE * self.usual * odds) / (SOFT * self.usual))


def join_features(embeddings: NDArray[np.float32], logits: NDArray[np.float32]) -> Floats:
    """(step, unit and label): the mean of the embeddings so far, and the logits."""
    mean = np.cumsum(embeddings, axis=0) / np.arange(1, len(embeddings) + 1)[:, None]
    return np.concatenate([mean, logits], axis=1, dtype=float)


def fit_new_classes(card: ModelCard, features: Floats, labels: Sequence[str]) -> IncrementalClasses:
    """Learn new classes.

    Args:
        card: of the network's file.
        features: (touch, unit and label) of all touches, at the last step.
        labels: (touch,) the class of each.

    Raises:
        ConfigError: the file does not tell where its classes lie, knows one of the classes, or a
            class has fewer than two touches.
    """
    check_new_classes(card, labels)
    check_enough(labels)
    assert card.embeddings is not None
    means, covariance = card.embeddings.arrays(len(card.classes), card.embedding)
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    values = np.maximum(values, 0)
    whitening = vectors / np.sqrt(values + values.mean())
    names = tuple(dict.fromkeys(map(str, labels)))
    own = np.array([names.index(name) for name in labels])
    new = np.stack([features[own == k, : card.embedding].mean(axis=0) for k in range(len(names))])
    count = np.bincount(own)
    unknown = card.labels.index(UNKNOWN) if UNKNOWN in card.refusals else -1
    return IncrementalClasses(
        names,
        whitening,
        means @ whitening,
        new @ whitening,
        count / (count + 1),
        float((values / (values + values.mean())).sum()),
        (len(card.classes), len(card.labels), unknown),
    )


def check_new_classes(card: ModelCard, labels: Sequence[str]) -> None:
    """Raise a ConfigError if a file cannot be taught these classes."""
    if card.embeddings is None:
        raise ConfigError(
            f"model {card.name} does not tell where its classes lie: export it anew, or, if it was "
            "taught, go on with its lesson"
        )
    if card.opset != OPSET or card.kind != "step":
        raise ConfigError(f"model {card.name} is not a step of opset {OPSET}: export it anew")
    if known := sorted(set(labels) & set(card.labels)):
        raise ConfigError(f"model {card.name} knows {known[0]!r} already: name it otherwise")


def leave_one_out_new_classes(
    card: ModelCard, features: Floats, labels: Sequence[str]
) -> LeaveOneOut:
    """Judge every touch by the others; one of a class of two by itself, too."""
    names = tuple(np.unique(np.asarray(labels)))
    own = np.searchsorted(names, labels)
    away = np.empty((len(own), 1, len(names)))
    right = np.zeros(len(own), dtype=bool)
    for k in range(len(own)):
        others = np.arange(len(own)) != k
        if (own[others] == own[k]).sum() < FEWEST:
            others[k] = True
        names_of = [labels[i] for i in np.flatnonzero(others).tolist()]
        found = fit_new_classes(card, features[others], names_of)
        scores = found.scores(features[k : k + 1])[0]
        order = [found.labels.index(name) for name in names]
        away[k, 0] = -scores[order]
        right[k] = scores.max() > 0 and found.labels[int(scores.argmax())] == names[own[k]]
    return LeaveOneOut(away, right)


def extend_graph(data: bytes, card: ModelCard, classes: IncrementalClasses) -> OnnxGraph:
    """Return the network's graph with logits of the new classes after its own."""
    g = OnnxGraph.of(data, "logits")
    units, (known, told, unknown) = card.embedding, classes.knows
    total = g("Add", g.input(SUM, ["batch", units]), "embedding")
    count = g("Add", g.input(COUNT, ["batch", 1]), g.constant(1.0))
    at = g("MatMul", g("Div", total, count), g.constant(classes.whitening))
    logits = "hidden_logits"
    axis, begin = g.integers(1), g.integers(0)
    mine = g("Slice", logits, begin, g.integers(known), axis)
    near = g("ReduceMin", _distances(g, at, classes.known), axis, keepdims=1)
    early = g("Mul", count, g.constant(-EARLY / card.steps))
    new = g("Mul", _distances(g, at, classes.new), g("Add", early, g.constant(1.0 + EARLY)))
    new = g("Mul", new, g.constant(NEARER * classes.share))
    top = g("ReduceMax", mine, axis, keepdims=1)
    others = g("ReduceSum", g("Exp", g("Sub", mine, top)), axis, keepdims=1)
    others = g("Sub", others, g.constant(1.0 - 1e-6))
    odds = g("Neg", g("Log", g("Max", others, g.constant(1e-9))))
    odds = g("Clip", odds, g.constant(-MOST), g.constant(MOST))
    odds = g("Mul", odds, g.constant(SURE * classes.usual))
    scores = g("Sub", g("Sub", near, new), odds)
    scores = g("Div", scores, g.constant(SOFT * classes.usual))
    if unknown >= 0:
        there = g("Slice", logits, g.integers(unknown), g.integers(unknown + 1), axis)
        top = g("Max", top, there)
    added = g("Add", top, scores)
    rest = g("Slice", logits, g.integers(known), g.integers(told), axis)
    parts = [mine, added, rest] if told > known else [mine, added]
    together = g("Concat", *parts, axis=1)
    g.output("logits", together, ["batch", told + len(classes.labels)])
    g.output(f"{SUM}_next", total, ["batch", units])
    g.output(f"{COUNT}_next", count, ["batch", 1])
    return g


def extend_card(card: ModelCard, classes: IncrementalClasses) -> ModelCard:
    """Return the card of that; its prediction sets were those of its own classes."""
    state = (StateTensor(SUM, (card.embedding,), "float32"), StateTensor(COUNT, (1,), "float32"))
    return msgspec.structs.replace(
        card,
        labels=(*card.classes, *classes.labels, *card.refusals),
        state=(*card.state, *state),
        candidates=(),
        embeddings=None,
        figures={},
        hashes={},
        probe=(),
    )


def _distances(g: OnnxGraph, at: str, means: Floats) -> str:
    """(batch, class) squared distances."""
    own = g("ReduceSum", g("Mul", at, at), g.integers(1), keepdims=1)
    both = g("MatMul", at, g.constant(-2 * means.T))
    return g("Add", g("Add", own, both), g.constant(np.square(means).sum(axis=1)))
