"""Model cards: a model file's metadata on its array, episode, classes and measured results.

A release ignores fields that it does not know; the version is raised only when an older reader
would misread a file.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.calibration import declare_calibration
from tactile_rt.classifier.decision_rules import (
    MAX_NAME,
    POSTERIOR,
    UNKNOWN,
    Count,
    OpenSetRule,
    Positive,
    PredictionSetRule,
    is_printable_name,
)
from tactile_rt.classifier.enrolment import EnrolledObject, IdentityRule, enrolment_fault
from tactile_rt.classifier.onnx_check import MAX_ELEMENTS
from tactile_rt.core.errors import ConfigError, ModelError, SpecMismatch, name_some
from tactile_rt.core.stream import ArraySpec
from tactile_rt.core.stream.sensor_spec import SensorSpec, channel_limits

CARD_VERSION = 3
STATE_TYPES = ("bool", "float16", "float32", "float64", "int32", "int64", "int8", "uint8")
MAX_STEPS = 1_000_000
PERIODS_NS = range(1_000, 10**12 + 1)  # of samples: at most a million per second
MAX_EPISODE = 2**24  # values: checks run a whole episode at once; a robot's has some 20,000

Kind = Literal["step", "window"]


class StateTensor(msgspec.Struct, frozen=True):
    """One recurrent state: its name, shape without the batch axis, and element type.

    With `in_place`, a step writes only some rows, so `<name>_next` may share the state's memory.
    """

    name: str
    shape: tuple[int, ...]
    dtype: str
    in_place: bool = False


class ModelCard(msgspec.Struct, frozen=True):
    """The metadata of a model file, stored as JSON under ``tactile_rt``.

    Attributes:
        name: The name of the model, at most 200 characters.
        spec: The JSON form of the `ArraySpec` that the model was trained on.
        period_ns: The period of a sub-step, ns; the stream is resampled to it.
        substeps: The number of sub-steps in a step.
        labels: (class,) The names of the classes, in the order of the logits.
        state: The recurrent state tensors, all zero when an episode begins.
        clip, scale: (channel,) Limits and smallest scale of the input compression, SI.
        floor: (channel,) The smallest sigma that the contact detector assumes, SI.
        temperature: The number that divides the logits, fitted on validation sweeps so that
            probabilities are calibrated.
        provenance: The origin of the file: network, training, data set, hashes.
        figures: The results measured on the model, such as parity and accuracy.
        kind: The form of the input, "step" or "window", see `model_file`.
        precision: The number format in which weights are stored and multiplied.
        opset: The version of ONNX's operators that the graph uses.
        hashes: SHA-256 sums, hex, by subject; "graph" is `onnx_check.graph_sha256` of the file.
        probe: (step, class) Logits of the built-in probe episode, by which `tactile-rt model
            verify` checks whether another machine computes the same.
        embedding: The number of units of the output ``embedding``.
        sensor: Known properties of the array's sensor (rate, noise, range, ...); may be empty.
        changes: The share of readings at rest that differ from the one before, for the element that
            repeats most; 0 if unknown.
        unknown: The open-set rule; None if the model has none.
        candidates: The rules of prediction sets, each for another noise or coverage.
        kinds: The kinds that the model distinguishes within a class, by class; only classes that
            have kinds. All kinds in this order are the columns of the output ``names``.
        names: The rules of prediction sets of these kinds, by class.
        refusals: The last labels, if they name no class, but state that the object is unknown, or
            what is wrong with the loads.
        identity: The rule that identifies enrolled objects, for networks whose embedding was
            trained to tell objects apart; None if no object can be enrolled.
        enrolled: The objects that the model knows by a few touches, in addition to its classes.
        license: The licence of the file, an SPDX expression such as "Apache-2.0"; empty if unknown.
    """

    name: Annotated[str, msgspec.Meta(max_length=MAX_NAME)]
    spec: str
    period_ns: Annotated[int, msgspec.Meta(ge=PERIODS_NS[0], le=PERIODS_NS[-1])]
    substeps: Count
    steps: Annotated[int, msgspec.Meta(ge=1, le=MAX_STEPS)]
    labels: tuple[str, ...]
    state: tuple[StateTensor, ...]
    clip: tuple[Positive, ...]
    scale: tuple[Positive, ...]
    floor: tuple[Positive, ...]
    temperature: Positive = 1.0
    provenance: dict[str, Any] = {}
    figures: dict[str, Any] = {}
    version: int = CARD_VERSION
    kind: Kind = "step"
    precision: Literal["fp32", "fp16", "bf16", "int8"] = "fp32"
    opset: int | None = None
    hashes: dict[str, str] = {}
    probe: tuple[tuple[float, ...], ...] = ()
    embedding: int = 0
    sensor: dict[str, Any] = {}
    changes: float = 0.0
    refusals: tuple[str, ...] = ()
    unknown: OpenSetRule | None = None
    candidates: tuple[PredictionSetRule, ...] = ()
    kinds: dict[str, tuple[str, ...]] = {}
    names: dict[str, tuple[PredictionSetRule, ...]] = {}
    identity: IdentityRule | None = None
    enrolled: tuple[EnrolledObject, ...] = ()
    license: str = ""

    @property
    def classes(self) -> tuple[str, ...]:
        """The labels that name classes: all labels before the refusals."""
        return self.labels[: len(self.labels) - len(self.refusals)]

    @property
    def array(self) -> ArraySpec:
        """The array that the model was trained on."""
        return ArraySpec.from_json(self.spec)

    @property
    def class_of(self) -> dict[str, str]:
        """The class of each category, from the first sweep set's recipe; empty if unknown."""
        with suppress(TypeError, KeyError, msgspec.ValidationError):
            classes = self.provenance["sweep_set"]["objects"]["classes"]
            merged = msgspec.convert(classes, dict[str, tuple[str, ...]])
            return {category: one for one, some in merged.items() for category in some}
        return {}


