"""Mamba is its equations, by a loop over every number."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from tactile_rt.models.attenders.mamba import MambaBlock, MambaStack, selective_scan


def build(width: int = 32, seed: int = 1) -> MambaStack:
    """In evaluation mode, every parameter off its initial value."""
    torch.manual_seed(seed)
    attender = MambaStack(width).eval()
    with torch.no_grad():
        for parameter in attender.parameters():
            parameter += 0.1 * torch.randn_like(parameter)
    return attender


def oracle(block: MambaBlock, features: Tensor) -> Tensor:
    """Gu & Dao 2023, section 3.4 and algorithm 2. features (step, width)"""
    inner = block.D.shape[0]
    x_in, z = (features @ block.in_proj.weight.T).split(inner, dim=1)
    a = -torch.exp(block.A_log)
    h = [[0.0] * a.shape[1] for _ in range(inner)]
    out = []
    for t in range(len(features)):
        x = []
        for d in range(inner):
            total = block.conv_bias[d].item()
            for k in range(4):
                if t - k >= 0:
                    total += block.conv_weight[d, 3 - k].item() * x_in[t - k, d].item()
            x.append(total / (1 + math.exp(-total)))
        low, b, c = (block.x_proj.weight @ features.new_tensor(x)).split([block.rank, 16, 16])
        dt = F.softplus(block.dt_proj.weight @ low + block.dt_proj.bias)
        y = []
        for d in range(inner):
            for n in range(a.shape[1]):
                keep = math.exp(dt[d].item() * a[d, n].item())
                h[d][n] = keep * h[d][n] + dt[d].item() * b[n].item() * x[d]
            read = sum(c[n].item() * h[d][n] for n in range(a.shape[1]))
            y.append(read + block.D[d].item() * x[d])
        gated = features.new_tensor(y) * z[t] * torch.sigmoid(z[t])
        out.append(block.out_proj.weight @ gated)
    return torch.stack(out)


def test_block_follows_its_equations():
    block = build(8).double().blocks[0]
    features = torch.randn(1, 7, 8, dtype=torch.float64)
    with torch.no_grad():
        torch.testing.assert_close(
            block(features)[0], oracle(block, features[0]), rtol=1e-9, atol=1e-10
        )


def test_time_scales_at_the_start():
    dt = F.softplus(MambaBlock(64).dt_proj.bias)
    assert dt.min() > 0.9e-3
    assert dt.max() < 0.11


def test_scan_gradient():
    torch.manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, dtype=torch.float64, requires_grad=True)

    inputs = (random(2, 4, 3), random(2, 4, 3), random(3, 5), random(2, 4, 5), random(2, 4, 5))
    assert torch.autograd.gradcheck(selective_scan, inputs)


def test_gradients_are_finite_at_any_time_scale():
    attender = build()
    with torch.no_grad():
        for block in attender.blocks:
            block.dt_proj.bias.uniform_(-30, 30)
    attender(100 * torch.randn(2, 22, 32)).square().mean().backward()
    assert all(torch.isfinite(p.grad).all() for p in attender.parameters())
