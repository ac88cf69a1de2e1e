"""ResNet18 on the array's grid: the feed-forward control (He et al. 2016), on each frame alone.

On a 5 x 7 grid the maps shrink to 3 x 4, 2 x 2 and then 1 x 1, where most of a 3 x 3 kernel lies
on padding: of 11,523,840 parameters only 1,914,624 can ever affect the output. Every convolution
is therefore one product with a matrix of only those taps that lie inside the map. Maps are
`(frame, site * channel)`, sites row by row.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.ead_config import MOUSE_FRAME

STAGES = (64, 128, 256, 512)  # channels at width 1
FEATURES = 512

Shape = tuple[int, int]


def output_shape(shape: Shape, kernel: int, stride: int) -> Shape:
    """Return a convolution's output rows and columns, with padding of half the kernel size."""
    rows, columns = ((n + 2 * (kernel // 2) - kernel) // stride + 1 for n in shape)
    return rows, columns


def site_taps(shape: Shape, kernel: int, stride: int) -> Tensor:
    """Return the tap index (site out, site in) that connects two sites; kernel**2: none."""

    def along(size_in: int, size_out: int) -> Tensor:
        centre = stride * torch.arange(size_out)[:, None]
        return torch.arange(size_in)[None, :] - centre + kernel // 2

    out = output_shape(shape, kernel, stride)
    row = along(shape[0], out[0])[:, None, :, None]
    column = along(shape[1], out[1])[None, :, None, :]
    inside = (row >= 0) & (row < kernel) & (column >= 0) & (column < kernel)
    taps = torch.where(inside, kernel * row + column, kernel**2)
    return taps.reshape(out[0] * out[1], shape[0] * shape[1])


class ConvNorm(nn.Module):
    """Convolution without bias, then batch norm.

    Args:
        kernel, stride: the same along rows and columns; padding is kernel // 2.
    """

    taps: Tensor

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, shape: Shape) -> None:
        super().__init__()
        self.shape = output_shape(shape, kernel, stride)
        self.weight = nn.Parameter(torch.empty(outputs, inputs, kernel, kernel))
        self.norm = nn.BatchNorm1d(outputs)
        self.register_buffer("taps", site_taps(shape, kernel, stride), persistent=False)
        nn.init.kaiming_normal_(self.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> Tensor:
        """Map x (frame, site in * inputs) to (frame, site out * outputs)."""
        y = F.linear(x, self.matrix())  # (frame, site out * outputs)
        y = self.norm(y.view(-1, len(self.weight)))  # statistics over frames and sites
        out: Tensor = y.view(len(x), -1)
        return out

    def matrix(self) -> Tensor:
        """Return the convolution as a matrix (site out * outputs, site in * inputs)."""
        taps = F.pad(self.weight.flatten(2).permute(2, 0, 1), (0, 0, 0, 0, 0, 1))
        matrix = taps[self.taps]  # (site out, site in, output, input)
        return matrix.transpose(1, 2).flatten(2).flatten(0, 1)

    def fold_norm(self) -> tuple[Tensor, Tensor]:
        """Return one matrix and bias that equal the convolution and the trained batch norm."""
        norm = self.norm
        assert norm.running_var is not None and norm.running_mean is not None
        gain = norm.weight / torch.sqrt(norm.running_var + norm.eps)
        bias = norm.bias - gain * norm.running_mean
        sites = len(self.taps)
        return self.matrix() * gain.repeat(sites)[:, None], bias.repeat(sites)


class ResidualBlock(nn.Module):
    """Residual block relu(x + norm(conv(relu(norm(conv(x)))))); x is projected to a new shape."""

    def __init__(self, inputs: int, outputs: int, stride: int, shape: Shape) -> None:
        super().__init__()
        self.first = ConvNorm(inputs, outputs, 3, stride, shape)
        self.shape = self.first.shape
        self.second = ConvNorm(outputs, outputs, 3, 1, self.shape)
        same = inputs == outputs and stride == 1
        self.shortcut = None if same else ConvNorm(inputs, outputs, 1, stride, shape)

    def forward(self, x: Tensor) -> Tensor:
        """Map x (frame, site in * inputs) to (frame, site out * outputs)."""
        short = x if self.shortcut is None else self.shortcut(x)
        out: Tensor = F.relu(short + self.second(F.relu(self.first(x))))
        return out


class _FrameEncoder(nn.Module):
    """Base class of encoders without memory, which map each frame by `_encode`."""

    def forward(self, frames: Tensor) -> Tensor:
        """Map frames (batch, step, channel, row, column) to features (batch, step, feature)."""
        features: Tensor = self._encode(frames.flatten(0, 1)).unflatten(0, frames.shape[:2])
        return features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        return {}

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map a frame (batch, channel, row, column) to (batch, feature), and an empty state."""
        return self._encode(frame), {}

    def _encode(self, frames: Tensor) -> Tensor:
        """Map frames (frame, channel, row, column) to features (frame, feature)."""
        raise NotImplementedError


class ResNet18Encoder(_FrameEncoder):
    """Encoder by a ResNet18 on each frame alone, to 512 * width features per step."""

    lag = 0

    def __init__(self, width: float = 1.0, frame: tuple[int, int, int] = MOUSE_FRAME) -> None:
        super().__init__()
        channels = [round(stage * width) for stage in STAGES]
        self.features = round(FEATURES * width)
        self.stem = ConvNorm(frame[0], channels[0], 7, 2, frame[1:])
        shape = output_shape(self.stem.shape, 3, 2)  # after `maximum`
        inputs, blocks = channels[0], []
        for i, outputs in enumerate(channels):
            for stride in (1 if i == 0 else 2, 1):
                blocks.append(ResidualBlock(inputs, outputs, stride, shape))
                inputs, shape = outputs, blocks[-1].shape
        if shape != (1, 1):  # beyond 32 rows or columns, where an average would be due
            raise ConfigError(f"resnet18 takes grids up to 32 x 32, not {frame[1]} x {frame[2]}")
        self.blocks = nn.ModuleList(blocks)
        self.fc = nn.Linear(inputs, self.features)

    def fold_weights(self) -> "FoldedResNet18":
        """Return the encoder for inference: batch norm folded into matrices of the used taps."""
        return FoldedResNet18(self)

    def _encode(self, frames: Tensor) -> Tensor:
        x = maximum(F.relu(self.stem(sites_first(frames))), self.stem.shape)  # (frame, site * c)
        for block in self.blocks:
            x = block(x)
        features: Tensor = self.fc(x)
        return features


class FoldedResNet18(_FrameEncoder):
    """A trained `ResNet18Encoder` as matrix products: 2 M weights at width 1, not 11.5 M."""

    lag = 0

    def __init__(self, encoder: ResNet18Encoder) -> None:
        super().__init__()
        self.features, self.shape = encoder.features, encoder.stem.shape
        self.layers = nn.ModuleDict()
        self._add_layer("stem", encoder.stem)
        self.count = len(encoder.blocks)
        for i, block in enumerate(encoder.blocks):
            assert isinstance(block, ResidualBlock)
            self._add_layer(f"{i}_first", block.first)
            self._add_layer(f"{i}_second", block.second)
            if block.shortcut is not None:
                self._add_layer(f"{i}_shortcut", block.shortcut)
        self.layers["fc"] = _make_linear(encoder.fc.weight, encoder.fc.bias)

    def _encode(self, frames: Tensor) -> Tensor:
        layers = self.layers
        x = maximum(F.relu(layers["stem"](sites_first(frames))), self.shape)
        for i in range(self.count):
            short = layers[f"{i}_shortcut"](x) if f"{i}_shortcut" in layers else x
            x = F.relu(short + layers[f"{i}_second"](F.relu(layers[f"{i}_first"](x))))
        features: Tensor = layers["fc"](x)
        return features

    def _add_layer(self, name: str, layer: ConvNorm) -> None:
        self.layers[name] = _make_linear(*layer.fold_norm())


def sites_first(frames: Tensor) -> Tensor:
    """Permute and flatten frames (frame, channel, row, column) to (frame, site * channel)."""
    return frames.flatten(2).transpose(1, 2).flatten(1)


def maximum(x: Tensor, shape: Shape) -> Tensor:
    """Max-pool (frame, site * channel) over 3 x 3 sites, stride 2, padding 1."""
    x = x.unflatten(1, (*shape, -1))  # not by len(x), which an export would fix
    for axis in (1, 2):
        size = x.shape[axis]
        ranges = [(max(c - 1, 0), min(c + 2, size)) for c in range(0, size, 2)]
        x = torch.stack([x.narrow(axis, a, b - a).amax(axis) for a, b in ranges], axis)
    return x.flatten(1)


def _make_linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    layer = nn.Linear(weight.shape[1], weight.shape[0], device="meta")
    layer.weight = nn.Parameter(weight.detach().clone(), requires_grad=False)
    layer.bias = nn.Parameter(bias.detach().clone(), requires_grad=False)
    return layer
