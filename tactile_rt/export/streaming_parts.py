"""Parts of a streaming step: products whose weights lie as the kernels read them, and the GPT.

The cache of a layer of the GPT is written by rows: what was attended before stays where it is.
Tokens are the rows of one matrix, (lane * token, width), or where that is faster (1, lane, token,
width).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.attenders import GPT, HEADS, TOKENS
from tactile_rt.models.attenders.gpt import TransformerBlock

__all__ = ["Columns", "Pointwise", "Product", "StreamingGPT"]

WIDE = 256  # features, from where on convolutions were the faster products


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


class StreamingGPT(nn.Module):
    """A `GPT` whose cache is one tensor per layer and kind, of which a step writes its own rows."""

    positions: Tensor

    def __init__(self, gpt: GPT, integer: bool = False) -> None:
        super().__init__()
        self.features, self.max_steps = gpt.features, gpt.max_steps
        self.head = gpt.features // HEADS
        with torch.no_grad():
            tokens = TOKENS * gpt.max_steps
            positions = gpt.positions[:tokens].unflatten(0, (-1, TOKENS)).clone()
            positions[:, 0] += gpt.project_in.bias
            positions[:, 1] += gpt.project_in(gpt.action)
        self.register_buffer("positions", positions.flatten(1))
        self.project_in = Product(gpt.project_in.weight, None)
        self.project_out = Product(gpt.project_out.weight, gpt.project_out.bias)
        self.norm = gpt.norm
        convolve = not integer and gpt.features >= WIDE
        self.layout = (1, -1, TOKENS, gpt.features) if convolve else (-1, gpt.features)
        self.blocks = nn.ModuleList(StreamingBlock(block, self.layout) for block in gpt.blocks)

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Zeros: keys and values of each layer, (batch, head, step * token, width / head)."""
        zeros = self.norm.weight.new_zeros
        shape = (batch, HEADS, TOKENS * self.max_steps, self.head)
        names = [f"gpt_{kind}{layer}" for layer in range(len(self.blocks)) for kind in "kv"]
        return {name: zeros(shape) for name in names}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """One step, as `GPT.step`."""
        index = index.clamp(max=self.max_steps - 1)
        query = TOKENS * index[:, None, None] + torch.arange(TOKENS)
        # The observation sees the pairs before and itself, the action token its own pair too.
        token = torch.arange(TOKENS * self.max_steps)
        unseen = torch.where(token <= query[..., None], 0.0, -torch.inf)
        lane = torch.arange(index.shape[0])[:, None, None]
        head = torch.arange(HEADS)[:, None]
        here = Rows(*torch.broadcast_tensors(lane, head, query), unseen=unseen)  # type: ignore[misc]
        pair = F.pad(self.project_in(features), (0, self.features))
        x = (pair + self.positions[index]).view(self.layout)
        new: dict[str, Tensor] = {}
        for layer, block in enumerate(self.blocks):
            names = (f"gpt_k{layer}", f"gpt_v{layer}")
            x, *cache = block(x, state[names[0]], state[names[1]], here)
            new |= dict(zip(names, cache, strict=True))
        last = x.view(-1, TOKENS, self.features)[:, TOKENS - 1]
        return self.project_out(self.norm(last)), new


@dataclass(frozen=True)
class Rows:
    """Where a step's tokens go in a cache: lane, head, row, each (lane, head, token).

    `unseen` is (lane, 1, token, row): 0 for what a token sees, else minus infinity.
    """

    lane: Tensor
    head: Tensor
    row: Tensor
    unseen: Tensor

    def write(self, cache: Tensor, values: Tensor) -> Tensor:
        """A cache (lane, head, row, number) with values (lane, head, token, number) in place."""
        return cache.index_put((self.lane, self.head, self.row), values)


class StreamingBlock(nn.Module):
    """One layer of `StreamingGPT`."""

    def __init__(self, block: nn.Module, layout: tuple[int, ...]) -> None:
        super().__init__()
        assert isinstance(block, TransformerBlock)
        self.norm1, self.norm2 = block.norm1, block.norm2
        width = block.proj.in_features
        self.head, self.layout = width // HEADS, layout
        # The attention's scale is in the queries' weights.
        scale = torch.ones(3 * width)
        scale[:width] = 1 / math.sqrt(self.head)
        qkv = block.qkv
        form = Product if len(layout) == 2 else Pointwise
        self.qkv = form(qkv.weight * scale[:, None], qkv.bias * scale)
        self.proj, self.mlp_in, self.mlp_out = (
            form(linear.weight, linear.bias) for linear in (block.proj, block.mlp_in, block.mlp_out)
        )

    def forward(
        self, x: Tensor, k_cache: Tensor, v_cache: Tensor, here: Rows
    ) -> tuple[Tensor, Tensor, Tensor]:
        qkv = self.qkv(self.norm1(x)).view(-1, TOKENS, 3 * HEADS, self.head).transpose(1, 2)
        q, k, v = qkv.chunk(3, dim=1)
        k_cache, v_cache = here.write(k_cache, k), here.write(v_cache, v)
        scores = torch.matmul(q, k_cache.transpose(-1, -2))
        weights = torch.softmax(scores + here.unseen, dim=-1)
        attended = torch.matmul(weights, v_cache).transpose(1, 2).reshape(self.layout)
        x = x + self.proj(attended)
        hidden = F.gelu(self.mlp_in(self.norm2(x)), approximate="tanh")
        return x + self.mlp_out(hidden), k_cache, v_cache
