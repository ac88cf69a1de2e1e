"""Updates of a network: loss, optimizer, schedule, and the stored progress of a run.

An update of a recurrent network is thousands of kernels, each of which takes longer to launch than
to run, so on a GPU they are launched as one CUDA graph. Optimizers and schedules are those of the
paper's Table A2 and of the shipped recipe. A parameter may carry its own settings (state-space
models need them), as in ``parameter._optim = {"lr_scale": 0.1, "weight_decay": 0.0}``; parameters
with equal settings share a group. With ``"stacked"`` each row counts as a separate parameter of a
layer norm.

A run's folder holds `last.pt` and `history.csv` (a line per epoch), both written after each epoch:
an interrupted run resumes from them and ends with the same results.
"""

import csv
import io
import logging
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, OneCycleLR

from tactile_rt.core.errors import ModelError
from tactile_rt.core.files import replace_file
from tactile_rt.models.checkpoints import describe_checkpoint, reason
from tactile_rt.models.training.batches import Batch, BatchFeed
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.objectives import Objective

if TYPE_CHECKING:
    from lightning.fabric import Fabric

MOMENTUM = 0.9
WARMUP_RATIO = 1e-4  # of the peak rate: "cosine-annealing" starts just above
TRUST = 1e-3  # LARS's coefficient (You et al. 2017)


@dataclass
class RunState:
    """The state of a run, from which it can be resumed: network, optimizer, schedule, counters.

    Attributes:
        per_epoch: The number of updates in an epoch.
        epoch, done: The numbers of finished epochs and updates.
    """

    objective: Objective
    config: TrainingConfig
    per_epoch: int
    epoch: int = 0
    done: int = 0
    best: float = -math.inf

    def __post_init__(self) -> None:
        self.updates = self.config.updates or self.config.epochs * self.per_epoch
        self.epochs = math.ceil(self.updates / self.per_epoch)
        self.optimizer = build_optimizer(self.objective, self.config)
        self.schedule: LRScheduler = build_schedule(
            self.optimizer, self.config, self.updates, self.per_epoch
        )
        self._parts: dict[str, Any] = {
            "model": self.objective, "optimizer": self.optimizer, "schedule": self.schedule
        }  # fmt: skip

    def state(self) -> dict[str, Any]:
        """Return the state as the contents of `last.pt`."""
        kept = {name: part.state_dict() for name, part in self._parts.items()}
        return kept | {"epoch": self.epoch, "done": self.done, "best": self.best}

    def resume(self, folder: Path) -> None:
        """Load the state from a folder's `last.pt`, if it exists.

        Raises:
            ModelError: `last.pt`, `best.pt` or `history.csv` is damaged, or `best.pt` is missing.
        """
        last = folder / "last.pt"
        if not last.exists():
            return
        try:
            saved = torch.load(last, map_location="cpu", weights_only=True)
            for name, part in self._parts.items():
                part.load_state_dict(saved[name])
            self.epoch, self.done, self.best = saved["epoch"], saved["done"], saved["best"]
        except Exception as error:  # torch raises many unrelated types for a damaged file
            raise ModelError(
                f"{last} is damaged ({reason(error)[:60]}): delete it to begin the run anew"
            ) from None
        try:
            describe_checkpoint(folder / "best.pt")
        except ModelError as error:
            raise ModelError(f"{error}: delete {last} to begin the run anew") from None
        logged_epochs(folder / "history.csv", until=self.epoch + 1)  # fail now, not after an epoch


def logged_epochs(path: Path, until: float) -> list[dict[str, str]]:
    """Read the lines of a run's `history.csv` for epochs before `until`.

    Raises:
        ModelError: the file is damaged, or lines are missing.
    """
    if until <= 1 or not path.exists():
        return []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            lines = list(csv.DictReader(file, strict=True))
        epochs = [int(line["epoch"]) for line in lines]
        whole = epochs[-1] >= until - 1 and all(b == a + 1 for a, b in pairwise(epochs))
    except (UnicodeDecodeError, csv.Error, IndexError, KeyError, TypeError, ValueError):
        whole = False
    if not whole:
        raise ModelError(f"{path} is damaged: delete it to go on without its contents")
    return [line for line, epoch in zip(lines, epochs, strict=True) if epoch < until]


