"""Recurrent cells of convolutional networks on the array's grid.

A cell takes its node's convolution `x` and its own state, maps `(row, column, lane, channel)`,
and returns the node's output and the new state; a lane is one stream of the batch. Input and state
are convolved together; `*` below is that convolution. With `layer_norm` each gate is normalised
over its channels, per site, before the non-linearity; constants such as the forget bias are added
after it, or they would be normalised away. The initial state is zero.

For two cells Nayebi et al.'s equations ("lstm-ln", "vanilla") differ from the code published with
the paper ("lstm-ln-published", and "vanilla-elu" or "vanilla-elu-ln").
"""

from collections.abc import Callable
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.core import packages
from tactile_rt.core.errors import ConfigError
from tactile_rt.models.encoders.convolution import Convolution, convolve

FORGET_BIAS = 1.0
# Where nothing is touched the gates have no variance, and the gradient through a norm grows by
# 1 / sqrt(epsilon) with every step: at the usual 1e-5 it reaches 1e29 in a window of 22. At 1 it
# stays below 10 with every cell. The Intersection's x bypasses the norms, so 0.1 is enough there.
NORM_EPSILON = 1.0

State = tuple[Tensor, ...]


class Cell(nn.Module):
    """Base class of recurrent cells: a convolution that computes all gates, and layer norms.

    Attributes:
        gates: The number of maps that `conv` computes, one per gate.
        norms: The number of maps that layer norms are applied to, if used.
        states: The names of the state's tensors, each shaped like x.
        epsilon: The layer norms' epsilon, which is added to the variance.
    """

    gates: ClassVar[int]
    norms: ClassVar[int]
    states: ClassVar[tuple[str, ...]] = ("s",)
    epsilon: float = NORM_EPSILON
    gamma: nn.Parameter | None
    beta: nn.Parameter | None

    def __init__(self, channels: int, layer_norm: bool) -> None:
        super().__init__()
        self.channels = channels
        if self.gates:
            self.conv = Convolution(2 * channels, self.gates * channels)
        self.gamma = self.beta = None
        if layer_norm:
            self.gamma = nn.Parameter(torch.ones(self.norms, channels))
            self.beta = nn.Parameter(torch.zeros(self.norms, channels))
            for norm in (self.gamma, self.beta):  # an optimizer treats each row as a tensor
                norm._optim = {"stacked": True}  # type: ignore[attr-defined]

    def drive(self, x: Tensor) -> Tensor | None:
        """Return the gates' input W*x + b, of one or many steps; None if unused."""
        return convolve(self.conv.weight[..., : self.channels], self.conv.bias, x)

    def forward(self, x: Tensor, state: State, drive: Tensor | None = None) -> tuple[Tensor, State]:
        """Return the output h, shaped like x, and the new state, given `self.drive(x)` or None."""
        raise NotImplementedError

    def convolve_gates(self, x: Tensor, recurrent: Tensor, drive: Tensor | None) -> Tensor:
        """Return the gates (..., gate * channel) before the non-linearity, in the state's type.

        Autocast rounds the convolutions, but the state keeps its precision.
        """
        if drive is None:
            gates = self.conv(x, recurrent)
        else:
            gates = drive + convolve(self.conv.weight[..., self.channels :], None, recurrent)
        return self.normal(gates.to(recurrent.dtype))

    def normal(self, gates: Tensor, first: int = 0) -> Tensor:
        """Apply layer norms number `first` and following to maps (..., n * channel), if used."""
        if self.gamma is None or self.beta is None:
            return gates
        n = gates.shape[-1] // self.channels
        gamma, beta = self.gamma[first : first + n], self.beta[first : first + n]
        normal = F.layer_norm(gates.unflatten(-1, gamma.shape), gamma.shape[1:], eps=self.epsilon)
        return torch.addcmul(beta, normal, gamma).flatten(-2)


class TimeDecayCell(Cell):
    """Time-decay cell (Zhuang et al. 2017): s' = x + tau s, h = s'.

    tau is one learned number, initially 0. With `layer_norm`, x is normalised: there is no gate.
    """

    gates, norms = 0, 1

    def __init__(self, channels: int, layer_norm: bool) -> None:
        super().__init__(channels, layer_norm)
        self.tau = nn.Parameter(torch.zeros(()))

    def drive(self, x: Tensor) -> None:
        return None

    def forward(self, x: Tensor, state: State, drive: Tensor | None = None) -> tuple[Tensor, State]:
        s = torch.addcmul(self.normal(x.to(state[0].dtype)), self.tau, state[0])
        return s, (s,)


class VanillaCell(Cell):
    """Vanilla cell (Nayebi et al. 2022, appendix): s' = tanh(W*x + U*s + b), h = s'."""

    gates, norms = 1, 1
    elu: ClassVar[bool] = False

    def forward(self, x: Tensor, state: State, drive: Tensor | None = None) -> tuple[Tensor, State]:
        gate = self.convolve_gates(x, state[0], drive)
        s = F.elu(gate) if self.elu else torch.tanh(gate)
        return s, (s,)


class VanillaELUCell(VanillaCell):
    """Vanilla cell with ELU in place of tanh, from the published code. Its default is "-ln"."""

    elu = True