def kind_columns(kinds: Mapping[str, Sequence[str]]) -> dict[str, slice]:
    """Return the columns of the output ``names`` that belong to each class."""
    ends = list(accumulate(map(len, kinds.values()), initial=0))
    return {name: slice(*ends[k : k + 2]) for k, name in enumerate(kinds)}


def element_order(card_spec: ArraySpec, source_spec: ArraySpec) -> NDArray[np.intp]:
    """Return the source's index of each model element: ``samples[..., order, :]`` feeds the model.

    Only the arrays' names, rates and orders of elements may differ.

    Returns:
        (element,) Indices into the source's elements, 0, 1, 2, ... when the order is the same.

    Raises:
        SpecMismatch: The arrays differ; the message says exactly where.
    """
    mine, theirs = card_spec.elements, source_spec.elements
    if set(mine) == set(theirs):
        order = np.array([theirs.index(element) for element in mine], dtype=np.intp)
        per_element = ("elements", "grid", "positions", "orientations")
        fields = {f: getattr(source_spec, f) for f in source_spec.__dataclass_fields__}
        fields |= {f: tuple(fields[f][i] for i in order) for f in per_element}
        differences = card_spec.differences(ArraySpec(**fields), ignore=("name", "rate_hz"))
    else:
        lacking = [e for e in mine if e not in theirs]
        foreign = [e for e in theirs if e not in mine]
        differences = [f"lacks {name_some(lacking)}"] if lacking else []
        differences += [f"{name_some(foreign)} unknown to the model"] if foreign else []
        rest = ("name", "rate_hz", "elements", "grid", "positions", "orientations")
        differences += card_spec.differences(source_spec, ignore=rest)
    if differences:
        raise SpecMismatch(name_some(differences, 2, "; "))
    return order


def fit_source(model: Path, card: ModelCard, spec: ArraySpec) -> NDArray[np.intp]:
    """Return the `element_order` of a source's array, or raise an error with advice.

    Args:
        model: The model's file, for the message.

    Raises:
        SpecMismatch: The model was made for another array; the message says where they differ, and
            what to do.
    """
    try:
        return element_order(card.array, spec)
    except SpecMismatch as error:
        do = "name a model of it"
        with suppress(SpecMismatch):
            declare_calibration(spec, card.array)
            do += f", or declare it as the model's: array={model}"
        raise SpecMismatch(
            f"{model} was made for another array than {spec.name!r}: {error}; {do}"
        ) from None


