"""Batches of training windows with random noise and sensor faults, as on a robot.

A thread draws and augments batches while the network computes. A batch depends on (seed, epoch,
index) alone, so that neither threads nor an interruption change it.
"""

import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Generator as Yields
from contextlib import closing, suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Generator, Tensor

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.datasets import NOISE_LEVELS, SweepSet, windows
from tactile_rt.models.implausible import IMPLAUSIBLE

CLEAN_SHARE, RATED_SHARE = 1 / 3, 1 / 3  # of training windows; the others draw a uniform noise
CPU = torch.device("cpu")
AHEAD = 2  # batches drawn in advance: more would only use memory
AUGMENTED = 1  # in the seed of the augmentation of frames, so that it differs from that of loads
JITTER = 5  # samples by which a window may begin earlier or later, by default


def draw_partners(objects: NDArray[Any], rng: np.random.Generator) -> NDArray[np.int64]:
    """Draw for each sweep another sweep of the same object; itself if the only one.

    objects (n,), the object of each sweep -> (n,) indices into `objects`
    """
    order, begins = _order_by_object(objects, rng)
    ends = np.r_[begins[1:], len(objects)] - 1
    following = np.arange(1, len(objects) + 1)
    following[ends] = begins  # the last of an object is followed by its first
    found = np.empty(len(objects), dtype=np.int64)
    found[order] = order[following]
    return found


def order_in_twos(objects: NDArray[Any], rng: np.random.Generator) -> NDArray[np.int64]:
    """Order sweeps at random, but in pairs of consecutive sweeps of one object.

    objects (n,), the object of each sweep -> (n,) indices into `objects`. An odd sweep is unpaired.
    """
    order, begins = _order_by_object(objects, rng)
    place = np.arange(len(objects)) - np.repeat(begins, np.diff(np.r_[begins, len(objects)]))
    two = np.cumsum(place % 2 == 0) - 1  # number of each sweep's pair
    return np.asarray(order[np.argsort(rng.random(len(objects))[two], kind="stable")])


