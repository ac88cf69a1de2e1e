"""Losses against plain loops, and every network with every objective."""

import math

import numpy as np
import pytest
import torch

from tactile_rt.core.stream.sensor_spec import channel_limits
from tactile_rt.models.augmentation import build
from tactile_rt.models.ead import TactileClassifier
from tactile_rt.models.ead_config import ATTENDERS, ENCODERS, EADConfig
from tactile_rt.models.training.objectives import (
    Autoencoder,
    Predictive,
    SimCLR,
    SimSiam,
    Supervised,
    anytime_loss,
    last_loss,
    nt_xent,
)
from tests.helpers.tiny_sweeps import tiny_array

SPEC = tiny_array()
STEPS = 5
NETWORKS = [name for name in ENCODERS if name != "graph"]


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def loads(n=4, seed=0):
    rng = np.random.default_rng(seed)
    samples = rng.normal(size=(n, STEPS, 5, *SPEC.shape)) * np.array([1e-4] * 3 + [1e-6] * 3)
    offset, sigma = np.zeros((2, n, *SPEC.shape))
    return tuple(torch.from_numpy(a.astype(np.float32)) for a in (samples, offset, sigma))


def classifier(encoder="gru", attender="none", width=1 / 32, **other):
    torch.manual_seed(0)
    config = EADConfig(3, encoder, attender, "linear", width, max_steps=STEPS, **other)
    return TactileClassifier(SPEC, config, channel_limits(SPEC))


def objectives(model):
    plain, tactile = build("none", SPEC), build("tactile", SPEC)
    masked = build("none", SPEC, 0.25)
    return (
        Supervised(model, plain, "anytime", 0.1),
        SimCLR(model, tactile, 0.1),
        SimSiam(model, tactile),
        Autoencoder(model, plain),
        Predictive(model, masked),
    )


@pytest.mark.parametrize("temperature", [0.1, 1.0])
def test_nt_xent_is_that_of_a_plain_loop(temperature):
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, 5, 7))
    views = [v / np.sqrt((v * v).sum()) for v in (*first, *second)]
    total = 0.0
    for i in range(10):
        partner = (i + 5) % 10
        others = [math.exp(views[i] @ views[k] / temperature) for k in range(10) if k != i]
        total -= math.log(math.exp(views[i] @ views[partner] / temperature) / sum(others))
    found = nt_xent(torch.from_numpy(first), torch.from_numpy(second), temperature)
    assert found.item() == pytest.approx(total / 10, rel=1e-5)


def test_supervised_losses_are_those_of_a_plain_loop():
    logits = torch.randn(3, 6, 4, generator=generator(), dtype=torch.float64)
    labels, smoothing = torch.tensor([2, 0, 3]), 0.1

    def entropy(row, label):
        log = row - math.log(sum(math.exp(v) for v in row))
        target = [smoothing / 4 + (1 - smoothing) * (k == label) for k in range(4)]
        return -sum(t * v for t, v in zip(target, log, strict=True))

    each = [[entropy(logits[b, t].numpy(), labels[b]) for t in range(6)] for b in range(3)]
    last = np.mean([row[-1] for row in each])
    known = np.mean([row[2:] for row in each])
    assert float(last_loss(logits, labels, smoothing)) == pytest.approx(last, rel=1e-5)
    anytime = anytime_loss(logits, labels, smoothing, lag=2)
    assert float(anytime) == pytest.approx(0.5 * last + 0.5 * known, rel=1e-5)


def test_simsiam_stops_the_gradient_of_what_is_predicted():
    objective = SimSiam(classifier(), build("none", SPEC))
    a, b = loads(seed=1), loads(seed=2)
    objective.eval()
    loss = objective([a, b], torch.zeros(4), generator())
    frames = [objective.frames(v, generator()) for v in (a, b)]
    z = [objective.projector(objective.embedding(x)) for x in frames]
    p = [objective.predictor(v) for v in z]

    def cosine(u, v):
        return (u * v).sum(1) / (u.norm(dim=1) * v.norm(dim=1))

    expected = -0.5 * (cosine(p[0], z[1].detach()) + cosine(p[1], z[0].detach())).mean()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    weight = objective.projector[0].weight
    (found,) = torch.autograd.grad(loss, weight, retain_graph=True)
    (stopped,) = torch.autograd.grad(expected, weight, retain_graph=True)
    through = -0.5 * (cosine(p[0], z[1]) + cosine(p[1], z[0])).mean()
    (leaking,) = torch.autograd.grad(through, weight)
    torch.testing.assert_close(found, stopped, atol=1e-6, rtol=1e-4)
    assert (leaking - stopped).abs().max() > 1e-2 * stopped.abs().max()


