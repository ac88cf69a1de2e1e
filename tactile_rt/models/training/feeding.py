"""Batches ahead of the network: drawn and augmented in a thread while it computes.

Everything of a batch is drawn from (seed, epoch, index) alone, so that neither threads nor an
interruption change it.
"""

import queue
import threading
import time
from collections.abc import Callable, Iterator
from collections.abc import Generator as Yields
from contextlib import closing, suppress
from dataclasses import dataclass

import numpy as np
import torch
from torch import Generator, Tensor

from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.training.batches import TrainingBatches

__all__ = ["Batch", "BatchFeed", "Share", "generator_of", "prefetched"]

CPU = torch.device("cpu")
AHEAD = 2  # batches that wait for the network: more only take memory


@dataclass(frozen=True)
class Share:
    """This device's part of every batch."""

    rank: int = 0
    devices: int = 1

    def of(self, tensor: Tensor) -> Tensor:
        """(batch, ...) -> every `devices`-th row from `rank` on, as many on every device."""
        even = len(tensor) // self.devices * self.devices
        return tensor[self.rank : even : self.devices]


@dataclass(frozen=True)
class Batch:
    """What an update needs.

    Attributes:
        views: The loads, one or two batches of them, as `InputStage` takes them, each drawn by
            itself.
        labels: (batch,) The index of the category of each window.
        index: The index of the batch among the epoch's, counted from 0.
    """

    views: list[Loads]
    labels: Tensor
    index: int


class BatchFeed:
    """Epochs of batches, each view augmented afresh, on the device."""

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
        self.waited = 0.0  # s, by the network for the present epoch's batches

    def __len__(self) -> int:
        return len(self._batches)

    def epoch(self, number: int) -> Yields[Batch, None, None]:
        """The batches of an epoch."""
        self.waited = 0.0
        with closing(prefetched(lambda: self._draw(number))) as ready:
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
            generator = generator_of(CPU, self._seed, number, index, share.rank)
            views = [
                self._augmentation.loads((share.of(a), share.of(b), share.of(c)), generator)
                for a, b, c, _ in batches
            ]
            yield Batch(views, share.of(batches[0][3]).to(self._device), index)


def generator_of(device: torch.device, *seed: int) -> Generator:
    """A generator that any numbers seed."""
    word = int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> np.uint64(1))
    return Generator(device).manual_seed(word)


def prefetched(
    draw: Callable[[], Iterator[Batch]], ahead: int = AHEAD
) -> Yields[Batch, None, None]:
    """The items of `draw()`, made in a thread of their own, at most so many ahead.

    What is raised there is raised here; the thread ends when the iteration is left.
    """
    ready: queue.Queue[Batch | BaseException | None] = queue.Queue(ahead)
    left = threading.Event()

    def put(item: Batch | BaseException | None) -> None:
        while not left.is_set():
            with suppress(queue.Full):
                ready.put(item, timeout=0.1)
                return

    def work() -> None:
        try:
            for item in draw():
                put(item)
                if left.is_set():
                    return
            put(None)
        except BaseException as error:
            put(error)

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