def _order_by_object(
    objects: NDArray[Any], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Order sweeps by object, shuffled within each; return the order and each object's start."""
    order = np.lexsort((rng.random(len(objects)), objects))
    in_order = objects[order]
    return order, np.flatnonzero(np.r_[True, in_order[1:] != in_order[:-1]])


def check_batches(
    objects: NDArray[np.str_], samples: int, batch: int, jitter: int, two_sweeps: bool
) -> None:
    """Check that the sweeps in which a touch was detected are enough for a batch.

    Args:
        objects: (sweep,) the object of each sweep.
        batch, jitter, two_sweeps: as for `TrainingBatches`.

    Raises:
        ConfigError: the jitter is longer than a sweep, there are fewer sweeps than a batch needs,
            or no object has two sweeps though `two_sweeps` is True.
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
    """Generator of training windows with random noise and faults, by epoch and batch.

    A third of the windows have no noise, a third the rated sensor noise, and a third a random
    level; other sensor faults are drawn by the amounts of the set's recipe or the defaults of
    `SensorFaults`. A recorded sweep keeps its own noise and baseline, and no noise is added. Labels
    number the categories, then the set's `refusals`.

    Args:
        jitter: largest number of samples by which a window begins earlier or later.
        two_sweeps: True if the second view of a window is from another sweep of its object.
        kinds: the kinds of each category. If given, labels (batch, 3) are class, kind and object,
            each -1 where a window has none, and batches hold pairs of sweeps of an object.
        device: device of samples, offsets and sigmas; on a GPU it also draws the samples' noise.

    Attributes:
        easy_epochs: The number of epochs in which noise, offset and drift rise linearly to their
            amounts: with full amounts at once a network takes far longer to learn.
    """

    def __init__(
        self,
        data: SweepSet,
        batch: int,
        seed: int,
        jitter: int = JITTER,
        two_sweeps: bool = False,
        device: str = "cpu",
        kinds: Mapping[str, Sequence[str]] | None = None,
    ) -> None:
        self._data, self._batch, self._seed, self._jitter = data, batch, seed, jitter
        self._device = device
        self.easy_epochs = 0
        self._faults, self._refusals = data.manifest.faults, data.refusals
        starts = data.noisy_starts
        # A touch too faint to be detected at a noise level gets its onset without noise.
        self._starts = np.where(starts < 0, starts[0], starts)  # (level, sweep)
        self._usable = np.flatnonzero(self._starts[0] >= 0)
        touched, samples = data.sweeps.objects[self._usable], data.sweeps.values.shape[1]
        check_batches(touched, samples, batch, jitter, two_sweeps)
        self._two_sweeps = two_sweeps
        self._related: NDArray[np.int64] | None = None  # (sweep, 2) kind and object
        if kinds is not None:
            _, number = np.unique(data.sweeps.objects, return_inverse=True)
            self._related = np.stack([data.kinds(kinds), number], axis=1)

    def __len__(self) -> int:
        return len(self._usable) // self._batch

    def epoch(self, number: int, view: int = 0) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Yield an epoch's batches: samples, offset, sigma (see `InputStage`) and labels (batch,).

        Every view of an epoch has the same sweeps in the same order, or other sweeps of the same
        objects if `two_sweeps`. Onset, noise, gains and dead whiskers are drawn for each view, so
        that they cannot reveal that two views are of one sweep.
        """
        rng = np.random.default_rng([self._seed, number])
        if self._related is None:
            order = rng.permutation(self._usable)
        else:
            order = self._usable[order_in_twos(self._related[self._usable, 1], rng)]
        if view:
            rng = np.random.default_rng([self._seed, number, view])
            if self._two_sweeps:
                order = order[draw_partners(self._data.sweeps.objects[order], rng)]
        severity = min(1.0, number / self.easy_epochs) if self.easy_epochs else 1.0
        for i in range(len(self)):
            yield self._draw(order[i * self._batch : (i + 1) * self._batch], rng, severity)

    def _draw(
        self, at: NDArray[np.int64], rng: np.random.Generator, severity: float
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        data, n = self._data, len(at)
        elements, channels = data.manifest.spec.shape
        faults = self._faults
        recorded = data.recorded[at]
        level = np.float32(severity) * _draw_noise_levels(n, faults.noise, rng)
        level[recorded] = 0
        found_at = np.array(NOISE_LEVELS[: len(self._starts)])
        nearest = np.abs(level[:, None] - found_at).argmin(axis=1)
        start = self._starts[nearest, at] + rng.integers(-self._jitter, self._jitter + 1, n)
        values = data.sweeps.values[at]
        # Relative to rest, where a magnetometer reads its magnet's field, and a load cell zero.
        rest = np.zeros((n, elements, channels), dtype=np.float32)
        if data.manifest.lead:
            rest = values[:, : data.manifest.lead].mean(axis=1)
        baseline = data.baselines[0][at], data.baselines[1][at]
        rest = np.where(recorded[:, None, None], baseline[0], rest)
        shape = (n, 1, 1, elements, 1)
        gain = 1 + np.float32(faults.gain) * rng.standard_normal(shape, dtype=np.float32)
        alive = rng.random(shape) >= faults.dead
        if faults.dead_row:
            rows = np.array(data.manifest.spec.grid)[:, 0]
            alive &= (rng.random((n, rows.max() + 1)) >= faults.dead_row)[:, None, None, rows, None]
        # (batch, step, sub-step, element, channel); from here on large arrays are on the device.
        samples = self._to_device(windows(values, start, data.timing))
        samples -= self._to_device(rest)[:, None, None]
        samples *= self._to_device(gain * alive)
        sound = data.sweeps.labels[at]
        sound = np.where(sound < 0, len(data.manifest.categories), sound)  # first refusal: unknown
        labels = self._spoil(samples, sound, rng)
        if self._related is not None:
            related = np.where((labels == sound)[:, None], self._related[at], -1)
            labels = np.concatenate([labels[:, None], related], axis=1)
        if faults.offset or faults.drift:
            self._add_drift(samples, rng, severity)
        noise = data.noise * level[:, None, None]  # (batch, 1, channel)
        samples.addcmul_(
            self._draw_normal(samples.shape, rng), self._to_device(noise)[:, None, None]
        )
        # The baseline: mean and standard deviation of a random number of quiet samples before it.
        quiet = rng.integers(20, 60, (n, 1, 1))
        per_channel = (n, elements, channels)
        offset = noise * rng.normal(size=per_channel) / np.sqrt(quiet)
        spread = 1 + rng.normal(size=per_channel) / np.sqrt(2 * (quiet - 1))
        sigma = np.maximum(noise * np.abs(spread), data.floor)
        sigma = np.where(recorded[:, None, None], baseline[1], sigma)
        return samples, self._to_device(offset), self._to_device(sigma), torch.from_numpy(labels)

    def _to_device(self, array: NDArray[Any]) -> Tensor:
        """Copy an array to the device, in single precision."""
        tensor = torch.from_numpy(np.asarray(array, dtype=np.float32))
        if self._device == "cpu":
            return tensor
        return tensor.pin_memory().to(self._device, non_blocking=True)

    def _draw_normal(self, shape: Sequence[int], rng: np.random.Generator) -> Tensor:
        if self._device == "cpu":
            return torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))
        generator = torch.Generator(self._device).manual_seed(int(rng.integers(2**63)))
        return torch.randn(*shape, generator=generator, device=self._device)

    def _spoil(
        self, samples: Tensor, labels: NDArray[np.int64], rng: np.random.Generator
    ) -> NDArray[np.int64]:
        """Make random windows of a batch implausible, in place; return all labels (n,)."""
        spec, first = self._data.manifest.spec, len(self._data.manifest.categories)
        labels = labels.copy()
        names = [name for name in self._refusals if name in IMPLAUSIBLE]
        if names:
            bad = rng.random(len(samples)) < self._faults.implausible
            which = rng.integers(0, len(names), len(samples))
            for number, name in enumerate(names):
                at = np.flatnonzero(bad & (which == number))
                spoilt = IMPLAUSIBLE[name](samples[at].cpu().numpy(), spec, rng)
                samples[at] = self._to_device(spoilt)
                labels[at] = first + self._refusals.index(name)
        return labels

    def _add_drift(self, samples: Tensor, rng: np.random.Generator, severity: float) -> None:
        """Add random offset and drift since the baseline to samples, in place."""
        data, timing, n = self._data, self._data.timing, len(samples)
        course = np.arange(1, timing.samples + 1) / timing.samples
        faults = self._faults
        for most, over in ((faults.offset, np.ones_like(course)), (faults.drift, course)):
            # half of the sweeps have none
            share = severity * np.maximum(rng.uniform(-1, 1, (n, 1, 1)), 0)
            size = most * share * data.noise
            reached = self._to_device(size * rng.normal(size=(n, *data.manifest.spec.shape)))
            # (batch, sample, element, channel)
            samples.flatten(1, 2).addcmul_(reached[:, None], self._to_device(over)[:, None, None])


