"""The selective scan of Mamba over a window, its gradient written out.

Time leads inside, so that a step is one contiguous block: the recurrence is a loop of products
into buffers that already hold what they add to, and everything else is done for all steps at once.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

__all__ = ["selective_scan"]


def selective_scan(dt: Tensor, x: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """y_t = h_t c_t with h_t = exp(dt_t a) h_{t-1} + dt_t x_t b_t, from h = 0.

    dt, x (batch, step, channel); a (channel, state); b, c (batch, step, state)
    -> (batch, step, channel). All real, of one type.
    """
    steps_first = [part.transpose(0, 1).contiguous() for part in (dt, dt * x, b, c)]
    with torch.autocast(x.device.type, enabled=False):
        y: Tensor = _Scan.apply(*steps_first, a)  # type: ignore[no-untyped-call]
    return y.transpose(0, 1)


class _Scan(torch.autograd.Function):
    """(step, batch, ·) throughout; u is dt x."""

    @staticmethod
    def forward(ctx: Any, dt: Tensor, u: Tensor, b: Tensor, c: Tensor, a: Tensor) -> Tensor:
        keep = torch.mul(dt[..., None], a).exp_()
        h = u[..., None] * b[..., None, :]
        for t in range(1, len(h)):
            h[t].addcmul_(keep[t], h[t - 1])
        ctx.save_for_backward(dt, u, a, b, c, keep, h)
        return torch.matmul(h, c[..., None])[..., 0]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, ...]:
        dt, u, a, b, c, keep, h = ctx.saved_tensors
        to_c = torch.matmul(grad[..., None, :], h)[..., 0, :]
        to_h = grad[..., None] * c[..., None, :]
        for t in range(len(h) - 1, 0, -1):
            to_h[t - 1].addcmul_(keep[t], to_h[t])
        to_u = torch.matmul(to_h, b[..., None])[..., 0]
        to_b = torch.matmul(u[..., None, :], to_h)[..., 0, :]
        # keep_t multiplied h_{t-1}: the gradient of its exponent dt a
        exponent = to_h[1:].mul_(keep[1:]).mul_(h[:-1])
        to_dt = torch.zeros_like(dt)
        to_dt[1:] = (exponent * a).sum(-1)
        to_a = exponent.mul_(dt[1:, ..., None]).sum((0, 1))
        return to_dt, to_u, to_b, to_c, to_a
