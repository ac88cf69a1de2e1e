"""S4 is its equations, by dense matrices in double precision."""

import math

import pytest
import torch
from torch import Tensor

from tactile_rt.models.encoders.s4 import S4Block, hippo_legs, kernels

TOLERANCE = 2e-6


def dense(block: S4Block) -> tuple[Tensor, Tensor, Tensor]:
    """A (channel, N, N), B and C (channel, N) of a block, complex128, both of each pair."""

    def both(x: Tensor) -> Tensor:
        x = x.detach().double()
        half = torch.complex(x[:, 0], x[:, 1])
        return torch.cat([half, half.conj()], 1)

    eigenvalues = both(torch.stack([-block.log_decay.double().exp(), block.frequency.double()], 1))
    p = both(block.P)
    a = torch.diag_embed(eigenvalues) - p[:, :, None] * p[:, None, :].conj()
    return a, both(block.B), both(block.C)


def kernel_oracle(block: S4Block, steps: int) -> Tensor:
    """Gu et al. 2022, equations 3 and 4, by inverting dense matrices. (channel, step)"""
    a, b, c = dense(block)
    dt = block.log_dt.detach().double().exp()[:, None, None]
    eye = torch.eye(a.shape[1], dtype=a.dtype)
    inverse = torch.linalg.inv(eye - dt / 2 * a)
    a_bar, x = inverse @ (eye + dt / 2 * a), (inverse * dt) @ b[:, :, None]
    taps = []
    for _ in range(steps):
        y = (c[:, None, :] @ x)[:, 0, 0]
        assert y.imag.abs().max() < 1e-9 * y.real.abs().max()
        taps.append(y.real)
        x = a_bar @ x
    out = torch.stack(taps, 1)
    out[:, 0] += block.D.detach().double()
    return out


def disturb(block: S4Block) -> S4Block:
    """As training would: every state space parameter moves."""
    with torch.no_grad():
        for parameter in (block.log_dt, block.log_decay, block.frequency, block.P, block.B):
            parameter += 0.1 * torch.randn_like(parameter) * (1 + parameter.abs())
    return block


def test_hippo_legs_is_similar_to_its_matrix():
    """Λ - P P* is HiPPO's matrix in other coordinates: y of e^(At) B under a shared C agrees."""
    eigenvalues, p, b = hippo_legs(64)
    full = torch.cat([eigenvalues, eigenvalues.conj()])
    p, b = torch.cat([p, p.conj()]), torch.cat([b, b.conj()])
    ours = torch.diag(full) - p[:, None] * p[None, :].conj()
    n = torch.arange(64, dtype=torch.float64)
    a = torch.zeros(64, 64, dtype=torch.float64)
    for i in range(64):
        for k in range(i + 1):
            a[i, k] = -(i + 1) if i == k else -math.sqrt((2 * i + 1) * (2 * k + 1))
    # Coordinates do not show in the Markov parameters B* A^k B of a unitary change.
    x, y = (2 * n + 1).sqrt(), b
    for _ in range(4):
        expected = ((2 * n + 1).sqrt() @ x).item()
        found = torch.vdot(b, y)
        assert found.real.item() == pytest.approx(expected, rel=1e-9)
        x, y = a @ x, ours @ y


@pytest.mark.parametrize("moved", [False, True])
def test_kernel_is_the_dense_recurrence(moved):
    torch.manual_seed(3)
    block = S4Block(16)
    if moved:
        disturb(block)
    expected = kernel_oracle(block, 22)
    error = (kernels([block], 22)[0].double() - expected).abs().max()
    assert error < 3e-6 * expected.abs().max()
    exact = kernels([block.double()], 22)[0]
    torch.testing.assert_close(exact, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("log_dt", [-12.0, 3.0])
def test_kernel_and_gradient_stay_finite_at_any_step_size(log_dt):
    block = disturb(S4Block(8))
    with torch.no_grad():
        block.log_dt.fill_(log_dt)
    kernel = kernels([block], 22)[0]
    kernel.square().sum().backward()
    assert torch.isfinite(kernel).all()
    assert all(torch.isfinite(p.grad).all() for p in (block.log_dt, block.P, block.C, block.B))


def test_convolution_is_a_sum_over_the_past():
    block, x = disturb(S4Block(8)).eval(), torch.randn(2, 9, 8)
    kernel = kernels([block], 5)[0]
    past = torch.zeros_like(x)
    for t in range(9):
        for k in range(min(t + 1, 5)):
            past[:, t] += kernel[:, k] * x[:, t - k]
    torch.testing.assert_close(block(x, kernel), block.merge(x, past), rtol=0, atol=TOLERANCE)


def test_state_space_parameters_tell_the_optimizer():
    block = S4Block(8)
    told = {name for name, p in block.named_parameters() if hasattr(p, "_optim")}
    assert told == {"log_dt", "log_decay", "frequency", "P", "B"}
    assert block.log_dt._optim["weight_decay"] == 0.0
