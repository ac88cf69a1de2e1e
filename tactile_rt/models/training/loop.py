"""Training of an EAD network on a sweep set.

An interrupted run resumes after its last finished epoch and ends with the same results as an
uninterrupted run. Under torchrun every process has a share of each batch:

    torchrun --nproc-per-node 2 --no-python tactile-rt train data/default24 runs/mine
"""

import logging
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict
from itertools import islice
from math import inf, isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.locks import alone_in
from tactile_rt.models.augmentation import Augmentation, Loads
from tactile_rt.models.checkpoints import begin_from, fill_checkpoint, save_whole
from tactile_rt.models.datasets import SweepSet, drawn_as, read_splits, windows
from tactile_rt.models.disturbances import CLEAN, RATED
from tactile_rt.models.evaluation.measures import among, cut_windows, hits, posteriors, run_on
from tactile_rt.models.training.batches import (
    BatchFeed,
    Share,
    TrainingBatches,
    draw_partners,
    generator_of,
)
from tactile_rt.models.training.config import (
    TWO_SWEEPS,
    DivergedError,
    Progress,
    TrainingConfig,
    as_json,
    begin_run,
)
from tactile_rt.models.training.objectives import Objective, build_objective
from tactile_rt.models.training.updates import RunState, batch_loss, log_epoch
from tactile_rt.sets.splits import trained_objects

if TYPE_CHECKING:
    from lightning.fabric import Fabric

Report = Callable[[Progress], None]
Splits = tuple[SweepSet, SweepSet]  # to train and to validate on
VIEWS, FRAMES = 2**32, 2**32 + 1  # in seeds of validation: epochs that no training reaches
Score = tuple[dict[str, float], float]


def train(
    config: TrainingConfig,
    folder: Path,
    report: Report = lambda _: None,
    *,
    device: str = "auto",
    splits: Splits | None = None,
) -> Path:
    """Train a network, or resume an interrupted run; return the path of the best checkpoint.

    Args:
        device: "auto" (an accelerator if there is one), "cpu", "cuda", ...
        splits: the result of `read_splits`, if several runs share it.

    Raises:
        ConfigError: the folder holds a run of another configuration, another process trains in it,
            or the configuration cannot be trained.
        RecordingError: the sweep set is missing, unfinished, damaged or unfit.
        DivergedError: the training diverged.
        ModelError: `last.pt` or `history.csv` is damaged, or `best.pt` is missing.
        OSError: the disk is full, or failed; the last checkpoint is unchanged.
    """
    first = os.environ.get("RANK", "0") == "0"  # only torchrun's first process writes
    with alone_in(folder) if first else nullcontext(), launch_devices(config, device) as fabric:
        return _train(fabric, config, folder, report, splits)


