"""Zhuang's encoder with every cell against the paper's equations, written with convolutions."""

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from tactile_rt.models.ead import EAD, EADConfig
from tactile_rt.models.encoders.cells import CELLS
from tactile_rt.models.encoders.zhuang import ZhuangEncoder
from tests.helpers.small_networks import STEPS, build, frames, stir

READS = {2: (1, 3, 4), 3: (2, 4, 5), 4: (3, 5, 6), 5: (4, 6), 6: (5,)}


def kernel(weight: Tensor) -> Tensor:
    """(out, 2, 2, in) -> (out, in, 2, 2)"""
    return weight.permute(0, 3, 1, 2)


def same(x: Tensor, layer) -> Tensor:
    """A 2 x 2 convolution padded right and below."""
    return F.conv2d(F.pad(x, (0, 1, 0, 1)), kernel(layer.weight), layer.bias)


def norm(cell, i: int, x: Tensor) -> Tensor:
    """Layer norm i of the cell over channels, per site; x (batch, channel, row, column)."""
    if cell.gamma is None:
        return x
    epsilon = 0.1 if cell.norms == 4 else 1.0  # the Intersection's, all others'
    spread = (x.var(1, unbiased=False, keepdim=True) + epsilon).sqrt()
    x = (x - x.mean(1, keepdim=True)) / spread
    return x * cell.gamma[i][:, None, None] + cell.beta[i][:, None, None]


def gates(cell, x, s) -> list[Tensor]:
    parts = same(torch.cat([x, s], 1), cell.conv).split(x.shape[1], dim=1)
    return [norm(cell, i, part) for i, part in enumerate(parts)]


def timedecay(cell, x, s):
    s = norm(cell, 0, x) + cell.tau * s
    return s, s


def vanilla(cell, x, s):
    s = torch.tanh(gates(cell, x, s)[0])
    return s, s


def vanilla_elu(cell, x, s):
    s = F.elu(gates(cell, x, s)[0])
    return s, s


def ugrnn(cell, x, s):
    c, g = gates(cell, x, s)
    c, g = torch.tanh(c), torch.sigmoid(g + 1)
    s = g * s + (1 - g) * c
    return s, s


def intersection(cell, x, s):
    m, n, p, y = gates(cell, x, s)
    m, n, p, y = torch.tanh(m), F.relu(n), torch.sigmoid(p + 1), torch.sigmoid(y + 1)
    return y * x + (1 - y) * n, p * s + (1 - p) * m


def gru(cell, x, s):
    r, u = gates(cell, x, s)
    r, u = torch.sigmoid(r + 1), torch.sigmoid(u)
    c = torch.tanh(norm(cell, 2, same(torch.cat([x, r * s], 1), cell.candidate)))
    s = u * s + (1 - u) * c
    return s, s


def lstm(cell, x, s):
    c, h = s if isinstance(s, tuple) else (s, s)  # at first both are zero
    i, j, f, o = gates(cell, x, h)
    c = torch.sigmoid(f + 1) * c + torch.sigmoid(i) * torch.tanh(j)
    h = torch.sigmoid(o) * torch.tanh(norm(cell, 4, c))
    return h, (c, h)


def lstm_ln_published(cell, x, s):
    """It remembers what it normalised."""
    h, (c, _) = lstm(cell, x, s)
    return h, (norm(cell, 4, c), h)


EQUATIONS = {
    f.__name__.replace("_", "-"): f
    for f in (
        timedecay, vanilla, vanilla_elu, ugrnn, intersection, gru, lstm, lstm_ln_published,
    )
}  # fmt: skip


