"""Recurrent cells on the whisker map.

A cell takes its node's convolution `x` and its own state, maps `(row, column, lane, channel)`,
and returns the node's output and the new state. Both are convolved together.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.encoders.convolution import Convolution, convolve

FORGET_BIAS = 1.0
# Where nothing is touched the gates have no variance, and the gradient through a norm grows by
# 1 / sqrt(epsilon) with every step: at the usual 1e-5 it reaches 1e29 in a window of 22.
NORM_EPSILON = 0.1


class IntersectionCell(nn.Module):
    """IntersectionRNN (paper, appendix "IntersectionRNN"; Collins et al. 2017).

    With `layer_norm` each gate is normalised over its channels, per site, before the
    non-linearity. The forget bias comes after it: a constant before it would be normalised away.
    """

    GATES = 4  # m, n, p, y

    def __init__(self, channels: int, layer_norm: bool) -> None:
        super().__init__()
        self.channels = channels
        self.conv = Convolution(2 * channels, self.GATES * channels)
        self.gamma: nn.Parameter | None = None
        self.beta: nn.Parameter | None = None
        if layer_norm:
            self.gamma = nn.Parameter(torch.ones(self.GATES, channels))
            self.beta = nn.Parameter(torch.zeros(self.GATES, channels))

    def drive(self, x: Tensor) -> Tensor:
        """W*x + b alone, for an x that is known for many steps at once."""
        return convolve(self.conv.weight[..., : self.channels], self.conv.bias, x)

    def forward(
        self, x: Tensor, state: Tensor, drive: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """One step: output h and new state s', shaped like x. `drive` saves convolving x."""
        if drive is None:
            gates = self.conv(x, state)
        else:
            gates = drive + convolve(self.conv.weight[..., self.channels :], None, state)
        return intersect(gates, x, state.expand_as(x), self.gamma, self.beta)


def intersect(
    gates: Tensor, x: Tensor, state: Tensor, gamma: Tensor | None, beta: Tensor | None
) -> tuple[Tensor, Tensor]:
    """The cell after its convolution.

        m = tanh(W_m*x + U_m*s + b_m)        p = sigmoid(W_p*x + U_p*s + b_p + 1)
        n = relu(W_n*x + U_n*s + b_n)        y = sigmoid(W_y*x + U_y*s + b_y + 1)
        s' = p s + (1 - p) m                 h = y x + (1 - y) n

    Computed in the state's type: autocast rounds the convolutions, but not the memory.

    gates        (..., 4 * channel), m to y before their non-linearity
    x, state     (..., channel)
    gamma, beta  (4, channel) of the layer norm, or None
    ->           h, s' (..., channel)
    """
    gates = gates.to(state.dtype)
    if gamma is not None and beta is not None:
        normal = F.layer_norm(gates.unflatten(-1, gamma.shape), gamma.shape[1:], eps=NORM_EPSILON)
        gates = torch.addcmul(beta, normal, gamma).flatten(-2)
    m, n, p, y = gates.chunk(4, dim=-1)
    m, n = torch.tanh(m), torch.relu(n)
    p, y = torch.sigmoid(p + FORGET_BIAS), torch.sigmoid(y + FORGET_BIAS)
    return (n + y * (x - n)).to(x.dtype), m + p * (state - m)


CELLS: dict[str, Callable[[int], IntersectionCell]] = {
    "intersection": partial(IntersectionCell, layer_norm=False),
    "intersection-ln": partial(IntersectionCell, layer_norm=True),
}
