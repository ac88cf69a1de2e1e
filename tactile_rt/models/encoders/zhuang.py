"""Zhuang's recurrent convolutional network on the whisker map (Zhuang et al. 2017).

The graph is data: `GRAPH` names every node's predecessors and channels. Time is unrolled as in
biology: a step costs every edge the same delay, so at step t a node reads what its predecessors
put out at step t-1 (nothing at t = 0), and only conv1 reads the frame of step t itself.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.encoders.cells import CELLS, IntersectionCell
from tactile_rt.models.encoders.convolution import Convolution, convolve_valid

ROWS, COLUMNS = 4, 6  # every map, after conv1's valid 2 x 2 kernel on the 5 x 7 grid
LAG = 3  # steps from a frame to the features: conv1 -> conv2 -> fc7 -> fc8


class Node(NamedTuple):
    channels: int
    reads: tuple[str, ...]  # predecessors, in the order of their channels: alphabetical


FRAME = "frame"
FRAME_CHANNELS = 30
GRAPH = {
    "conv1": Node(96, (FRAME,)),
    "conv2": Node(128, ("conv1", "conv3", "conv4")),
    "conv3": Node(256, ("conv2", "conv4", "conv5")),
    "conv4": Node(384, ("conv3", "conv5", "conv6")),
    "conv5": Node(384, ("conv4", "conv6")),
    "conv6": Node(256, ("conv5",)),
}
FC7 = Node(1024, ("conv2", "conv4", "conv6"))
FC8 = Node(512, ("fc7",))


class ZhuangEncoder(nn.Module):
    """Frames `(batch, step, 30, 5, 7)` to features `(batch, step, 512 * width)`.

    Inside, maps are `(row, column, lane, channel)`; the state's are `(lane, row, column, channel)`.
    """

    def __init__(self, width: float = 1.0, cell: str = "intersection-ln") -> None:
        super().__init__()
        self.channels = {name: round(node.channels * width) for name, node in GRAPH.items()}
        sources = {FRAME: FRAME_CHANNELS, **self.channels}
        self.convs = nn.ModuleDict()
        self.cells = nn.ModuleDict()
        for name, node in GRAPH.items():
            inputs = sum(sources[source] for source in node.reads)
            self.convs[name] = Convolution(inputs, self.channels[name])
            self.cells[name] = CELLS[cell](self.channels[name])
        flat = ROWS * COLUMNS * sum(self.channels[source] for source in FC7.reads)
        self.fc7 = nn.Linear(flat, round(FC7.channels * width))
        self.fc8 = nn.Linear(self.fc7.out_features, round(FC8.channels * width))
        for linear in (self.fc7, self.fc8):
            nn.init.kaiming_normal_(linear.weight, nonlinearity="relu")
            nn.init.constant_(linear.bias, 0.1)
        self.features = self.fc8.out_features

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Zeros: each node's cell state `_s` and output `_h`, and the output of fc7."""
        zeros = self.fc7.weight.new_zeros
        state = {}
        for name, channels in self.channels.items():
            for kind in "sh":
                state[f"{name}_{kind}"] = zeros(batch, ROWS, COLUMNS, channels)
        state["fc7_h"] = zeros(batch, self.fc7.out_features)
        return state

    def step(self, frame: Tensor, state: dict[str, Tensor]) -> tuple[Tensor, dict[str, Tensor]]:
        """One step. frame (batch, 30, 5, 7) -> features (batch, feature), new state."""
        old = {f"{n}_{kind}": state[f"{n}_{kind}"].movedim(0, 2) for n in GRAPH for kind in "sh"}
        maps = self._recur(tuple(GRAPH), old, self._conv1(frame))
        new = {name: value.movedim(2, 0) for name, value in maps.items()}
        new["fc7_h"] = F.relu(self.fc7(self._flat(old)))
        return F.relu(self.fc8(state["fc7_h"])), new

    def forward(self, frames: Tensor) -> Tensor:
        """A whole window at once: the features that `step` gives one by one.

        What does not depend on the recurrence is computed for all steps in one product, and what
        cannot reach a feature of this window is not computed.
        """
        batch, steps = frames.shape[:2]
        # A node has one lane until the first frame reaches it: until then all lanes are equal.
        state = self.initial_state(1)
        state = {name: value.movedim(0, 2) for name, value in state.items() if value.dim() == 4}
        flat = [self._flat(state)]
        if steps > LAG:
            x = self._conv1(frames[:, :-LAG].transpose(0, 1).flatten(0, 1))
            cell1 = self.cells["conv1"]
            assert isinstance(cell1, IntersectionCell)
            drive = cell1.drive(x)
            for now in zip(x.split(batch, 2), drive.split(batch, 2), strict=True):
                state = self._recur(tuple(GRAPH), state, *now)
                flat.append(self._flat(state))
        if steps >= LAG:  # of the last maps, only those that fc7 reads
            flat.append(self._flat(self._recur(FC7.reads, state)))
        fc7 = [self.fc7.weight.new_zeros(batch, 1, self.fc7.out_features)]
        if steps > 1:
            flat = [f.expand(batch, -1) for f in flat[: steps - 1]]
            fc7.append(F.relu(self.fc7(torch.stack(flat, dim=1))))
        return F.relu(self.fc8(torch.cat(fc7, dim=1)))

    def _conv1(self, frames: Tensor) -> Tensor:
        """frames (lane, 30, 5, 7) -> (4, 6, lane, channel)"""
        conv = self.convs["conv1"]
        assert isinstance(conv, Convolution)
        return convolve_valid(conv.weight, conv.bias, frames.permute(2, 3, 0, 1))

    def _recur(
        self,
        nodes: tuple[str, ...],
        state: dict[str, Tensor],
        conv1: Tensor | None = None,
        drive1: Tensor | None = None,
    ) -> dict[str, Tensor]:
        """The nodes' new outputs and cell states, from their predecessors' previous outputs.

        conv1, drive1: that node's convolution of the frame and, if known, its cell's drive.
        """
        new = {}
        for name in nodes:
            if name == "conv1":
                x, drive = conv1, drive1
            else:
                x = self.convs[name](*(state[f"{r}_h"] for r in GRAPH[name].reads))
                drive = None
            h, new[f"{name}_s"] = self.cells[name](x, state[f"{name}_s"], drive)
            new[f"{name}_h"] = F.relu(h)
        return new

    def _flat(self, state: dict[str, Tensor]) -> Tensor:
        """What fc7 reads, (lane, site * channel)."""
        maps = [state[f"{r}_h"] for r in FC7.reads]
        lanes = max(m.shape[2] for m in maps)
        joined = torch.cat([m.expand(-1, -1, lanes, -1) for m in maps], dim=-1)
        return joined.movedim(2, 0).flatten(1)
