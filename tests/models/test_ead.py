"""Every combination is one network: its timing, and a stream that equals a window."""

import itertools

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from tactile_rt.core.errors import ConfigError
from tactile_rt.models import decoders
from tactile_rt.models.ead import EAD
from tactile_rt.models.ead_config import ATTENDERS, DECODERS, ENCODERS, READOUTS, EADConfig
from tests.helpers.small_networks import STEPS, TOLERANCE, build, frames, stream

NAMES = tuple(name for name in ENCODERS if name != "graph")  # which has its own tests
ZHUANG = tuple(name for name in NAMES if name.startswith("zhuang"))
COMBINATIONS = list(itertools.product(NAMES, ATTENDERS))
LEARNERS = list(
    itertools.product(("zhuang-intersection", "zhuang-intersection-ln"), ("gpt", "none"))
)


# Which network


def test_width_scales_every_channel_count():
    with torch.device("meta"):
        full, half = (EAD(EADConfig(117, decoder="mlp", width=width)) for width in (1.0, 0.5))
    fixed = {2, 4, 30, 65, 117}  # kernel, gates, input channels, positions, classes
    for (name, a), b in zip(full.named_parameters(), half.parameters(), strict=True):
        for wide, narrow in zip(a.shape, b.shape, strict=True):
            assert narrow == (wide if wide in fixed else wide // 2), name


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"classes": 0}, "classes"),
        ({"encoder": "zhuang"}, "encoder is 'zhuang', not one of zhuang-timedecay, .* and 12 more"),
        ({"attender": "lstm"}, "attender"),
        ({"width": 0.0}, "width"),
        ({"width": 0.3}, "multiple of 1/32"),
        ({"dropout": 1.0}, "dropout"),
        ({"max_steps": 33}, "max_steps"),
        ({"encoder": "graph"}, "graph must be given"),
        ({"graph": "readout = 'fc'"}, "graph must be given"),
    ],
)
def test_config_refuses(wrong, match):
    with pytest.raises(ConfigError, match=match):
        EADConfig(**{"classes": 7, **wrong})


# Timing


@pytest.mark.parametrize(
    ("encoder", "attender"),
    [*((name, "none") for name in NAMES), (ZHUANG[7], "gpt"), (ZHUANG[7], "mamba")],
)
def test_the_frames_that_can_count(encoder, attender):
    """A frame reaches Zhuang's logits three steps later; all others decide on the last one."""
    ead = build(encoder, attender)
    x = frames(1, 12).requires_grad_()
    (gradient,) = torch.autograd.grad(ead(x)[:, -1].square().sum(), x)
    lag = 3 if encoder in ZHUANG else 0
    assert ead.lag == lag
    counts = [bool(g) for g in gradient.abs().amax(dim=(0, 2, 3, 4)) > 0]
    if encoder == "resnet18":  # without an attender each step stands alone
        assert counts == [False] * 11 + [True]
    else:
        assert counts == [True] * (12 - lag) + [False] * lag


# A stream equals a window


