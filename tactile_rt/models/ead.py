"""Encoder-attender-decoder networks that classify, at every step, the object an array touches.

    samples -> input stage -> frames -> encoder -> attender -> decoder -> logits
    (batch, step, channel, row, column) -> (batch, step, feature) -> (batch, step, class)

The channels are those of all sub-steps of a step, rows and columns the array's grid: 5 sub-steps
x 6 loads on 5 x 7 cells for the mouse's whiskers of the paper.

The input stage is part of the graph, so that an exported network takes SI units. Most whiskers
measure micronewtons, a jammed one newtons, so values are compressed as sign(v) log(1 + |v| / s).
The scale s never falls below the noise measured at rest, or the logarithm would magnify silent
channels into signals. A recurrent network would never forget a NaN, so a sample that is NaN or
infinite counts as zero load, as does a channel with such a baseline or noise, in exported files
too. The paper's own preprocessing ("paper") has no logarithm: forces in mN and moments in
uN m, each limited to a magnitude of 1000 (Chung et al. 2025, and its code).

`EAD.forward` takes a whole window for training; `EAD.step` takes one frame and explicit state,
for streaming, and gives the same logits. The logits of a step use no later frame.
"""

from collections.abc import Sequence
from importlib import import_module
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.stream import ArraySpec, Timing
from tactile_rt.core.stream.sensor_spec import ChannelLimits
from tactile_rt.models import attenders, decoders
from tactile_rt.models.ead_config import EADConfig, encoder_class
from tactile_rt.models.encoders.cells import Cell

__all__ = ["EAD", "EADConfig", "InputStage", "TactileClassifier", "count_parameters", "paper_units"]

PAPER_UNITS = {"N": 1e-3, "N m": 1e-6}  # mN and uN m
PAPER_CLIP = 1000.0  # of these units
NOISE_FLOOR = 3.0  # standard deviations of the noise that count as silence
GPT_OF_RESNET = 256  # the paper's GPT is narrower than its features there, and only there


