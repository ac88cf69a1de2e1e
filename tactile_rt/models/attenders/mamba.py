"""Mamba: a selective state-space attender (Gu & Dao 2023), in plain torch.

A block projects to a signal x and a gate z, convolves x over the last steps, and runs for every
channel d and state n

    h_t[d, n] = exp(dt_t[d] A[d, n]) h_{t-1}[d, n] + dt_t[d] B_t[n] x_t[d]
    y_t[d] = sum_n C_t[n] h_t[d, n] + D[d] x_t[d]

where dt, B and C are computed from x itself, so that the input controls what the state keeps and
forgets. The output is y silu(z), projected back.

The scan over a window has an explicit gradient. Time is its first axis, so that a step is a
contiguous block: the recurrence is a loop of multiply-adds into buffers that already hold the
addends, and everything else is computed for all steps at once.
"""

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

LAYERS = 4
STATES = 16
TAPS = 4  # of the causal convolution
EXPAND = 2
RANK = 16  # features per rank of the step size dt
DT_RANGE = (1e-3, 1e-1)


class MambaBlock(nn.Module):
    """One Mamba layer, features (batch, step, width) to the same shape, without the residual."""

    def __init__(self, width: int) -> None:
        super().__init__()
        inner, self.rank = EXPAND * width, math.ceil(width / RANK)
        self.in_proj = nn.Linear(width, 2 * inner, bias=False)
        self.conv_weight = nn.Parameter(torch.empty(inner, TAPS))
        self.conv_bias = nn.Parameter(torch.empty(inner))
        self.x_proj = nn.Linear(inner, self.rank + 2 * STATES, bias=False)
        self.dt_proj = nn.Linear(self.rank, inner)
        self.A_log = nn.Parameter(torch.arange(1.0, STATES + 1).log().repeat(inner, 1))
        self.D = nn.Parameter(torch.ones(inner))
        self.out_proj = nn.Linear(inner, width, bias=False)

        for parameter in (self.conv_weight, self.conv_bias):
            nn.init.uniform_(parameter, -1 / math.sqrt(TAPS), 1 / math.sqrt(TAPS))
        nn.init.uniform_(self.dt_proj.weight, -(self.rank**-0.5), self.rank**-0.5)
        low, high = map(math.log, DT_RANGE)
        dt = torch.exp(low + (high - low) * torch.rand(inner))
        with torch.no_grad():
            self.dt_proj.bias.copy_(dt + torch.log(-torch.expm1(-dt)))  # softplus gives dt back
            self.out_proj.weight /= math.sqrt(LAYERS)  # the residual sums as many
        # Decay would pull the time scales away from where the state space is well conditioned.
        for parameter in (self.A_log, self.D, self.dt_proj.bias):
            parameter._optim = {"lr_scale": 1.0, "weight_decay": 0.0}  # type: ignore[attr-defined]

    def forward(self, features: Tensor) -> Tensor:
        """Map features (batch, step, width) to the same shape, from a zero state."""
        x, gate = self.in_proj(features).chunk(2, dim=-1)  # (batch, step, inner) each
        steps = x.shape[1]
        padded = F.pad(x, (0, 0, TAPS - 1, 0))
        conv = self.conv_bias + sum(
            padded[:, k : k + steps] * self.conv_weight[:, k] for k in range(TAPS)
        )
        x = F.silu(conv)
        y = selective_scan(*self._select(x))  # (batch, step, inner)
        return self._project_out(y, x, gate)

    def step(self, features: Tensor, taps: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Map the features (batch, width) of one step; return output, taps and h.

        taps (batch, TAPS - 1, inner): the last inputs x of the convolution, oldest first
        h    (batch, inner, STATES): the state of the recurrence
        """
        x, gate = self.in_proj(features).chunk(2, dim=-1)  # (batch, inner) each
        taps = torch.cat([taps, x[:, None]], dim=1)  # (batch, TAPS, inner)
        x = F.silu(self.conv_bias + (taps * self.conv_weight.t()).sum(1))  # (batch, inner)
        dt, signal, a, b, c = self._select(x)  # a (inner, STATES); b, c (batch, STATES)
        h = torch.exp(dt[..., None] * a) * h + (dt * signal)[..., None] * b[:, None]
        return self._project_out((h * c[:, None]).sum(-1), x, gate), taps[:, 1:], h

    def _select(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Compute the arguments of `selective_scan` from x (..., inner): dt, x, a, b and c."""
        dt, b, c = self.x_proj(x).split([self.rank, STATES, STATES], dim=-1)
        dt = F.softplus(self.dt_proj(dt))
        # In the parameters' type, even under autocast: the state is a long product.
        exact = self.A_log.dtype
        return dt.to(exact), x.to(exact), -torch.exp(self.A_log), b.to(exact), c.to(exact)

    def _project_out(self, y: Tensor, x: Tensor, gate: Tensor) -> Tensor:
        out: Tensor = self.out_proj((y + self.D * x) * F.silu(gate))
        return out


class MambaStack(nn.Module):
    """Four pre-norm residual Mamba blocks and a final norm; 6,784,000 parameters at width 512.

    Args:
        prefix: prefix of the state's names, so that those of encoder and attender differ.
    """

    def __init__(self, width: int, prefix: str = "mamba") -> None:
        super().__init__()
        self.features, self.prefix = width, prefix
        self.blocks = nn.ModuleList(MambaBlock(width) for _ in range(LAYERS))
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(LAYERS))
        self.norm = nn.LayerNorm(width)

    def forward(self, features: Tensor) -> Tensor:
        """Map features (batch, step, width) to the same shape, from a zero state."""
        x = features
        for block, norm in zip(self.blocks, self.norms, strict=True):
            x = x + block(norm(x))
        out: Tensor = self.norm(x)
        return out

    def initial_state(self, batch: int) -> dict[str, Tensor]:
        """Return zero taps (batch, layer, TAPS - 1, inner) and h (batch, layer, inner, STATES)."""
        inner = EXPAND * self.features
        zeros = self.norm.weight.new_zeros
        return {
            f"{self.prefix}_taps": zeros(batch, LAYERS, TAPS - 1, inner),
            f"{self.prefix}_h": zeros(batch, LAYERS, inner, STATES),
        }

    def step(
        self, features: Tensor, index: Tensor, state: dict[str, Tensor]
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Map the features (batch, width) of one step; return output and new state."""
        old_taps, old_h = state[f"{self.prefix}_taps"], state[f"{self.prefix}_h"]
        x, new_taps, new_h = features, [], []
        for layer, (block, norm) in enumerate(zip(self.blocks, self.norms, strict=True)):
            assert isinstance(block, MambaBlock)
            out, taps, h = block.step(norm(x), old_taps[:, layer], old_h[:, layer])
            x = x + out
            new_taps.append(taps)
            new_h.append(h)
        new = {
            f"{self.prefix}_taps": torch.stack(new_taps, 1),
            f"{self.prefix}_h": torch.stack(new_h, 1),
        }
        return self.norm(x), new


def selective_scan(dt: Tensor, x: Tensor, a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """Run the selective state-space recurrence from h = 0; return y (batch, step, channel).

    h_t = exp(dt_t a) h_{t-1} + dt_t x_t b_t and y_t = h_t c_t, with dt, x (batch, step, channel);
    a (channel, state); b, c (batch, step, state), all real and of one type.
    """
    steps_first = [part.transpose(0, 1).contiguous() for part in (dt, dt * x, b, c)]
    with torch.autocast(x.device.type, enabled=False):
        y: Tensor = _Scan.apply(*steps_first, a)  # type: ignore[no-untyped-call]
    return y.transpose(0, 1)


class _Scan(torch.autograd.Function):
    """The recurrence of `selective_scan` with its gradient, on (step, batch, ·); u is dt x."""

    @staticmethod
    def forward(ctx: Any, dt: Tensor, u: Tensor, b: Tensor, c: Tensor, a: Tensor) -> Tensor:
        keep = torch.mul(dt[..., None], a).exp_()  # (step, batch, channel, state)
        h = u[..., None] * b[..., None, :]  # the same
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
