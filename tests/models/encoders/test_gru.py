"""The GRU baseline steps as its window does."""

from __future__ import annotations

import torch

from tactile_rt.models.encoders.gru import GRUEncoder


def frames(batch: int = 2, steps: int = 22) -> torch.Tensor:
    return torch.randn(batch, steps, 30, 5, 7, generator=torch.Generator().manual_seed(0))


def test_count():
    with torch.device("meta"):
        assert sum(p.numel() for p in GRUEncoder().parameters()) == 3_978_240


def test_every_frame_counts_and_none_before_its_time():
    encoder, x = GRUEncoder(1 / 16), frames(1, 6).requires_grad_()
    (gradient,) = torch.autograd.grad(encoder(x)[:, 3].sum(), x)
    reached = gradient[0].flatten(1).abs().amax(1)
    assert (reached[:4] > 0).all()
    assert (reached[4:] == 0).all()


def test_gradients_are_finite():
    encoder = GRUEncoder(1 / 16)
    encoder(1000 * frames()).square().mean().backward()
    assert all(torch.isfinite(p.grad).all() for p in encoder.parameters())
