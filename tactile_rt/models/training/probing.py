"""Linear probe: a classifier of categories on a frozen network's features.

The network stays in evaluation mode, so features are computed once and a probe takes seconds.
(The published probe left dropout and batch norm in training mode.)
"""

from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.locks import alone_in
from tactile_rt.models.checkpoints import fill_checkpoint, load_checkpoint, probed_on, save_whole
from tactile_rt.models.datasets import SweepSet, check_sets, drawn_as, select_labelled, windows
from tactile_rt.models.ead import TactileClassifier
from tactile_rt.models.evaluation.measures import hits, predict, run_on
from tactile_rt.models.training.batches import JITTER, TrainingBatches
from tactile_rt.models.training.config import ProbeConfig, Progress
from tactile_rt.models.training.updates import log_epoch
from tactile_rt.sets.splits import check_split, trained_objects

WINDOWS = 32  # windows in a batch through the frozen network


def probe(
    checkpoint: Path,
    folder: Path,
    config: ProbeConfig | None = None,
    report: Callable[[Progress], None] = lambda _: None,
    splits: tuple[SweepSet, SweepSet] | None = None,
) -> Path:
    """Fit a linear classifier on a checkpoint's frozen features; return its `best.pt`.

    The layer of the epoch with the best validation top-1 is stored.

    Args:
        splits: the result of `read_splits`, if several runs share it.

    Raises:
        ModelError: there is no such checkpoint.
        SpecMismatch: the set is of another array.
        RecordingError, ConfigError: the set cannot be used, as in `train`; the folder is that of a
            training run, or another process writes into it.
    """
    config = config or ProbeConfig()
    with alone_in(folder):
        trained, saved = load_checkpoint(checkpoint)
        path, manifest = probed_on(checkpoint, saved, folder, config.data)
        if splits is None:
            check_split(path, manifest)
            splits = SweepSet.read(path, "train"), SweepSet.read(path, "validation")
            check_sets(path, splits)
        # the layer classifies categories only, not refusals
        data, validation = (select_labelled(drawn_as(one, saved["config"])) for one in splits)
        torch.manual_seed(config.seed)
        jitter = saved["config"].get("jitter", JITTER)
        touched = int((data.noisy_starts[0] >= 0).sum())  # sweeps may be silent in a small set
        batches = TrainingBatches(data, max(min(WINDOWS, touched), 1), config.seed, jitter)
        begin = trained.network.encoder.lag if config.readout == "mean" else -1
        drawn = [(_extract(trained, begin, *loads), labels) for *loads, labels in batches.epoch(0)]
        features, labels = (torch.cat(part) for part in zip(*drawn, strict=True))
        classes, held_out = len(manifest.categories), _extract_clean(trained, begin, validation)
        layer, history = linear_probe(features, labels, *held_out, classes, config)
        network = replace(
            trained.network.config, classes=classes, decoder="linear", readout=config.readout,
            names=0, identity=0,
        )  # fmt: skip
        model = TactileClassifier(manifest.spec, network, manifest.limits)
        head = "network.decoder."
        kept = {k: v for k, v in trained.state_dict().items() if not k.startswith(head)}
        kept |= {head + name: value for name, value in layer.state_dict().items()}
        model.load_state_dict(kept)
        answers = validation.sweeps.labels
        clean, noisy = (
            float(hits(predict(validation, run_on(model), level)[:, -1], answers).mean())
            for level in (0.0, 1.0)
        )
        metrics = {
            "epoch": config.epochs, "loss": history[-1]["loss"],
            "validation_top1": clean, "validation_top1_noisy": noisy,
        }  # fmt: skip
        folder.mkdir(parents=True, exist_ok=True)
        for line in history:
            log_epoch(folder / "history.csv", line)
        settings = {
            **saved["config"], "data": str(path), "also": (), "begin": "", "probe": asdict(config)
        }  # fmt: skip
        met = trained_objects([manifest], saved)
        save_whole(folder / "best.pt", fill_checkpoint(model, manifest, (), settings, met, metrics))
        report(Progress(config.epochs, config.epochs, 1, 1, metrics["loss"], metrics))
        return folder / "best.pt"


def linear_probe(
    features: Tensor,
    labels: Tensor,
    validation: Tensor,
    answers: Tensor,
    classes: int,
    config: ProbeConfig,
) -> tuple[nn.Linear, list[dict[str, float]]]:
    """Fit a linear layer to features and labels, and choose the best epoch by validation.

    Args:
        features, labels: (window, feature), (window,) to fit to.
        validation, answers: features and labels of the same shapes, to choose the epoch by.

    Returns:
        The layer of the best epoch, for features that are not standardised, and the history.
    """
    torch.manual_seed(config.seed)
    mean, scale = torch.zeros(features.shape[1]), torch.ones(features.shape[1])
    if config.standardise:
        mean, scale = features.mean(0), features.std(0).clamp(min=1e-6)
    inputs, held_out = (features - mean) / scale, (validation - mean) / scale
    layer = nn.Linear(features.shape[1], classes)
    optimizer = torch.optim.SGD(layer.parameters(), config.learning_rate, momentum=config.momentum)
    schedule = torch.optim.lr_scheduler.StepLR(optimizer, config.drop_epochs)
    best, kept, history = -1.0, layer.state_dict(), []
    for epoch in range(config.epochs):
        total = 0.0
        for at in torch.randperm(len(inputs)).split(config.batch):
            loss = F.cross_entropy(layer(inputs[at]), labels[at])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            total += loss.item() * len(at) / len(inputs)
        schedule.step()
        with torch.no_grad():
            top1 = float((layer(held_out).argmax(1) == answers).float().mean())
        history.append({"epoch": epoch + 1, "loss": total, "validation_top1": top1})
        if top1 >= best:
            best, kept = top1, {k: v.clone() for k, v in layer.state_dict().items()}
    weight = kept["weight"] / scale
    layer.load_state_dict({"weight": weight, "bias": kept["bias"] - weight @ mean})
    return layer, history


def _extract(
    model: TactileClassifier, begin: int, samples: Tensor, offset: Tensor, sigma: Tensor
) -> Tensor:
    """Return a network's features (window, feature), averaged over the steps from `begin` on."""
    with torch.inference_mode():
        steps = model.features(model.inputs(samples, offset, sigma))[:, begin:]
        return steps.float().mean(dim=1)


def _extract_clean(model: TactileClassifier, begin: int, data: SweepSet) -> tuple[Tensor, Tensor]:
    """Return features and labels of the sweeps, without added noise, that show contact."""
    found = data.onsets(data.sweeps.values)
    usable = torch.from_numpy(found.start >= 0).nonzero().flatten()
    if not len(usable):
        raise ConfigError("no touch was found in the validation sweeps: there is nothing to probe")
    parts = []
    for at in usable.split(WINDOWS):
        k = at.numpy()
        arrays = (
            windows(data.sweeps.values[k], found.start[k], data.timing),
            found.offset[k],
            found.sigma[k],
        )
        parts.append(_extract(model, begin, *(torch.from_numpy(a) for a in arrays)))
    return torch.cat(parts), torch.from_numpy(data.sweeps.labels)[usable]
