"""Matrix products whose weights are stored as the runtime's kernels read them."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

__all__ = ["Columns", "Pointwise", "Product", "product_of"]


class Product(nn.Module):
    """x W + b of (..., input); W is stored as the kernels read it."""

    weight: Tensor
    bias: Tensor | None

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        super().__init__()
        self.register_buffer("weight", weight.detach().t().contiguous())
        self.register_buffer("bias", None if bias is None else bias.detach().clone())

    def forward(self, x: Tensor) -> Tensor:
        out = torch.matmul(x, self.weight)
        return out if self.bias is None else out + self.bias


class Columns(nn.Module):
    """W x + b of maps (lane, site, channel), the lanes as columns.

    For one lane this reads the weights at memory speed, as a row times W does not. The bias is
    added after the transposition: onnxruntime would merge it with the product into a slow `Gemm`.
    """

    weight: Tensor
    bias: Tensor

    def __init__(self, weight: Tensor, bias: Tensor) -> None:
        super().__init__()
        self.register_buffer("weight", weight.detach().clone())
        self.register_buffer("bias", bias.detach().clone())

    def forward(self, maps: Tensor) -> Tensor:
        columns = maps.permute(1, 2, 0).flatten(0, 1)
        return torch.matmul(self.weight, columns).t() + self.bias


class Pointwise(nn.Module):
    """W x + b of a few rows (..., row, input), of up to four axes, as a 1 x 1 convolution.

    The runtime's blocked convolution reads large weights faster for a few rows than its product
    does: one at 26 GB/s, not 22, of 28; two at 27, not 19, of 31; 24 in 12 % less time. It has to
    reorder them (the transpositions here become a part of that), so small weights are better off
    as a `Product`.
    """

    weight: Tensor
    bias: Tensor | None

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        super().__init__()
        self.register_buffer("weight", weight.detach()[:, :, None, None].clone())
        self.register_buffer("bias", None if bias is None else bias.detach().clone())

    def forward(self, x: Tensor) -> Tensor:
        missing = 4 - x.dim()  # lanes are not the batch, for each of which it would read anew
        out = F.conv2d(x[(None,) * missing].permute(0, 3, 1, 2), self.weight, self.bias)
        return out.permute(0, 2, 3, 1).flatten(0, missing)


def product_of(linear: nn.Linear) -> Product:
    """A linear layer as a product."""
    return Product(linear.weight, linear.bias)
