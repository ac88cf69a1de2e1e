"""Matrix products whose weights are stored as the runtime's kernels read them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

__all__ = ["Columns", "Product", "product_of"]


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


def product_of(linear: nn.Linear) -> Product:
    """A linear layer as a product."""
    return Product(linear.weight, linear.bias)