def log_epoch(path: Path, metrics: dict[str, float]) -> None:
    """Append an epoch's line to `history.csv`; remove lines of the same and later epochs.

    Raises:
        OSError: the disk is full, or failed.
    """
    # A run that is interrupted between this and `last.pt` repeats the epoch when it resumes.
    old = logged_epochs(path, metrics["epoch"])
    text = io.StringIO()
    writer = csv.DictWriter(text, list(metrics))
    writer.writeheader()
    writer.writerows([*old, metrics])
    with replace_file(path) as whole:
        whole.write(text.getvalue().encode())


class LARS(torch.optim.Optimizer):
    """LARS optimizer (You et al. 2017): SGD with a learning rate for every tensor.

    The rate of a tensor w with gradient g is multiplied by TRUST |w| / (|g| + decay |w|). Biases,
    norms and tensors that are still zero have the plain rate; biases and norms have no decay.

    Args:
        lr, momentum, weight_decay: as in SGD.
        published: treat all tensors alike, as the paper's code does; so zero tensors never change.
    """

    def __init__(
        self,
        params: Iterable[Any],
        lr: float,
        momentum: float = MOMENTUM,
        weight_decay: float = 0.0,
        published: bool = False,
    ) -> None:
        super().__init__(params, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})
        self._published = published

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Update the parameters once; `closure`, if given, computes the loss again."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            for p in group["params"]:
                if p.grad is not None:
                    self._move(p, group)
        return loss

    def _move(self, p: torch.Tensor, group: dict[str, Any]) -> None:
        assert p.grad is not None
        stacked = group.get("stacked", False)
        layer = self._published or (p.dim() > 1 and not stacked)
        decay = group["weight_decay"] if layer else 0.0
        rate = p.new_ones(())
        if layer:
            size, slope = _norm(p, stacked), _norm(p.grad, stacked)
            ratio = TRUST * size / (slope + decay * size).clamp(min=1e-12)
            plain = torch.zeros_like(ratio) if self._published else rate
            rate = torch.where((size > 0) & (slope > 0), ratio, plain)
        change = p.grad.add(p, alpha=decay) * (rate * group["lr"])
        state = self.state[p]
        if "momentum" in state:
            state["momentum"].mul_(group["momentum"]).add_(change)
        else:
            state["momentum"] = change.clone()
        p.sub_(state["momentum"])


def _norm(tensor: torch.Tensor, stacked: bool) -> torch.Tensor:
    """Return a tensor's norm or, if stacked, those of its rows, with a broadcastable shape."""
    size: torch.Tensor = torch.linalg.vector_norm(
        tensor, dim=-1 if stacked else None, keepdim=stacked
    )
    return size


def parameter_groups(
    model: nn.Module, learning_rate: float, weight_decay: float, own_rates: bool = True
) -> list[Any]:
    """Group the trained parameters by the settings in their ``_optim``.

    Args:
        learning_rate, weight_decay: values for parameters without their own settings.
        own_rates: False to ignore the parameters' own rates and weight decays.
    """
    groups: dict[tuple[float, float, bool], list[nn.Parameter]] = {}
    for parameter in model.parameters():
        if parameter.requires_grad:
            own = getattr(parameter, "_optim", {})
            asked = own if own_rates else {}
            scale, decay = asked.get("lr_scale", 1.0), asked.get("weight_decay", weight_decay)
            key = scale, decay, own.get("stacked", False)
            groups.setdefault(key, []).append(parameter)
    return [
        {"params": members, "lr": learning_rate * scale, "weight_decay": decay, "stacked": stacked}
        for (scale, decay, stacked), members in groups.items()
    ]


def build_optimizer(model: nn.Module, config: TrainingConfig) -> torch.optim.Optimizer:
    """Build the optimizer of a configuration. The weight decay in Table A2 is always 1e-4."""
    rate, decay = config.learning_rate, config.weight_decay
    groups = parameter_groups(model, rate, decay, config.own_rates)
    if config.optimizer == "sgd":
        return torch.optim.SGD(groups, rate, momentum=MOMENTUM)
    if config.optimizer == "adam":
        return torch.optim.Adam(groups, rate)
    if config.optimizer == "adamw":
        return torch.optim.AdamW(groups, rate)
    return LARS(groups, rate, published=config.optimizer == "lars-paper")


