"""Model files learnt from touches, without torch and without the package `onnx`.

    features, classes --> an .onnx file that runs like any other

Before anything is learnt, `write_features` writes a model of one class whose embedding is the
features: run on a stream by an ordinary `Classifier`, it gives for every touch the same numbers as
the model that is learnt later.
"""

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnxruntime
from numpy.typing import NDArray

from tactile_rt.classifier import enrolment
from tactile_rt.classifier.classifier import Classification
from tactile_rt.classifier.decision_rules import POSTERIOR, UNKNOWN, OpenSetRule
from tactile_rt.classifier.model_card import ModelCard, StateTensor
from tactile_rt.classifier.model_file import METADATA_KEY, load_model, probe_logits, read_model
from tactile_rt.classifier.onnx_check import graph_sha256
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Timing
from tactile_rt.teaching import head
from tactile_rt.teaching.features import FeatureNetwork
from tactile_rt.teaching.onnx_bytes import OPSET, OnnxGraph, with_metadata

FASTEST_NS = 9_000_000  # sample period of the network; a slower sensor keeps its own
TOUCH = "touch"  # the class of a model that has learnt nothing
LARGER, NOISES = 3.0, 1e3  # times the largest load felt, or the noise, that may come later
MAYBE = 0.5  # posterior of `unknown` above which a touch is unknown

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class FewShot:
    """A few-shot learner, which makes a model from the touches of a lesson alone."""

    spec: ArraySpec
    # (channel,) smallest noise that the contact detector assumes, in the channel's unit
    floor: NDArray[np.float32]
    # share of readings at rest that differ from the one before, for the element that repeats most;
    # 0: unknown
    changes: float = 0.0
    each = 10  # touches of a class that are worth their time
    few = head.ENOUGH  # fewer are reported
    note = ""  # for the user, before the first touch

    @property
    def period_ns(self) -> int:
        """Period of the samples that the network takes, ns."""
        return max(FASTEST_NS, round(NS_PER_S / self.spec.rate_hz))

    @property
    def timing(self) -> Timing:
        """The division of a touch into steps."""
        return Timing.of(self.period_ns)

    @property
    def network(self) -> FeatureNetwork:
        """The network that computes the features."""
        return FeatureNetwork.draw(self.spec, self.timing.substeps, self.timing.steps)

    def describe(self, steps: Sequence[Classification]) -> NDArray[np.float32]:
        """Return a touch's features (step, feature), from decisions of `write_features`' model."""
        return np.stack([step.embedding for step in steps if step.embedding is not None])

    def leave_one_out(self, features: Floats, labels: Sequence[str]) -> head.LeaveOneOut:
        """Classify each touch at its last step by what is learnt from the others."""
        return head.leave_one_out(features[:, -1:], labels, self.network.kinds)

    def count_refused(self, features: Floats, labels: Sequence[str], others: Floats) -> int:
        """Return how many of `others` are refused, each by what is learnt without it."""
        return head.count_refused(features[:, -1:], labels, self.network.kinds, others[:, -1:])

    def learn(
        self,
        path: Path,
        features: Floats,
        labels: Sequence[str],
        others: Floats,
        largest: NDArray[np.float32],
        name: str,
        provenance: dict[str, Any],
    ) -> ModelCard:
        """Learn classes from touches (touch, step, feature); write the model to `path`."""
        graph, network = OnnxGraph(), self.network
        classes = head.fit_classes(features, labels, network.kinds, others=others)
        found, after = network.build(graph)
        logits = _add_head(graph, found, after["count"], self.timing, classes)
        graph.output("logits", logits, ["batch", len(classes.labels) + 1])
        card = {
            "name": name,
            "labels": (*classes.labels, UNKNOWN),
            "refusals": (UNKNOWN,),
            "unknown": OpenSetRule(POSTERIOR, "logits", (MAYBE,)),
            "temperature": classes.temperature,
            "provenance": {**_list_versions(), **provenance},
        }
        if largest.any():
            believed = np.maximum(LARGER * largest, NOISES * self.floor)
            card["clip"] = tuple(map(float, believed))
        return _write_model(path, self, graph, found, after, card)


