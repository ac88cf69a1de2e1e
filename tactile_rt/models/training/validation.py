"""How good a network is by the validation split: what chooses the checkpoint that is kept."""

from collections.abc import Callable
from math import nan

import numpy as np
import torch
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.checkpoints import run_on
from tactile_rt.models.datasets import SweepSet, windows
from tactile_rt.models.disturbances import CLEAN, RATED
from tactile_rt.models.evaluation.measures import among, cut_windows, hits, posteriors
from tactile_rt.models.objectives import Objective
from tactile_rt.models.training.batches import partners
from tactile_rt.models.training.config import TWO_SWEEPS, TrainingConfig
from tactile_rt.models.training.feeding import Share, generator_of

__all__ = ["Validation"]

VIEWS, FRAMES = 2**32, 2**32 + 1  # epochs that no training reaches: their draws are others

Score = tuple[dict[str, float], float]


class Validation:
    """Measures an objective on the validation split.

    Supervised: top-1 without and with rated noise; the score is their mean, since a robot's
    sensor is somewhere between, or the former alone where training draws no noise. Self-supervised:
    the loss, augmented alike every time; the score is its negative.

    Args:
        share: this device's of every batch.
    """

    def __init__(
        self,
        config: TrainingConfig,
        data: SweepSet,
        augmentation: Augmentation,
        share: Share,
        device: torch.device,
    ) -> None:
        self._config, self._data, self._augmentation = config, data, augmentation
        self._share, self._device = share, device
        supervised = config.objective == "supervised"
        self._measure: Callable[[Objective], Score] = self._top1 if supervised else self._loss
        if supervised:
            # Cut once, since they are the same after every epoch.
            self._clean, self._noisy = (
                list(cut_windows(data, disturbance=one)) for one in (CLEAN, RATED)
            )
        else:
            self._found = data.onsets(data.sweeps.values)
            usable = self._usable = np.flatnonzero(self._found.start >= 0)
            if not len(usable):
                raise ConfigError("in no validation sweep was a touch found: make more sweeps")
            self._other = np.arange(len(data.sweeps))  # what the second view is of
            if config.pairs == TWO_SWEEPS:
                rng = np.random.default_rng([config.seed, VIEWS])
                self._other[usable] = usable[partners(data.sweeps.objects[usable], rng)]

    def __call__(self, objective: Objective) -> Score:
        """Metrics by name, and the score: the higher the better; NaN if it answers no numbers."""
        objective.eval()
        return self._measure(objective)

    def _top1(self, objective: Objective) -> Score:
        data, run = self._data, run_on(objective.model)
        labels, classes = data.sweeps.labels, len(data.manifest.categories)
        shares = []
        for cut in (self._clean, self._noisy):
            answers = posteriors(cut, run)[:, -1]
            touched = np.concatenate([one.detected for one in cut])
            if not np.isfinite(answers[touched]).all():
                return {}, nan  # it overflows: no gradient says so, if training's windows do not
            # Whether a model may refuse to decide is another question.
            shares.append(hits(among(answers, classes), labels).mean())
        clean, noisy = shares
        metrics = {"validation_top1": float(clean), "validation_top1_noisy": float(noisy)}
        return metrics, float(clean + noisy) / 2 if data.manifest.faults.noise else float(clean)

    def _cut(self, at: NDArray[np.int64]) -> Loads:
        """This device's share of some sweeps' windows, as `InputStage` takes them."""
        cut = windows(self._data.sweeps.values[at], self._found.start[at], self._data.timing)
        arrays = cut, self._found.offset[at], self._found.sigma[at]
        samples, offset, sigma = (self._share.of(torch.from_numpy(a)) for a in arrays)
        return samples, offset, sigma

    @torch.inference_mode()
    def _loss(self, objective: Objective) -> Score:
        data, config = self._data, self._config
        # Whole batches, as far as there are any: a contrast is as hard as its batch is large.
        parts = max(len(self._usable) // config.batch, 1)
        total = torch.zeros((), device=self._device)
        for index, at in enumerate(np.array_split(self._usable, parts)):
            place = index, self._share.rank
            drawn = generator_of(torch.device("cpu"), config.seed, VIEWS, *place)
            views = [
                self._augmentation.loads(self._cut(one), drawn)
                for one in (at, self._other[at])[: objective.views]
            ]
            views = [
                (a.to(self._device), b.to(self._device), c.to(self._device)) for a, b, c in views
            ]
            frames = generator_of(self._device, config.seed, FRAMES, *place)
            labels = self._share.of(torch.from_numpy(data.sweeps.labels[at])).to(self._device)
            total += objective(views, labels, frames) / parts
        if self._share.devices > 1:
            torch.distributed.all_reduce(total)
            total /= self._share.devices
        return {"validation_loss": float(total)}, -float(total)
