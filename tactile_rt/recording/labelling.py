"""Recordings become a sweep set: touches that somebody has labelled, split by object.

    recordings + intervals -> touches -> objects -> train, validation, test -> folder

What a touch is, `touches` says; what was touched, `labels`. What cannot be used is counted and
told, never left out in silence.
"""

import hashlib
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tactile_rt.classifier.model_card import MAX_PERIOD_NS
from tactile_rt.classifier.model_file import read_model
from tactile_rt.files import whole_folder
from tactile_rt.recording.conversion import chunks_of
from tactile_rt.recording.labels import LABELS, LabelledInterval, label_of_file, read_labels
from tactile_rt.recording.touches import REST, RecordedTouch, find_touches
from tactile_rt.sensor_spec import SensorSpec, channel_limits
from tactile_rt.stream import (
    NS_PER_S,
    ArraySpec,
    Chunk,
    ConfigError,
    ModelError,
    RecordingError,
    SpecMismatch,
)
from tactile_rt.sweep_set import (
    RECORDED_VERSION,
    RECORDINGS,
    SPLITS,
    UNLABELLED,
    SweepManifest,
    write_object,
)
from tactile_rt.version import VERSION

__all__ = [
    "SHARES",
    "LabelledTouches",
    "check_shares",
    "find_labelled",
    "intervals_beside",
    "intervals_by_name",
    "intervals_of_all",
    "like",
    "write_set",
]

PERIOD_NS = 9_000_000  # of a set's samples, unless the sensor is slower
SHARES = (0.7, 0.15, 0.15)  # of the objects of each category, by split
ENOUGH = 3  # recordings of a label that may be its objects, one for each split
DIGITS = 6  # of a recording's checksum, in the names of its objects
STEM = 100  # bytes of a recording's name, likewise
TELL_NS = NS_PER_S  # of the stream, between reports of how far it is
# why a touch is not used, besides those of `touches`
OUTSIDE = "outside every interval"
DISPUTED = "in intervals that overlap and name different things"
AGAIN = "that an earlier recording holds, too"
MIXED = "that run into the interval of another thing"

Intervals = dict[Path, list[LabelledInterval]]


@dataclass(frozen=True)
class _Used:
    """A touch that is used: of which recording, when, and of what."""

    touch: RecordedTouch
    recording: Path
    onset_s: float
    interval: LabelledInterval


@dataclass
class LabelledTouches:
    """The touches of some recordings that can be used, and what could not.

    Attributes:
        spec: The array of the recordings.
        period_ns: The sample period of the touches, ns.
        sensor: The description of the array's sensor; None: it has none.
        used: The touches, in the order of the recordings.
        sums: The sha256 of each recording's file.
        found: The number of touches of each recording.
        left_out: The lines that tell what could not be used, or should be known.
    """

    spec: ArraySpec
    period_ns: int
    sensor: SensorSpec | None
    used: list[_Used] = field(default_factory=list)
    sums: dict[Path, str] = field(default_factory=dict)
    found: Counter[Path] = field(default_factory=Counter)
    left_out: list[str] = field(default_factory=list)


def intervals_beside(recordings: Sequence[Path], labels: Path | None = None) -> Intervals:
    """What was touched when, as a file says it.

    Args:
        recordings: which.
        labels: the file; None: ``labels.csv`` beside each recording.

    Raises:
        ConfigError: there is no such file, or a mistake in one.
    """
    if labels is not None:
        return read_labels(labels, recordings)
    found: Intervals = {}
    for folder in dict.fromkeys(one.parent for one in recordings):
        path = folder / LABELS
        there = [one for one in recordings if one.parent == folder]
        if not path.is_file():
            raise ConfigError(
                f"no {LABELS} beside {there[0]}: write one (recording,start_s,end_s,label), or "
                "give --labels FILE, --by-name or --unlabelled"
            )
        found |= read_labels(path, there)
    return found


def intervals_by_name(recordings: Sequence[Path]) -> Intervals:
    """All of each recording is of the label that its file's name tells.

    Raises:
        ConfigError: a name tells none.
    """
    return {one: [LabelledInterval(label=label_of_file(one))] for one in recordings}


