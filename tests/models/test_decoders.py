"""Decoders: old names, and the decoder of all steps adds up as it should."""

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.models import decoders


def features(steps: int = 22) -> Tensor:
    return torch.randn(3, steps, 16, generator=torch.Generator().manual_seed(0))


@pytest.mark.parametrize("name", decoders.KINDS)
@pytest.mark.parametrize("steps", [22, 5])
def test_stream_is_the_window(name, steps):
    torch.manual_seed(1)
    decoder, x = decoders.KINDS[name](16, 7, 1 / 32), features(steps)
    window, state = decoder(x), decoder.initial_state(3)
    for t in range(steps):
        embedding, state = decoder.step(x[:, t], torch.full((3,), t), state)
        torch.testing.assert_close(embedding, decoder.embed(x)[:, t], rtol=0, atol=2e-6)
        torch.testing.assert_close(decoder.logits(embedding), window[:, t], rtol=0, atol=2e-6)


@pytest.mark.parametrize(("name", "last"), [("linear", ""), ("mlp", "4."), ("mlp-all", "layer3.")])
def test_logits_are_one_linear_layer_of_the_embedding(name, last):
    """Its weights taken by the names that checkpoints have."""
    decoder, x = decoders.KINDS[name](16, 7, 1 / 32), features()
    saved = decoder.state_dict()
    embedding = decoder.embed(x)
    assert embedding.shape == (3, 22, 16)
    expected = embedding @ saved[f"{last}weight"].T + saved[f"{last}bias"]
    torch.testing.assert_close(decoder(x), expected, rtol=0, atol=2e-6)


def test_all_steps_is_one_layer_over_the_flattened_window():
    torch.manual_seed(1)
    decoder, x = decoders.KINDS["mlp-all"](16, 7, 1 / 32), features()
    first = nn.Linear(22 * 16, 32)
    with torch.no_grad():
        first.weight.copy_(decoder.weight.permute(1, 0, 2).flatten(1))
        first.bias.copy_(decoder.bias)
    for t in (0, 9, 21):
        known = x * (torch.arange(22)[:, None] <= t)
        hidden = F.relu(decoder.layer2(F.relu(first(known.flatten(1)))))
        torch.testing.assert_close(decoder(x)[:, t], decoder.layer3(hidden), rtol=0, atol=2e-6)


def test_all_steps_ends():
    decoder, x = decoders.KINDS["mlp-all"](16, 7, 1 / 32, steps=4), features(5)
    with pytest.raises(ValueError, match="5 steps, but this decoder ends at 4"):
        decoder(x)
    state = {"decoder_sum": torch.randn(3, 32)}
    _, new = decoder.step(x[:, 4], torch.full((3,), 4), state)
    assert torch.equal(new["decoder_sum"], state["decoder_sum"])
