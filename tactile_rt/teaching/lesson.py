"""A lesson: touches of one array, their labels, and the model learnt from them.

    Source --> Classifier(features.onnx) --> touches + labels --> model.onnx

A lesson is a folder, so that it can be continued, inspected and corrected:

    features.onnx      the features: the array, and its noise when the lesson began; or the network
                       that objects are enrolled on
    session-1.mcap     all samples, one recording for each session
    labels.csv         the interval and the label of each touch, written as the touch ends
    model.onnx         the model learnt, which runs like any other

`tactile-rt label` makes a sweep set of such a folder, for networks that learn longer.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.model_card import ModelCard
from tactile_rt.classifier.model_file import hash_of, load_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.core.stream import ArraySpec
from tactile_rt.recording import Recording, labels, recover
from tactile_rt.teaching.head import FEWEST, LeaveOneOut
from tactile_rt.teaching.listener import Listener
from tactile_rt.teaching.model import TOUCH, Enrolment, FewShot, write_features

ORDERS = ("next", "undo", "done", "list")  # commands to a teacher; any other text is a new label
NAMING = ("forget", "rename")  # commands with names after them
FEATURES, MODEL = "features.onnx", "model.onnx"
ANYTHING_ELSE = "anything else"  # the label of touches of no class, which are to be refused
BEFORE_NS = 20_000_000  # from the beginning of a touch's interval to its onset
SAME = 0.65  # if a smaller share of their touches is told apart, two classes feel the same
ODD = 3.0  # a touch so many times as far from its class as the others is odd

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TaughtTouch:
    """A labelled touch of a lesson, with its features."""

    label: str
    features: NDArray[np.float32]  # (step, feature) what was felt, step by step
    recording: str
    line: str


@dataclass
class Lesson:
    """A lesson in a folder: labelled touches, and the model learnt from them."""

    folder: Path
    taught: FewShot | Enrolment
    touches: list[TaughtTouch] = field(default_factory=list)  # all touches, in their order
    # number of touches in the list that are not in the recordings, since the last moment of a
    # recording was not written when the program was killed
    lost: int = 0
    # labels of those lost touches whose line in the list is complete
    unfelt: list[str] = field(default_factory=list)
    _largest: list[NDArray[np.float32]] = field(default_factory=list)  # of each listener

    @classmethod
    def begin(cls, folder: Path, taught: FewShot) -> "Lesson":
        """Begin a few-shot lesson in a folder, which is created if missing."""
        _check_free(folder)
        folder.mkdir(parents=True, exist_ok=True)
        write_features(folder / FEATURES, taught)
        return cls(folder, taught)

    @classmethod
    def on(cls, folder: Path, model: Path) -> "Lesson":
        """Begin a lesson that enrols objects on a network.

        Args:
            folder: The lesson's folder; created if missing.
            model: The network's file, which is copied.

        Raises:
            ConfigError: The folder holds a lesson already, or the file cannot enrol objects.
            ModelError: The file cannot be used.
        """
        _check_free(folder)
        taught = Enrolment(model)
        folder.mkdir(parents=True, exist_ok=True)
        data = model.read_bytes()
        write_whole(folder / FEATURES, lambda file: file.write(data))
        return cls(folder, taught)

    @classmethod
    def read(cls, folder: Path) -> "Lesson":
        """Read an existing lesson with all its touches from its folder."""
        path = folder / FEATURES
        if not path.exists():
            raise ConfigError(f"{folder} holds no lesson: there is no {FEATURES}")
        card = load_model(path)[1]
        few = card.labels == (TOUCH,)
        floor = np.array(card.floor, dtype=np.float32)
        taught = FewShot(card.array, floor, card.changes) if few else Enrolment(path)
        lesson = cls(folder, taught)
        lesson._read_touches(path)
        return lesson

    @classmethod
    def embedded_again(cls, folder: Path, model: Path) -> "Lesson":
        """Continue an enrolment lesson on another network, which embeds all recordings again.

        Raises:
            ConfigError: The lesson has no network, or the other network cannot enrol objects.
            SpecMismatch: The network is for another array than the recordings.
        """
        if load_model(folder / FEATURES)[1].labels == (TOUCH,):
            raise ConfigError(f"{folder} holds a lesson without a network: name another folder")
        lesson = cls(folder, Enrolment(model))
        data = model.read_bytes()
        lesson._read_touches(model)
        write_whole(folder / FEATURES, lambda file: file.write(data))
        return lesson

    def _read_touches(self, model: Path) -> None:
        file = self.folder / labels.LABELS
        if not file.exists():
            return
        self.lost += labels.drop_torn_label(file)
        if not file.stat().st_size:
            return  # its first line was torn
        recordings = sorted(self.folder.glob("session-*.mcap"), key=_parse_number)
        lines = labels.lines_of(file)
        labelled = labels.read_labels(file, [_repair(one) for one in recordings])
        labels.check_appendable(file)
        for path, intervals in labelled.items():
            if not intervals:
                continue
            found = self._find_touches(path, model)
            for interval in intervals:
                begin, end = interval.start_s, interval.end_s
                inside = [features for at_s, features in found if begin <= at_s < end]
                if not inside:
                    self.lost += 1
                    self.unfelt.append(interval.label)
                    continue
                line = lines[int(interval.where.rpartition(":")[2]) - 1].rstrip("\r\n")
                self.touches.append(TaughtTouch(interval.label, inside[0], path.name, line))

    def _find_touches(self, path: Path, model: Path) -> list[tuple[float, NDArray[np.float32]]]:
        """Return onset, s since the recording's first sample, and features of each touch."""
        recording = Recording(path)
        # the labels say which of them counted
        listener = Listener(model, recording.spec, self.taught.describe, hasty_ns=0)
        self._largest.append(listener.largest)
        found = []
        for chunk in recording:
            found += [(listener.seconds(onset), felt) for onset, _, felt in listener.push(chunk)]
        return found

    def listener(self, spec: ArraySpec) -> Listener:
        """Create a detector of this lesson's touches in a stream of an array."""
        listener = Listener(self.folder / FEATURES, spec, self.taught.describe)
        self._largest.append(listener.largest)
        return listener

    def next_recording(self) -> Path:
        """Return the path of the lesson's next recording."""
        numbers = [_parse_number(path) for path in self.folder.glob("session-*.mcap")]
        return self.folder / f"session-{max(numbers, default=0) + 1}.mcap"

    def add(
        self, label: str, features: NDArray[np.float32], recording: str, span_s: tuple[float, float]
    ) -> None:
        """Add a touch to the lesson, and write its label to disk.

        Args:
            features: (step, feature) The features of the touch.
            recording: The recording's name; its newest samples may not be on disk yet.
            span_s: The interval of the touch, seconds since the recording's first sample.
        """
        begin_s, end_s = max(0.0, span_s[0]), span_s[1]
        interval = labels.LabelledInterval(label=label, start_s=begin_s, end_s=end_s)
        line = labels.append_label(self.folder / labels.LABELS, recording, interval)
        self.touches.append(TaughtTouch(label, features, recording, line))

    def undo(self) -> TaughtTouch | None:
        """Remove and return the last touch, or return None if no touch is left."""
        if not self.touches:
            return None
        labels.remove_label(self.folder / labels.LABELS, self.touches[-1].line)
        return self.touches.pop()

    def rename(self, old: str, new: str) -> None:
        """Rename a label, or remove all its touches if the new name is empty.

        Raises:
            ConfigError: The label does not exist, or the new name is invalid.
        """
        if old not in (*self.labels, *self.unfelt):
            raise ConfigError(f"there is no {old!r}: `list` shows the names")
        if new:
            check_label(new)
        labels.relabel(self.folder / labels.LABELS, old, new)
        self.touches = [
            replace(one, label=new, line=labels.relabel_line(one.line, old, new).rstrip("\n"))
            if one.label == old
            else one
            for one in self.touches
            if new or one.label != old
        ]

    def count(self, label: str) -> int:
        """Count the touches of a label."""
        return sum(touch.label == label for touch in self.touches)

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of all classes, in order of their first touches."""
        names = (touch.label for touch in self.touches if touch.label != ANYTHING_ELSE)
        return tuple(dict.fromkeys(names))

    @property
    def taught_enough(self) -> tuple[str, ...]:
        """The classes with enough touches to learn from."""
        return tuple(name for name in self.labels if self.count(name) >= FEWEST)

    def leave_one_out(self) -> "LessonProgress":
        """Classify each touch at its last step by the other touches; return the results.

        With a single class no touch can be wrong, so none is counted as right.
        """
        used, names = self._select_touches()
        if not used:
            return LessonProgress((), (), ())
        features, others = self._stack_features(used), self._stack_others()
        found = self.taught.leave_one_out(features, names)
        progress = _summarise(used, names, found, self.taught.few)
        refused = self.taught.count_refused(features, names, others) if len(others) else 0
        progress = replace(progress, others=(refused, len(others)))
        if isinstance(self.taught, FewShot) and len(set(names)) < 2:
            return replace(progress, classes=())
        return progress

    def learn(self) -> ModelCard:
        """Learn a model of all classes with enough touches, and write it into the folder."""
        used, names = self._select_touches()
        if not used:
            why = f"nothing to learn from: no class has {FEWEST} touches yet"
            raise ConfigError(f"{self.folder}: {why}")
        provenance = {
            "taught": {name: names.count(name) for name in dict.fromkeys(names)},
            "labels_sha256": hash_of(self.folder / labels.LABELS),
        }
        return self.taught.learn(
            self.folder / MODEL,
            self._stack_features(used),
            names,
            self._stack_others(),
            np.max(self._largest, axis=0, initial=0.0),
            self.folder.resolve().name,
            provenance,
        )

    def _select_touches(self) -> tuple[list[int], list[str]]:
        """Return the indices and labels of touches whose class has enough touches."""
        enough = self.taught_enough
        used = [k for k, touch in enumerate(self.touches) if touch.label in enough]
        return used, [self.touches[k].label for k in used]

    def _stack_others(self) -> Floats:
        """Return the features (touch, step, feature) of touches labelled `ANYTHING_ELSE`."""
        found = [touch.features for touch in self.touches if touch.label == ANYTHING_ELSE]
        return np.array(found, dtype=float)

    def _stack_features(self, used: Sequence[int]) -> Floats:
        return np.stack([self.touches[k].features for k in used]).astype(float)


@dataclass(frozen=True)
class LessonProgress:
    """The leave-one-out results of a lesson."""

    # name of each class, the number of its touches, and how many of them were right
    classes: tuple[tuple[str, int, int], ...]
    # touches that are unlike the others of their class: their number, counted from 1, and the class
    # that they are most like
    odd: tuple[tuple[int, str], ...]
    # pairs of classes of which the first is taken for the second, the most frequent pair first
    confused: tuple[tuple[str, str], ...]
    # pairs of classes that feel the same: touches of the two are told apart by chance
    same: tuple[tuple[str, str], ...] = ()
    # number of touches of anything else that are refused, and of all of these
    others: tuple[int, int] = (0, 0)

    @property
    def right(self) -> tuple[int, int]:
        """Number of rightly classified touches, and number of all touches."""
        return sum(c[2] for c in self.classes), sum(c[1] for c in self.classes)


def _summarise(
    used: Sequence[int], names: Sequence[str], found: LeaveOneOut, few: int
) -> LessonProgress:
    classes = np.unique(np.asarray(names))
    own = np.searchsorted(classes, names)
    distances = found.distances[:, -1]
    nearest = distances.argmin(axis=1)
    squares = distances[np.arange(len(own)), own]  # with a network, below 0 well inside
    mine = np.sqrt(np.maximum(squares, 0))
    odd = []
    for k in range(len(own)):
        others = mine[(own == own[k]) & (np.arange(len(own)) != k)]
        if mine[k] > ODD * np.median(others) and len(others) > FEWEST:
            odd.append((used[k] + 1, str(classes[nearest[k]])))
    both = zip(classes[own].tolist(), classes[nearest].tolist(), strict=True)
    wrong = [pair for pair in both if pair[0] != pair[1]]
    pairs = sorted(dict.fromkeys(wrong), key=lambda pair: -wrong.count(pair))
    results = tuple(
        (name, names.count(name), int(found.right[own == np.searchsorted(classes, name)].sum()))
        for name in dict.fromkeys(names)
    )
    alike = []
    for a, b in combinations(range(len(classes)), 2):
        both = (own == a) | (own == b)
        counts = (own == a).sum(), (own == b).sum()
        nearer = (distances[both, a] < distances[both, b]) == (own[both] == a)
        if min(counts) >= few and nearer.mean() < SAME:
            alike.append((str(classes[a]), str(classes[b])))
    return LessonProgress(results, tuple(odd), tuple(pairs), tuple(alike))


def _check_free(folder: Path) -> None:
    if (folder / FEATURES).exists():
        raise ConfigError(f"{folder} holds a lesson already")
    if (folder / labels.LABELS).exists():
        held = f"{labels.LABELS}, but no {FEATURES}"
        raise ConfigError(f"{folder} holds {held}: teach in another folder")


def check_label(name: str) -> str:
    """Return a label, or raise `ConfigError` if it is invalid or a command."""
    if why := labels.check_name(name):
        raise ConfigError(f"label {name!r}: {why}")
    if name in ORDERS or name.partition(" ")[0] in NAMING:
        raise ConfigError(f"label {name!r} is a command of `teach`; choose another label")
    return name


def _repair(path: Path) -> Path:
    """Repair a recording if it was cut short; return its path."""
    if (new := recover(path, force=True)) != path:
        shutil.move(new, path)
    return path


def _parse_number(path: Path) -> int:
    digits = path.stem.removeprefix("session-")
    return int(digits) if digits.isdecimal() else 0