def intervals_of_all(recordings: Sequence[Path]) -> Intervals:
    """All of each recording, without a label."""
    return {one: [LabelledInterval(label=UNLABELLED)] for one in recordings}


def like(path: Path) -> tuple[ArraySpec, SensorSpec | None, int]:
    """Array, sensor and sample period (ns) of a sweep set, or of a model.

    Raises:
        RecordingError: no such set, or it is damaged.
        ModelError: the model cannot be read.
    """
    if path.suffix == ".onnx":
        card = read_model(path)[0]
        spec, period_ns = card.array, card.period_ns
        try:
            sensor = msgspec.convert(card.sensor, SensorSpec) if card.sensor else None
        except (msgspec.ValidationError, ConfigError) as error:
            why = str(error).removeprefix("sensor: ")
            raise ModelError(f"{path} has damaged metadata: sensor: {why}") from None
    else:
        manifest = SweepManifest.read(path)
        spec, sensor, period_ns = manifest.spec, manifest.sensor, manifest.period_ns
    if sensor is not None and len(sensor.channels) != len(spec.channels):
        raise RecordingError(
            f"{path} is damaged: its sensor has {len(sensor.channels)} channels, its array "
            f"{len(spec.channels)}"
        )
    if not 0 < period_ns <= MAX_PERIOD_NS:
        raise RecordingError(f"{path} is damaged: a sample period of {period_ns} ns")
    return spec, sensor, period_ns


def find_labelled(
    recordings: Sequence[Path],
    intervals: Mapping[Path, Sequence[LabelledInterval]],
    pattern: Path | None = None,
    report: Callable[[Path, float], None] = lambda recording, seconds: None,
) -> LabelledTouches:
    """Find the touches in recordings, and what was touched.

    Args:
        recordings: files, of any form.
        intervals: of each recording, and maybe of others.
        pattern: a sweep set or model of the same array, whose sensor and period are taken.
        report: is told how far a recording has been read, s.

    Raises:
        ConfigError: a file cannot be read or is there twice, or channels that cannot be learnt
            from.
        RecordingError: a file is damaged.
        SpecMismatch: recordings of different arrays, or of another than the pattern's.
    """
    for one in recordings:
        if one.is_dir():
            raise ConfigError(
                f"{one} is a folder: `tactile-rt convert {one} FILE.mcap --episode N` makes a "
                "recording of an episode of a dataset"
            )
    opened = [chunks_of(one) for one in recordings]
    sums = _sums(recordings)
    specs = [about.spec for about, _ in opened]
    first, whose = specs[0], recordings[0]
    sensor, period_ns = None, max(PERIOD_NS, *(round(NS_PER_S / spec.rate_hz) for spec in specs))
    if pattern is not None:
        (first, sensor, period_ns), whose = like(pattern), pattern
    for one, spec in zip(recordings, specs, strict=True):
        if differing := first.differences(spec, ("name", "rate_hz")):
            raise SpecMismatch(f"{one} is of another array than {whose}: {differing[0]}")
    found = LabelledTouches(specs[0], period_ns, sensor, sums=sums)
    try:
        floor = channel_limits(first, sensor, period_ns).floor
    except ConfigError as error:
        raise ConfigError(f"{error}: --like takes it from a sweep set or model") from None
    reasons, silent = _Reasons(), _Reasons()
    met: dict[bytes, Path] = {}  # the recording of each touch, by its numbers
    for one, (about, chunks) in zip(recordings, opened, strict=True):
        mine, touched = list(intervals.get(one, ())), set()
        with closing(chunks):
            stream = _Counted(one, chunks, report)
            for touch in find_touches(about.spec, stream.chunks(), period_ns, floor):
                found.found[one] += 1
                onset_s, end_s = (
                    (t - stream.first_ns) / NS_PER_S for t in (touch.onset_ns, touch.end_ns)
                )
                of = [i for i in mine if i.start_s <= onset_s < i.end_s]
                touched.update(of)
                why = touch.flaw if of else OUTSIDE
                if len({i.thing for i in of}) > 1:
                    why = DISPUTED
                elif of and not why and _runs_into(of[0], onset_s, end_s, mine):
                    why = MIXED
                elif of and not why and met.setdefault(_digest(touch), one) != one:
                    why = AGAIN
                if why:
                    reasons.add(why, f"{one.name} at {onset_s:.2f} s")
                else:
                    found.used.append(_Used(touch, one, onset_s, of[0]))
        for interval in mine:
            if interval not in touched:
                silent.add("in which no touch begins", interval.where or str(one))
        if stream.lost:
            found.left_out.append(f"samples missing in {one.name}: {stream.lost}")
        if not mine:
            found.left_out.append(f"no interval of {one.name} is labelled")
    found.left_out = [*reasons.lines("touches"), *silent.lines("intervals"), *found.left_out]
    others = {one: len(i) for one, i in intervals.items() if one not in recordings}
    if others:
        found.left_out.append(
            f"intervals of recordings that were not named: {sum(others.values())}, first of "
            f"{min(one.name for one in others)}"
        )
    return found