def test_the_autoencoder_rebuilds_each_step_from_its_own_features_sparsely():
    objective = Autoencoder(classifier(), build("none", SPEC)).eval()
    batch = loads()
    frames = objective.model.inputs(*batch)
    latent = objective.model.features(frames)
    steps = [objective.decoder(latent[:, t]) for t in range(STEPS)]
    error = ((torch.stack(steps, 1) - frames) ** 2).mean().item()
    expected = 0.5 * error + 1e-4 * latent.abs().mean().item()
    found = objective([batch], torch.zeros(4), generator())
    assert found.item() == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("encoder", ["gru", "zhuang-vanilla"])
def test_each_step_tells_the_four_after_it_and_has_seen_none_of_them(encoder):
    objective = Predictive(classifier(encoder), build("none", SPEC)).eval()
    batch = loads()
    frames = objective.model.inputs(*batch)
    told = objective.head(objective.model.features(frames)).view(4, STEPS, 4, -1)
    errors = []
    for t in range(objective.model.network.lag, STEPS):
        for ahead in range(1, 5):
            if t + ahead < STEPS:
                come = frames[:, t + ahead].flatten(1)
                errors.append((told[:, t, ahead - 1] - come) ** 2)
    found = objective([batch], torch.zeros(4), generator())
    assert found.item() == pytest.approx(torch.cat(errors).mean().item(), rel=1e-5)
    # What is told at a step is not changed by what comes after it.
    other = frames.clone()
    other[:, 3:] += 1.0
    again = objective.head(objective.model.features(other)).view(4, STEPS, 4, -1)
    torch.testing.assert_close(again[:, :3], told[:, :3])


def test_what_is_masked_is_predicted_all_the_same():
    """Of a network that is told nothing the loss is that of the untouched frames."""
    objective = Predictive(classifier(), build("none", SPEC, 0.8)).eval()
    with torch.no_grad():
        objective.head.weight.zero_()
        objective.head.bias.zero_()
    batch = loads()
    frames = objective.model.inputs(*batch).flatten(2)
    expected = torch.cat([frames[:, n:] for n in range(1, 5)], dim=1).square().mean()
    found = objective([batch], torch.zeros(4), generator())
    assert found.item() == pytest.approx(expected.item(), rel=1e-6)


def test_heads_have_the_published_sizes_at_full_width():
    model = classifier(width=1.0)
    simclr = SimCLR(model, build("none", SPEC), 0.1)
    simsiam = SimSiam(model, build("none", SPEC))

    def sizes(head):
        return [tuple(p.shape) for p in head.parameters() if p.dim() == 2]

    assert sizes(simclr.neck) == [(2048, 512), (128, 2048)]
    assert sizes(simsiam.projector) == [(2048, 512), (2048, 2048), (2048, 2048)]
    assert sizes(simsiam.predictor) == [(512, 2048), (2048, 512)]
    assert len([m for m in simsiam.projector if isinstance(m, torch.nn.BatchNorm1d)]) == 3


@pytest.mark.parametrize("attender", ATTENDERS)
@pytest.mark.parametrize("encoder", NETWORKS)
def test_every_network_is_trained_by_every_objective(encoder, attender):
    model = classifier(encoder, attender)
    labels = torch.tensor([0, 1, 2, 0])
    for objective in objectives(model):
        optimizer = torch.optim.SGD(objective.parameters(), 1e-2)
        before = [p.detach().clone() for p in model.network.encoder.parameters()]
        views = [
            objective.augmentation.loads(loads(), generator(v)) for v in range(objective.views)
        ]
        loss = objective.train()(views, labels, generator())
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        assert loss.isfinite()
        after = list(model.network.encoder.parameters())
        assert all(p.isfinite().all() for p in after)
        assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    with torch.inference_mode():
        logits = model.eval()(*loads())
    assert logits.shape == (4, STEPS, 3)
    assert logits.isfinite().all()
