"""Optimizers and schedules of the paper's Table A2, and the ones of the shipped recipe.

A parameter may carry its own settings (state-space models want them), as in
``parameter._optim = {"lr_scale": 0.1, "weight_decay": 0.0}``; equal settings share a group.
"""

import math
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import nn
from torch.optim.lr_scheduler import LambdaLR, LRScheduler, OneCycleLR

from tactile_rt.models.training.config import TrainingConfig

__all__ = ["LARS", "build_optimizer", "build_schedule", "parameter_groups"]

MOMENTUM = 0.9
WARMUP_RATIO = 1e-4  # of "cosine-annealing": where the rate begins
TRUST = 1e-3  # LARS's coefficient (You et al. 2017)


class LARS(torch.optim.Optimizer):
    """Layer-wise adaptive rates (You et al. 2017): SGD with a rate for every tensor.

    The rate of a tensor w with gradient g is multiplied by TRUST |w| / (|g| + decay |w|). Biases,
    norms and every tensor that is still zero take the plain rate, and the former no decay.

    Args:
        params: parameters or groups.
        lr, momentum, weight_decay: as in SGD.
        published: multiply even where |w| = 0, as the paper's code: such tensors never move.
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
        """One update; `closure`, if given, evaluates the loss anew."""
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
        layer = self._published or p.dim() > 1
        decay = group["weight_decay"] if layer else 0.0
        rate = p.new_ones(())
        if layer:
            size, slope = p.norm(), p.grad.norm()
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


def parameter_groups(model: nn.Module, learning_rate: float, weight_decay: float) -> list[Any]:
    """Groups of the parameters that are trained, by what their ``_optim`` asks for."""
    groups: dict[tuple[float, float], list[nn.Parameter]] = {}
    for parameter in model.parameters():
        if parameter.requires_grad:
            own = getattr(parameter, "_optim", {})
            key = own.get("lr_scale", 1.0), own.get("weight_decay", weight_decay)
            groups.setdefault(key, []).append(parameter)
    return [
        {"params": members, "lr": learning_rate * scale, "weight_decay": decay}
        for (scale, decay), members in groups.items()
    ]


def build_optimizer(model: nn.Module, config: TrainingConfig) -> torch.optim.Optimizer:
    """The optimizer of a configuration: Table A2 has a weight decay of 1e-4 for all."""
    groups = parameter_groups(model, config.learning_rate, config.weight_decay)
    rate = config.learning_rate
    if config.optimizer == "sgd":
        return torch.optim.SGD(groups, rate, momentum=MOMENTUM)
    if config.optimizer == "adam":
        return torch.optim.Adam(groups, rate)
    if config.optimizer == "adamw":
        return torch.optim.AdamW(groups, rate)
    return LARS(groups, rate, published=config.optimizer == "lars-paper")


def build_schedule(
    optimizer: torch.optim.Optimizer, config: TrainingConfig, updates: int
) -> LRScheduler:
    """The schedule of a configuration, to be stepped after every one of so many updates.

    - "step": tenfold down after every `drop_every` of all updates (StepLR).
    - "constant".
    - "cosine": up from nothing in the warm-up, then a half cosine down to 0.
    - "cosine-annealing": a half cosine down to 0 over all updates, damped in the warm-up, which
      begins at 1e-4 of it.
    - "one-cycle": Smith and Topin (2018), as torch has it.
    """
    if config.schedule == "one-cycle":
        return OneCycleLR(
            optimizer,
            [group["lr"] for group in optimizer.param_groups],
            total_steps=updates,
            pct_start=config.warmup,
            cycle_momentum=False,
        )
    warm = round(config.warmup * updates)
    drop = max(round(config.drop_every * updates), 1)

    def factor(update: int) -> float:
        if config.schedule == "constant":
            return 1.0
        if config.schedule == "step":
            return 0.1 ** (update // drop)
        ramp = min((update + 1) / (warm + 1), 1.0)
        if config.schedule == "cosine":
            return ramp if update < warm else _half_cosine(update - warm, updates - warm)
        damping = WARMUP_RATIO + (1 - WARMUP_RATIO) * min(update / max(warm, 1), 1.0)
        return _half_cosine(update, updates) * (damping if warm else 1.0)

    return LambdaLR(optimizer, factor)


def _half_cosine(at: int, end: int) -> float:
    return 0.5 * (1 + math.cos(math.pi * min(at / max(end, 1), 1.0)))
