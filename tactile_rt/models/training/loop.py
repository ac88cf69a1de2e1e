"""Train an EAD network on a sweep set, from top to bottom.

A run that is killed goes on from its last finished epoch and ends with the same numbers as one
that was not. Under torchrun every process has a share of each batch:

    torchrun --nproc-per-node 2 --no-python tactile-rt train data/default24 runs/mine
"""

import time
from collections.abc import Callable
from contextlib import closing, nullcontext
from dataclasses import asdict
from itertools import islice
from math import inf, isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
import torch

from tactile_rt.core.errors import RecordingError
from tactile_rt.core.locks import alone_in
from tactile_rt.models.augmentation import build
from tactile_rt.models.checkpoint_files import describe_checkpoint
from tactile_rt.models.checkpoints import TactileClassifier, begin_from, save_whole
from tactile_rt.models.data_checks import check_sets
from tactile_rt.models.datasets import SweepSet, drawn_as, frame_of, joined, relabelled
from tactile_rt.models.encoders.graph_encoder import GraphEncoder, draw_as_published
from tactile_rt.models.objectives import (
    Autoencoder,
    Objective,
    Predictive,
    SimCLR,
    SimSiam,
    Supervised,
)
from tactile_rt.models.training.batches import TrainingBatches
from tactile_rt.models.training.config import (
    TWO_SWEEPS,
    DivergedError,
    Progress,
    TrainingConfig,
    manifests_of,
)
from tactile_rt.models.training.devices import is_first, launched
from tactile_rt.models.training.feeding import BatchFeed, Share, generator_of
from tactile_rt.models.training.optimizers import build_optimizer
from tactile_rt.models.training.replay import batch_loss
from tactile_rt.models.training.resuming import RunState, as_json, begin_run, log_epoch
from tactile_rt.models.training.validation import Validation
from tactile_rt.sets.manifest import OUTLIERS, trained_objects

if TYPE_CHECKING:
    from lightning.fabric import Fabric

__all__ = ["build_objective", "initialise", "labels_of", "read_splits", "train"]

Report = Callable[[Progress], None]
Splits = tuple[SweepSet, SweepSet]  # to train and to validate on
AUGMENTED = 1  # tells the draws of frames from those of loads


def train(
    config: TrainingConfig,
    folder: Path,
    report: Report = lambda _: None,
    *,
    device: str = "auto",
    splits: Splits | None = None,
) -> Path:
    """Train, or go on with a run that was interrupted; returns the best checkpoint.

    Args:
        device: "auto" (an accelerator if there is one), "cpu", "cuda", ...
        splits: what `read_splits` gives, where many runs share it.

    Raises:
        ConfigError: the folder holds a run of another configuration, another process trains in it,
            or the configuration cannot be trained.
        RecordingError: the sweep set is missing, unfinished, damaged or unfit.
        DivergedError: the training diverged.
        ModelError: `last.pt` or `history.csv` is damaged, or the best network is gone.
        OSError: the medium is full, or failed; the last checkpoint is as it was.
    """
    with (
        alone_in(folder) if is_first() else nullcontext(),
        launched(config, device) as fabric,
    ):
        return _train(fabric, config, folder, report, splits)


def _train(
    fabric: "Fabric",
    config: TrainingConfig,
    folder: Path,
    report: Report,
    splits: Splits | None,
) -> Path:
    torch.manual_seed(config.seed)
    training, validating = (drawn_as(one, asdict(config)) for one in splits or read_splits(config))
    objective = build_objective(config, training)
    if config.begin:
        begin_from(objective.model, Path(config.begin), labels_of(training))
    before = describe_checkpoint(Path(config.begin)) if config.begin else None
    met = trained_objects(manifests_of(config)[0], before)
    share = Share(fabric.global_rank, fabric.world_size)
    two_sweeps = config.pairs == TWO_SWEEPS
    batches = TrainingBatches(
        training, config.batch, config.seed, config.jitter, two_sweeps, str(fabric.device)
    )
    if config.easy:
        updates = config.updates or config.epochs * len(batches)
        batches.easy_epochs = round(config.easy * updates / len(batches))
    augmentation = objective.augmentation
    feed = BatchFeed(batches, augmentation, objective.views, config.seed, share, fabric.device)
    validate = Validation(config, validating, augmentation, share, fabric.device)
    optimizer = build_optimizer(objective, config)
    run = RunState(objective, optimizer, config, len(batches))
    if fabric.is_global_zero:
        begin_run(config, folder)  # when all that may be refused has been
    fabric.barrier()
    run.resume(folder)
    wrapped, _ = fabric.setup(objective, optimizer)
    loss_of = batch_loss(fabric, wrapped, objective, config, feed)

    while run.done < run.updates:
        epoch, began, losses = run.epoch, time.monotonic(), []
        # Dropout: a resumed epoch is the same epoch, and no two devices drop the same.
        torch.manual_seed(config.seed * 1000 + epoch + 2**40 * share.rank)
        objective.train()
        with closing(feed.epoch(epoch)) as drawn:
            for batch in islice(drawn, run.updates - run.done):
                generator = generator_of(
                    fabric.device, config.seed, epoch, batch.index, share.rank, AUGMENTED
                )
                loss = loss_of(batch, generator)
                optimizer.zero_grad()
                fabric.backward(loss)
                norm = fabric.clip_gradients(
                    wrapped,
                    optimizer,
                    max_norm=config.clip_norm or inf,
                    error_if_nonfinite=False,
                )
                if norm is None or not torch.isfinite(
                    norm
                ):  # clipping would turn it into silence or NaN
                    raise DivergedError(
                        f"{folder}: training diverged in epoch {epoch + 1} (gradient norm {norm}); "
                        f"try a learning rate below {config.learning_rate:g}"
                    )
                optimizer.step()
                run.schedule.step()
                run.done += 1
                losses.append(loss.item())
                report(Progress(epoch, run.epochs, run.done, run.updates, losses[-1]))
        run.epoch += 1
        if share.devices > 1:
            for buffer in objective.buffers():  # batch norm's means are each device's own
                torch.distributed.broadcast(buffer, 0)
        found, score = fabric.broadcast(validate(objective))
        if not isfinite(score):  # nothing would ever be better
            raise DivergedError(
                f"{folder}: training diverged in epoch {epoch + 1} (validation {score}); try a "
                f"learning rate below {config.learning_rate:g}"
            )
        metrics = {
            "epoch": epoch + 1,
            "loss": _mean(fabric, losses),
            **found,
            "seconds": time.monotonic() - began,
        }
        better, run.best = score >= run.best, max(score, run.best)
        if fabric.is_global_zero:
            if better:
                save_whole(folder / "best.pt", _card(config, objective, training, met, metrics))
            log_epoch(folder / "history.csv", metrics)
            save_whole(folder / "last.pt", run.state())
        shown = {**metrics, "waiting": feed.waited / metrics["seconds"]}
        report(Progress(epoch + 1, run.epochs, run.done, run.updates, metrics["loss"], shown))
    fabric.barrier()
    return folder / "best.pt"