def oracle(encoder: ZhuangEncoder, x: Tensor, cell: str) -> Tensor:
    """Features (batch, step, feature), step by step and node by node."""
    equations = EQUATIONS[cell.removesuffix("-ln")]
    channels = {int(n.name[-1]): n.channels for n in encoder.graph.nodes}
    h = {n: x.new_zeros(len(x), channels[n], 4, 6) for n in range(1, 7)}
    s = dict(h)
    fc7, fc8 = x.new_zeros(len(x), channels[7]), x.new_zeros(len(x), channels[8])
    before, features = F.relu(fc7), []
    for t in range(x.shape[1]):
        flat = torch.cat([h[2], h[4], h[6]], 1).permute(0, 2, 3, 1).flatten(1)
        if cell.startswith("timedecay"):
            fc8 = encoder.dense["fc8"](before) + encoder.cells["fc8"].tau * fc8
            fc7 = encoder.dense["fc7"](flat) + encoder.cells["fc7"].tau * fc7
        else:
            fc8, fc7 = encoder.dense["fc8"](before), encoder.dense["fc7"](flat)
        before = F.relu(fc7)
        features.append(F.relu(fc8))
        new = {}
        for n in range(1, 7):
            conv = encoder.convs[f"conv{n}"]
            if n == 1:
                c = F.conv2d(x[:, t], kernel(conv.weight), conv.bias)
            else:
                c = same(torch.cat([h[k] for k in READS[n]], 1), conv)
            out, s[n] = equations(encoder.cells[f"conv{n}"], c, s[n])
            new[n] = F.relu(out)
        h = new
    return torch.stack(features, 1)


def encoder_of(cell: str) -> ZhuangEncoder:
    """In double precision, so that only a wrong equation can differ."""
    torch.manual_seed(1)
    encoder = ZhuangEncoder(1 / 32, cell).double()
    stir(encoder)
    if cell == "timedecay-ln":  # its fc7 and fc8 have no sites to normalise over: keep the norm
        assert encoder.cells["fc7"].gamma is None
    return encoder


@pytest.mark.parametrize("cell", CELLS)
def test_features_and_gradients_are_those_of_the_equations(cell):
    encoder, x = encoder_of(cell), frames(steps=10).double().requires_grad_()
    expected, found = oracle(encoder, x, cell), encoder(x)
    torch.testing.assert_close(found, expected, atol=1e-12, rtol=1e-10)
    assert (expected[:, 4:] - expected[:, 3:-1]).abs().max() > 1e-3
    weights = frames(2, 10, seed=3)[..., 0, 0].double()[..., : encoder.features]
    wanted = [x, *encoder.parameters()]
    a, b = (torch.autograd.grad((y * weights).sum(), wanted) for y in (found, expected))
    for one, other in zip(a, b, strict=True):
        torch.testing.assert_close(one, other, atol=1e-10, rtol=1e-8)
    assert all(other.any() for other in b)


@pytest.mark.parametrize("frozen", ["convs", "cells"])
def test_gradients_with_a_part_frozen(frozen):
    """The hand-written gradients leave out what is not asked for, and nothing else."""
    encoder = encoder_of("intersection-ln")
    for name, parameter in encoder.named_parameters():
        parameter.requires_grad_(not name.startswith(frozen))
    x = frames(steps=10).double().requires_grad_()
    wanted = [x, *(p for p in encoder.parameters() if p.requires_grad)]
    expected = torch.autograd.grad(oracle(encoder, x, "intersection-ln").sum(), wanted)
    found = torch.autograd.grad(encoder(x).sum(), wanted)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-10, rtol=1e-8)


@pytest.mark.parametrize("cell", CELLS)
def test_silent_sites_do_not_blow_up_the_gradient(cell):
    """Most of a clean window is exactly zero; a norm without variance multiplies gradients."""
    torch.manual_seed(1)
    ead = EAD(EADConfig(7, f"zhuang-{cell}", width=1 / 32))  # as initialised: zero biases
    x = torch.zeros(2, STEPS, 30, 5, 7)
    x[..., 2, 3] = frames()[..., 2, 3]
    ead(x)[:, -1].square().sum().backward()
    worst = max(float(p.grad.norm()) for p in ead.parameters() if p.grad is not None)
    assert 0 < worst < 100


def test_bfloat16_is_close_for_every_cell():
    x = frames(steps=8)
    for cell in CELLS:
        ead = build(f"zhuang-{cell}", "none")
        with torch.no_grad():
            exact = ead(x)
            with torch.autocast("cpu", torch.bfloat16):
                rough = ead(x)
        assert (exact - rough.float()).abs().max() < 0.05 * exact.abs().max(), cell
