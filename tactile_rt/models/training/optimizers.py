"""Optimizers and schedules of the paper's Table A2, and the ones of the shipped recipe.

A parameter may carry its own settings (state-space models want them), as in
``parameter._optim = {"lr_scale": 0.1, "weight_decay": 0.0}``; equal settings share a group. With
``"stacked"`` each of its rows is a norm's, and would be a tensor of its own elsewhere.
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
WARMUP_RATIO = 1e-4  # of "cosine-annealing": the rate begins above it
TRUST = 1e-3  # LARS's coefficient (You et al. 2017)


class LARS(torch.optim.Optimizer):
    """Layer-wise adaptive rates (You et al. 2017): SGD with a rate for every tensor.

    The rate of a tensor w with gradient g is multiplied by TRUST |w| / (|g| + decay |w|). Biases,
    norms and every tensor that is still zero take the plain rate, and the former no decay.

    Args:
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
        stacked = group.get("stacked", False)
        layer = self._published or (p.dim() > 1 and not stacked)
        decay = group["weight_decay"] if layer else 0.0
        rate = p.new_ones(())
        if layer:
            size, slope = _size(p, stacked), _size(p.grad, stacked)
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


def _size(tensor: torch.Tensor, stacked: bool) -> torch.Tensor:
    """A tensor's norm, or that of each of its rows, to multiply the tensor with."""
    size: torch.Tensor = torch.linalg.vector_norm(
        tensor, dim=-1 if stacked else None, keepdim=stacked
    )
    return size


def parameter_groups(
    model: nn.Module, learning_rate: float, weight_decay: float, own_rates: bool = True
) -> list[Any]:
    """Groups of the parameters that are trained, by what their ``_optim`` asks for.

    Args:
        learning_rate, weight_decay: of those that ask for none of their own.
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
    """The optimizer of a configuration: Table A2 has a weight decay of 1e-4 for all."""
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
    """The schedule of a configuration, to be stepped after every one of so many updates.

    Time is counted in updates, or, with `rate_per` "epoch", in epochs of `per_epoch` updates, as
    the paper does.

    - "step": tenfold down after every `drop_every` of all time (StepLR).
    - "constant".
    - "cosine": up from nothing in the warm-up, then a half cosine down to 0.
    - "cosine-annealing": up from 1e-4 in the warm-up, then a half cosine down to 0.
    - "one-cycle": Smith and Topin (2018), as torch has it.
    """
    if config.schedule == "one-cycle":
        return OneCycleLR(
            optimizer,
            [group["lr"] for group in optimizer.param_groups],
            total_steps=updates,
            # of a warm-up of one update torch makes a division by zero
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
