"""Train an EAD network on a sweep set, from top to bottom.

    tactile-rt train data/mouse24 runs/mouse24

A run folder holds `config.json`, `history.csv` (a line per epoch), `last.pt` (everything needed to
go on) and `best.pt` (the network of the best validation accuracy). A run that is killed goes on
from its last finished epoch and ends with the same numbers as one that was not.
"""

import csv
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.datasets import SweepSet, TrainingBatches, channel_values
from tactile_rt.models.ead import EAD, EADConfig
from tactile_rt.models.encoders.zhuang import LAG
from tactile_rt.models.evaluation import hits, predict
from tactile_rt.models.inputs import InputStage
from tactile_rt.stream import ArraySpec, ConfigError, ModelError

__all__ = ["TactileClassifier", "TrainingConfig", "load_checkpoint", "run_on", "train"]

# What is believed of a sensor, and the smallest scale of the logarithm: a third of the median
# load of a touching whisker in passive sweeps.
CLIP = {"N": 5e-3, "N m": 5e-6}
SCALE = {"N": 1e-5, "N m": 1e-7}


@dataclass(frozen=True)
class TrainingConfig:
    """What to train and how; the defaults are the shipped model's recipe."""

    data: str
    attender: str = "none"
    decoder: str = "mlp"
    width: float = 0.125
    readout: str = "mean"
    dropout: float = 0.1
    epochs: int = 14
    batch: int = 32
    learning_rate: float = 5e-3
    weight_decay: float = 1e-4
    warmup: float = 0.05  # share of all updates
    label_smoothing: float = 0.05
    clip_norm: float = 1.0
    bf16: bool = True
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("epochs", "batch", "learning_rate", "clip_norm"):
            if not 0 < getattr(self, name) < float("inf"):  # which NaN is not either
                raise ConfigError(f"{name} must be positive, not {getattr(self, name)}")
        if not 0 <= self.seed < 2**32:
            raise ConfigError(f"seed must be 0 to {2**32 - 1}, not {self.seed}")


class TactileClassifier(nn.Module):
    """Samples in SI units to logits: the input stage and the network, trained and shipped as one.

    Args:
        spec: the array.
        network: the EAD's configuration.
    """

    def __init__(self, spec: ArraySpec, network: EADConfig) -> None:
        super().__init__()
        self.inputs = InputStage(
            spec.grid,
            spec.grid_shape,
            channel_values(spec, CLIP).tolist(),
            channel_values(spec, SCALE).tolist(),
        )
        self.network = EAD(network)

    def forward(self, samples: Tensor, offset: Tensor, sigma: Tensor) -> Tensor:
        """(batch, step, sub-step, element, channel) SI -> logits (batch, step, class)"""
        logits: Tensor = self.network(self.inputs(samples, offset, sigma))
        return logits


@dataclass
class Progress:
    """What a run reports after every update and every epoch."""

    epoch: int
    epochs: int
    update: int
    updates: int
    loss: float
    metrics: dict[str, float] = field(default_factory=dict)


def anytime_loss(logits: Tensor, labels: Tensor, smoothing: float) -> Tensor:
    """Half the cross-entropy of the last step, half the mean of all steps that can know anything.

    logits (batch, step, class), labels (batch,) -> scalar. The first steps, before any input has
    reached the output, would only teach the prior.
    """
    steps = logits[:, LAG:]
    n = steps.shape[1]
    each = F.cross_entropy(
        steps.flatten(0, 1).float(),
        labels.repeat_interleave(n),
        reduction="none",
        label_smoothing=smoothing,
    ).view(-1, n)
    return 0.5 * each[:, -1].mean() + 0.5 * each.mean()


