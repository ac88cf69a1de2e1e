"""Encoder-Attender-Decoder: what an array of whiskers touches, decided anew at every step.

    normalised frames -> encoder -> attender -> decoder -> logits
    (batch, step, channel, row, column) -> (batch, step, feature) -> (batch, step, class)

The channels are those of all sub-steps of a step, rows and columns the array's grid: 5 sub-steps
x 6 loads on 5 x 7 cells for the mouse's whiskers of the paper.

`EAD.forward` takes a whole window for training; `EAD.step` takes one frame and explicit state,
for streaming, and gives the same logits. The logits of a step use no later frame.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.core.errors import ConfigError
from tactile_rt.models import attenders, decoders
from tactile_rt.models.ead_config import (
    ATTENDERS,
    DECODERS,
    ENCODERS,
    READOUTS,
    EADConfig,
    encoder_class,
)
from tactile_rt.models.encoders.cells import Cell

__all__ = ["ATTENDERS", "DECODERS", "EAD", "ENCODERS", "READOUTS", "EADConfig", "count_parameters"]

GPT_OF_RESNET = 256  # the paper's GPT is narrower than its features there, and only there


class EAD(nn.Module):
    """The network of one `EADConfig`; see the module's docstring.

    Attributes:
        lag: The number of steps that a frame takes to reach the logits: the first `lag` steps of a
            window know of no frame, the last `lag` frames do not count.
    """

    def __init__(self, config: EADConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder: Any = _encoder(config)
        if config.norm_epsilon:
            for cell in self.encoder.modules():
                if isinstance(cell, Cell):
                    cell.epsilon = config.norm_epsilon
        self._alone = _alone(config)
        self.lag: int = self.encoder.lag
        width: int = self.encoder.features
        self.attender: attenders.GPT | attenders.MambaAttender | attenders.NoAttender
        if config.attender == "gpt":
            inputs = width
            if config.encoder == "resnet18":
                width = round(GPT_OF_RESNET * config.width)
            self.attender = attenders.GPT(width, config.dropout, config.max_steps, inputs)
        elif config.attender == "mamba":
            self.attender = attenders.MambaAttender(width)
        else:
            self.attender = attenders.NoAttender()
        self.decoder = decoders.make(
            config.decoder, width, config.classes, config.width, config.max_steps
        )

    def features(self, frames: Tensor) -> Tensor:
        """What the decoder reads of frames, (batch, step, feature)."""
        frames = F.pad(frames, (0, 1)) if self._alone else frames
        features: Tensor = self.attender(self.encoder(frames))
        return features

    def embed(self, frames: Tensor) -> Tensor:
        """What the decoder's last layer reads of frames at each step, (batch, step, unit)."""
        return self.decoder.embed(self.features(frames))

    def forward(self, frames: Tensor) -> Tensor:
        """frames (batch, step, channel, row, column) -> logits (batch, step, class)"""
        logits: Tensor = self.decoder(self.features(frames))
        if self.config.readout == "last":
            return logits
        # At least single precision: sums of many steps would stall in autocast's types.
        exact = torch.promote_types(logits.dtype, torch.float32)
        total = logits[:, self.lag :].cumsum(dim=1, dtype=exact)  # (batch, step - lag, class)
        counts = torch.arange(1, total.shape[1] + 1, device=total.device)  # (step - lag,)
        return torch.cat([logits[:, : self.lag], total / counts[:, None]], dim=1)

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """The state before the first step: zeros, each with a leading batch axis, in order."""
        weight = next(self.parameters())
        state = {
            "index": torch.zeros(batch, dtype=torch.int64, device=weight.device),
            **self.encoder.initial_state(batch),
            **self.attender.initial_state(batch),
            **self.decoder.initial_state(batch),
        }
        if self.config.readout == "mean":
            state["logits_sum"] = weight.new_zeros(batch, self.config.classes)
        return state

    def step(self, frame: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """One step: frame (batch, channel, row, column) to logits (batch, class), the next state.

        A lane is reset by putting its rows of `initial_state` back.
        """
        logits, _, new = self.step_embedded(frame, state)
        return logits, new

    def step_embedded(
        self, frame: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """As `step`, with the step's embedding (batch, unit) between logits and state.

        It is that of the step alone, also where the logits are a mean over steps.
        """
        index = state["index"]
        frame = F.pad(frame, (0, 1)) if self._alone else frame
        features, encoder = self.encoder.step(frame, index, state)  # (batch, feature)
        features, attender = self.attender.step(features, index, state)
        embedding, decoder = self.decoder.step(features, index, state)  # (batch, unit)
        logits = self.decoder.logits(embedding)  # (batch, class)
        new = {"index": index + 1, **encoder, **attender, **decoder}
        if self.config.readout == "mean":
            count = index[:, None] - self.lag + 1  # steps in the mean; none before the lag is over
            total = state["logits_sum"] + torch.where(count > 0, logits, 0.0)
            logits = torch.where(count > 0, total / count.clamp(min=1), logits)
            new["logits_sum"] = total
        return logits, embedding, {name: new[name] for name in state}


def _encoder(config: EADConfig) -> Any:
    module, name = encoder_class(config.encoder)
    kind = getattr(import_module(f"tactile_rt.models.encoders.{module}"), name)
    if config.encoder == "graph":
        from tactile_rt.models.encoders.graph import parse_graph

        graph = parse_graph(config.graph)
        read = graph.frame
        if (found := (read.channels, read.rows, read.columns)) != config.frame:
            sizes = (" x ".join(map(str, size)) for size in (found, config.frame))
            raise ConfigError(
                "the graph's {} has {} channels, rows and columns, the array's frames "
                "{}: change the graph".format(read.name, *sizes)
            )
        return kind(graph.scaled(config.width))
    if config.encoder.startswith("zhuang-"):
        channels, rows, columns = config.frame
        frame = (channels, rows, columns + int(_alone(config)))
        return kind(config.width, config.encoder.removeprefix("zhuang-"), frame)
    return kind(config.width, config.frame)


def _alone(config: EADConfig) -> bool:
    """Whether a single cell gets a silent one beside it: convolutions need a map."""
    return config.encoder.startswith("zhuang-") and config.frame[1:] == (1, 1)


def count_parameters(module: nn.Module) -> int:
    """The number of numbers in a module's parameters; buffers do not count."""
    return sum(parameter.numel() for parameter in module.parameters())
