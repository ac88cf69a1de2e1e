"""Labelled touches of recordings.

    recordings + intervals -> touches with labels

Module `touches` finds the touches, `labels` reads the labelled intervals. Touches that cannot be
used are counted and reported, never silently dropped. `labelled_set` makes a set of the others.
"""

import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import msgspec

from tactile_rt.classifier.model_card import PERIODS_NS
from tactile_rt.classifier.model_file import read_model
from tactile_rt.core.errors import ConfigError, ModelError, RecordingError, SpecMismatch
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk
from tactile_rt.core.stream.sensor_spec import SensorSpec, channel_limits
from tactile_rt.recording.labels import LABELS, LabelledInterval, label_of_file, read_labels
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.replay import prepare_replay
from tactile_rt.recording.touches import RecordedTouch, find_touches
from tactile_rt.sets.manifest import UNLABELLED, SweepManifest

PERIOD_NS = 9_000_000  # sample period of a set, unless the sensor is slower
TELL_NS = NS_PER_S  # stream time between two progress reports
# reasons for which a touch is not used, in addition to those of `touches`
OUTSIDE = "outside every interval"
DISPUTED = "in intervals that overlap and name different things"
AGAIN = "that an earlier recording holds, too"
MIXED = "that run into the interval of another thing"

Intervals = dict[Path, list[LabelledInterval]]


@dataclass(frozen=True)
class LabelledTouch:
    """Touch with the labelled interval in which it begins."""

    touch: RecordedTouch
    recording: Path
    onset_s: float  # time of its onset, seconds since the first sample of the recording
    interval: LabelledInterval


@dataclass
class LabelledTouches:
    """Usable touches of some recordings, with a report of the others."""

    spec: ArraySpec
    period_ns: int  # sample period of the touches, ns
    sensor: SensorSpec | None  # description of the array's sensor; None if unknown
    used: list[LabelledTouch] = field(default_factory=list)
    sums: dict[Path, str] = field(default_factory=dict)  # sha256 of each recording's file
    found: Counter[Path] = field(default_factory=Counter)
    # lines about touches that could not be used, and other things that the user should know
    left_out: list[str] = field(default_factory=list)


def intervals_beside(recordings: Sequence[Path], labels: Path | None = None) -> Intervals:
    """Read the labelled intervals of recordings from a file of labels.

    Args:
        labels: the file; None: ``labels.csv`` beside each recording.

    Raises:
        ConfigError: no such file exists, or one has a mistake.
    """
    if labels is not None:
        return read_labels(labels, recordings)
    found: Intervals = {}
    for folder in dict.fromkeys(one.parent for one in recordings):
        path = folder / LABELS
        inside = [one for one in recordings if one.parent == folder]
        if not path.is_file():
            raise ConfigError(
                f"no {LABELS} beside {inside[0]}: write one (recording,start_s,end_s,label), or "
                "give --labels FILE, --by-name or --unlabelled"
            )
        found |= read_labels(path, inside)
    return found


def intervals_by_name(recordings: Sequence[Path]) -> Intervals:
    """Return one interval per recording, all of it, labelled by its file name.

    Raises:
        ConfigError: a name contains no label.
    """
    return {one: [LabelledInterval(label=label_of_file(one))] for one in recordings}


def intervals_of_all(recordings: Sequence[Path]) -> Intervals:
    """Return one unlabelled interval per recording, which covers all its samples."""
    return {one: [LabelledInterval(label=UNLABELLED)] for one in recordings}