def write_set(
    folder: Path,
    touches: LabelledTouches,
    shares: Sequence[float] = SHARES,
    seed: int = 0,
    options: str = "",
    finish: Callable[[Path], None] = lambda folder: None,
) -> SweepManifest:
    """Write a sweep set of labelled touches, whole or not at all.

    Args:
        folder: where to; a set that is there is replaced.
        touches: what is in it.
        shares: of the objects of each category, for training, validation and test.
        seed: of the split.
        options: with which the command made it, for provenance.
        finish: is called with the folder before it takes its name.

    Raises:
        ConfigError: no touch can be used, or shares that cannot be.
    """
    check_shares(shares)
    if not touches.used:
        why = "; ".join(touches.left_out) or "no recording holds one"
        raise ConfigError(f"no touch can be used: {why}")
    objects = _objects(touches)
    categories = sorted({used[0].interval.label for used in objects.values()})
    category_of = {name: used[0].interval.label for name, used in objects.items()}
    manifest = SweepManifest(
        spec=touches.spec,
        sensor=touches.sensor,
        period_ns=touches.period_ns,
        lead=REST,
        categories=tuple(categories),
        split=_split(category_of, shares, seed),
        category_of=category_of,
        recipe={
            "name": folder.name,
            "objects": {"from": RECORDINGS},
            RECORDINGS: {str(one): digest for one, digest in touches.sums.items()},
            "options": options,
            "seed": seed,
        },
        versions={"tactile_rt": VERSION, "numpy": np.__version__},
        version=RECORDED_VERSION,
    )
    with whole_folder(folder) as made:
        manifest.write(made)
        for name, used in objects.items():
            about: dict[str, Any] = {
                "recording": np.array([u.recording.name for u in used]),
                "onset_s": np.array([u.onset_s for u in used]),
            }
            write_object(made, name, np.stack([u.touch.values for u in used]), about)
        finish(made)
    return manifest


def check_shares(shares: Sequence[float]) -> None:
    """Refuse shares by which objects cannot be split.

    Raises:
        ConfigError: not one for each split, a negative one, or nothing to train on.
    """
    whole = len(shares) == len(SPLITS) and all(s >= 0 for s in shares) and sum(shares) < inf
    if not whole or not shares[0]:
        raise ConfigError(
            "--shares is TRAIN,VALIDATION,TEST, as 0.7,0.15,0.15: 0 or more each, and some to train"
        )


class _Counted:
    """A recording's chunks, of which one knows when they began and what is missing.

    Attributes:
        first_ns: The stream time of the first sample, ns.
        lost: The number of samples that the sequence numbers leave out.
    """

    def __init__(
        self, recording: Path, chunks: Iterator[Chunk], report: Callable[[Path, float], None]
    ) -> None:
        self._recording, self._chunks, self._report = recording, chunks, report
        self.first_ns = self.lost = 0

    def chunks(self) -> Iterator[Chunk]:
        after: int | None = None
        told = 0
        for chunk in self._chunks:
            if after is None:
                self.first_ns = told = int(chunk.t_ns[0])
                after = int(chunk.seq[0])
            self.lost += max(0, int(chunk.seq[-1]) + 1 - after - len(chunk))
            after = int(chunk.seq[-1]) + 1
            if chunk.t_ns[-1] - told >= TELL_NS:
                told = int(chunk.t_ns[-1])
                self._report(self._recording, (told - self.first_ns) / NS_PER_S)
            yield chunk