class Enrolment:
    """An enroller of objects on a network that was trained to tell objects apart.

    Raises:
        ModelError: The model cannot be used.
        ConfigError: The model was not trained for that, or has enrolled objects already.
    """

    each, few = 5, 3
    note = "names are objects: the model enrols them beside its classes"

    def __init__(self, model: Path) -> None:
        self.card, _, self._data = read_model(model)
        self.spec = self.card.array
        self.floor = np.array(self.card.floor, dtype=np.float32)
        if self.card.identity is None:
            raise ConfigError(
                f"{model} cannot enrol objects: it has no rule `identity`. Train it with identity, "
                "and 20 objects or more for validation; or teach without --model"
            )
        if self.card.enrolled:
            raise ConfigError(
                f"model {model} has enrolled objects: go on with its lesson, or name its network"
            )

    def describe(self, steps: Sequence[Classification]) -> NDArray[np.float32]:
        """Return the embedding (1, unit) of a whole touch."""
        embedding = steps[-1].embedding
        assert embedding is not None
        return embedding[None]

    def leave_one_out(self, features: Floats, labels: Sequence[str]) -> head.LeaveOneOut:
        """Identify each touch (touch, 1, unit) among objects enrolled with the other touches."""
        rule = self.card.identity
        assert rule is not None
        touches = enrolment.project(rule, features[:, -1])
        names, own = np.unique(np.asarray(labels), return_inverse=True)
        mine = own[:, None] == np.arange(len(names))  # (touch, object)
        others = mine.sum(axis=0) - mine
        total = mine.T.astype(float) @ touches - mine[..., None] * touches[:, None]
        above = enrolment.margins(rule, total / others[..., None], others, touches)
        return head.LeaveOneOut(-above[:, None], (above.argmax(axis=1) == own) & (above[mine] >= 0))

    def count_refused(self, features: Floats, labels: Sequence[str], others: Floats) -> int:
        """Return how many of `others` (touch, 1, unit) match none of the labelled objects."""
        found = self._enrol(features, labels)
        assert self.card.identity is not None
        names = [enrolment.identify(self.card.identity, found, [other[-1]])[0] for other in others]
        return names.count(enrolment.NONE_OF_THESE)

    def learn(
        self,
        path: Path,
        features: Floats,
        labels: Sequence[str],
        others: Floats,
        largest: NDArray[np.float32],
        name: str,
        provenance: dict[str, Any],
    ) -> ModelCard:
        """Enrol the touches' objects; write a copy of the model with them to `path`."""
        card = msgspec.structs.replace(
            self.card,
            name=name,
            provenance={**self.card.provenance, **_list_versions(), **provenance},
            enrolled=self._enrol(features, labels),
        )
        data = with_metadata(self._data, METADATA_KEY, msgspec.json.encode(card).decode())
        write_whole(path, lambda file: file.write(data))
        return card

    def _enrol(
        self, features: Floats, labels: Sequence[str]
    ) -> tuple[enrolment.EnrolledObject, ...]:
        own, enrol = np.asarray(labels), enrolment.EnrolledObject.of
        return tuple(enrol(one, features[own == one, -1]) for one in dict.fromkeys(labels))


def write_features(path: Path, taught: FewShot) -> ModelCard:
    """Write a model of one class, whose embedding is the features of a touch."""
    graph, network = OnnxGraph(), taught.network
    features, after = network.build(graph)
    first = graph("Slice", features, graph.integers(0), graph.integers(1), graph.integers(1))
    graph.output("logits", first, ["batch", 1])
    return _write_model(path, taught, graph, features, after, {"labels": (TOUCH,)})


def _add_head(
    g: OnnxGraph, features: str, count: str, timing: Timing, classes: head.TouchClasses
) -> str:
    """Add logits (batch, class + 1): squared distances and the reach, times -1/2."""
    done = g("Div", count, g.constant(float(timing.substeps)))
    step = g("Cast", g("Sub", done, g.constant(1.0)), to=7)
    step = g("Clip", step, g.constant(0, np.int64), g.constant(timing.steps - 1, np.int64))
    step = g("Squeeze", step, g.integers(1))  # (batch,)

    def now(values: NDArray[np.float64]) -> str:
        return g("Gather", g.constant(values), step, axis=0)

    found = g("Mul", g("Sub", features, now(classes.mean)), now(1 / classes.scale))
    found = g("Clip", found, g.constant(-head.LIMIT), g.constant(head.LIMIT))
    away = g("Sub", g("Unsqueeze", found, g.integers(1)), now(classes.centres))  # b, class, feature
    along = g("MatMul", away, now(classes.axes))
    whole = g("ReduceSum", g("Mul", away, away), g.integers(2), keepdims=0)
    whole = g("Mul", whole, now(1 / classes.rest[:, None]))
    less = g("ReduceSum", g("Mul", along, along), g.integers(2), keepdims=0)
    nearer = g("Mul", g("Sub", whole, less), g.constant(classes.share))
    distances = g("Concat", nearer, now(classes.reach[:, None]), axis=1)
    return g("Mul", distances, g.constant(-0.5))


def _write_model(
    path: Path, taught: FewShot, graph: OnnxGraph, features: str, after: dict[str, str], own: Any
) -> ModelCard:
    network, timing = taught.network, taught.timing
    graph.output("embedding", features, ["batch", network.size])
    for name, shape in network.state().items():
        graph.output(f"{name}_next", after[name], ["batch", *shape])
    floor = tuple(float(value) for value in taught.floor)
    card = ModelCard(
        **{"name": path.stem, "clip": tuple(1e6 * value for value in floor), **own},
        spec=taught.spec.to_json(),
        period_ns=taught.period_ns,
        substeps=timing.substeps,
        steps=timing.steps,
        state=tuple(StateTensor(n, s, "float32") for n, s in network.state().items()),
        scale=floor,
        floor=floor,
        changes=taught.changes,
        embedding=network.size,
        opset=OPSET,
    )  # fmt: skip
    return write_checked(path, graph, card)


def write_checked(path: Path, graph: OnnxGraph, card: ModelCard) -> ModelCard:
    """Write a model file that stores its graph's hash and probe logits, for `model verify`."""
    whole = path.with_name(f".{path.name}")
    whole.write_bytes(_serialise(graph, card))
    try:
        session, _ = load_model(whole)
        probe = tuple(tuple(map(float, row)) for row in probe_logits(session, card))
        hashes = {"graph": graph_sha256(whole.read_bytes())}
    finally:
        whole.unlink(missing_ok=True)
    card = msgspec.structs.replace(card, probe=probe, hashes=hashes)
    write_whole(path, lambda file: file.write(_serialise(graph, card)))
    return card


def _list_versions() -> dict[str, str]:
    return {
        "tactile_rt": version("tactile-rt"),
        "onnxruntime": onnxruntime.__version__,
        "python": platform.python_version(),
    }


def _serialise(graph: OnnxGraph, card: ModelCard) -> bytes:
    return graph.serialise(card.name, {METADATA_KEY: msgspec.json.encode(card).decode()})