@pytest.mark.parametrize(("encoder", "attender"), COMBINATIONS)
def test_stream_equals_window_for_every_combination(encoder, attender):
    at = COMBINATIONS.index((encoder, attender))
    decoder, readout = DECODERS[at % 3], READOUTS[at // 3 % 2]
    ead = build(encoder, attender, readout, decoder=decoder, max_steps=9)
    x = frames(2, 9)
    with torch.no_grad():
        window, streamed = ead(x), stream(ead, x)
        size = 8 if (encoder, attender) == ("resnet18", "gpt") else 16
        assert ead.features(x).shape == (2, 9, size)
    assert (window[:, 5:] - window[:, 4:-1]).abs().max() > 1e-4  # not trivially equal
    assert (window - streamed).abs().max() <= TOLERANCE


@pytest.mark.parametrize("steps", [1, 2, 3, 4, 5, 32])
def test_any_length(steps):
    ead = build(readout="mean", max_steps=32)
    x = frames(steps=steps)
    with torch.no_grad():
        assert (ead(x) - stream(ead, x)).abs().max() <= TOLERANCE


def test_state_keeps_its_shapes_and_is_not_written_to():
    ead = build(readout="mean")
    state = ead.initial_state(3)
    assert all(tensor.shape[0] == 3 and not tensor.any() for tensor in state.values())
    with torch.no_grad():
        _, new = ead.step(frames(3)[:, 0], state)
    assert list(new) == list(state)
    for name, tensor in state.items():
        assert (new[name].shape, new[name].dtype) == (tensor.shape, tensor.dtype), name
        assert not tensor.any(), name
        assert new[name].any() or name == "logits_sum", name


def test_an_episode_may_overrun():
    """Past the last position a stream goes on, finite; a window is refused."""
    ead = build(max_steps=4)
    x = frames(steps=9)
    with torch.no_grad():
        logits = stream(ead, x)
        assert logits.isfinite().all()
        assert (logits[:, :4] - ead(x[:, :4])).abs().max() <= TOLERANCE
    with pytest.raises(ValueError, match="9 steps; this attender takes at most 4"):
        ead(x)


# Readout and training


def test_mean_readout_averages_from_the_fourth_step():
    last, mean = build(readout="last"), build(readout="mean")
    x = frames()
    with torch.no_grad():
        a, b = last(x), mean(x)
    torch.testing.assert_close(b[:, :3], a[:, :3])
    for t in range(3, STEPS):
        torch.testing.assert_close(b[:, t], a[:, 3 : t + 1].mean(1), atol=TOLERANCE, rtol=1e-5)


@pytest.mark.parametrize(
    ("encoder", "attender"),
    LEARNERS + [(f"zhuang-{c}", "none") for c in ("timedecay", "lstm-ln")],
)
def test_training_reaches_every_parameter_and_learns(encoder, attender):
    ead = build(encoder, attender, dropout=0.0).train()
    optimizer = torch.optim.AdamW(ead.parameters(), 5e-3)
    x, labels = frames(4, steps=9), torch.arange(4)
    losses = []
    for _ in range(25):
        loss = F.cross_entropy(ead(x)[:, -1], labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    idle = [n for n, p in ead.named_parameters() if p.grad is None or not p.grad.any()]
    assert set(idle) <= {"attender.positions"}
    assert losses[-1] < 0.5 * losses[0]


# The step is one static graph


@pytest.mark.parametrize("attender", [pytest.param("gpt", marks=pytest.mark.slow), "none"])
def test_step_traces_for_any_batch(attender):
    ead = build(attender=attender, readout="mean")
    state = ead.initial_state(2)

    class Step(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.ead = ead

        def forward(self, frame, *tensors):
            logits, new = self.ead.step(frame, dict(zip(state, tensors, strict=True)))
            return logits, *new.values()

    lanes = torch.export.Dim("batch", min=1, max=64)
    program = torch.export.export(
        Step().eval(),
        (frames(2)[:, 0], *state.values()),
        dynamic_shapes={"frame": {0: lanes}, "tensors": tuple({0: lanes} for _ in state)},
    )
    # The traced convolution has its own code: follow it until every node has heard the frames.
    eager = ead.initial_state(5)
    traced = list(eager.values())
    with torch.no_grad():
        for frame in frames(5, steps=7).unbind(1):
            logits, *traced = program.module()(frame, *traced)
            expected, eager = ead.step(frame, eager)
    torch.testing.assert_close(logits, expected, atol=TOLERANCE, rtol=1e-5)
    for tensor, (name, value) in zip(traced, eager.items(), strict=True):
        torch.testing.assert_close(tensor, value, atol=1e-5, rtol=1e-5, msg=name)


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
    with pytest.raises(ValueError, match="5 steps; this decoder takes at most 4"):
        decoder(x)
    state = {"decoder_sum": torch.randn(3, 32)}
    _, new = decoder.step(x[:, 4], torch.full((3,), 4), state)
    assert torch.equal(new["decoder_sum"], state["decoder_sum"])