class TactileClassifier(nn.Module):
    """Classifier of samples in SI units: the input stage and the network in one module.

    Args:
        limits: clip and scale of each channel, SI; not used by the preprocessing "paper".

    Raises:
        ConfigError: the network is for another array, or its preprocessing for other units.
    """

    def __init__(self, spec: ArraySpec, network: EADConfig, limits: ChannelLimits) -> None:
        super().__init__()
        if network.preprocessing == "paper":
            clip, scale = paper_units(spec)
        else:
            clip, scale = limits.clip.tolist(), limits.scale.tolist()
        self.inputs = InputStage(spec.grid, spec.grid_shape, clip, scale, network.preprocessing)
        channels, *grid = network.frame
        if tuple(grid) != tuple(spec.grid_shape) or channels % len(spec.channels):
            found = " x ".join(map(str, network.frame))
            rows, columns = spec.grid_shape
            raise ConfigError(
                f"a network for frames of {found} (channels x rows x columns) does not fit an "
                f"array of {len(spec.channels)} channels on {rows} x {columns} cells"
            )
        self.network = EAD(network)

    @property
    def timing(self) -> Timing:
        """Numbers of steps and sub-steps in an input window."""
        config = self.network.config
        return Timing(config.max_steps, config.frame[0] // len(self.inputs.clip))

    def forward(self, samples: Tensor, offset: Tensor, sigma: Tensor) -> Tensor:
        """Map samples (batch, step, sub-step, element, channel) to logits (batch, step, class)."""
        logits: Tensor = self.network(self.inputs(samples, offset, sigma))
        return logits

    def features(self, frames: Tensor) -> Tensor:
        """Map frames (batch, step, channel, row, column) to features (batch, step, feature)."""
        return self.network.features(frames)


class InputStage(nn.Module):
    """Input layer that maps samples in SI units to frames on the array's grid.

    Args:
        positions: grid (row, column) of each element, in the order of the samples.
        shape: rows and columns of the grid; cells without an element are zero.
        clip: (channel,) largest magnitude, SI; larger loads are clipped to it.
        scale: (channel,) smallest scale s of the logarithm, SI; without a logarithm, the unit that
            loads are divided by.
        preprocessing: one of `ead_config.PREPROCESSINGS`.

    Raises:
        ConfigError: clip and scale of unlike lengths or not positive, two elements in one place,
            or one outside the grid.
    """

    clip: Tensor
    scale: Tensor
    element: Tensor

    def __init__(
        self,
        positions: Sequence[tuple[int, int]],
        shape: tuple[int, int],
        clip: Sequence[float],
        scale: Sequence[float],
        preprocessing: str = "log",
    ) -> None:
        super().__init__()
        self.logarithm = preprocessing == "log"
        rows, columns = shape
        if len(clip) != len(scale):
            raise ConfigError(f"{len(clip)} clip limits, but {len(scale)} scales")
        if not all(value > 0 for value in (*clip, *scale)):
            raise ConfigError("clip limits and scales must be positive")
        if len(set(positions)) != len(positions):
            raise ConfigError("two elements share a grid position")
        # An extra, always silent element fills the cells that have none.
        element = torch.full((rows, columns), len(positions))
        for i, (row, column) in enumerate(positions):
            if not (0 <= row < rows and 0 <= column < columns):
                raise ConfigError(
                    f"position {(row, column)} is outside the {rows} x {columns} grid"
                )
            element[row, column] = i
        self.shape = (rows, columns)
        self.elements = len(positions)
        self.register_buffer("clip", torch.tensor(clip, dtype=torch.float32))
        self.register_buffer("scale", torch.tensor(scale, dtype=torch.float32))
        self.register_buffer("element", element.flatten())

    def forward(self, samples: Tensor, offset: Tensor, sigma: Tensor) -> Tensor:
        """Map samples to frames, whose channels are those of the first sub-step, then the second.

        samples         (batch, ..., sub-step, element, channel)  SI
        offset, sigma   (batch, element, channel)                 SI: mean and noise at rest
        ->              (batch, ..., sub-step * channel, row, column)

        Raises:
            ValueError: samples of another number of elements or channels.
        """
        if samples.shape[-2:] != (self.elements, len(self.clip)):
            found = " x ".join(map(str, samples.shape[-2:]))
            raise ValueError(
                f"samples are {found} (element x channel), not {self.elements} x {len(self.clip)}"
            )
        for _ in range(samples.dim() - offset.dim()):
            offset, sigma = offset.unsqueeze(1), sigma.unsqueeze(1)
        load = samples - offset  # as samples, SI
        load = torch.where(load.abs() < torch.inf, load, 0.0)  # False for NaN too
        value = torch.clamp(load, -self.clip, self.clip)  # as samples, SI
        scale = torch.sqrt(self.scale**2 + (NOISE_FLOOR * sigma) ** 2)  # as offset, SI
        scale = torch.where(scale < torch.inf, scale, torch.inf)  # NaN too: any load over it is 0
        if self.logarithm:
            value = torch.sign(value) * torch.log1p(value.abs() / scale)  # as samples, no unit
        else:
            value = value / self.scale
        cells = F.pad(value, (0, 0, 0, 1)).index_select(-2, self.element)
        # (batch, ..., sub-step, cell, channel) -> (batch, ..., sub-step * channel, row, column)
        frames: Tensor = cells.transpose(-2, -1).flatten(-3, -2).unflatten(-1, self.shape)
        return frames


def paper_units(spec: ArraySpec) -> tuple[list[float], list[float]]:
    """Return the clip and the unit (channel,), SI, of the preprocessing "paper".

    Raises:
        ConfigError: a channel that is neither a force nor a moment.
    """
    if unknown := sorted(set(spec.units) - set(PAPER_UNITS)):
        raise ConfigError(
            f"preprocessing paper needs forces and moments only: this array has "
            f"{name_some(unknown)}; take log"
        )
    units = [PAPER_UNITS[unit] for unit in spec.units]
    return [PAPER_CLIP * unit for unit in units], units


class EAD(nn.Module):
    """Encoder-attender-decoder network, built from an `EADConfig`, from frames to logits.

    Attributes:
        feature_size: The number of features in a step, the decoder's input.
        lag: The delay in steps from a frame to the logits: the first `lag` logits of a window
            depend on no frame, and its last `lag` frames have no effect.
    """

    def __init__(self, config: EADConfig) -> None:
        super().__init__()
        self.config = config
        self.encoder: Any = _build_encoder(config)
        if config.norm_epsilon:
            for cell in self.encoder.modules():
                if isinstance(cell, Cell):
                    cell.epsilon = config.norm_epsilon
        self._needs_silent_cell = _needs_silent_cell(config)
        self.lag: int = self.encoder.lag
        width: int = self.encoder.features
        self.attender: attenders.GPT | attenders.MambaStack | attenders.NoAttender
        if config.attender == "gpt":
            inputs = width
            if config.encoder == "resnet18":
                width = round(GPT_OF_RESNET * config.width)
            self.attender = attenders.GPT(width, config.dropout, config.max_steps, inputs)
        elif config.attender == "mamba":
            self.attender = attenders.MambaStack(width)
        else:
            self.attender = attenders.NoAttender()
        self.feature_size = width
        kind = decoders.KINDS[config.decoder]
        self.decoder = kind(width, config.outputs, config.width, config.max_steps)

    def features(self, frames: Tensor) -> Tensor:
        """Map frames to the decoder's input, features (batch, step, feature)."""
        frames = F.pad(frames, (0, 1)) if self._needs_silent_cell else frames
        features: Tensor = self.attender(self.encoder(frames))
        return features

    def embed(self, frames: Tensor) -> Tensor:
        """Map frames to embeddings (batch, step, unit), the same as `step_outputs` returns."""
        if self.config.identity:
            return self.split(self.answer(frames))["embedding"]
        return self.decoder.embed(self.features(frames))

    def forward(self, frames: Tensor) -> Tensor:
        """Map frames (batch, step, channel, row, column) to logits (batch, step, class)."""
        return self.answer(frames)[..., : self.config.classes]

    def split(self, answers: Tensor) -> dict[str, Tensor]:
        """Split outputs (..., output) into logits and, if any, names and a unit-norm embedding."""
        classes, names = self.config.classes, self.config.classes + self.config.names
        out = {"logits": answers[..., :classes]}
        if self.config.identity:
            out["embedding"] = F.normalize(answers[..., names:], dim=-1)
        if self.config.names:
            out["names"] = answers[..., classes:names]
        return out

    def answer(self, frames: Tensor) -> Tensor:
        """Map frames to all outputs (batch, step, output); running means with readout "mean"."""
        logits: Tensor = self.decoder(self.features(frames))
        if self.config.readout == "last":
            return logits
        # At least single precision: sums of many steps would stall in autocast's types.
        exact = torch.promote_types(logits.dtype, torch.float32)
        total = logits[:, self.lag :].cumsum(dim=1, dtype=exact)  # (batch, step - lag, class)
        counts = torch.arange(1, total.shape[1] + 1, device=total.device)  # (step - lag,)
        return torch.cat([logits[:, : self.lag], total / counts[:, None]], dim=1)

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return the state before the first step: named zero tensors (batch, ...), in order."""
        weight = next(self.parameters())
        state = {
            "index": torch.zeros(batch, dtype=torch.int64, device=weight.device),
            **self.encoder.initial_state(batch),
            **self.attender.initial_state(batch),
            **self.decoder.initial_state(batch),
        }
        if self.config.readout == "mean":
            state["logits_sum"] = weight.new_zeros(batch, self.config.outputs)
        return state

    def step(self, frame: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """Map a frame (batch, channel, row, column) to logits (batch, class) and the next state.

        To reset one stream of the batch, set its rows of the state to those of `initial_state`.
        """
        outputs, new = self.step_outputs(frame, state)
        return outputs["logits"], new

    def step_outputs(
        self, frame: Tensor, state: dict[str, Tensor]
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Map a frame to `logits`, `embedding` and, if configured, `names`, and the next state.

        The embedding (batch, unit) is the last layer's input in this step alone, even if the
        logits are a mean over steps; an embedding trained on identity is averaged as well.
        """
        index = state["index"]
        frame = F.pad(frame, (0, 1)) if self._needs_silent_cell else frame
        features, encoder = self.encoder.step(frame, index, state)  # (batch, feature)
        features, attender = self.attender.step(features, index, state)
        embedding, decoder = self.decoder.step(features, index, state)  # (batch, unit)
        logits = self.decoder.logits(embedding)  # (batch, output)
        new = {"index": index + 1, **encoder, **attender, **decoder}
        if self.config.readout == "mean":
            count = index[:, None] - self.lag + 1  # steps in the mean; none before the lag is over
            total = state["logits_sum"] + torch.where(count > 0, logits, 0.0)
            logits = torch.where(count > 0, total / count.clamp(min=1), logits)
            new["logits_sum"] = total
        outputs = self.split(logits)
        outputs.setdefault("embedding", embedding)
        return outputs, {name: new[name] for name in state}


def _build_encoder(config: EADConfig) -> Any:
    module, name = encoder_class(config.encoder)
    kind = getattr(import_module(f"tactile_rt.models.encoders.{module}"), name)
    if config.encoder == "graph":
        return kind(config.graph, config.width, config.frame)
    if config.encoder.startswith("zhuang-"):
        channels, rows, columns = config.frame
        frame = (channels, rows, columns + int(_needs_silent_cell(config)))
        return kind(config.width, config.encoder.removeprefix("zhuang-"), frame)
    return kind(config.width, config.frame)


def _needs_silent_cell(config: EADConfig) -> bool:
    """Return whether a one-cell grid must be padded by a zero cell for the convolutions."""
    return config.encoder.startswith("zhuang-") and config.frame[1:] == (1, 1)


def count_parameters(module: nn.Module) -> int:
    """Return the number of scalar parameters in a module, without buffers."""
    return sum(parameter.numel() for parameter in module.parameters())
