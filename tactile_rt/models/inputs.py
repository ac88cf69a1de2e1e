"""From a sensor's samples to what the network sees, in the graph, so that units travel with it.

Most whiskers feel micronewtons while one that jams feels newtons, so values are compressed as
sign(v) log(1 + |v| / s). The scale s never falls below the noise measured at rest, or the
logarithm would magnify silent channels into signals.

A recurrent network would never forget a number that is none. So a sample that is NaN or infinite
counts as no load, and so does a channel whose baseline or noise is: also in a file that others run.

The paper's own preprocessing ("paper") has no logarithm: forces in mN and moments in uN m as they
are, limited to 1000 of either (Chung et al. 2025, and its code).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.core.errors import ConfigError, name_some
from tactile_rt.core.stream import ArraySpec

PAPER_UNITS = {"N": 1e-3, "N m": 1e-6}  # mN and uN m
PAPER_CLIP = 1000.0  # of these units
NOISE_FLOOR = 3.0  # standard deviations of the noise that count as silence


class InputStage(nn.Module):
    """Raw samples in SI units (N, N m) to network frames.

    Args:
        positions: grid (row, column) of each element, in the order of the samples.
        shape: rows and columns of the grid; cells without an element are zero.
        clip: per channel, the largest magnitude that is believed (channel,), SI.
        scale: per channel, the floor of the logarithm's scale (channel,), SI; without a logarithm,
            the unit.

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
        """Frames, sub-step-major: all channels of the first sub-step, then of the second, ...

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
        load = torch.where(load.abs() < torch.inf, load, 0.0)  # NaN is not less either
        value = torch.clamp(load, -self.clip, self.clip)  # as samples, SI
        scale = torch.sqrt(self.scale**2 + (NOISE_FLOOR * sigma) ** 2)  # as offset, SI
        scale = torch.where(scale < torch.inf, scale, torch.inf)  # of which any load is nothing
        if self.logarithm:
            value = torch.sign(value) * torch.log1p(value.abs() / scale)  # as samples, no unit
        else:
            value = value / self.scale
        cells = F.pad(value, (0, 0, 0, 1)).index_select(-2, self.element)
        # (batch, ..., sub-step, cell, channel) -> (batch, ..., sub-step * channel, row, column)
        frames: Tensor = cells.transpose(-2, -1).flatten(-3, -2).unflatten(-1, self.shape)
        return frames


def paper_units(spec: ArraySpec) -> tuple[list[float], list[float]]:
    """Clip and unit of each channel (channel,), SI, of the preprocessing "paper".

    Raises:
        ConfigError: a channel that is neither a force nor a moment.
    """
    if unknown := sorted(set(spec.units) - set(PAPER_UNITS)):
        raise ConfigError(
            f"preprocessing paper is of forces and moments: this array has {name_some(unknown)}; "
            "take log"
        )
    units = [PAPER_UNITS[unit] for unit in spec.units]
    return [PAPER_CLIP * unit for unit in units], units
