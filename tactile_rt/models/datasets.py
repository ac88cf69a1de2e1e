"""From stored sweeps to training windows: onsets as the robot will find them, noise as it will be.

A window is what the classifier would feed the network: it starts where `ContactDetector` reports
onset on the noisy signal, and carries the tare that the detector had measured by then.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.classifier.decision_rules import UNKNOWN
from tactile_rt.models.implausible import IMPLAUSIBLE, implausible
from tactile_rt.models.onsets import Onsets, find_onsets
from tactile_rt.sensor_faults import SensorFaults
from tactile_rt.stream import ConfigError
from tactile_rt.sweep_set import FAULTS, SweepManifest, Sweeps, join_manifests, read_sweeps
from tactile_rt.timing import MOUSE, Timing

if TYPE_CHECKING:
    from torch import Tensor

__all__ = [
    "JITTER",
    "Onsets",
    "SweepSet",
    "TrainingBatches",
    "check_batches",
    "drawn_as",
    "find_onsets",
    "frame_of",
    "joined",
    "of_categories",
    "partners",
    "relabelled",
    "windows",
    "with_faults",
]

NOISE_LEVELS = (0.0, 0.25, 0.5, 1.0, 2.0)  # of the rated noise, at which training finds onsets
CLEAN_SHARE, RATED_SHARE = 1 / 3, 1 / 3  # of training windows; the others are drawn evenly
JITTER = 5  # samples either side of where a window begins, unless told otherwise


def frame_of(manifest: SweepManifest) -> tuple[int, int, int]:
    """Channels, rows and columns of what a network sees of a sweep set's array in a step."""
    spec = manifest.spec
    rows, columns = spec.grid_shape
    return Timing.of(manifest.period_ns).substeps * len(spec.channels), rows, columns