class _Reasons:
    """Counts by reason, with the first place of each."""

    def __init__(self) -> None:
        self._count: Counter[str] = Counter()
        self._first: dict[str, str] = {}

    def add(self, why: str, where: str) -> None:
        self._count[why] += 1
        self._first.setdefault(why, where)

    def lines(self, what: str) -> list[str]:
        return [f"{what} {why}: {n}, first {self._first[why]}" for why, n in self._count.items()]


def _digest(touch: RecordedTouch) -> bytes:
    return hashlib.sha256(touch.values.tobytes()).digest()


def _runs_into(
    own: LabelledInterval, onset_s: float, end_s: float, intervals: Sequence[LabelledInterval]
) -> bool:
    """Whether another thing's interval begins before the window ends."""
    return any(onset_s < i.start_s <= end_s and i.thing != own.thing for i in intervals)


def _objects(touches: LabelledTouches) -> dict[str, list[_Used]]:
    """The touches by the names of their objects.

    An object is what the labels call one; else a recording, where a label has enough of them;
    else each touch is one, and a line tells what that costs.
    """
    recordings: defaultdict[str, set[Path]] = defaultdict(set)
    for used in touches.used:
        recordings[used.interval.label].add(used.recording)
    objects: defaultdict[str, list[_Used]] = defaultdict(list)
    alone: Counter[str] = Counter()
    for used in touches.used:
        label, thing = used.interval.thing
        if not thing:
            stem = os.fsencode(used.recording.stem)[:STEM].decode(errors="ignore")
            thing = f"{stem}-{touches.sums[used.recording][:DIGITS]}"
            if label == UNLABELLED or len(recordings[label]) < ENOUGH:
                alone[label] += 1
                thing += f"-{used.onset_s:.3f}"
        objects[f"{label}@{thing}"].append(used)
    for label, n in alone.items():
        if label != UNLABELLED:
            touches.left_out.append(
                f"touches of {label}, each taken for an object of its own: {n}; an accuracy says "
                f"nothing of other things: fill in the column object, or record {ENOUGH} files"
            )
    return dict(objects)


def _split(
    category_of: Mapping[str, str], shares: Sequence[float], seed: int
) -> dict[str, tuple[str, ...]]:
    """The objects of each split, by a hash of their names; of each category some to train."""
    sides: dict[str, list[str]] = {split: [] for split in SPLITS}
    for category in sorted(set(category_of.values())):
        names = sorted(
            (name for name, of in category_of.items() if of == category),
            key=lambda name: hashlib.sha256(f"{seed}:{name}".encode()).digest(),
        )
        held = [max(1, round(len(names) * s / sum(shares))) if s else 0 for s in shares[1:]]
        while sum(held) >= len(names):  # of few objects rather one to tune on than one to test on
            held[1 if held[1] >= held[0] else 0] -= 1
        ends = np.cumsum([len(names) - sum(held), *held]).tolist()
        for split, begin, end in zip(SPLITS, [0, *ends], ends, strict=False):
            sides[split] += names[begin:end]
    return {split: tuple(names) for split, names in sides.items()}


def _sums(recordings: Sequence[Path]) -> dict[Path, str]:
    """The sha256 of each recording's file.

    Raises:
        ConfigError: two are the same, whose touches would be on two sides of the split.
    """
    sums: dict[Path, str] = {}
    by_sum: dict[str, Path] = {}
    for one in recordings:
        if one in sums:
            raise ConfigError(f"{one} is named twice: name it once")
        with one.open("rb") as file:
            sums[one] = hashlib.file_digest(file, "sha256").hexdigest()
        other = by_sum.setdefault(sums[one], one)
        if other != one:
            raise ConfigError(f"{other} and {one} are the same recording: name one of them")
    return sums