def _train(
    fabric: "Fabric", config: TrainingConfig, folder: Path, report: Report, splits: Splits | None
) -> Path:
    torch.manual_seed(config.seed)
    training, validating = _take_splits(config, splits)
    objective = build_objective(config, training)
    before = None
    if config.begin:
        kinds = training.manifest.kinds
        before = begin_from(objective.model, Path(config.begin), training.classes, kinds)
    met = trained_objects(training.manifests, before)
    share = Share(fabric.global_rank, fabric.world_size)
    two_sweeps = config.pairs == TWO_SWEEPS
    batches = TrainingBatches(
        training, config.batch, config.seed, config.jitter, two_sweeps, str(fabric.device),
        training.manifest.kinds if config.related else None,
    )  # fmt: skip
    if config.easy:
        updates = config.updates or config.epochs * len(batches)
        batches.easy_epochs = round(config.easy * updates / len(batches))
    augmentation = objective.augmentation
    feed = BatchFeed(batches, augmentation, objective.views, config.seed, share, fabric.device)
    validate = Validation(config, validating, augmentation, share, fabric.device)
    run = RunState(objective, config, len(batches))
    settings = as_json(config)
    if fabric.is_global_zero:
        begin_run(config, folder)  # after all checks
    fabric.barrier()
    run.resume(folder)
    wrapped, _ = fabric.setup(objective, run.optimizer)
    loss_of = batch_loss(fabric, wrapped, objective, feed, config.precision == "bf16")

    while run.done < run.updates:
        epoch, began, losses = run.epoch, time.monotonic(), []
        # For dropout: the same in a resumed epoch, and different on every device.
        torch.manual_seed(config.seed * 1000 + epoch + 2**40 * share.rank)
        objective.train()
        with closing(feed.epoch(epoch)) as drawn:
            for batch in islice(drawn, run.updates - run.done):
                loss = loss_of(batch)
                run.optimizer.zero_grad()
                fabric.backward(loss)
                most = config.clip_norm or inf
                norm = fabric.clip_gradients(
                    wrapped, run.optimizer, max_norm=most, error_if_nonfinite=False
                )
                # Clipping would turn such a gradient into zeros or NaN.
                if norm is None or not torch.isfinite(norm):
                    raise DivergedError(
                        f"{folder}: training diverged in epoch {epoch + 1} (gradient norm {norm}); "
                        f"try a learning rate below {config.learning_rate:g}"
                    )
                run.optimizer.step()
                run.schedule.step()
                run.done += 1
                losses.append(loss.item())
                report(Progress(epoch, run.epochs, run.done, run.updates, losses[-1]))
        run.epoch += 1
        if share.devices > 1:
            for buffer in objective.buffers():  # batch norm's means differ between devices
                torch.distributed.broadcast(buffer, 0)
        found, score = fabric.broadcast(validate(objective))
        if not isfinite(score):  # no later score would be higher
            raise DivergedError(
                f"{folder}: training diverged in epoch {epoch + 1} (validation {score}); try a "
                f"learning rate below {config.learning_rate:g}"
            )
        metrics = {
            "epoch": epoch + 1,
            "loss": _mean_loss(fabric, losses),
            **found,
            "seconds": time.monotonic() - began,
        }
        better, run.best = score >= run.best, max(score, run.best)
        if fabric.is_global_zero:
            if better:
                model, refusals = objective.model, training.refusals
                best = fill_checkpoint(model, training.manifest, refusals, settings, met, metrics)
                save_whole(folder / "best.pt", best)
            log_epoch(folder / "history.csv", metrics)
            save_whole(folder / "last.pt", run.state())
        shown = {**metrics, "waiting": feed.waited / metrics["seconds"]}
        report(Progress(epoch + 1, run.epochs, run.done, run.updates, metrics["loss"], shown))
    fabric.barrier()
    return folder / "best.pt"


def initialise(config: TrainingConfig, folder: Path, splits: Splits | None = None) -> Path:
    """Write a configuration's untrained network as a `best.pt`; return the path."""
    torch.manual_seed(config.seed)
    training, _ = _take_splits(config, splits)
    model = build_objective(config, training).model
    folder.mkdir(parents=True, exist_ok=True)
    settings, manifest = as_json(config), training.manifest
    begun = fill_checkpoint(model, manifest, training.refusals, settings, {}, {"epoch": 0})
    save_whole(folder / "best.pt", begun)
    return folder / "best.pt"


def _take_splits(config: TrainingConfig, splits: Splits | None) -> Splits:
    """Return the training and validation splits, with the configuration's window and faults."""
    training, validating = splits or read_splits(config.folders, config.labelled)
    drawn = asdict(config)
    return drawn_as(training, drawn), drawn_as(validating, drawn)


def _mean_loss(fabric: "Fabric", losses: list[float]) -> float:
    """Return the mean loss over an epoch's updates and over all devices."""
    mean = float(np.mean(losses))
    if fabric.world_size == 1:
        return mean
    shared = fabric.all_reduce(torch.tensor(mean))
    assert isinstance(shared, torch.Tensor)
    return shared.item()


