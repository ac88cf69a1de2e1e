"""Trained network rewritten for streaming: the same logits, laid out for the runtime's kernels.

Maps are `(lane, site, channel)`, sites row by row, in the state and inside, so nothing is
transposed between steps; a convolution is one gather of every site's taps and one product, or two
where that is less arithmetic. The cache of a layer of the GPT is written by rows: earlier keys
and values stay in place. Tokens are the rows of one matrix, (lane * token, width), or where that is
faster (1, lane, token, width). Parts that cannot be rewritten stay as trained.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.attenders import GPT, HEADS, TOKENS
from tactile_rt.models.attenders.gpt import TransformerBlock
from tactile_rt.models.ead import EAD
from tactile_rt.models.encoders.cells import FORGET_BIAS, Cell, IntersectionCell, State
from tactile_rt.models.encoders.graph_encoder import GraphEncoder

LARGE = 2**18  # weights of a convolution from which on `Pointwise` was the faster form
WIDE = 256  # features from which on convolutions were the faster products


def streaming(network: EAD, integer: bool = False) -> EAD:
    """Return a copy of a network that is rewritten to run step by step.

    It has `step` and `initial_state`, but no `forward`; its state has other names and layouts.

    Args:
        network: as trained, in evaluation mode.
        integer: whether products will be quantised; convolutions then gather all taps at once.
    """
    out = copy.copy(network)
    out._modules = dict(network._modules)  # a shallow copy would share it
    encoder = network.encoder
    if isinstance(encoder, GraphEncoder):
        if all(_is_plain(encoder, node.name) for node in encoder.graph.nodes):
            out.encoder = StreamingGraph(encoder, integer)
    elif hasattr(encoder, "fold_weights"):
        out.encoder = encoder.fold_weights()
    if isinstance(network.attender, GPT):
        out._modules["attender"] = StreamingGPT(network.attender, integer)
    return out.eval()


def _is_plain(encoder: GraphEncoder, name: str) -> bool:
    """Return whether a node only concatenates and, if it is a map, reads only maps."""
    (node,) = [n for n in encoder.graph.nodes if n.name == name]
    fused = any(e.fusion != "concatenate" for e in node.reads)
    vectors = any(encoder.sizes[e.source] == (1, 1) for e in node.reads)
    return not fused and (node.kind == "dense" or not vectors)


class Taps(nn.Module):
    """2 x 2 convolution of maps, (lane, site, channel), concatenated along channels.

    Args:
        weight: (output, 2, 2, input).
        valid: whether to omit the padding that makes the output as large as the input.
        whole: whether to gather all four taps at once; else the lower two are a second product,
            which omits the last row of sites: only padding is below it.
    """

    taps: Tensor

    def __init__(
        self, weight: Tensor, bias: Tensor | None, size: tuple[int, int], valid: bool, whole: bool
    ) -> None:
        super().__init__()
        rows, columns = size
        self.columns, self.sites = columns, rows * columns
        self.padded = not valid
        site = torch.full((rows + 1, columns + 1), self.sites)  # the last site is always zero
        site[:-1, :-1] = torch.arange(self.sites).view(size)
        if valid:
            site = site[:-1, :-1]
        taps = torch.stack([site[:-1, :-1], site[:-1, 1:], site[1:, :-1], site[1:, 1:]], -1)
        taps = taps.flatten(0, 1)
        self.product: Pointwise | Product
        self.lower: Pointwise | Product | None = None
        if whole or valid:
            self.product = Product(weight.flatten(1), bias)
        else:
            taps = taps[:, :2]
            upper, lower = weight.flatten(2).unbind(1)
            form = Pointwise if upper.numel() >= LARGE else Product
            self.product = form(upper, bias)
            self.lower = form(lower, None) if rows > 1 else None
        self.outputs = len(taps)
        self.register_buffer("taps", taps.flatten())

    def forward(self, *maps: Tensor) -> Tensor:
        x = torch.cat(maps, dim=-1) if len(maps) > 1 else maps[0]
        if self.padded:
            x = F.pad(x, (0, 0, 0, 1))
        x = x.index_select(1, self.taps).unflatten(1, (self.outputs, -1)).flatten(2)
        out: Tensor = self.product(x)
        if self.lower is not None:
            out = out + F.pad(self.lower(x[:, self.columns :]), (0, 0, 0, self.columns))
        return out


class StreamingIntersection(Cell):
    """Streaming form of an `IntersectionCell`; its norms have scale, offset and forget bias."""

    gates, norms = 0, 0

    def __init__(self, cell: IntersectionCell, conv: Taps) -> None:
        super().__init__(cell.channels, layer_norm=False)
        assert cell.gamma is not None and cell.beta is not None
        self.conv = conv  # type: ignore[assignment]
        self.normed = nn.ModuleList()
        for gate in range(cell.norms):
            norm = nn.LayerNorm(cell.channels, cell.epsilon)
            forget = FORGET_BIAS if gate >= 2 else 0.0  # of p and y
            norm.weight, norm.bias = (
                nn.Parameter(part[gate].detach().clone())
                for part in (cell.gamma, cell.beta + forget)
            )
            self.normed.append(norm)

    def forward(self, x: Tensor, state: State, drive: Tensor | None = None) -> tuple[Tensor, State]:
        (s,) = state
        gates = self.conv(x, s).chunk(4, dim=-1)
        m, n, p, y = (norm(gate) for norm, gate in zip(self.normed, gates, strict=True))
        m, n, p, y = torch.tanh(m), torch.relu(n), torch.sigmoid(p), torch.sigmoid(y)
        return n + y * (x - n), (m + p * (s - m),)


class StreamingGraph(nn.Module):
    """Streaming form of a `GraphEncoder` whose nodes only concatenate; see `streaming`."""

    def __init__(self, encoder: GraphEncoder, integer: bool) -> None:
        super().__init__()
        self.graph, self.sizes, self.lag = encoder.graph, encoder.sizes, encoder.lag
        self.features = encoder.features
        self.keys = {node.name: encoder.keys(node) for node in self.graph.nodes}
        self.drives, self.cells = nn.ModuleDict(), nn.ModuleDict()
        self.integer = integer
        for node in self.graph.nodes:
            if node.kind == "dense":
                linear = encoder.dense[node.name]
                assert isinstance(linear, nn.Linear)
                maps = all(self.sizes[e.source] != (1, 1) for e in node.reads)
                kind: type[Columns | Pointwise | Product] = Product
                if not integer and linear.weight.numel() >= 4 * LARGE:
                    kind = Pointwise  # one row gains less than several
                elif maps and not integer:
                    kind = Columns
                self.drives[node.name] = kind(linear.weight, linear.bias)
            else:
                conv: Any = encoder.convs[node.name]
                size = self.sizes[node.reads[0].source]
                valid = node.kind == "valid"
                self.drives[node.name] = Taps(conv.weight, conv.bias, size, valid, integer)
            if node.cell != "none":
                self.cells[node.name] = self._make_cell(encoder.cells[node.name], node.name)

    def _make_cell(self, cell: nn.Module, name: str) -> Cell:
        assert isinstance(cell, Cell)
        if isinstance(cell, IntersectionCell) and cell.gamma is not None:
            weights = cell.conv.weight, cell.conv.bias
            taps = Taps(*weights, self.sizes[name], valid=False, whole=self.integer)
            return StreamingIntersection(cell, taps)
        out = copy.copy(cell)
        out._modules = dict(cell._modules)
        for part, conv in cell._modules.items():
            assert conv is not None
            weight, bias = conv.weight, conv.bias
            out._modules[part] = Taps(weight, bias, self.sizes[name], False, self.integer)  # type: ignore[arg-type]
        return out

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return a state of zeros: each node's cell state and, if read, output ``NAME_h``."""
        zeros = next(self.buffers()).new_zeros
        state = {}
        for node in self.graph.nodes:
            rows, columns = self.sizes[node.name]
            sites = () if node.kind == "dense" else (rows * columns,)
            for key in self.keys[node.name]:
                state[key] = zeros((batch, *sites, node.channels), dtype=torch.float32)
        return state

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Run one step on a frame (batch, channel, row, column); return features, new state."""
        now = frame.flatten(2).transpose(1, 2)
        new: dict[str, Tensor] = {}
        for node in self.graph.nodes:
            sources = [e.source for e in node.reads]
            read = [now if s == self.graph.frame.name else state[f"{s}_h"] for s in sources]
            drive = self.drives[node.name]
            x = self._apply_dense(drive, read) if node.kind == "dense" else drive(*read)
            if node.name in self.cells:
                cell = self.cells[node.name]
                assert isinstance(cell, Cell)
                names = [f"{node.name}_{kind}" for kind in cell.states]
                x, memory = cell(x, tuple(state[name] for name in names))
                new |= dict(zip(names, memory, strict=True))
            new[f"{node.name}_h"] = F.relu(x)
        kept = (key for node in self.graph.nodes for key in self.keys[node.name])
        return new[f"{self.graph.readout}_h"], {key: new[key] for key in kept}

    def _apply_dense(self, drive: nn.Module, read: Sequence[Tensor]) -> Tensor:
        """Apply a dense node to its concatenated sources: maps site by site, then vectors."""
        maps, vectors = [m for m in read if m.dim() == 3], [m for m in read if m.dim() == 2]
        if not vectors:
            joined = torch.cat(maps, -1)
            out: Tensor = drive(joined if isinstance(drive, Columns) else joined.flatten(1))
            return out
        x = torch.cat([torch.cat(maps, -1).flatten(1), *vectors] if maps else vectors, -1)
        out = drive(x)
        return out


class Product(nn.Module):
    """Linear layer on (..., input), with weights stored as the kernels read them."""

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
    """Linear layer on maps, (lane, site, channel), with the lanes as columns.

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
    """Linear layer on a few rows, computed as a 1 x 1 convolution.

    Rows are (..., row, input), of up to four axes. For a few rows the runtime's blocked
    convolution reads large weights faster than its product does: for one row at 26 GB/s, not 22,
    of 28; for two at 27, not 19, of 31; for 24 in 12 % less time. It has to reorder the rows (by
    the transpositions here, too), so a `Product` is better for small weights.
    """

    weight: Tensor
    bias: Tensor | None

    def __init__(self, weight: Tensor, bias: Tensor | None) -> None:
        super().__init__()
        self.register_buffer("weight", weight.detach()[:, :, None, None].clone())
        self.register_buffer("bias", None if bias is None else bias.detach().clone())

    def forward(self, x: Tensor) -> Tensor:
        missing = 4 - x.dim()  # a batch of lanes would read the weights once per lane
        out = F.conv2d(x[(None,) * missing].permute(0, 3, 1, 2), self.weight, self.bias)
        return out.permute(0, 2, 3, 1).flatten(0, missing)


