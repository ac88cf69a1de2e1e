"""2 x 2 convolutions on the array's grid, as matrix products.

Maps are `(row, column, lane, channel)`. With the sites first, the rows below a row are one block
of memory, so a kernel's lower taps are a product with a slice. That is faster than a convolution on
so small a map, can use integer matrix kernels, and multiplies nothing with the padding below.
An even kernel has no centre, so 'same' padding is on the right and the bottom only.
"""

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F


class Convolution(nn.Module):
    """2 x 2 'same' convolution of concatenated maps; initially Kaiming weights and zero bias."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(outputs, 2, 2, inputs))
        self.bias = nn.Parameter(torch.zeros(outputs))
        nn.init.kaiming_normal_(self.weight, nonlinearity="relu")

    def forward(self, *maps: Tensor) -> Tensor:
        """Concatenate maps on channels and convolve them, as the function `convolve` does."""
        return convolve(self.weight, self.bias, *maps)


def convolve(weight: Tensor, bias: Tensor | None, *maps: Tensor) -> Tensor:
    """Concatenate maps on channels and return their 2 x 2 'same' convolution.

    weight  (output, 2, 2, sum of channels)
    bias    (output,) or None
    maps    (row, column, lane, channel) each; a map of one lane is broadcast to all lanes
    ->      (row, column, lane, output)
    """
    if not torch.compiler.is_compiling():
        out: Tensor = _Convolve.apply(weight, bias, *maps)  # type: ignore[no-untyped-call]
        return out
    # For a graph that is traced or exported: every map has all lanes, and nothing is in place.
    x = torch.cat(maps, dim=-1)
    pairs = torch.cat([x, F.pad(x[:, 1:], (0, 0, 0, 0, 0, 1))], dim=-1)
    upper, lower = weight.flatten(2).unbind(1)
    below = F.linear(pairs[1:], lower)
    return F.linear(pairs, upper, bias) + F.pad(below, (0, 0, 0, 0, 0, 0, 0, 1))


def convolve_valid(weight: Tensor, bias: Tensor, x: Tensor) -> Tensor:
    """Convolve x unpadded. x (row + 1, column + 1, lane, channel) -> (row, column, lane, output)"""
    taps = [x[:-1, :-1], x[:-1, 1:], x[1:, :-1], x[1:, 1:]]
    return F.linear(torch.cat(taps, dim=-1), weight.flatten(1), bias)


class _Convolve(torch.autograd.Function):
    """`convolve` with an explicit gradient, without copies for padding or slices.

    Under autocast the products have autocast's type, parameter gradients the parameters' type.
    """

    @staticmethod
    def forward(ctx: Any, weight: Tensor, bias: Tensor | None, *maps: Tensor) -> Tensor:
        device, dtype, channels = weight.device.type, weight.dtype, weight.shape[3]
        if torch.is_autocast_enabled(device):
            dtype = torch.get_autocast_dtype(device)
        rows, columns = maps[0].shape[:2]
        lanes = max(m.shape[2] for m in maps)
        # The channels of each site, then those of its right neighbour.
        pairs = weight.new_empty(rows, columns, lanes, 2 * channels, dtype=dtype)
        pairs[:, -1, :, channels:] = 0
        start = 0
        for m in (m.to(dtype) for m in maps):
            stop = start + m.shape[3]
            pairs[..., start:stop] = m
            pairs[:, :-1, :, channels + start : channels + stop] = m[:, 1:]
            start = stop
        pairs = pairs.flatten(0, 2)
        row = columns * lanes  # tokens in a row of sites
        upper, lower = weight.to(dtype).flatten(2).unbind(1)
        with torch.autocast(device, enabled=False):
            out = F.linear(pairs, upper, None if bias is None else bias.to(dtype))
            out[:-row].addmm_(pairs[row:], lower.t())
        ctx.save_for_backward(pairs, upper, lower)
        ctx.shapes, ctx.row, ctx.dtype = [m.shape for m in maps], row, weight.dtype
        return out.view(rows, columns, lanes, -1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        pairs, upper, lower = ctx.saved_tensors
        rows, columns, lanes, outputs = grad.shape
        grad, row, channels = grad.reshape(-1, outputs), ctx.row, upper.shape[1] // 2
        weight = bias = None
        if ctx.needs_input_grad[0]:
            weight = grad.new_empty(outputs, 2, 2 * channels, dtype=ctx.dtype)
            weight[:, 0] = grad.t() @ pairs
            weight[:, 1] = grad[:-row].t() @ pairs[row:]
            weight = weight.view(outputs, 2, 2, channels)
        if ctx.needs_input_grad[1]:
            bias = grad.sum(0, dtype=ctx.dtype)
        if not any(ctx.needs_input_grad[2:]):
            return weight, bias, *(None for _ in ctx.shapes)
        to_pairs = grad @ upper
        to_pairs[row:].addmm_(grad[:-row], lower)
        to_pairs = to_pairs.view(rows, columns, lanes, -1)
        x = to_pairs[..., :channels]
        x[:, 1:] += to_pairs[:, :-1, :, channels:]
        maps = x.split([shape[3] for shape in ctx.shapes], dim=3)
        return (
            weight,
            bias,
            *(
                m if shape[2] == lanes else m.sum(2, keepdim=True)
                for m, shape in zip(maps, ctx.shapes, strict=True)
            ),
        )
