"""The network of any `Graph`: runs a whole window at once for training, or single steps.

A lane is one stream of the batch. Inside, maps are `(row, column, lane, channel)`, and vectors are
maps of one site; in the state maps are `(lane, row, column, channel)`, vectors `(lane, channel)`.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.encoders.cells import Cell, make_cell
from tactile_rt.models.encoders.convolution import Convolution, convolve, convolve_valid
from tactile_rt.models.encoders.graph import Graph, Input, Node, parse_graph


class Fusion(nn.Module):
    """Layer that adds a node's "sum" and "gate" sources to its concatenated sources.

    gate: sigmoid(w . [base, added] + b), a scalar per site and edge (gated attention).
    """

    def __init__(self, base: int, sources: Sequence[int], gated: Sequence[bool]) -> None:
        super().__init__()
        self.projections = nn.ModuleList(nn.Linear(c, base, bias=False) for c in sources)
        self.gates = nn.ModuleList(nn.Linear(2 * base, 1) if g else nn.Identity() for g in gated)

    def forward(self, base: Tensor, maps: Sequence[Tensor]) -> Tensor:
        """Add `maps`, each projected to the channels of `base` (row, column, lane, channel)."""
        out = base
        for project, gate, m in zip(self.projections, self.gates, maps, strict=True):
            added = project(m)
            if isinstance(gate, nn.Linear):
                shape = torch.broadcast_shapes(base.shape, added.shape)
                both = torch.cat([base.expand(shape), added.expand(shape)], dim=-1)
                added = added * torch.sigmoid(gate(both))
            out = out + added
        return out


class GraphEncoder(nn.Module):
    """Encoder that runs a graph, from frames `(batch, step, channel, row, column)` to features.

    Args:
        graph: the graph, already scaled to the network's width (see `Graph.scale_channels`).

    Attributes:
        features: The number of channels of the graph's readout.
        lag: The delay in steps from a frame to the readout: the first `lag` steps of a window
            cannot depend on any frame.
    """

    def __init__(self, graph: Graph) -> None:
        super().__init__()
        self.graph = graph
        self.lag = graph.lag
        self.sizes = graph.sizes
        self.remaining = graph.remaining
        self.heard = {edge.source for node in graph.nodes for edge in node.reads}
        parts: tuple[Input | Node, ...] = (graph.frame, *graph.nodes)
        channels = {part.name: part.channels for part in parts}
        self.convs = nn.ModuleDict()
        self.cells = nn.ModuleDict()
        self.dense = nn.ModuleDict()
        self.fusions = nn.ModuleDict()
        for node in graph.nodes:
            inputs = {e.source: channels[e.source] for e in node.reads}
            if node.kind == "dense":
                for source in inputs:
                    rows, columns = self.sizes[source]
                    inputs[source] *= rows * columns
            base = sum(inputs[e.source] for e in node.reads if e.fusion == "concatenate")
            if node.kind == "dense":
                linear = nn.Linear(base, node.channels)
                nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
                nn.init.constant_(linear.bias, 0.1)
                self.dense[node.name] = linear
            else:
                self.convs[node.name] = Convolution(base, node.channels)
            if node.cell != "none":
                self.cells[node.name] = make_cell(node.cell, node.channels)
            added = [e for e in node.reads if e.fusion != "concatenate"]
            if added:
                self.fusions[node.name] = Fusion(
                    base, [inputs[e.source] for e in added], [e.fusion == "gate" for e in added]
                )
        self.features = channels[graph.readout]

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return zeros for each node's cell state and, if nodes read it, its output ``NAME_h``."""
        zeros = next(self.parameters()).new_zeros
        state = {}
        for node in self.graph.nodes:
            sites = () if node.kind == "dense" else self.sizes[node.name]
            for key in self.keys(node):
                state[key] = zeros(batch, *sites, node.channels)
        return state

    def step(
        self, frame: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map a frame (batch, channel, row, column) to features (batch, feature) and the state.

        `index` is not used: the network has no positions.
        """
        name, now = self.graph.frame.name, _to_inside(frame)
        keys = [key for node in self.graph.nodes for key in self.keys(node)]
        old = {key: _from_state(state[key]) for key in keys}
        new: dict[str, Tensor] = {}
        for node in self.graph.nodes:
            sources = [edge.source for edge in node.reads]
            read = [now if source == name else old[f"{source}_h"] for source in sources]
            memory = tuple(old[key] for key in self._memory_names(node))
            new[f"{node.name}_h"], memory = self._run_cell(node, self._drive(node, read), memory)
            new |= dict(zip(self._memory_names(node), memory, strict=True))
        features = new[f"{self.graph.readout}_h"][0, 0]
        return features, {key: _to_state(new[key], state[key].dim()) for key in keys}

    def forward(self, frames: Tensor) -> Tensor:
        """Map frames (batch, step, channel, row, column) to features (batch, step, feature).

        The result is the same as from `step`. Nodes outside loops of the graph are computed for all
        steps in one product, and outputs that cannot reach a feature of this window are skipped. A
        node has one lane until the first frame reaches it, since until then all lanes are equal.
        """
        batch, steps = frames.shape[:2]
        # The outputs of the frame and the nodes, indexed by the step in which they are read.
        every = _to_inside(frames.transpose(0, 1).flatten(0, 1))
        outputs = {self.graph.frame.name: list(every.split(batch, 2))}
        state = {key: _from_state(value) for key, value in self.initial_state(1).items()}
        for node in self.graph.nodes:
            outputs[node.name] = [state[f"{node.name}_h"]] if node.name in self.heard else []
        for component in self.graph.components:
            first = component[0]
            if len(component) == 1 and all(e.source != first.name for e in first.reads):
                self._append_outputs(first, outputs, state, batch, steps)
                continue
            for t in range(steps):
                for node in component:
                    if t >= steps - self.remaining[node.name]:
                        continue
                    x = self._drive(node, [outputs[e.source][t] for e in node.reads])
                    memory = tuple(state[key] for key in self._memory_names(node))
                    h, memory = self._run_cell(node, x, memory)
                    state |= dict(zip(self._memory_names(node), memory, strict=True))
                    outputs[node.name].append(h)
        out = [h.expand(-1, -1, batch, -1)[0, 0] for h in outputs[self.graph.readout][-steps:]]
        return torch.stack(out, dim=1)

    def _append_outputs(
        self,
        node: Node,
        outputs: dict[str, list[Tensor]],
        state: dict[str, Tensor],
        batch: int,
        steps: int,
    ) -> None:
        """Compute a node outside loops for all steps, and append its outputs to `outputs`."""
        steps -= self.remaining[node.name]
        if steps <= 0:
            return
        maps = []
        for edge in node.reads:
            lanes = [m.expand(-1, -1, batch, -1) for m in outputs[edge.source][:steps]]
            maps.append(torch.cat(lanes, dim=2))
        x = self._drive(node, maps)
        if node.cell == "none":
            outputs[node.name] += F.relu(x).split(batch, 2)
            return
        cell = self.cells[node.name]
        assert isinstance(cell, Cell)
        drive = cell.drive(x)
        drives = [None] * steps if drive is None else drive.split(batch, 2)
        memory = tuple(state[key] for key in self._memory_names(node))
        for now, driven in zip(x.split(batch, 2), drives, strict=True):
            h, memory = self._run_cell(node, now, memory, driven)
            outputs[node.name].append(h)

    def _drive(self, node: Node, maps: Sequence[Tensor]) -> Tensor:
        """Apply a node's convolution or dense layer to its sources, ordered as its edges."""
        fused = [edge.fusion != "concatenate" for edge in node.reads]
        if node.kind == "dense":
            beside = _flat([m for m, f in zip(maps, fused, strict=True) if not f])
            added = [_flat([m]) for m, f in zip(maps, fused, strict=True) if f]
            out: Tensor = self.dense[node.name](self._fuse(node, beside, added))
            return out
        conv = self.convs[node.name]
        assert isinstance(conv, Convolution)
        rows, columns = self.sizes[node.name]
        if node.kind == "valid":
            rows, columns = rows + 1, columns + 1
        maps = [m.expand(rows, columns, -1, -1) for m in maps]
        if node.kind == "same" and not any(fused):
            return convolve(conv.weight, conv.bias, *maps)
        beside = _cat([m for m, f in zip(maps, fused, strict=True) if not f])
        added = [m for m, f in zip(maps, fused, strict=True) if f]
        joined = self._fuse(node, beside, added)
        if node.kind == "valid":
            return convolve_valid(conv.weight, conv.bias, joined)
        return convolve(conv.weight, conv.bias, joined)

    def _fuse(self, node: Node, beside: Tensor, added: Sequence[Tensor]) -> Tensor:
        if not added:
            return beside
        out: Tensor = self.fusions[node.name](beside, added)
        return out

    def _run_cell(
        self, node: Node, x: Tensor, memory: tuple[Tensor, ...], drive: Tensor | None = None
    ) -> tuple[Tensor, tuple[Tensor, ...]]:
        if node.cell == "none":
            return F.relu(x), ()
        h, memory = self.cells[node.name](x, tuple(m.expand_as(x) for m in memory), drive)
        return F.relu(h), memory

    def _memory_names(self, node: Node) -> list[str]:
        """List the state's keys for a node's cell."""
        if node.cell == "none":
            return []
        cell = self.cells[node.name]
        assert isinstance(cell, Cell)
        return [f"{node.name}_{kind}" for kind in cell.states]

    def keys(self, node: Node) -> list[str]:
        """List a node's keys in the state: its cell's and, if read, its output's."""
        return self._memory_names(node) + [f"{node.name}_h"] * (node.name in self.heard)


@torch.no_grad()
def draw_as_published(encoder: nn.Module) -> None:
    """Draw initial weights as the paper's code does: uniformly within +-1 / sqrt(fan-in).

    Biases of cells are drawn as well; those of convolutions stay 0, those of dense nodes 0.1.
    """
    for name, part in encoder.named_modules():
        if isinstance(part, Convolution):
            bound = part.weight[0].numel() ** -0.5
            nn.init.uniform_(part.weight, -bound, bound)
            if name.startswith("cells."):
                nn.init.uniform_(part.bias, -bound, bound)
        elif name.startswith("dense.") and isinstance(part, nn.Linear):
            bound = part.in_features**-0.5
            nn.init.uniform_(part.weight, -bound, bound)


def _to_inside(x: Tensor) -> Tensor:
    """Permute a frame (lane, channel[, row, column]) to (row, column, lane, channel)."""
    return x[None, None] if x.dim() == 2 else x.permute(2, 3, 0, 1)


def _from_state(x: Tensor) -> Tensor:
    """Permute a state (lane, [row, column,] channel) to (row, column, lane, channel)."""
    return x[None, None] if x.dim() == 2 else x.movedim(0, 2)


def _to_state(x: Tensor, dimensions: int) -> Tensor:
    return x[0, 0] if dimensions == 2 else x.movedim(2, 0)


def _cat(maps: Sequence[Tensor]) -> Tensor:
    lanes = max(m.shape[2] for m in maps)
    return torch.cat([m.expand(-1, -1, lanes, -1) for m in maps], dim=-1)


def _flat(maps: Sequence[Tensor]) -> Tensor:
    """Flatten and concatenate maps, vectors last, to (1, 1, lane, site * channel + ...)."""
    sites = [m for m in maps if m.shape[:2] != (1, 1)]
    parts = [_cat(sites).movedim(2, 0).flatten(1)[None, None]] if sites else []
    return _cat(parts + [m for m in maps if m.shape[:2] == (1, 1)])


def build_encoder(text: str, width: float, frame: tuple[int, int, int]) -> GraphEncoder:
    """Build an encoder from a graph in TOML.

    Args:
        width: the factor of the nodes' numbers of channels.
        frame: channels, rows and columns of the array's frames.

    Raises:
        ConfigError: the text is no graph, or the graph's frame is not `frame`.
    """
    graph = parse_graph(text)
    read = graph.frame
    if (found := (read.channels, read.rows, read.columns)) != frame:
        sizes = (" x ".join(map(str, size)) for size in (found, frame))
        raise ConfigError(
            "the graph's {} has {} channels, rows and columns, the array's frames "
            "{}: change the graph".format(read.name, *sizes)
        )
    return GraphEncoder(graph.scale_channels(width))