@dataclass(frozen=True)
class SweepSet:
    """One split of a sweep set, with what its windows need.

    Attributes:
        manifest: The manifest of the whole set.
        sweeps: The sweeps of the split.
        noise: (channel,) The rated noise per sample, SI.
        floor: (channel,) The smallest sigma of the detector, SI.
        window: The first sample of a sweep's window: "onset", where the detector hears the touch,
            or "sweep", where the object sets out, tared by what was measured until then.
    """

    manifest: SweepManifest
    sweeps: Sweeps
    noise: NDArray[np.float32]
    floor: NDArray[np.float32]
    window: str = "onset"

    @classmethod
    def read(cls, folder: Path, split: str) -> SweepSet:
        """Read a split.

        Raises:
            RecordingError, ConfigError: as `read_sweeps` and `channel_limits`.
        """
        manifest = SweepManifest.read(folder)
        limits = manifest.limits
        return cls(manifest, read_sweeps(folder, split), limits.noise, limits.floor)

    def onsets(self, values: NDArray[np.float32]) -> Onsets:
        """Where the windows of sweeps (sweep, sample, element, channel) begin, and their tares."""
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

    def __getitem__(self, at: slice | NDArray[Any]) -> SweepSet:
        """Some of the sweeps."""
        return replace(self, sweeps=self.sweeps[at])

    @property
    def _levels(self) -> tuple[float, ...]:
        largest = max(self.manifest.faults.noise, 1.0)
        return tuple(level for level in NOISE_LEVELS if level <= largest)

    @property
    def refusals(self) -> tuple[str, ...]:
        """What a network that learns from these sweeps may decide without naming a category."""
        unknown = (UNKNOWN,) if (self.sweeps.labels < 0).any() else ()
        named = implausible(self.manifest.spec) if self.manifest.faults.implausible else ()
        return (*unknown, *named)

    @cached_property
    def noisy_starts(self) -> NDArray[np.int64]:
        """(level, sweep) onsets with noise of each of `NOISE_LEVELS`; -1 where none was found.

        Of levels that training never draws there are none. Recorded sweeps have their own noise at
        every level.
        """
        rng = np.random.default_rng(0)
        starts, parts = [], max(len(self.sweeps) // 256, 1)
        for values, recorded in zip(
            np.array_split(self.sweeps.values, parts),
            np.array_split(self.recorded, parts),
            strict=True,
        ):
            noise = rng.standard_normal(values.shape, dtype=np.float32) * self.noise
            noise[recorded] = 0
            noisy = (values + np.float32(level) * noise for level in self._levels)
            starts.append(np.stack([self.onsets(v).start for v in noisy]))
        return np.concatenate(starts, axis=1)

    @cached_property
    def tares(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
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


def joined(sets: Sequence[SweepSet]) -> SweepSet:
    """Sets of one array as one, with the categories of all; faults are those of the first.

    Shorter sweeps rest longer before, as they did, and repeat their last sample after.

    Raises:
        ConfigError: as `join_manifests`.
    """
    if len(sets) == 1:
        return sets[0]
    manifest = join_manifests([one.manifest for one in sets])
    after = max(one.sweeps.values.shape[1] - one.manifest.lead for one in sets)
    whole = Sweeps(
        np.concatenate([_lengthened(one, manifest.lead, after) for one in sets]),
        np.concatenate([relabelled(one, manifest.categories).sweeps.labels for one in sets]),
        np.concatenate([one.sweeps.objects for one in sets]),
        recorded=np.concatenate([one.recorded for one in sets]),
    )
    return replace(sets[0], manifest=manifest, sweeps=whole)


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


def _noise_levels(n: int, largest: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """(n,) noise in units of the rated: exactly none, exactly the rated, or uniform."""
    which, levels = rng.random(n), largest * rng.random(n)
    levels = np.where(which < CLEAN_SHARE + RATED_SHARE, min(largest, 1.0), levels)
    levels = np.where(which < CLEAN_SHARE, 0.0, levels)
    drawn: NDArray[np.float32] = levels.astype(np.float32)
    return drawn


def partners(objects: NDArray[Any], rng: np.random.Generator) -> NDArray[np.int64]:
    """For each of some sweeps another one of the same object, any as likely; itself if alone.

    objects (n,), the object of each -> (n,) indices into it.
    """
    order = np.lexsort((rng.random(len(objects)), objects))  # each object's, shuffled
    in_order = objects[order]
    begins = np.flatnonzero(np.r_[True, in_order[1:] != in_order[:-1]])
    ends = np.r_[begins[1:], len(objects)] - 1
    following = np.arange(1, len(objects) + 1)
    following[ends] = begins  # the last of an object is followed by its first
    found = np.empty(len(objects), dtype=np.int64)
    found[order] = order[following]
    return found


def check_batches(
    objects: NDArray[np.str_], samples: int, batch: int, jitter: int, two_sweeps: bool
) -> None:
    """Refuse batches that sweeps in which a touch was found, or all that there are, cannot fill.

    Args:
        objects: (sweep,) the object of each.
        samples: of each sweep.
        batch, jitter, two_sweeps: as `TrainingBatches` takes them.

    Raises:
        ConfigError: a jitter longer than a sweep, not even one batch of sweeps with a touch, or no
            object that has two.
    """
    n = len(objects)
    if jitter >= samples:
        raise ConfigError(f"jitter is {jitter} samples, but a sweep has {samples}")
    if n < batch:
        raise ConfigError(
            f"a batch of {batch} is more than the {n} sweeps in which a touch was found: take a "
            "smaller batch, or make more sweeps"
        )
    if two_sweeps and len(set(objects.tolist())) == n:
        raise ConfigError(
            'pairs of "two-sweeps": no object has two sweeps in which a touch was found; make '
            'more of each, or take pairs of "one-sweep"'
        )


class TrainingBatches:
    """Epochs of augmented training windows, each drawn afresh from (seed, epoch).

    A third of the windows are clean, a third carry the rated sensor noise, and a third any level;
    what else is wrong with the sensor is drawn as the set's recipe says, or else as `SensorFaults`
    does. A recorded sweep has the noise that it was recorded with and no other, and its own tare,
    as when a classifier meets it. Labels beyond the categories are those of the set's `refusals`,
    in their order.

    Args:
        data: the sweeps.
        batch: windows in a batch.
        seed: of all that is drawn.
        jitter: samples by which a window may begin earlier or later.
        two_sweeps: whether the second view of a window is of another sweep of its object.
        device: of the samples, offsets and sigmas; a GPU also draws the noise of the samples.

    Attributes:
        easy_epochs: The number of epochs in which noise, offset and drift rise to what is said: a
            network that meets them at once takes far longer to learn.

    Raises:
        ConfigError: as `check_batches`.
    """

    def __init__(
        self,
        data: SweepSet,
        batch: int,
        seed: int,
        jitter: int = JITTER,
        two_sweeps: bool = False,
        device: str = "cpu",
    ) -> None:
        self._data, self._batch, self._seed, self._jitter = data, batch, seed, jitter
        self._device = device
        self.easy_epochs = 0
        self._faults, self._refusals = data.manifest.faults, data.refusals
        starts = data.noisy_starts
        # Too faint to be found at its noise level: learn it from where it is found without.
        self._starts = np.where(starts < 0, starts[0], starts)  # (level, sweep)
        self._usable = np.flatnonzero(self._starts[0] >= 0)
        touched, samples = data.sweeps.objects[self._usable], data.sweeps.values.shape[1]
        check_batches(touched, samples, batch, jitter, two_sweeps)
        self._two_sweeps = two_sweeps

    def __len__(self) -> int:
        return len(self._usable) // self._batch

    def epoch(self, number: int, view: int = 0) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Batches of samples, offset, sigma (as `InputStage` takes them) and labels (batch,).

        Every view of an epoch has the same sweeps in the same order, or others of the same objects
        if `two_sweeps`, with an onset, noise, gains and dead whiskers of its own: by those alone
        two views are not to be known as one sweep.
        """
        rng = np.random.default_rng([self._seed, number])
        order = rng.permutation(self._usable)
        if view:
            rng = np.random.default_rng([self._seed, number, view])
            if self._two_sweeps:
                order = order[partners(self._data.sweeps.objects[order], rng)]
        severity = min(1.0, number / self.easy_epochs) if self.easy_epochs else 1.0
        for i in range(len(self)):
            yield self._draw(order[i * self._batch : (i + 1) * self._batch], rng, severity)

    def _draw(
        self, at: NDArray[np.int64], rng: np.random.Generator, severity: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        import torch  # here: sets are read and checked without

        data, n = self._data, len(at)
        elements, channels = data.manifest.spec.shape
        faults = self._faults
        recorded = data.recorded[at]
        level = np.float32(severity) * _noise_levels(n, faults.noise, rng)
        level[recorded] = 0
        found_at = np.array(NOISE_LEVELS[: len(self._starts)])
        nearest = np.abs(level[:, None] - found_at).argmin(axis=1)
        start = self._starts[nearest, at] + rng.integers(-self._jitter, self._jitter + 1, n)
        values = data.sweeps.values[at]
        # Relative to rest, where a magnetometer reads its magnet's field, and a load cell nothing.
        rest = np.zeros((n, elements, channels), dtype=np.float32)
        if data.manifest.lead:
            rest = values[:, : data.manifest.lead].mean(axis=1)
        tare = data.tares[0][at], data.tares[1][at]
        rest = np.where(recorded[:, None, None], tare[0], rest)
        shape = (n, 1, 1, elements, 1)
        gain = 1 + np.float32(faults.gain) * rng.standard_normal(shape, dtype=np.float32)
        alive = rng.random(shape) >= faults.dead
        if faults.dead_row:
            rows = np.array(data.manifest.spec.grid)[:, 0]
            alive &= (rng.random((n, rows.max() + 1)) >= faults.dead_row)[:, None, None, rows, None]
        # (batch, step, sub-step, element, channel), all that is large, on the device from here on.
        samples = self._there(windows(values, start, data.timing))
        samples -= self._there(rest)[:, None, None]
        samples *= self._there(gain * alive)
        labels = self._spoilt(samples, data.sweeps.labels[at], rng)
        if faults.offset or faults.drift:
            self._wander(samples, rng, severity)
        noise = data.noise * level[:, None, None]  # (batch, 1, channel)
        samples.addcmul_(self._normal(samples.shape, rng), self._there(noise)[:, None, None])
        # The tare: a mean and a spread over the quiet samples that happened to come before.
        quiet = rng.integers(20, 60, (n, 1, 1))
        per_channel = (n, elements, channels)
        offset = noise * rng.normal(size=per_channel) / np.sqrt(quiet)
        spread = 1 + rng.normal(size=per_channel) / np.sqrt(2 * (quiet - 1))
        sigma = np.maximum(noise * np.abs(spread), data.floor)
        sigma = np.where(recorded[:, None, None], tare[1], sigma)
        return samples, self._there(offset), self._there(sigma), torch.from_numpy(labels)

    def _there(self, array: NDArray[Any]) -> Tensor:
        """In single precision, on the device."""
        import torch

        tensor = torch.from_numpy(np.asarray(array, dtype=np.float32))
        if self._device == "cpu":
            return tensor
        return tensor.pin_memory().to(self._device, non_blocking=True)

    def _normal(self, shape: Sequence[int], rng: np.random.Generator) -> Tensor:
        """Standard normal numbers on the device."""
        import torch

        if self._device == "cpu":
            return torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))
        generator = torch.Generator(self._device).manual_seed(int(rng.integers(2**63)))
        return torch.randn(*shape, generator=generator, device=self._device)

    def _spoilt(
        self, samples: Tensor, labels: NDArray[np.int64], rng: np.random.Generator
    ) -> NDArray[np.int64]:
        """Make some of the samples implausible, in place; (n,) the labels that all then have."""
        spec, first = self._data.manifest.spec, len(self._data.manifest.categories)
        labels = np.where(labels < 0, first, labels)  # unknown is the first refusal
        names = [name for name in self._refusals if name in IMPLAUSIBLE]
        if names:
            bad = rng.random(len(samples)) < self._faults.implausible
            which = rng.integers(0, len(names), len(samples))
            for number, name in enumerate(names):
                at = np.flatnonzero(bad & (which == number))
                spoilt = IMPLAUSIBLE[name](samples[at].cpu().numpy(), spec, rng)
                samples[at] = self._there(spoilt)
                labels[at] = first + self._refusals.index(name)
        return labels

    def _wander(self, samples: Tensor, rng: np.random.Generator, severity: float) -> None:
        """Add, in place, what has come to the readings since their tare."""
        data, timing, n = self._data, self._data.timing, len(samples)
        course = np.arange(1, timing.samples + 1) / timing.samples
        for most, over in (
            (self._faults.offset, np.ones_like(course)),
            (self._faults.drift, course),
        ):
            # half of the sweeps have none
            share = severity * np.maximum(rng.uniform(-1, 1, (n, 1, 1)), 0)
            size = most * share * data.noise
            reached = self._there(size * rng.normal(size=(n, *data.manifest.spec.shape)))
            # (batch, sample, element, channel)
            samples.flatten(1, 2).addcmul_(reached[:, None], self._there(over)[:, None, None])