class UGRNNCell(Cell):
    """UGRNN cell (paper, appendix "UGRNN"; Collins et al. 2017).

    c = tanh(W_c*x + U_c*s + b_c)        g = sigmoid(W_g*x + U_g*s + b_g + 1)
    s' = g s + (1 - g) c                 h = s'
    """

    gates, norms = 2, 2

    def forward(self, x: Tensor, state: State, drive: Tensor | None = None) -> tuple[Tensor, State]:
        c, g = self.convolve_gates(x, state[0], drive).chunk(2, dim=-1)
        s = torch.lerp(torch.tanh(c), state[0], torch.sigmoid(g + FORGET_BIAS))
        return s, (s,)


class IntersectionCell(Cell):
    """IntersectionRNN cell (paper, appendix "IntersectionRNN"; Collins et al. 2017).

    m = tanh(W_m*x + U_m*s + b_m)        p = sigmoid(W_p*x + U_p*s + b_p + 1)
    n = relu(W_n*x + U_n*s + b_n)        y = sigmoid(W_y*x + U_y*s + b_y + 1)
    s' = p s + (1 - p) m                 h = y x + (1 - y) n
    """

    gates, norms = 4, 4
    epsilon = 0.1

    def forward(self, x: Tensor, state: State, drive: Tensor | None = None) -> tuple[Tensor, State]:
        (s,) = state
        m, n, p, y = self.convolve_gates(x, s, drive).chunk(4, dim=-1)
        m, n = torch.tanh(m), torch.relu(n)
        p, y = torch.sigmoid(p + FORGET_BIAS), torch.sigmoid(y + FORGET_BIAS)
        return (n + y * (x - n)).to(x.dtype), (m + p * (s - m),)


class GRUCell(Cell):
    """GRU cell (Nayebi et al. 2022, appendix; Cho et al. 2014).

    r = sigmoid(W_r*x + U_r*s + b_r + 1)     c = tanh(W_c*x + U_c*(r s) + b_c)
    u = sigmoid(W_u*x + U_u*s + b_u)         s' = u s + (1 - u) c,  h = s'
    """

    gates, norms = 2, 3

    def __init__(self, channels: int, layer_norm: bool) -> None:
        super().__init__(channels, layer_norm)
        self.candidate = Convolution(2 * channels, channels)

    def drive(self, x: Tensor) -> None:
        return None

    def forward(self, x: Tensor, state: State, drive: Tensor | None = None) -> tuple[Tensor, State]:
        (s,) = state
        r, u = self.convolve_gates(x, s, drive).chunk(2, dim=-1)
        c = self.candidate(x, torch.sigmoid(r + FORGET_BIAS) * s)
        c = torch.tanh(self.normal(c.to(s.dtype), first=2))
        s = torch.lerp(c, s, torch.sigmoid(u))
        return s, (s,)


class LSTMCell(Cell):
    """LSTM cell (Nayebi et al. 2022, appendix; Hochreiter & Schmidhuber 1997).

    i = sigmoid(W_i*x + U_i*h + b_i)         f = sigmoid(W_f*x + U_f*h + b_f + 1)
    j = tanh(W_j*x + U_j*h + b_j)            o = sigmoid(W_o*x + U_o*h + b_o)
    c' = f c + i j                           h' = o tanh(c')

    With `layer_norm`, c' inside the last tanh is normalised too (Ba et al. 2016, equation 31). The
    state is (c, h), with the h before the node's ReLU.
    """

    gates, norms = 4, 5
    states = ("c", "s")
    keeps_normal: ClassVar[bool] = False

    def forward(self, x: Tensor, state: State, drive: Tensor | None = None) -> tuple[Tensor, State]:
        c, h = state
        i, j, f, o = self.convolve_gates(x, h, drive).chunk(4, dim=-1)
        c = torch.sigmoid(f + FORGET_BIAS) * c + torch.sigmoid(i) * torch.tanh(j)
        normal = self.normal(c, first=4)
        h = torch.sigmoid(o) * torch.tanh(normal)
        return h, (normal if self.keeps_normal else c, h)


class PublishedLSTMCell(LSTMCell):
    """LSTM cell of the published code, whose next state is the normalised c', unlike `LSTMCell`."""

    keeps_normal = True


CELLS: dict[str, Callable[[int], Cell]] = {
    f"{name}{suffix}": partial(cell, layer_norm=bool(suffix))
    for name, cell in (
        ("timedecay", TimeDecayCell),
        ("vanilla", VanillaCell),
        ("vanilla-elu", VanillaELUCell),
        ("ugrnn", UGRNNCell),
        ("intersection", IntersectionCell),
        ("gru", GRUCell),
        ("lstm", LSTMCell),
    )
    for suffix in ("", "-ln")
}
CELLS["lstm-ln-published"] = partial(PublishedLSTMCell, layer_norm=True)


def make_cell(name: str, channels: int) -> Cell:
    """Make a cell of `CELLS`, or a cell that a plugin adds.

    Args:
        name: name of the cell; of a plugin's cell the entry point's name, with or without "-ln".
    """
    if name in CELLS:
        return CELLS[name](channels)
    base = name.removesuffix("-ln")
    found = packages.import_addition(packages.CELLS, base)
    if not (isinstance(found, type) and issubclass(found, Cell)):
        raise ConfigError(f"cell {base}: {found} is not a subclass of encoders.cells.Cell")
    return found(channels, layer_norm=name != base)