def build_schedule(
    optimizer: torch.optim.Optimizer, config: TrainingConfig, updates: int, per_epoch: int = 1
) -> LRScheduler:
    """Build the learning-rate schedule of a configuration, to step after every update.

    Time counts in updates or, with `rate_per` "epoch", in epochs of `per_epoch` updates, as in the
    paper. The run has `updates` updates.

    - "step": divide by ten after every share `drop_every` of the run (StepLR).
    - "constant": the peak rate.
    - "cosine": rise linearly from 0 in the warm-up, then fall by a half cosine to 0.
    - "cosine-annealing": rise from 1e-4 of the peak in the warm-up, then a half cosine down to 0.
    - "one-cycle": torch's OneCycleLR (Smith and Topin 2018).
    """
    if config.schedule == "one-cycle":
        return OneCycleLR(
            optimizer,
            [group["lr"] for group in optimizer.param_groups],
            total_steps=updates,
            # with a warm-up of one update torch divides by zero
            pct_start=config.warmup if config.warmup * updates != 1 else 0.0,
            cycle_momentum=False,
        )
    unit = per_epoch if config.rate_per == "epoch" else 1  # updates
    end = math.ceil(updates / unit)
    warm = round(config.warmup * end)
    late = int(config.rate_per == "epoch")  # annealing counts epochs from 1
    drop = max(round(config.drop_every * end), 1)

    def factor(update: int) -> float:
        at = update // unit
        if config.schedule == "constant":
            return 1.0
        if config.schedule == "step":
            return 0.1 ** (at // drop)
        if config.schedule == "cosine":
            return at / warm if at < warm else _half_cosine(at - warm, end - warm)
        if at < warm:
            return 1 - (1 - (at + late) / warm) * (1 - WARMUP_RATIO)
        return _half_cosine(at + late - warm, end - warm)

    return LambdaLR(optimizer, factor)


def _half_cosine(at: int, end: int) -> float:
    return 0.5 * (1 + math.cos(math.pi * min(at / max(end, 1), 1.0)))


def batch_loss(
    fabric: "Fabric",
    wrapped: Callable[..., Tensor],
    objective: Objective,
    feed: BatchFeed,
    bf16: bool,
) -> Callable[[Batch], Tensor]:
    """Return a function that computes a batch's loss, as a CUDA graph where possible.

    Args:
        wrapped: the objective as returned by `fabric.setup`.
        bf16: True for products in mixed precision.
    """
    device = fabric.device.type

    def by_kernels(batch: Batch) -> Tensor:
        # Not Fabric's autocast, which casts a recurrent network's weights again at every step.
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            loss: Tensor = wrapped(batch.views, batch.labels, batch.generator)
            return loss

    if device != "cuda" or fabric.world_size > 1:
        return by_kernels
    with closing(feed.epoch(0)) as drawn:
        batch = next(drawn)
    seen = objective.see(batch.views, batch.generator)
    graph = capture_loss(objective, seen, batch.labels, bf16)
    if graph is None:
        return by_kernels

    def by_graph(batch: Batch) -> Tensor:
        with torch.autocast(device, torch.bfloat16, enabled=bf16):
            seen = objective.see(batch.views, batch.generator)
        return graph(*seen, batch.labels)

    return by_graph


class _Loss(nn.Module):
    """An objective's loss with only tensors as arguments, as a CUDA graph requires."""

    def __init__(self, objective: Objective) -> None:
        super().__init__()
        self.objective = objective

    def forward(self, *tensors: Tensor) -> Tensor:
        *seen, labels = tensors
        return self.objective.loss(seen, labels)


def capture_loss(
    objective: Objective, seen: Sequence[Tensor], labels: Tensor, bf16: bool
) -> Callable[..., Tensor] | None:
    """Capture an objective's loss as a CUDA graph, a function of (*seen, labels).

    The shapes are fixed. The objective does not change, including its running means. During the
    capture no other thread may use the GPU.

    Args:
        objective: on a GPU, in training mode.
        seen, labels: those of any batch, as for `Objective.loss`.

    Returns:
        The function; None, with a logged warning, if the objective cannot be captured, e.g.
        because a plugin's module branches on values.
    """
    before = {name: buffer.clone() for name, buffer in objective.named_buffers()}
    loss = _Loss(objective).train()
    try:
        with torch.autocast("cuda", torch.bfloat16, enabled=bf16, cache_enabled=False):
            # In place: from here on calls of the module replay the graph.
            torch.cuda.make_graphed_callables(loss, (*seen, labels), allow_unused_input=True)
    except RuntimeError as error:
        logging.getLogger(__name__).warning(
            "an update cannot be one CUDA graph (%s): training goes on kernel by kernel, slower",
            reason(error),
        )
        return None
    finally:
        for name, buffer in objective.named_buffers():
            buffer.copy_(before[name])
    return loss
