"""The network is the paper's: counts, equations, edges and timing; and a stream equals a window."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor
from torch.nn import functional as F

from tactile_rt.models.attenders import GPT
from tactile_rt.models.ead import EAD, EADConfig, count_parameters
from tactile_rt.models.encoders.cells import NORM_EPSILON
from tactile_rt.models.encoders.zhuang import GRAPH, ZhuangEncoder
from tactile_rt.stream import ConfigError

STEPS = 22
TOLERANCE = 2e-6
VARIANTS = list(
    itertools.product(
        ("zhuang-intersection", "zhuang-intersection-ln"), ("gpt", "none"), ("last", "mean")
    )
)

EDGES = "1->2; 3,4->2; 2->3; 4,5->3; 3->4; 5,6->4; 4->5; 6->5; 5->6; 2,4,6->fc7"


@pytest.fixture(autouse=True)
def _one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def build(
    encoder="zhuang-intersection-ln", attender="gpt", readout="last", width=1 / 32, **more
) -> EAD:
    """A small network in evaluation mode whose every parameter matters (no zero biases)."""
    torch.manual_seed(1)
    ead = EAD(EADConfig(7, encoder, attender, width=width, readout=readout, **more)).eval()
    with torch.no_grad():
        for parameter in ead.parameters():
            if parameter.dim() == 1 or parameter.shape[0] == 4:
                parameter += 0.1 * torch.randn_like(parameter)
    return ead


def frames(batch=2, steps=STEPS, seed=0) -> Tensor:
    return torch.randn(batch, steps, 30, 5, 7, generator=torch.Generator().manual_seed(seed))


def stream(ead: EAD, x: Tensor) -> Tensor:
    state = ead.initial_state(len(x))
    logits = []
    for t in range(x.shape[1]):
        out, state = ead.step(x[:, t], state)
        logits.append(out)
    return torch.stack(logits, 1)


# Which network


@pytest.mark.parametrize(
    ("config", "count"),
    [
        (EADConfig(117), 63_767_509),
        (EADConfig(117, attender="none", decoder="mlp"), 39_038_933),
        (EADConfig(117, attender="none"), 37_988_821),
    ],
)
def test_published_totals(config, count):
    with torch.device("meta"):
        assert count_parameters(EAD(config)) == count


def test_published_parts():
    with torch.device("meta"):
        assert count_parameters(ZhuangEncoder(cell="intersection-ln")) == 37_928_800
        assert count_parameters(ZhuangEncoder(cell="intersection")) == 37_916_768
        assert count_parameters(GPT(512, 0.1, 22)) == 25_778_688


def test_width_scales_every_channel_count():
    with torch.device("meta"):
        full, half = (
            EAD(EADConfig(117, decoder="mlp")),
            EAD(EADConfig(117, decoder="mlp", width=0.5)),
        )
    fixed = {2, 4, 30, 65, 117}  # kernel, gates, input channels, positions, classes
    for (name, a), b in zip(full.named_parameters(), half.parameters(), strict=True):
        for wide, narrow in zip(a.shape, b.shape, strict=True):
            assert narrow == (wide if wide in fixed else wide // 2), name


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"classes": 0}, "classes"),
        ({"encoder": "zhuang"}, "encoder is 'zhuang'.*zhuang-intersection-ln"),
        ({"attender": "lstm"}, "attender"),
        ({"decoder": ""}, "decoder"),
        ({"readout": "first"}, "readout"),
        ({"width": 0.0}, "width"),
        ({"width": -1.0}, "width"),
        ({"width": 0.3}, "multiple of 1/32"),
        ({"dropout": 1.0}, "dropout"),
        ({"max_steps": 33}, "max_steps"),
        ({"max_steps": 0}, "max_steps"),
    ],
)
def test_config_refuses(wrong, match):
    with pytest.raises(ConfigError, match=match):
        EADConfig(**{"classes": 7, **wrong})


# The encoder against the paper's equations, written with convolutions


def kernel(weight: Tensor) -> Tensor:
    """(out, 2, 2, in) -> (out, in, 2, 2)"""
    return weight.permute(0, 3, 1, 2)


def same(x: Tensor, weight: Tensor, bias: Tensor | None = None) -> Tensor:
    return F.conv2d(F.pad(x, (0, 1, 0, 1)), kernel(weight), bias)


def oracle(encoder: ZhuangEncoder, x: Tensor, layer_norm: bool) -> Tensor:
    reads = {2: (1, 3, 4), 3: (2, 4, 5), 4: (3, 5, 6), 5: (4, 6), 6: (5,)}
    h = {n: x.new_zeros(len(x), encoder.channels[f"conv{n}"], 4, 6) for n in range(1, 7)}
    s = dict(h)
    fc7 = x.new_zeros(len(x), encoder.fc7.out_features)
    features = []
    for t in range(x.shape[1]):
        flat = torch.cat([h[2], h[4], h[6]], 1).permute(0, 2, 3, 1).flatten(1)
        features.append(F.relu(encoder.fc8(fc7)))
        fc7 = F.relu(encoder.fc7(flat))
        new = {}
        for n in range(1, 7):
            conv, cell = encoder.convs[f"conv{n}"], encoder.cells[f"conv{n}"]
            if n == 1:
                c = F.conv2d(x[:, t], kernel(conv.weight), conv.bias)
            else:
                c = same(torch.cat([h[k] for k in reads[n]], 1), conv.weight, conv.bias)
            both = kernel(cell.conv.weight)
            gates = F.conv2d(F.pad(torch.cat([c, s[n]], 1), (0, 1, 0, 1)), both, cell.conv.bias)
            gates = list(gates.chunk(4, 1))
            if layer_norm:
                for i, g in enumerate(gates):
                    g = (g - g.mean(1, keepdim=True)) / (
                        g.var(1, unbiased=False, keepdim=True) + NORM_EPSILON
                    ).sqrt()
                    gates[i] = g * cell.gamma[i][:, None, None] + cell.beta[i][:, None, None]
            m, n_ = torch.tanh(gates[0]), F.relu(gates[1])
            p, y = torch.sigmoid(gates[2] + 1), torch.sigmoid(gates[3] + 1)
            s[n] = p * s[n] + (1 - p) * m
            new[n] = F.relu(y * c + (1 - y) * n_)
        h = new
    return torch.stack(features, 1)


@pytest.mark.parametrize("layer_norm", [True, False])
def test_encoder_follows_the_equations(layer_norm):
    ead = build("zhuang-intersection-ln" if layer_norm else "zhuang-intersection")
    x = frames(steps=12)
    with torch.no_grad():
        expected = oracle(ead.encoder, x, layer_norm)
        torch.testing.assert_close(ead.encoder(x), expected, atol=TOLERANCE, rtol=1e-5)
    assert expected.std() > 0.01


@pytest.mark.parametrize("frozen", ["", "convs", "cells"])
def test_gradients_are_those_of_the_equations(frozen):
    """The hand-written gradient of the convolution, in double precision, through time."""
    encoder = build().encoder.double()
    for name, parameter in encoder.named_parameters():
        parameter.requires_grad_(not (frozen and name.startswith(frozen)))
    x = frames(steps=10).double().requires_grad_()
    wanted = [x, *(p for p in encoder.parameters() if p.requires_grad)]
    weights = frames(2, 10, seed=3)[..., 0, 0].double()[..., : encoder.features]
    expected = torch.autograd.grad((oracle(encoder, x, True) * weights).sum(), wanted)
    found = torch.autograd.grad((encoder(x) * weights).sum(), wanted)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, atol=1e-10, rtol=1e-8)
    assert all(b.any() for b in expected)


def test_silent_sites_do_not_blow_up_the_gradient():
    """Most of a clean window is exactly zero; a norm without variance multiplies gradients."""
    torch.manual_seed(1)
    ead = EAD(EADConfig(7, width=1 / 32))  # as initialised: zero biases
    x = torch.zeros(2, STEPS, 30, 5, 7)
    x[..., 2, 3] = frames()[..., 2, 3]
    ead(x)[:, -1].square().sum().backward()
    worst = max(float(p.grad.norm()) for p in ead.parameters() if p.grad is not None)
    assert 0 < worst < 100


def test_edges():
    """Each node listens to its predecessors, to its own state, and to nothing else."""
    expected = {("fc8", "fc7_h"), *((f"conv{n}", f"conv{n}_s") for n in range(1, 7))}
    for edge in EDGES.split(";"):
        sources, target = edge.strip().split("->")
        target = target if target == "fc7" else f"conv{target}"
        expected |= {(target, f"conv{source}_h") for source in sources.split(",")}
    encoder = build().encoder
    state = {k: torch.rand_like(v).requires_grad_() for k, v in encoder.initial_state(1).items()}
    features, new = encoder.step(frames(1)[:, 0], state)
    outputs = {"fc8": features, "fc7": new["fc7_h"], **{n: new[f"{n}_h"] for n in GRAPH}}
    found = set()
    for target, output in outputs.items():
        gradients = torch.autograd.grad(
            output.square().sum(), list(state.values()), retain_graph=True, allow_unused=True
        )
        for source, gradient in zip(state, gradients, strict=True):
            if gradient is not None and gradient.abs().sum() > 0:
                found.add((target, source))
    assert found == expected


@pytest.mark.parametrize("attender", ["gpt", "none"])
def test_the_last_three_frames_cannot_count(attender):
    """Unrolling lag: a frame reaches the logits three steps later; nothing flushes the graph."""
    ead = build(attender=attender)
    x = frames(1).requires_grad_()
    (gradient,) = torch.autograd.grad(ead(x)[:, -1].square().sum(), x)
    assert [bool(g) for g in gradient.abs().amax(dim=(0, 2, 3, 4)) > 0] == [True] * 19 + [False] * 3


# A stream equals a window


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize(("encoder", "attender", "readout"), VARIANTS)
def test_stream_equals_window(encoder, attender, readout, batch):
    ead = build(encoder, attender, readout, decoder="mlp" if batch == 3 else "linear")
    x = frames(batch)
    with torch.no_grad():
        window, streamed = ead(x), stream(ead, x)
    assert window.shape == (batch, STEPS, 7)
    assert (window[:, 5:] - window[:, 4:-1]).abs().max() > 1e-3  # not trivially equal
    assert (window - streamed).abs().max() <= TOLERANCE


@pytest.mark.parametrize("steps", [1, 2, 3, 4, 5, 32])
def test_any_length(steps):
    ead = build(readout="mean", max_steps=32)
    x = frames(steps=steps)
    with torch.no_grad():
        assert (ead(x) - stream(ead, x)).abs().max() <= TOLERANCE


@pytest.mark.parametrize(("encoder", "attender", "readout"), VARIANTS)
def test_causal(encoder, attender, readout):
    ead = build(encoder, attender, readout)
    x = frames()
    y = x.clone()
    y[:, 9:] = frames(seed=5)[:, 9:]
    with torch.no_grad():
        a, b = ead(x), ead(y)
    assert (a[:, :12] - b[:, :12]).abs().max() <= TOLERANCE  # frame 9 first counts at step 12
    assert (a[:, 12:] - b[:, 12:]).abs().amax(dim=(0, 2)).min() > 1e-5


def test_reset_equals_a_fresh_start():
    ead = build(readout="mean")
    x = frames()
    with torch.no_grad():
        _, used = ead.step(x[:, 0], ead.initial_state(2))
        for t in range(1, 9):
            _, used = ead.step(x[:, t], used)
        fresh = ead.initial_state(2)
        # What a runtime does for one lane of several: put that lane's initial state back.
        lane = {name: torch.stack([fresh[name][0], used[name][1]]) for name in fresh}
        out, _ = ead.step(x[:, 9], lane)
        first, _ = ead.step(x[:, 9], fresh)
        later, _ = ead.step(x[:, 9], used)
    assert (out[0] - first[0]).abs().max() <= TOLERANCE
    assert (out[1] - later[1]).abs().max() <= TOLERANCE
    assert (first - later).abs().amax(dim=1).min() > 1e-4


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
    with pytest.raises(ValueError, match=r"9 steps.* 4"):
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


@pytest.mark.parametrize(("encoder", "attender"), [v[:2] for v in VARIANTS[::2]])
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


def test_bfloat16_training_agrees():
    ead = build(attender="none")
    x = frames()
    with torch.no_grad():
        exact = ead(x)
        with torch.autocast("cpu", torch.bfloat16):
            rough = ead(x)
    assert (exact - rough.float()).abs().max() < 0.05 * exact.abs().max()


# The step is one static graph


@pytest.mark.parametrize("attender", ["gpt", "none"])
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