def parse_card(path: Path, text: str) -> ModelCard:
    """Parse and check the metadata of a model file.

    Raises:
        ModelError: The metadata is damaged, of another version, or describes no usable model.
    """

    def reject(why: object) -> ModelError:
        return ModelError(f"{path} has damaged metadata: {one_line(why)}")

    try:
        version = msgspec.json.decode(text, type=dict[str, Any]).get("version")
        if version != CARD_VERSION:
            raise ModelError(
                f"{path} has metadata of version {repr(version)[:40]}; this release reads "
                f"{CARD_VERSION}: export it anew"
            )
        card = msgspec.json.decode(text, type=ModelCard)
        elements, channels = card.array.shape
    except (msgspec.MsgspecError, ConfigError) as error:
        raise reject(error) from None
    except RecursionError:
        raise reject("nested too deeply") from None
    for what in ("clip", "scale", "floor"):
        if len(getattr(card, what)) != channels:
            raise reject(f"{len(getattr(card, what))} values of {what} for {channels} channels")
    if not card.labels or len(set(card.labels)) != len(card.labels):
        raise reject("labels are missing or repeat")
    # Decisions carry labels to terminals, pages and logs.
    if not all(map(is_printable_name, card.labels)):
        raise reject(f"labels must be 1 to {MAX_NAME} printable characters")
    if card.license and not is_printable_name(card.license):
        raise reject(f"a licence must be at most {MAX_NAME} printable characters")
    if not isinstance(card.provenance.get("unseen_objects", []), list):
        raise reject("unseen_objects of the provenance must be a list")
    names = ["samples", "offset", "sigma", *(s.name for s in card.state)]
    if len(set(names)) != len(names):
        raise reject("names of the state repeat")
    if card.kind == "window" and card.state:
        raise reject("kind is window, but state is declared; only step models have state")
    shapes = {s.name: s.shape for s in card.state}
    window = (card.steps,) if card.kind == "window" else ()
    shapes["samples"] = (*window, card.substeps, elements, channels)
    for name, shape in shapes.items():
        # Python's integers, since a product of int64 may overflow to a small number.
        if min(shape, default=1) < 1 or math.prod(shape) > MAX_ELEMENTS:
            raise reject(f"{name[:40]} has the shape {'x'.join(map(str, shape))[:80]}")
    episode = card.steps * card.substeps * elements * channels
    if episode > MAX_EPISODE:
        raise reject(f"an episode has {episode} values, more than {MAX_EPISODE}")
    if sum(math.prod(shape) for shape in shapes.values()) > MAX_ELEMENTS:
        raise reject("its state is larger than any robot's memory should hold")
    for state in card.state:
        if state.dtype not in STATE_TYPES:
            raise reject(f"state {state.name[:40]} has the type {state.dtype[:40]!r}")
    if card.probe and [len(row) for row in card.probe] != [len(card.labels)] * card.steps:
        raise reject(f"the probe must be {card.steps} steps of {len(card.labels)} logits")
    if card.embedding < 1:
        raise reject(f"embedding must be 1 or more, not {card.embedding}")
    for name, kinds in card.kinds.items():
        if name not in card.classes or not kinds or len(set(kinds)) != len(kinds):
            raise reject(
                f"kinds of {name[:MAX_NAME]!r}: no such class, or its kinds are missing or repeat"
            )
        if not all(map(is_printable_name, kinds)):
            raise reject(f"kinds must be 1 to {MAX_NAME} printable characters")
    if not card.names.keys() <= card.kinds.keys():
        raise reject("names has rules for a class without kinds")
    rules = {f"candidates[{i}]": rule for i, rule in enumerate(card.candidates)}
    for name, own in card.names.items():
        rules |= {f"names.{name[:MAX_NAME]}[{i}]": rule for i, rule in enumerate(own)}
    for what, rule in {"unknown": card.unknown, **rules}.items():
        if rule is not None and (wrong := rule.fault(card.steps)):
            raise reject(f"{what}.{wrong}")
    if card.refusals != card.labels[len(card.labels) - len(card.refusals) :]:
        raise reject("refusals must be the last entries of labels, in the same order")
    if len(card.refusals) == len(card.labels):
        raise reject("all labels are refusals")
    if wrong := enrolment_fault(card.identity, card.enrolled, card.embedding):
        raise reject(wrong)
    return card


def choose_label(card: ModelCard, probabilities: NDArray[np.float32], step: int) -> int:
    """Return the index of the label that a model decides for.

    Args:
        probabilities: (class,) The posterior probabilities of all labels.
        step: The step of the episode, counted from 1.
    """
    rule = card.unknown
    if rule is None or rule.score != POSTERIOR or UNKNOWN not in card.refusals:
        return int(probabilities.argmax())
    best, unknown = int(probabilities.argmax()), card.labels.index(UNKNOWN)
    if best != unknown and best >= len(card.classes):
        return best  # faulty loads say nothing about the object
    if probabilities[unknown] > rule.threshold(step):
        return unknown
    others = probabilities.copy()
    others[unknown] = -1
    return int(others.argmax())


def rated_noise(card: ModelCard) -> NDArray[np.float32]:
    """Return the rated noise (channel,) per sample of a model's array, SI.

    If neither the card nor a unit determines the noise, the card's floor is returned.
    """
    try:
        return channel_limits(card.array, sensor_of(card), card.period_ns).noise
    except ConfigError:
        return np.array(card.floor, dtype=np.float32)


def sensor_of(card: ModelCard) -> SensorSpec | None:
    """Return the sensor that a model was made for, or None if unknown."""
    try:
        return msgspec.convert(card.sensor, SensorSpec) if card.sensor else None
    except (ConfigError, msgspec.ValidationError):
        return None


def one_line(reason: object) -> str:
    """Return the first line of a reason, with unprintable characters replaced."""
    line = (str(reason).strip().splitlines() or [type(reason).__name__])[0]
    return "".join(c if c.isprintable() else "?" for c in line)
