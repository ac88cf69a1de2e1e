"""Encoder-Attender-Decoder: what an array of whiskers touches, decided anew at every step.

    normalised frames -> encoder -> attender -> decoder -> logits
    (batch, step, 30, 5, 7)   (batch, step, feature)   (batch, step, class)

The 30 channels are 5 sub-steps x 6 loads, the 5 x 7 cells the whiskers' grid.

`EAD.forward` takes a whole window for training; `EAD.step` takes one frame and explicit state,
for streaming, and gives the same logits. The logits of a step use no later frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from tactile_rt.models import attenders, decoders
from tactile_rt.models.encoders.cells import CELLS
from tactile_rt.models.encoders.zhuang import LAG, ZhuangEncoder
from tactile_rt.stream import ConfigError

ENCODERS = tuple(f"zhuang-{cell}" for cell in CELLS)
ATTENDERS = ("gpt", "none")
DECODERS = ("linear", "mlp")
READOUTS = ("last", "mean")
WIDTH_UNIT = 32  # every channel count is a multiple of this at width 1


@dataclass(frozen=True)
class EADConfig:
    """Which network. The defaults are the paper's Intersection-LN + GPT, 63.8 M parameters."""

    classes: int
    encoder: str = "zhuang-intersection-ln"
    attender: str = "gpt"
    decoder: str = "linear"
    width: float = 1.0  # scales every channel count; the GPT's heads and layers stay
    # "last": a step's own logits (the paper). "mean": their running mean since the first frame
    # could count, for a decision at any time.
    readout: str = "last"
    dropout: float = 0.1
    max_steps: int = 22  # an episode; the GPT's positions end here

    def __post_init__(self) -> None:
        for field, known in (
            ("encoder", ENCODERS),
            ("attender", ATTENDERS),
            ("decoder", DECODERS),
            ("readout", READOUTS),
        ):
            if (value := getattr(self, field)) not in known:
                raise ConfigError(f"{field} is {value!r}, not one of {', '.join(known)}")
        if self.classes < 1:
            raise ConfigError(f"classes is {self.classes}, must be at least 1")
        if self.width <= 0 or self.width * WIDTH_UNIT % 1:
            raise ConfigError(
                f"width is {self.width}, must be a positive multiple of 1/{WIDTH_UNIT}"
            )
        if not 0 <= self.dropout < 1:
            raise ConfigError(f"dropout is {self.dropout}, must be in [0, 1)")
        if not 1 <= self.max_steps <= attenders.MAX_STEPS:
            raise ConfigError(f"max_steps is {self.max_steps}, must be 1 to {attenders.MAX_STEPS}")


class EAD(nn.Module):
    """The network of one `EADConfig`; see the module's docstring."""

    def __init__(self, config: EADConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder = ZhuangEncoder(config.width, cell=config.encoder.removeprefix("zhuang-"))
        features = self.encoder.features
        self.attender: attenders.GPT | attenders.NoAttender
        if config.attender == "gpt":
            self.attender = attenders.GPT(features, config.dropout, config.max_steps)
        else:
            self.attender = attenders.NoAttender()
        if config.decoder == "mlp":
            self.decoder = decoders.mlp(features, config.classes, config.width)
        else:
            self.decoder = decoders.linear(features, config.classes)

    def forward(self, frames: Tensor) -> Tensor:
        """frames (batch, step, 30, 5, 7) -> logits (batch, step, class)"""
        logits: Tensor = self.decoder(self.attender(self.encoder(frames)))
        if self.config.readout == "last":
            return logits
        # At least single precision: sums of many steps would stall in autocast's types.
        exact = torch.promote_types(logits.dtype, torch.float32)
        total = logits[:, LAG:].cumsum(dim=1, dtype=exact)
        counts = torch.arange(1, total.shape[1] + 1, device=total.device)
        return torch.cat([logits[:, :LAG], total / counts[:, None]], dim=1)

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """The state before the first step: zeros, each with a leading batch axis, in order."""
        weight = self.encoder.fc8.weight
        state = {
            "index": torch.zeros(batch, dtype=torch.int64, device=weight.device),
            **self.encoder.initial_state(batch),
            **self.attender.initial_state(batch),
        }
        if self.config.readout == "mean":
            state["logits_sum"] = weight.new_zeros(batch, self.config.classes)
        return state

    def step(self, frame: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """One 45 ms step. frame (batch, 30, 5, 7) -> logits (batch, class), the next state.

        A lane is reset by putting its rows of `initial_state` back.
        """
        index = state["index"]
        features, encoder = self.encoder.step(frame, state)
        features, attender = self.attender.step(features, index, state)
        logits: Tensor = self.decoder(features)
        new = {"index": index + 1, **encoder, **attender}
        if self.config.readout == "mean":
            count = index[:, None] - LAG + 1  # steps in the mean; none before the lag is over
            total = state["logits_sum"] + torch.where(count > 0, logits, 0.0)
            logits = torch.where(count > 0, total / count.clamp(min=1), logits)
            new["logits_sum"] = total
        return logits, {name: new[name] for name in state}


def count_parameters(module: nn.Module) -> int:
    return sum(parameter.numel() for parameter in module.parameters())