@contextmanager
def launch_devices(config: TrainingConfig, device: str) -> Iterator["Fabric"]:
    """Launch a run's devices with Lightning Fabric; the process group ends with the block.

    Args:
        device: "auto", "cpu", "cuda", ...

    Raises:
        ConfigError: a batch is too small to be shared, or this machine has no such device.
    """
    # Imported here: the import takes seconds, and loading a checkpoint does not need it.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from lightning.fabric import Fabric
        from lightning.fabric.strategies.ddp import DDPStrategy

    size = int(os.environ.get("WORLD_SIZE", "1"))
    local = int(os.environ.get("LOCAL_WORLD_SIZE", "1"))
    if (config.batch < 2 * size and config.objective != "supervised") or config.batch < size:
        raise ConfigError(f"a batch of {config.batch} is too small to be shared by {size} devices")
    for name in ("lightning.fabric", "lightning.pytorch"):  # a run reports enough itself
        logging.getLogger(name).setLevel(logging.WARNING)
    # Caused by 1 x 1 kernels, whose memory layout is the same with both strides.
    warnings.filterwarnings("ignore", message="Grad strides do not match bucket view strides")
    try:
        fabric = Fabric(
            accelerator=device,
            devices=local,
            num_nodes=size // local,
            # Static: some networks have layers that no window uses (a position never reached), and
            # these are always the same.
            strategy=DDPStrategy(static_graph=True) if size > 1 else "auto",
        )
    # no such kind; none in this machine; a package that it needs is missing
    except (ValueError, RuntimeError, ModuleNotFoundError) as error:
        raise ConfigError(f"accelerator is {device!r}: {error}") from None
    joined = torch.distributed.is_available() and torch.distributed.is_initialized()
    fabric.launch()
    try:
        yield fabric
    finally:
        if size > 1 and not joined:
            torch.distributed.destroy_process_group()


class Validation:
    """Validation of an objective: a call measures it on the validation split.

    Supervised: top-1 without and with rated noise. The score is their mean, since a robot's
    sensor is between the two, or only the former where training draws no noise. Self-supervised:
    the loss, with the same augmentation every time; the score is the negative loss.

    Args:
        share: this device's share of every batch.
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
        self._measure: Callable[[Objective], Score] = (
            self._measure_top1 if supervised else self._measure_loss
        )
        if supervised:
            # Cut once, since the windows are the same after every epoch.
            self._clean, self._noisy = (
                list(cut_windows(data, disturbance=one)) for one in (CLEAN, RATED)
            )
        else:
            self._found = data.onsets(data.sweeps.values)
            usable = self._usable = np.flatnonzero(self._found.start >= 0)
            if not len(usable):
                raise ConfigError("no touch was found in the validation sweeps: make more sweeps")
            self._other = np.arange(len(data.sweeps))  # the sweep of the second view
            if config.pairs == TWO_SWEEPS:
                rng = np.random.default_rng([config.seed, VIEWS])
                self._other[usable] = usable[draw_partners(data.sweeps.objects[usable], rng)]

    def __call__(self, objective: Objective) -> Score:
        """Return metrics by name and a score to maximise; NaN if outputs are not finite."""
        objective.eval()
        return self._measure(objective)

    def _measure_top1(self, objective: Objective) -> Score:
        data, run = self._data, run_on(objective.model)
        labels, classes = data.sweeps.labels, len(data.manifest.categories)
        shares = []
        for cut in (self._clean, self._noisy):
            answers = posteriors(cut, run)[:, -1]
            touched = np.concatenate([one.detected for one in cut])
            if not np.isfinite(answers[touched]).all():
                return {}, nan  # overflow; gradients reveal it only in training windows
            # Refusals are left out: the evaluation of a model file measures them.
            shares.append(hits(among(answers, classes), labels).mean())
        clean, noisy = shares
        metrics = {"validation_top1": float(clean), "validation_top1_noisy": float(noisy)}
        return metrics, float(clean + noisy) / 2 if data.manifest.faults.noise else float(clean)

    def _cut_share(self, at: NDArray[np.int64]) -> Loads:
        """Cut this device's share of the windows of sweeps `at`, the input of `InputStage`."""
        cut = windows(self._data.sweeps.values[at], self._found.start[at], self._data.timing)
        arrays = cut, self._found.offset[at], self._found.sigma[at]
        samples, offset, sigma = (self._share.of(torch.from_numpy(a)) for a in arrays)
        return samples, offset, sigma

    @torch.inference_mode()
    def _measure_loss(self, objective: Objective) -> Score:
        data, config = self._data, self._config
        # Batches of the training's size if possible: a contrast is harder in a larger batch.
        parts = max(len(self._usable) // config.batch, 1)
        total = torch.zeros((), device=self._device)
        for index, at in enumerate(np.array_split(self._usable, parts)):
            place = index, self._share.rank
            drawn = generator_of(torch.device("cpu"), config.seed, VIEWS, *place)
            views = [
                self._augmentation.loads(self._cut_share(one), drawn)
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