def like(path: Path) -> tuple[ArraySpec, SensorSpec | None, int]:
    """Return array, sensor and sample period (ns) of a sweep set or a model.

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
    if period_ns not in PERIODS_NS:
        raise RecordingError(f"{path} is damaged: a sample period of {period_ns} ns")
    return spec, sensor, period_ns


def find_labelled(
    recordings: Sequence[Path],
    intervals: Mapping[Path, Sequence[LabelledInterval]],
    pattern: Path | None = None,
    report: Callable[[Path, float], None] = lambda recording, seconds: None,
) -> LabelledTouches:
    """Find the touches in recordings, and label them by the intervals.

    Args:
        pattern: a sweep set or model of the same array, whose sensor and period are used.
        report: is called with a recording and the position up to which it has been read, s.

    Raises:
        ConfigError: a file cannot be read or is given twice, or nothing can be learnt from its
            channels.
        RecordingError: a file is damaged.
        SpecMismatch: recordings of different arrays, or of another array than the pattern's.
    """
    opened = [Recording(one) for one in recordings]
    sums = _hash_files(recordings)
    specs = [recording.spec for recording in opened]
    first, whose = specs[0], recordings[0]
    sensor, period_ns = None, max(PERIOD_NS, *(round(NS_PER_S / spec.rate_hz) for spec in specs))
    if pattern is not None:
        (first, sensor, period_ns), whose = like(pattern), pattern
    for one, spec in zip(recordings, specs, strict=True):
        if differing := first.differences(spec, ("name", "rate_hz")):
            raise SpecMismatch(f"{one} has another array than {whose}: {differing[0]}")
    found = LabelledTouches(specs[0], period_ns, sensor, sums=sums)
    try:
        floor = channel_limits(first, sensor, period_ns).floor
    except ConfigError as error:
        raise ConfigError(f"{error}: --like takes it from a sweep set or model") from None
    reasons, silent = defaultdict[str, list[str]](list), list[str]()  # places, by reason
    met: dict[bytes, Path] = {}  # the recording of each touch, by the hash of its values
    for one, recording in zip(recordings, opened, strict=True):
        mine, touched = list(intervals.get(one, ())), set()
        begin_ns = next((int(chunk.t_ns[0]) for chunk in recording), 0)
        with prepare_replay(str(one.absolute()), {"speed": "0"}).open() as source:
            followed = _report_progress(source, begin_ns, partial(report, one))
            for touch in find_touches(recording.spec, followed, period_ns, floor):
                found.found[one] += 1
                onset_s, end_s = ((t - begin_ns) / NS_PER_S for t in (touch.onset_ns, touch.end_ns))
                of = [i for i in mine if i.start_s <= onset_s < i.end_s]
                touched.update(of)
                why = touch.flaw if of else OUTSIDE
                numbers = hashlib.sha256(touch.values.tobytes()).digest()
                begun = {i.thing for i in mine if onset_s < i.start_s <= end_s}
                if len({i.thing for i in of}) > 1:
                    why = DISPUTED
                elif of and not why and begun - {of[0].thing}:
                    why = MIXED
                elif of and not why and met.setdefault(numbers, one) != one:
                    why = AGAIN
                if why:
                    reasons[why].append(f"{one.name} at {onset_s:.2f} s")
                else:
                    found.used.append(LabelledTouch(touch, one, onset_s, of[0]))
        for interval in mine:
            if interval not in touched:
                silent.append(interval.where or str(one))
        if source.stats.missing:
            found.left_out.append(f"samples missing in {one.name}: {source.stats.missing}")
        if not mine:
            found.left_out.append(f"no interval of {one.name} is labelled")
    unused = [f"touches {why}: {len(at)}, first {at[0]}" for why, at in reasons.items()]
    if silent:
        unused.append(f"intervals in which no touch begins: {len(silent)}, first {silent[0]}")
    found.left_out = [*unused, *found.left_out]
    others = {one: len(i) for one, i in intervals.items() if one not in recordings}
    if others:
        found.left_out.append(
            f"intervals of recordings that were not named: {sum(others.values())}, first of "
            f"{min(one.name for one in others)}"
        )
    return found


def _report_progress(
    source: Iterable[Chunk], begin_ns: int, report: Callable[[float], None]
) -> Iterator[Chunk]:
    """Yield the chunks, and report the time since the stream's beginning, s."""
    reported = begin_ns
    for chunk in source:
        if chunk.t_ns[-1] - reported >= TELL_NS:
            reported = int(chunk.t_ns[-1])
            report((reported - begin_ns) / NS_PER_S)
        yield chunk


def _hash_files(recordings: Sequence[Path]) -> dict[Path, str]:
    """Return the sha256 of each recording's file.

    Raises:
        ConfigError: two are the same, so that a touch could be on two sides of the split.
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
