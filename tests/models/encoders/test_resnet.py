"""ResNet18 is the published one: counts and convolutions; and a stream is the window."""

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models.ead import count_parameters
from tactile_rt.models.encoders.resnet import ConvNorm, ResidualBlock, ResNet18Encoder

TOLERANCE = 2e-6


def build(width: float = 1 / 16) -> ResNet18Encoder:
    """A small network in evaluation mode whose norms are not the identity."""
    torch.manual_seed(1)
    encoder = ResNet18Encoder(width)
    for module in encoder.modules():
        if isinstance(module, nn.BatchNorm1d):
            nn.init.uniform_(module.weight, 0.5, 1.5)
            nn.init.normal_(module.bias, std=0.1)
            nn.init.normal_(module.running_mean, std=0.1)
            nn.init.uniform_(module.running_var, 0.5, 1.5)
    return encoder.eval()


def frames(batch: int = 3, steps: int = 4) -> Tensor:
    return torch.randn(batch, steps, 30, 5, 7, generator=torch.Generator().manual_seed(0))


def oracle(encoder: ResNet18Encoder, x: Tensor) -> Tensor:
    """He et al. 2016, table 1, with convolutions on padded maps. x (frame, 30, 5, 7)"""

    def layer(conv: ConvNorm, x: Tensor, stride: int) -> Tensor:
        norm, padding = conv.norm, conv.weight.shape[-1] // 2
        x = F.conv2d(x, conv.weight, stride=stride, padding=padding)
        known = (None, None) if norm.training else (norm.running_mean, norm.running_var)
        return F.batch_norm(x, *known, norm.weight, norm.bias, norm.training)

    x = F.max_pool2d(F.relu(layer(encoder.stem, x, 2)), 3, 2, 1)
    for i, block in enumerate(encoder.blocks):
        assert isinstance(block, ResidualBlock)
        stride = 2 if i in (2, 4, 6) else 1
        short = x if block.shortcut is None else layer(block.shortcut, x, stride)
        x = F.relu(short + layer(block.second, F.relu(layer(block.first, x, stride)), 1))
    return encoder.fc(x.mean((2, 3)))


@pytest.mark.parametrize("training", [False, True])
def test_convolutions(training):
    encoder, x = build().train(training).double(), frames().double()
    expected = oracle(encoder, x.flatten(0, 1)).unflatten(0, x.shape[:2])
    torch.testing.assert_close(encoder(x), expected, rtol=1e-9, atol=1e-10)


def test_gradients_are_those_of_the_convolutions():
    encoder, x = build(), frames()
    parameters = list(encoder.parameters())
    ours = torch.autograd.grad(encoder(x).square().sum(), parameters)
    theirs = torch.autograd.grad(oracle(encoder, x.flatten(0, 1)).square().sum(), parameters)
    for a, b in zip(ours, theirs, strict=True):
        assert torch.isfinite(a).all()
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5 * b.abs().max().item())


def test_deployed_gives_the_same():
    encoder, x = build(), frames()
    folded = encoder.fold_weights()
    torch.testing.assert_close(folded(x), encoder(x), rtol=0, atol=TOLERANCE)
    out, _ = folded.step(x[:, 0], torch.zeros(len(x), dtype=torch.int64), {})
    torch.testing.assert_close(out, encoder(x)[:, 0], rtol=0, atol=TOLERANCE)
    assert (folded.features, folded.lag) == (encoder.features, encoder.lag)
    assert not any(p.requires_grad for p in folded.parameters())


def test_deployed_is_small():
    assert count_parameters(ResNet18Encoder().fold_weights()) < 3_000_000
