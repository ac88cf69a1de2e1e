"""A trained network rewritten for streaming: the same logits, laid out for the runtime's kernels.

Maps are `(lane, site, channel)`, sites row by row, in the state and inside, so nothing is
transposed between steps; a convolution is one gather of every site's taps and one product, or two
where that is less arithmetic. What cannot be rewritten is left as it was trained.
"""

import copy
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.export.streaming_parts import Columns, Pointwise, Product, StreamingGPT
from tactile_rt.models.attenders import GPT
from tactile_rt.models.ead import EAD
from tactile_rt.models.encoders.cells import FORGET_BIAS, Cell, IntersectionCell, State
from tactile_rt.models.encoders.graph_encoder import GraphEncoder

__all__ = ["StreamingGraph", "streaming"]

LARGE = 2**18  # numbers of a convolution's weights, from where on `Pointwise` was the faster form


def streaming(network: EAD, integer: bool = False) -> EAD:
    """The same network for the runtime: `step` and `initial_state`, not `forward`.

    Its state has other names and layouts than the trained network's.

    Args:
        network: as trained, in evaluation mode.
        integer: its products will be quantised: gather all taps of a convolution at once.
    """
    out = copy.copy(network)
    out._modules = dict(network._modules)  # a shallow copy would share it
    encoder = network.encoder
    if isinstance(encoder, GraphEncoder):
        if all(_plain(encoder, node.name) for node in encoder.graph.nodes):
            out.encoder = StreamingGraph(encoder, integer)
    elif hasattr(encoder, "deployed"):
        out.encoder = encoder.deployed()
    if isinstance(network.attender, GPT):
        out._modules["attender"] = StreamingGPT(network.attender, integer)
    return out.eval()


def _plain(encoder: GraphEncoder, name: str) -> bool:
    """Whether a node only concatenates, and reads maps if it is one."""
    (node,) = [n for n in encoder.graph.nodes if n.name == name]
    fused = any(e.fusion != "concatenate" for e in node.reads)
    vectors = any(encoder.sizes[e.source] == (1, 1) for e in node.reads)
    return not fused and (node.kind == "dense" or not vectors)


class Taps(nn.Module):
    """2 x 2 convolution of maps (lane, site, channel) that are concatenated on channels.

    Args:
        weight: (output, 2, 2, input).
        valid: without the padding that makes the output as large as the input.
        whole: gather all four taps; else add the lower two as a product of their own, of fewer
            sites or of none: what lies below the map needs no product.
    """

    taps: Tensor

    def __init__(
        self, weight: Tensor, bias: Tensor | None, size: tuple[int, int], valid: bool, whole: bool
    ) -> None:
        super().__init__()
        rows, columns = size
        self.columns, self.sites = columns, rows * columns
        self.padded = not valid
        site = torch.full((rows + 1, columns + 1), self.sites)  # the last one is silent
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
    """An `IntersectionCell` with layer norm, whose norms have scale, offset and forget bias."""

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
    """A `GraphEncoder` that only concatenates; see `streaming`."""

    def __init__(self, encoder: GraphEncoder, integer: bool) -> None:
        super().__init__()
        self.graph, self.sizes, self.lag = encoder.graph, encoder.sizes, encoder.lag
        self.features, self.heard = encoder.features, encoder.heard
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
                self.cells[node.name] = self._cell(encoder.cells[node.name], node.name)

    def _cell(self, cell: nn.Module, name: str) -> Cell:
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
        """Zeros: each node's cell state and, where a node hears it, its output, ``NAME_h``."""
        zeros = next(self.buffers()).new_zeros
        state = {}
        for node in self.graph.nodes:
            rows, columns = self.sizes[node.name]
            sites = () if node.kind == "dense" else (rows * columns,)
            for key in self._keys(node.name):
                state[key] = zeros((batch, *sites, node.channels), dtype=torch.float32)
        return state

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """One step. frame (batch, channel, row, column) -> features (batch, feature), new state."""
        now = frame.flatten(2).transpose(1, 2)
        new: dict[str, Tensor] = {}
        for node in self.graph.nodes:
            sources = [e.source for e in node.reads]
            read = [now if s == self.graph.frame.name else state[f"{s}_h"] for s in sources]
            drive = self.drives[node.name]
            x = self._dense(drive, read) if node.kind == "dense" else drive(*read)
            if node.name in self.cells:
                cell = self.cells[node.name]
                assert isinstance(cell, Cell)
                names = [f"{node.name}_{kind}" for kind in cell.states]
                x, memory = cell(x, tuple(state[name] for name in names))
                new |= dict(zip(names, memory, strict=True))
            new[f"{node.name}_h"] = F.relu(x)
        kept = (key for node in self.graph.nodes for key in self._keys(node.name))
        return new[f"{self.graph.readout}_h"], {key: new[key] for key in kept}

    def _dense(self, drive: nn.Module, read: Sequence[Tensor]) -> Tensor:
        """Of every site's channels, then those of vectors."""
        maps, vectors = [m for m in read if m.dim() == 3], [m for m in read if m.dim() == 2]
        if not vectors:
            joined = torch.cat(maps, -1)
            out: Tensor = drive(joined if isinstance(drive, Columns) else joined.flatten(1))
            return out
        x = torch.cat([torch.cat(maps, -1).flatten(1), *vectors] if maps else vectors, -1)
        out = drive(x)
        return out

    def _keys(self, name: str) -> list[str]:
        memory = []
        if name in self.cells:
            cell = self.cells[name]
            assert isinstance(cell, Cell)
            memory = [f"{name}_{kind}" for kind in cell.states]
        return memory + [f"{name}_h"] * (name in self.heard)
