"""Sweep sets in memory, and windows cut out of them at the onsets that a robot would detect.

A window is the input that the classifier would pass to the network: it starts where
`ContactDetector` reports onset on the noisy signal, with the baseline that it has by then.
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
    """The sweeps of one split of a set, with the settings for cutting windows.

    Attributes:
        noise: (channel,) The rated noise per sample, SI.
        floor: (channel,) The smallest sigma of the detector, SI.
        window: The first sample of a sweep's window: "onset", where the detector finds contact,
            or "sweep", where the object starts to move, with the baseline measured until then.
        joined_of: The manifests of the sets that were joined into this one; empty for a single set.
    """

    manifest: SweepManifest
    sweeps: Sweeps
    noise: NDArray[np.float32]
    floor: NDArray[np.float32]
    window: str = "onset"
    joined_of: tuple[SweepManifest, ...] = ()

    @classmethod
    def read(cls, folder: Path, split: str) -> "SweepSet":
        """Read a split of the sweep set in a folder."""
        return cls.read_known(folder, SweepManifest.read(folder), split)

    @classmethod
    def read_known(cls, folder: Path, manifest: SweepManifest, split: str) -> "SweepSet":
        """Read a split of the sweep set in a folder, given the set's manifest."""
        limits = manifest.limits
        return cls(manifest, read_split(folder, manifest, split), limits.noise, limits.floor)

    @property
    def manifests(self) -> tuple[SweepManifest, ...]:
        """Manifests of the sets that the sweeps come from."""
        return self.joined_of or (self.manifest,)

    def onsets(self, values: NDArray[np.float32]) -> Onsets:
        """Find the first sample and the baseline of each window.

        Args:
            values: (sweep, sample, element, channel), SI; samples may be added before each sweep.
        """
        if self.window == "onset":
            return find_onsets(values, self.floor)
        n, shape = len(values), self.manifest.spec.shape
        # after the lead and any silence that was put before it
        begin = self.manifest.lead + values.shape[1] - self.sweeps.values.shape[1]
        offset = np.zeros((n, *shape), dtype=np.float32)
        sigma = np.broadcast_to(self.floor, (n, *shape)).astype(np.float32)
        if begin > 1:
            offset = values[:, :begin].mean(axis=1)
            sigma = np.maximum(values[:, :begin].std(axis=1, ddof=1), sigma)
        return Onsets(np.full(n, begin, dtype=np.int64), offset, sigma)

    @property
    def timing(self) -> Timing:
        """Numbers of steps and sub-steps in a window."""
        return Timing.of(self.manifest.period_ns)

    @property
    def recorded(self) -> NDArray[np.bool_]:
        """Mask (sweep,) of recorded sweeps, whose own sensor noise counts as the rated noise."""
        none = np.zeros(len(self.sweeps), dtype=np.bool_)
        return none if self.sweeps.recorded is None else self.sweeps.recorded

    def __getitem__(self, at: slice | NDArray[Any]) -> "SweepSet":
        return replace(self, sweeps=self.sweeps[at])

    @property
    def refusals(self) -> tuple[str, ...]:
        """Labels other than categories: "unknown" and faults, if training has examples of them."""
        unknown = (UNKNOWN,) if (self.sweeps.labels < 0).any() else ()
        named = implausible(self.manifest.spec) if self.manifest.faults.implausible else ()
        return (*unknown, *named)

    @property
    def classes(self) -> tuple[str, ...]:
        """All labels of a network that is trained on these sweeps: categories, then refusals."""
        return (*self.manifest.categories, *self.refusals)

    def kinds(self, of: Mapping[str, Sequence[str]]) -> NDArray[np.int64]:
        """Return the number (sweep,) of each object's kind, -1 where `of` lacks the kind.

        Args:
            of: the kinds of each category; they are numbered consecutively over all categories.
        """
        numbers = {key: k for k, key in enumerate((c, kind) for c in of for kind in of[c])}
        names, which = np.unique(self.sweeps.objects, return_inverse=True)
        category, kind_of = self.manifest.category, self.manifest.kind_of
        found = [
            numbers.get((category(name), kind_of[name]), -1) if name in kind_of else -1
            for name in names.tolist()
        ]
        return np.array(found, dtype=np.int64)[which]

    @cached_property
    def noisy_starts(self) -> NDArray[np.int64]:
        """First samples (level, sweep) of windows at each of `NOISE_LEVELS`; -1 without an onset.

        Levels that training never draws are left out. Recorded sweeps get no added noise at any
        level.
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
        """Baseline offset and sigma (sweep, element, channel), SI, of recorded sweeps at onset.

        Both are 0 for simulated sweeps, whose baselines are drawn in training."""
        offset, sigma = np.zeros((2, len(self.sweeps), *self.manifest.spec.shape), dtype=np.float32)
        if self.recorded.any():
            found = self.onsets(self.sweeps.values[self.recorded])
            offset[self.recorded], sigma[self.recorded] = found.offset, found.sigma
        return offset, sigma


def windows(
    values: NDArray[np.float32], start: NDArray[np.int64], timing: Timing = MOUSE
) -> NDArray[np.float32]:
    """Cut windows (sweep, step, sub-step, element, channel) that begin at sample `start` (sweep,).

    A window that reaches past the sweep's end repeats the sweep's last sample.
    """
    samples = start[:, None] + np.arange(timing.samples)
    samples = np.clip(samples, 0, values.shape[1] - 1)
    cut = values[np.arange(len(values))[:, None], samples]
    shaped: NDArray[np.float32] = cut.reshape(
        len(values), timing.steps, timing.substeps, *values.shape[2:]
    )
    return shaped


def read_splits(folders: Sequence[Path], labelled: bool) -> tuple[SweepSet, SweepSet]:
    """Read, check and join the training and validation splits of sweep sets.

    Args:
        folders: folders of the sets; the training split includes their outliers.
        labelled: True if training uses the labels.

    Raises:
        ConfigError: the sets cannot be joined, or a set has no labels and `labelled` is True.
        RecordingError: a set is missing, unfinished, damaged or unfit.
    """
    manifests, whole = read_manifests(folders, labelled)
    training, validating = [], []
    for folder, manifest in zip(folders, manifests, strict=True):
        names = ["train", *([OUTLIERS] if manifest.split.get(OUTLIERS) else [])]
        splits = [join_sets([SweepSet.read_known(folder, manifest, name) for name in names])]
        if manifest.split.get("validation") or len(folders) == 1:  # a further set may have none
            splits.append(SweepSet.read_known(folder, manifest, "validation"))
        check_sets(folder, splits)
        training.append(splits[0])
        validating += splits[1:]
    if not validating:
        raise RecordingError(f"{folders[0]} and the sets beside it have no validation objects")
    return join_sets(training), relabel_set(join_sets(validating), whole.categories)


def join_sets(sets: Sequence[SweepSet]) -> SweepSet:
    """Join sets of one array, with all their categories and the first set's faults.

    Shorter sweeps are padded: with their rest before the touch, with their last sample after it.
    """
    if len(sets) == 1:
        return sets[0]
    manifest = join_manifests([one.manifest for one in sets])
    after = max(one.sweeps.values.shape[1] - one.manifest.lead for one in sets)
    parts = [
        (
            _pad_sweeps(one, manifest.lead, after),
            relabel_set(one, manifest.categories).sweeps.labels,
            one.sweeps.objects,
            one.recorded,
        )
        for one in sets
    ]
    values, labels, objects, recorded = map(np.concatenate, zip(*parts, strict=True))
    whole = Sweeps(values, labels, objects, recorded=recorded)
    of = tuple(manifest for one in sets for manifest in one.manifests)
    return replace(sets[0], manifest=manifest, sweeps=whole, joined_of=of)


def _pad_sweeps(data: SweepSet, lead: int, after: int) -> NDArray[np.float32]:
    """Return values padded to `lead` samples before the touch and `after` samples from then on."""
    own, samples = data.manifest.lead, data.sweeps.values.shape[1]
    if (own, samples) == (lead, lead + after):
        return data.sweeps.values
    rest = np.arange(-lead, 0) % max(own, 1)  # repeated, the latest last
    touch = np.minimum(own + np.arange(after), samples - 1)
    return data.sweeps.values[:, np.concatenate([rest, touch])]


def select_labelled(data: SweepSet) -> SweepSet:
    """Return a set of the labelled sweeps, for which training draws no implausible loads."""
    if not data.refusals:
        return data  # with the onsets that it has cached
    known = np.flatnonzero(data.sweeps.labels >= 0)
    return with_faults(data[known], replace(data.manifest.faults, implausible=0.0))


def drawn_as(data: SweepSet, training: Mapping[str, Any]) -> SweepSet:
    """Return the set with the window and sensor faults of a training configuration."""
    window = training.get("window", data.window)
    if window != data.window:  # otherwise the cached onsets are shared between trainings
        data = replace(data, window=window)
    faults = training.get("faults")
    return with_faults(data, SensorFaults(**faults)) if faults else data


def with_faults(data: SweepSet, faults: SensorFaults) -> SweepSet:
    """Return the set with `faults` as the sensor faults that training draws."""
    recipe = {**data.manifest.recipe, FAULTS: asdict(faults)}
    return replace(data, manifest=replace(data.manifest, recipe=recipe))


def relabel_set(data: SweepSet, categories: Sequence[str]) -> SweepSet:
    """Return the set with labels that index `categories`, which include the set's own."""
    place = np.array([*(categories.index(c) for c in data.manifest.categories), -1])
    return replace(
        data,
        manifest=replace(data.manifest, categories=tuple(categories)),
        sweeps=replace(data.sweeps, labels=place[data.sweeps.labels]),
    )


def check_sets(folder: Path, sets: Sequence[SweepSet]) -> None:
    """Check that sweeps are finite and long enough, and no object is in two splits.

    Raises:
        RecordingError: a check fails; the message names the object or the length.
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
                continue  # sweeps that miss the object are all alike, also with a magnet's field
            key = hashlib.blake2b(sweeps.values[at].tobytes()).digest()
            twin, where = seen.setdefault(key, (name, number))
            if where != number:
                raise RecordingError(
                    f"{folder}: {name} is {twin} by another name, on another side of the split: an "
                    "accuracy on it would mean nothing; make the set anew"
                )