def _draw_noise_levels(n: int, largest: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """Draw noise levels (n,), in units of the rated: 0, 1, or uniform to `largest`."""
    which, levels = rng.random(n), largest * rng.random(n)
    levels = np.where(which < CLEAN_SHARE + RATED_SHARE, min(largest, 1.0), levels)
    levels = np.where(which < CLEAN_SHARE, 0.0, levels)
    drawn: NDArray[np.float32] = levels.astype(np.float32)
    return drawn


@dataclass(frozen=True)
class Share:
    """The share of every batch that this device processes."""

    rank: int = 0
    devices: int = 1

    def of(self, tensor: Tensor) -> Tensor:
        """Return this device's rows of (batch, ...), as many as every other device's."""
        even = len(tensor) // self.devices * self.devices
        return tensor[self.rank : even : self.devices]


@dataclass(frozen=True)
class Batch:
    """The input of one update.

    Attributes:
        views: One or two batches of loads, the input of `InputStage`, each drawn independently.
        labels: (batch,) The index of the category of each window, or (batch, 3) class, kind and
            object, as from `TrainingBatches` with kinds.
        generator: The random generator for the augmentation of the frames.
    """

    views: list[Loads]
    labels: Tensor
    generator: Generator


class BatchFeed:
    """Source of a training's batches, with augmented views, drawn in a thread ahead of use."""

    def __init__(
        self,
        batches: TrainingBatches,
        augmentation: Augmentation,
        views: int,
        seed: int,
        share: Share,
        device: torch.device,
    ) -> None:
        self._batches, self._augmentation = batches, augmentation
        self._views, self._seed, self._share, self._device = views, seed, share, device
        self.waited = 0.0  # s spent waiting for batches in the present epoch

    def __len__(self) -> int:
        return len(self._batches)

    def epoch(self, number: int) -> Yields[Batch, None, None]:
        """Yield this device's batches of an epoch."""
        self.waited = 0.0
        with closing(prefetch_items(lambda: self._draw(number))) as ready:
            while True:
                began = time.monotonic()
                batch = next(ready, None)
                self.waited += time.monotonic() - began
                if batch is None:
                    return
                yield batch

    def _draw(self, number: int) -> Iterator[Batch]:
        share = self._share
        drawn = [self._batches.epoch(number, view) for view in range(self._views)]
        for index, batches in enumerate(zip(*drawn, strict=True)):
            place = self._seed, number, index, share.rank
            generator = generator_of(CPU, *place)
            views = [
                self._augmentation.loads((share.of(a), share.of(b), share.of(c)), generator)
                for a, b, c, _ in batches
            ]
            labels = share.of(batches[0][3]).to(self._device)
            yield Batch(views, labels, generator_of(self._device, *place, AUGMENTED))


def generator_of(device: torch.device, *seed: int) -> Generator:
    """Make a torch random generator seeded by a sequence of integers."""
    word = int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> np.uint64(1))
    return Generator(device).manual_seed(word)


def prefetch_items(
    draw: Callable[[], Iterator[Batch]], ahead: int = AHEAD
) -> Yields[Batch, None, None]:
    """Yield the items of `draw()`, computed by a thread at most `ahead` in advance.

    Exceptions in the thread are raised here. The thread ends when the iteration is left.
    """
    ready: queue.Queue[Batch | BaseException | None] = queue.Queue(ahead)
    left = threading.Event()

    def enqueue(item: Batch | BaseException | None) -> None:
        while not left.is_set():
            with suppress(queue.Full):
                ready.put(item, timeout=0.1)
                return

    def work() -> None:
        try:
            for item in draw():
                enqueue(item)
                if left.is_set():
                    return
            enqueue(None)
        except BaseException as error:
            enqueue(error)

    thread = threading.Thread(target=work, name="batches", daemon=True)
    thread.start()
    try:
        while (item := ready.get()) is not None:
            if isinstance(item, BaseException):
                raise item
            yield item
    finally:
        left.set()
        thread.join()