class StreamingGPT(nn.Module):
    """Streaming form of a `GPT`, with key and value caches; steps write their own rows."""

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
        """Return zeros: each layer's keys and values, (batch, head, step * token, width / head)."""
        zeros = self.norm.weight.new_zeros
        shape = (batch, HEADS, TOKENS * self.max_steps, self.head)
        names = [f"gpt_{kind}{layer}" for layer in range(len(self.blocks)) for kind in "kv"]
        return {name: zeros(shape) for name in names}

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Run one step, as `GPT.step` does."""
        index = index.clamp(max=self.max_steps - 1)
        query = TOKENS * index[:, None, None] + torch.arange(TOKENS)
        # The observation attends to earlier pairs and itself, the action token to its pair too.
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
    """Indices of a step's tokens in a cache: lane, head, row, each (lane, head, token).

    `unseen` is the attention mask, (lane, 1, token, row): 0 to attend, else minus infinity.
    """

    lane: Tensor
    head: Tensor
    row: Tensor
    unseen: Tensor

    def write(self, cache: Tensor, values: Tensor) -> Tensor:
        """Copy a cache (lane, head, row, feature), with `values` written at the tokens' rows."""
        return cache.index_put((self.lane, self.head, self.row), values)


class StreamingBlock(nn.Module):
    """Transformer block of `StreamingGPT`."""

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