def train(
    config: TrainingConfig, folder: Path, report: Callable[[Progress], None] = lambda _: None
) -> Path:
    """Train, or go on with a run that was interrupted; returns the best checkpoint.

    Raises:
        ConfigError: the folder holds a run of another configuration.
        RecordingError: the sweep set is missing, unfinished or damaged.
    """
    torch.manual_seed(config.seed)
    data = SweepSet.read(Path(config.data), "train")
    validation = SweepSet.read(Path(config.data), "validation")
    manifest = data.manifest
    network = EADConfig(
        classes=len(manifest.categories),
        attender=config.attender,
        decoder=config.decoder,
        width=config.width,
        readout=config.readout,
        dropout=config.dropout,
    )
    _begin_run(config, folder)

    model = TactileClassifier(manifest.spec, network)
    optimizer = torch.optim.AdamW(
        model.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
    )
    batches = TrainingBatches(data, config.batch, config.seed)
    updates = config.epochs * len(batches)
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        config.learning_rate,
        total_steps=updates,
        pct_start=config.warmup,
        cycle_momentum=False,
    )

    begin, best = 0, -1.0
    last = folder / "last.pt"
    if last.exists():
        try:
            saved = torch.load(last, weights_only=True)
            model.load_state_dict(saved["model"])
            optimizer.load_state_dict(saved["optimizer"])
            schedule.load_state_dict(saved["schedule"])
            begin, best = saved["epoch"], saved["best"]
        except Exception as error:  # torch raises many unrelated types for a damaged file
            raise ModelError(
                f"{last} is damaged ({_reason(error)}): delete it to begin the run anew"
            ) from None

    for epoch in range(begin, config.epochs):
        torch.manual_seed(config.seed * 1000 + epoch)  # dropout: a resumed epoch is the same epoch
        model.train()
        began, losses = time.monotonic(), []
        for samples, offset, sigma, labels in batches.epoch(epoch):
            with torch.autocast("cpu", torch.bfloat16, enabled=config.bf16):
                logits = model(samples, offset, sigma)
            loss = anytime_loss(logits, labels, config.label_smoothing)
            optimizer.zero_grad()
            loss.backward()
            norm = nn.utils.clip_grad_norm_(model.parameters(), config.clip_norm)
            if not torch.isfinite(norm):  # clipping would turn it into silence or NaN
                raise ModelError(
                    f"{folder}: training diverged in epoch {epoch + 1} (gradient norm {norm}); "
                    f"try a learning rate below {config.learning_rate:g}"
                )
            optimizer.step()
            schedule.step()
            losses.append(loss.item())
            done = epoch * len(batches) + len(losses)
            report(Progress(epoch, config.epochs, done, updates, losses[-1]))
        labels_v = validation.sweeps.labels
        clean = hits(predict(validation, run_on(model))[:, -1], labels_v).mean()
        noisy = hits(predict(validation, run_on(model), 1.0)[:, -1], labels_v).mean()
        metrics = {
            "epoch": epoch + 1,
            "loss": float(np.mean(losses)),
            "validation_top1": float(clean),
            "validation_top1_noisy": float(noisy),
            "seconds": time.monotonic() - began,
        }
        card = {
            "config": asdict(config),
            "network": asdict(network),
            "spec": manifest.spec.to_json(),
        }
        score = float(clean + noisy) / 2  # a robot's sensor is somewhere between
        if score >= best:
            best = score
            _save(folder / "best.pt", {"model": model.state_dict(), **card, "metrics": metrics})
        state = {
            "model": model.state_dict(),
            "optimizer": optimizer.state_dict(),
            "schedule": schedule.state_dict(),
            "epoch": epoch + 1,
            "best": best,
        }
        _log(folder / "history.csv", metrics)
        _save(last, state)
        report(Progress(epoch + 1, config.epochs, done, updates, metrics["loss"], metrics))
    return folder / "best.pt"


def run_on(
    model: TactileClassifier,
) -> Callable[[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]:
    """The function that `evaluation.predict` wants, of a torch model."""

    def run(
        samples: NDArray[np.float32], offset: NDArray[np.float32], sigma: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        model.eval()
        with torch.inference_mode():
            logits = model(*(torch.from_numpy(a) for a in (samples, offset, sigma)))
        out: NDArray[np.float32] = logits.float().numpy()
        return out

    return run


def load_checkpoint(path: Path) -> tuple[TactileClassifier, dict[str, Any]]:
    """The network of a `best.pt`, in evaluation mode, with what it was trained on.

    Raises:
        ModelError: not there, or not such a checkpoint.
    """
    try:
        saved = torch.load(path, weights_only=True)
        spec = ArraySpec.from_json(saved["spec"])
        model = TactileClassifier(spec, EADConfig(**saved["network"]))
        model.load_state_dict(saved["model"])
    except FileNotFoundError:
        raise ModelError(f"no checkpoint {path}") from None
    except Exception as error:  # torch raises many unrelated types for a damaged file
        raise ModelError(
            f"{path} is not a checkpoint of `tactile-rt train`: {_reason(error)}"
        ) from None
    return model.eval(), saved


def _reason(error: Exception) -> str:
    return str(error).splitlines()[0] if str(error) else type(error).__name__


def _begin_run(config: TrainingConfig, folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "config.json"
    text = msgspec.json.format(msgspec.json.encode(config), indent=1)
    # Before its first epoch is finished a run has nothing to lose: correct its options and go on.
    if not (folder / "last.pt").exists() or not path.exists():
        path.write_bytes(text)
    elif path.read_bytes() != text:
        raise ConfigError(
            f"{folder} holds a run of another configuration: choose another folder, or repeat the "
            "options that began it"
        )


def _save(path: Path, state: dict[str, Any]) -> None:
    partial = path.with_suffix(".partial")
    torch.save(state, partial)
    os.replace(partial, path)


def _log(path: Path, metrics: dict[str, float]) -> None:
    # A line that was logged before the run was killed, but not yet saved, is written again.
    old = []
    if path.exists():
        with path.open(newline="") as file:
            old = [r for r in csv.DictReader(file) if int(r["epoch"]) < metrics["epoch"]]
    partial = path.with_suffix(".partial")
    with partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(metrics))
        writer.writeheader()
        writer.writerows([*old, metrics])
    os.replace(partial, path)
