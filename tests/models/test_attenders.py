"""Attenders keep the old names, the paper's counts, and stream as they see a window."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from tactile_rt.models.attenders import GPT, MambaAttender, NoAttender

TOLERANCE = 2e-6
MAKERS = {
    "gpt": lambda: GPT(32, 0.1, 22),
    "gpt-narrow": lambda: GPT(16, 0.1, 22, inputs=32),
    "mamba": lambda: MambaAttender(32),
    "none": NoAttender,
}


def count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


def build(name: str) -> nn.Module:
    torch.manual_seed(1)
    return MAKERS[name]().eval()


def features(steps: int = 22) -> Tensor:
    return torch.randn(2, steps, 32, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("name", MAKERS)
def test_stream_is_the_window(name):
    attender, x = build(name), features()
    window, state = attender(x), attender.initial_state(2)
    assert window.shape == (2, 22, getattr(attender, "features", 32))
    for t in range(x.shape[1]):
        out, new = attender.step(x[:, t], torch.full((2,), t), state)
        assert new.keys() == state.keys()
        assert all(new[k].shape == state[k].shape for k in new)
        torch.testing.assert_close(out, window[:, t], rtol=0, atol=TOLERANCE)
        state = new


@pytest.mark.parametrize("name", ["gpt", "gpt-narrow", "mamba"])
def test_past_steps_count_and_gradients_are_finite(name):
    attender, x = build(name).train(), features(6).requires_grad_()
    attender(x)[:, 5].square().sum().backward()
    assert (x.grad[:, 0] != 0).any()
    assert all(torch.isfinite(p.grad).all() for p in attender.parameters())


def test_gpt_refuses_a_window_past_its_positions():
    with pytest.raises(ValueError, match="5 steps, but this attender ends at 4"):
        GPT(32, 0.1, 4)(features(5))