def initialise(config: TrainingConfig, folder: Path, splits: Splits | None = None) -> Path:
    """A run's network as it is before its first update, as a `best.pt`; of the same seed."""
    torch.manual_seed(config.seed)
    training = drawn_as((splits or read_splits(config))[0], asdict(config))
    objective = build_objective(config, training)
    folder.mkdir(parents=True, exist_ok=True)
    save_whole(folder / "best.pt", _card(config, objective, training, {}, {"epoch": 0}))
    return folder / "best.pt"


def read_splits(config: TrainingConfig) -> tuple[SweepSet, SweepSet]:
    """What a configuration trains and validates on, held against `data_checks`.

    What it trains on has the outliers of the sets, too.

    Raises:
        ConfigError: the configuration names no network, its sets cannot be joined, or one has no
            labels to learn from.
        RecordingError: a set is missing, unfinished, damaged or unfit.
    """
    folders = [Path(folder) for folder in (config.data, *config.also)]
    manifests, whole = manifests_of(config)
    training, validating = [], []
    for folder, manifest in zip(folders, manifests, strict=True):
        names = ["train", *([OUTLIERS] if manifest.split.get(OUTLIERS) else [])]
        splits = [joined([SweepSet.read(folder, name) for name in names])]
        if manifest.split.get("validation") or len(folders) == 1:  # a further set may have none
            splits.append(SweepSet.read(folder, "validation"))
        check_sets(folder, splits)
        training.append(splits[0])
        validating += splits[1:]
    if not validating:
        raise RecordingError(f"{folders[0]} and the sets beside it have no validation objects")
    return joined(training), relabelled(joined(validating), whole.categories)


def labels_of(training: SweepSet) -> tuple[str, ...]:
    """The names of what a network that learns from these sweeps tells apart: last the refusals."""
    return (*training.manifest.categories, *training.refusals)


def build_objective(config: TrainingConfig, training: SweepSet) -> Objective:
    """The network of a configuration and what it is trained for.

    Raises:
        ConfigError: there is no such network, or the array cannot be augmented so.
    """
    manifest = training.manifest
    network = config.network(len(labels_of(training)), frame_of(manifest))
    model = TactileClassifier(manifest.spec, network, manifest.limits)
    if config.first_weights == "paper" and isinstance(model.network.encoder, GraphEncoder):
        draw_as_published(model.network.encoder)
    predictive = config.objective == "predictive"
    masking = 0.0 if predictive else config.masking  # what it predicts is not blanked
    augmentation = build(config.augmentation, manifest.spec, masking)
    if config.objective == "supervised":
        return Supervised(model, augmentation, config.loss, config.label_smoothing)
    model.network.decoder.requires_grad_(False)  # it has no part in these
    if predictive:
        return Predictive(model, augmentation, config.masking)
    if config.objective == "simclr":
        return SimCLR(model, augmentation, config.temperature)
    return {"simsiam": SimSiam, "autoencoder": Autoencoder}[config.objective](model, augmentation)


def _mean(fabric: "Fabric", losses: list[float]) -> float:
    """Over an epoch's updates and all devices, each of which has its share of every batch."""
    mean = float(np.mean(losses))
    if fabric.world_size == 1:
        return mean
    shared = fabric.all_reduce(torch.tensor(mean))
    assert isinstance(shared, torch.Tensor)
    return shared.item()


def _card(
    config: TrainingConfig,
    objective: Objective,
    data: SweepSet,
    met: dict[str, list[str]],
    metrics: dict[str, float],
) -> dict[str, Any]:
    return {
        "model": objective.model.state_dict(),
        "config": as_json(config),
        "network": msgspec.to_builtins(objective.model.network.config),
        "spec": data.manifest.spec.to_json(),
        "period_ns": data.manifest.period_ns,
        "categories": list(data.manifest.categories),
        "refusals": list(data.refusals),
        "trained_objects": met,
        "metrics": metrics,
    }
