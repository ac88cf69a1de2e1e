"""Stored sweeps in memory, and the windows of them: onsets as the robot will find them.

A window is what the classifier would feed the network: it starts where `ContactDetector` reports
onset on the noisy signal, and carries the baseline that the detector had measured by then.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.decision_rules import UNKNOWN
from tactile_rt.core.errors import RecordingError
from tactile_rt.core.stream import MOUSE, Timing
from tactile_rt.models.implausible import implausible
from tactile_rt.models.onsets import Onsets, find_onsets
from tactile_rt.sets.manifest import FAULTS, OUTLIERS, SweepManifest, object_path
from tactile_rt.sets.objects import Sweeps, read_split
from tactile_rt.sets.sensor_faults import SensorFaults
from tactile_rt.sets.splits import join_manifests, read_manifests

NOISE_LEVELS = (0.0, 0.25, 0.5, 1.0, 2.0)  # of the rated noise, at which training finds onsets


@dataclass(frozen=True)
class SweepSet:
    """One split of a sweep set, with what its windows need.

    Attributes:
        noise: (channel,) The rated noise per sample, SI.
        floor: (channel,) The smallest sigma of the detector, SI.
        window: The first sample of a sweep's window: "onset", where the detector hears the touch,
            or "sweep", where the object sets out, on the baseline that was measured until then.
        joined_of: The manifests of the sets that it was joined of; none if of one alone.
    """

    manifest: SweepManifest
    sweeps: Sweeps
    noise: NDArray[np.float32]
    floor: NDArray[np.float32]
    window: str = "onset"
    joined_of: tuple[SweepManifest, ...] = ()

    @classmethod
    def read(cls, folder: Path, split: str) -> "SweepSet":
        """Read a split."""
        return cls.read_known(folder, SweepManifest.read(folder), split)

    @classmethod
    def read_known(cls, folder: Path, manifest: SweepManifest, split: str) -> "SweepSet":
        """Read a split of a set whose manifest is known."""
        limits = manifest.limits
        return cls(manifest, read_split(folder, manifest, split), limits.noise, limits.floor)

    @property
    def manifests(self) -> tuple[SweepManifest, ...]:
        """What the sets are that its sweeps are of."""
        return self.joined_of or (self.manifest,)

    def onsets(self, values: NDArray[np.float32]) -> Onsets:
        """Find where windows of (sweep, sample, element, channel) begin, and their baselines."""
        if self.window == "onset":
            return find_onsets(values, self.floor)
        n, shape = len(values), self.manifest.spec.shape
        # after the lead, and what silence was put before it
        begin = self.manifest.lead + values.shape[1] - self.sweeps.values.shape[1]
        offset = np.zeros((n, *shape), dtype=np.float32)
        sigma = np.broadcast_to(self.floor, (n, *shape)).astype(np.float32)
        if begin > 1:
            offset = values[:, :begin].mean(axis=1)
            sigma = np.maximum(values[:, :begin].std(axis=1, ddof=1), sigma)
        return Onsets(np.full(n, begin, dtype=np.int64), offset, sigma)

    @property
    def timing(self) -> Timing:
        """How its windows are cut."""
        return Timing.of(self.manifest.period_ns)

    @property
    def recorded(self) -> NDArray[np.bool_]:
        """(sweep,) whether it was recorded: its sensor's noise, which counts as the rated, is in
        it already."""
        none = np.zeros(len(self.sweeps), dtype=np.bool_)
        return none if self.sweeps.recorded is None else self.sweeps.recorded

    def __getitem__(self, at: slice | NDArray[Any]) -> "SweepSet":
        return replace(self, sweeps=self.sweeps[at])

    @property
    def refusals(self) -> tuple[str, ...]:
        """What a network that learns from these sweeps may decide without naming a category."""
        unknown = (UNKNOWN,) if (self.sweeps.labels < 0).any() else ()
        named = implausible(self.manifest.spec) if self.manifest.faults.implausible else ()
        return (*unknown, *named)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of all that a network that learns from it tells apart: last the refusals."""
        return (*self.manifest.categories, *self.refusals)

    def kinds(self, of: Mapping[str, Sequence[str]]) -> NDArray[np.int64]:
        """Number the kind of each sweep's object; -1 where it has none of these.

        Args:
            of: the kinds of each category, counted through all of them.

        Returns:
            (sweep,) numbers.
        """
        numbers = {one: k for k, one in enumerate((c, kind) for c in of for kind in of[c])}
        names, which = np.unique(self.sweeps.objects, return_inverse=True)
        category, kind_of = self.manifest.category, self.manifest.kind_of
        found = [
            numbers.get((category(name), kind_of[name]), -1) if name in kind_of else -1
            for name in names.tolist()
        ]
        return np.array(found, dtype=np.int64)[which]

    @cached_property
    def noisy_starts(self) -> NDArray[np.int64]:
        """(level, sweep) onsets with noise of each of `NOISE_LEVELS`; -1 where none was found.

        Of levels that training never draws there are none. Recorded sweeps have their own noise at
        every level.
        """
        rng, largest = np.random.default_rng(0), max(self.manifest.faults.noise, 1.0)
        levels = [level for level in NOISE_LEVELS if level <= largest]
        starts, parts = [], max(len(self.sweeps) // 256, 1)
        for values, recorded in zip(
            np.array_split(self.sweeps.values, parts),
            np.array_split(self.recorded, parts),
            strict=True,
        ):
            noise = rng.standard_normal(values.shape, dtype=np.float32) * self.noise
            noise[recorded] = 0
            noisy = (values + np.float32(level) * noise for level in levels)
            starts.append(np.stack([self.onsets(v).start for v in noisy]))
        return np.concatenate(starts, axis=1)

    @cached_property
    def baselines(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Offset and sigma (sweep, element, channel), SI, as the detector has measured them by the
        onset, of recorded sweeps; 0 of others, of which training draws them."""
        offset, sigma = np.zeros((2, len(self.sweeps), *self.manifest.spec.shape), dtype=np.float32)
        if self.recorded.any():
            found = self.onsets(self.sweeps.values[self.recorded])
            offset[self.recorded], sigma[self.recorded] = found.offset, found.sigma
        return offset, sigma


def windows(
    values: NDArray[np.float32], start: NDArray[np.int64], timing: Timing = MOUSE
) -> NDArray[np.float32]:
    """Cut (sweep, step, sub-step, element, channel) windows that begin at `start` (sweep,).

    A window that reaches past the sweep's end repeats its last sample.
    """
    samples = start[:, None] + np.arange(timing.samples)
    samples = np.clip(samples, 0, values.shape[1] - 1)
    cut = values[np.arange(len(values))[:, None], samples]
    shaped: NDArray[np.float32] = cut.reshape(
        len(values), timing.steps, timing.substeps, *values.shape[2:]
    )
    return shaped


def read_splits(folders: Sequence[Path], labelled: bool) -> tuple[SweepSet, SweepSet]:
    """Read and check what a training learns from, with outliers, and what it validates on.

    Args:
        folders: of sets that are learnt from together.
        labelled: whether it is learnt from their labels.

    Raises:
        ConfigError: the sets cannot be joined, or one has no labels to learn from.
        RecordingError: a set is missing, unfinished, damaged or unfit.
    """
    manifests, whole = read_manifests(folders, labelled)
    training, validating = [], []
    for folder, manifest in zip(folders, manifests, strict=True):
        names = ["train", *([OUTLIERS] if manifest.split.get(OUTLIERS) else [])]
        splits = [joined([SweepSet.read_known(folder, manifest, name) for name in names])]
        if manifest.split.get("validation") or len(folders) == 1:  # a further set may have none
            splits.append(SweepSet.read_known(folder, manifest, "validation"))
        check_sets(folder, splits)
        training.append(splits[0])
        validating += splits[1:]
    if not validating:
        raise RecordingError(f"{folders[0]} and the sets beside it have no validation objects")
    return joined(training), relabelled(joined(validating), whole.categories)


def joined(sets: Sequence[SweepSet]) -> SweepSet:
    """Sets of one array as one, with the categories of all; faults are those of the first.

    Shorter sweeps rest longer before, as they did, and repeat their last sample after.
    """
    if len(sets) == 1:
        return sets[0]
    manifest = join_manifests([one.manifest for one in sets])
    after = max(one.sweeps.values.shape[1] - one.manifest.lead for one in sets)
    parts = [
        (
            _lengthened(one, manifest.lead, after),
            relabelled(one, manifest.categories).sweeps.labels,
            one.sweeps.objects,
            one.recorded,
        )
        for one in sets
    ]
    values, labels, objects, recorded = map(np.concatenate, zip(*parts, strict=True))
    whole = Sweeps(values, labels, objects, recorded=recorded)
    of = tuple(manifest for one in sets for manifest in one.manifests)
    return replace(sets[0], manifest=manifest, sweeps=whole, joined_of=of)


def _lengthened(data: SweepSet, lead: int, after: int) -> NDArray[np.float32]:
    """Its values (sweep, sample, element, channel), so many samples before the touch and after."""
    own, samples = data.manifest.lead, data.sweeps.values.shape[1]
    if (own, samples) == (lead, lead + after):
        return data.sweeps.values
    rest = np.arange(-lead, 0) % max(own, 1)  # again and again, the latest last
    touch = np.minimum(own + np.arange(after), samples - 1)
    return data.sweeps.values[:, np.concatenate([rest, touch])]


def of_categories(data: SweepSet) -> SweepSet:
    """The sweeps of its categories alone, of which training then spoils none."""
    if not data.refusals:
        return data  # with the onsets that were found once
    known = np.flatnonzero(data.sweeps.labels >= 0)
    return with_faults(data[known], replace(data.manifest.faults, implausible=0.0))


def drawn_as(data: SweepSet, training: Mapping[str, Any]) -> SweepSet:
    """The set whose windows begin, and whose sensor fails, as a run's configuration says."""
    window = training.get("window", data.window)
    if window != data.window:  # else many trainings share the onsets that were found once
        data = replace(data, window=window)
    faults = training.get("faults")
    return with_faults(data, SensorFaults(**faults)) if faults else data


def with_faults(data: SweepSet, faults: SensorFaults) -> SweepSet:
    """The set with other faults of the sensor to be drawn for training."""
    recipe = {**data.manifest.recipe, FAULTS: asdict(faults)}
    return replace(data, manifest=replace(data.manifest, recipe=recipe))


def relabelled(data: SweepSet, categories: Sequence[str]) -> SweepSet:
    """The set with labels among these categories, which have all of its own."""
    place = np.array([*(categories.index(c) for c in data.manifest.categories), -1])
    return replace(
        data,
        manifest=replace(data.manifest, categories=tuple(categories)),
        sweeps=replace(data.sweeps, labels=place[data.sweeps.labels]),
    )


def check_sets(folder: Path, sets: Sequence[SweepSet]) -> None:
    """The sweeps themselves: finite, long enough, and none on two sides.

    Raises:
        RecordingError: otherwise; the message names the object.
    """
    seen: dict[bytes, tuple[str, int]] = {}
    for number, data in enumerate(sets):
        sweeps = data.sweeps
        if sweeps.values.shape[1] < data.timing.samples:
            raise RecordingError(
                f"{folder}: sweeps of {sweeps.values.shape[1]} samples are shorter than a window "
                f"of {data.timing.samples}"
            )
        first = {str(name): int(at) for at, name in reversed(list(enumerate(sweeps.objects)))}
        for k, sweep in enumerate(sweeps.values):
            if not np.isfinite(sweep).all():
                name = str(sweeps.objects[k])
                raise RecordingError(
                    f"{object_path(folder, name)}: sweep {k - first[name]} holds values that are "
                    "not finite: delete the file and sweep again"
                )
        for name, at in first.items():
            if not np.ptp(sweeps.values[at], axis=0).any():
                continue  # a miss is like any other miss, also above a magnet
            key = hashlib.blake2b(sweeps.values[at].tobytes()).digest()
            twin, where = seen.setdefault(key, (name, number))
            if where != number:
                raise RecordingError(
                    f"{folder}: {name} is {twin} by another name, on another side of the split: an "
                    "accuracy on it would mean nothing; make the set anew"
                )
