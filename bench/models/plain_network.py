"""The Intersection-LN encoder as its equations are usually written: the peer of our own.

Maps `(batch, channel, row, column)`, `conv2d` on padded concatenations, every node at every step,
automatic gradients. Written here from the paper (Chung et al. 2025, appendix "IntersectionRNN";
Zhuang et al. 2017). It is not the published code, whose training step of batch 32 took 21-25
CPU s on an idle core; `bench/models/peer.py` measures beside that one.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.encoders.cells import FORGET_BIAS, IntersectionCell
from tactile_rt.models.encoders.zhuang import ZhuangEncoder


class PlainCell(nn.Module):
    """The cell after its node's convolution; see `IntersectionCell` for the equations."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(2 * channels, 4 * channels, 2)
        self.norms = nn.ModuleList(nn.LayerNorm(channels, IntersectionCell.epsilon) for _ in "mnpy")

    def forward(self, x: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        gates = self.conv(F.pad(torch.cat([x, s], 1), (0, 1, 0, 1))).chunk(4, 1)
        m, n, p, y = (
            norm(gate.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
            for norm, gate in zip(self.norms, gates, strict=True)
        )
        m, n = torch.tanh(m), F.relu(n)
        p, y = torch.sigmoid(p + FORGET_BIAS), torch.sigmoid(y + FORGET_BIAS)
        return y * x + (1 - y) * n, p * s + (1 - p) * m


class PlainEncoder(nn.Module):
    """Frames (batch, step, 30, 5, 7) to features (batch, step, feature), with another's weights."""

    def __init__(self, weights: ZhuangEncoder) -> None:
        super().__init__()
        self.graph = weights.graph
        self.layers, self.cells = nn.ModuleDict(), nn.ModuleDict()
        saved = weights.state_dict()
        for node in self.graph.nodes:
            name = node.name
            weight = saved.get(f"convs.{name}.weight", saved.get(f"dense.{name}.weight"))
            assert weight is not None
            if node.kind == "dense":
                layer: nn.Module = nn.Linear(weight.shape[1], node.channels)
                layer.load_state_dict({k: saved[f"dense.{name}.{k}"] for k in ("weight", "bias")})
                self.layers[name] = layer
                continue
            layer = nn.Conv2d(weight.shape[3], node.channels, 2)
            layer.load_state_dict(
                {"weight": weight.permute(0, 3, 1, 2), "bias": saved[f"convs.{name}.bias"]}
            )
            cell = PlainCell(node.channels)
            kernel = saved[f"cells.{name}.conv.weight"].permute(0, 3, 1, 2)
            cell.conv.load_state_dict({"weight": kernel, "bias": saved[f"cells.{name}.conv.bias"]})
            for i, norm in enumerate(cell.norms):
                scale, shift = (saved[f"cells.{name}.{k}"][i] for k in ("gamma", "beta"))
                norm.load_state_dict({"weight": scale, "bias": shift})
            self.layers[name], self.cells[name] = layer, cell

    def forward(self, frames: Tensor) -> Tensor:
        h: dict[str, Tensor] = {}
        for node in self.graph.nodes:
            sites = () if node.kind == "dense" else (4, 6)
            h[node.name] = frames.new_zeros(len(frames), node.channels, *sites)
        s = {name: h[name] for name in self.cells}
        features = []
        for frame in frames.unbind(1):
            new = {}
            for node in self.graph.nodes:
                layer = self.layers[node.name]
                x = torch.cat(
                    [frame if e.source == "frame" else h[e.source] for e in node.reads], 1
                )
                if node.kind == "dense":
                    x = x.permute(0, 2, 3, 1).flatten(1) if x.dim() == 4 else x
                    new[node.name] = F.relu(layer(x))
                    continue
                x = layer(x if node.kind == "valid" else F.pad(x, (0, 1, 0, 1)))
                out, s[node.name] = self.cells[node.name](x, s[node.name])
                new[node.name] = F.relu(out)
            h = new
            features.append(h[self.graph.readout])
        return torch.stack(features, 1)
