"""Training: optimizers and schedules against their definitions, runs that are killed or shared."""

import csv
import hashlib
import json
import math
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from tactile_rt.core.errors import ConfigError, ModelError
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.datasets import SweepSet, read_splits
from tactile_rt.models.evaluation.measures import hits, predict, run_on
from tactile_rt.models.training.batches import TrainingBatches, prefetch_items
from tactile_rt.models.training.config import ProbeConfig, TrainingConfig
from tactile_rt.models.training.loop import initialise, train
from tactile_rt.models.training.objectives import build_objective
from tactile_rt.models.training.probing import linear_probe, probe
from tactile_rt.models.training.recipes import read_recipe
from tactile_rt.models.training.updates import (
    LARS,
    build_optimizer,
    build_schedule,
    capture_loss,
    parameter_groups,
)
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import write_object
from tests.helpers.tiny_sweeps import SAMPLES, write_tiny_set

SMALL = {"encoder": "gru", "decoder": "linear", "width": 1 / 32, "batch": 6}
CHILD = Path(__file__).parent / "train_child.py"


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """12 training, 3 validation sweeps of three categories."""
    folder = tmp_path_factory.mktemp("data") / "set"
    write_tiny_set(folder)
    return str(folder)


def weights(path):
    return torch.load(path, weights_only=True)["model"]


def equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


def history(run):
    with (run / "history.csv").open() as file:
        return list(csv.DictReader(file))


# Configuration


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"objective": "contrast"}, "objective is 'contrast', not one of supervised"),
        ({"learning_rate": math.nan}, "learning_rate must be positive"),
        ({"updates": -1}, "updates must be 0 or more"),
        ({"masking": 1.0}, r"masking must be in \[0, 1\)"),
        ({"objective": "simclr", "batch": 1}, "batch must be 2 or more"),
        ({"objective": "simclr", "pairs": "three"}, "pairs is 'three', not one of one-sweep, two"),
        ({"objective": "simclr", "temperature": 0.0}, "temperature must be positive"),
        ({"objective": "predictive", "pairs": "two-sweeps"}, "pairs needs objective simclr"),
    ],
)
def test_what_cannot_be_is_refused(changed, said):
    with pytest.raises(ConfigError, match=said):
        TrainingConfig("set", **changed)


# Optimizers


def test_a_parameter_may_ask_for_its_own_rate():
    model = nn.Sequential(nn.Linear(3, 2), nn.Linear(2, 2))
    model[0].weight._optim = {"lr_scale": 0.1, "weight_decay": 0.0}
    model[1].bias.requires_grad_(False)
    groups = parameter_groups(model, 0.5, 1e-4)
    found = {(g["lr"], g["weight_decay"]): [tuple(p.shape) for p in g["params"]] for g in groups}
    assert found == {(0.05, 0.0): [(2, 3)], (0.5, 1e-4): [(2,), (2, 2)]}
    config = TrainingConfig("set", optimizer="adamw", learning_rate=0.5, schedule="one-cycle")
    optimizer = build_optimizer(model, config)
    schedule = build_schedule(optimizer, config, 10)
    peak = np.zeros(2)
    for _ in range(10):
        peak = np.maximum(peak, [g["lr"] for g in optimizer.param_groups])
        optimizer.step()
        schedule.step()
    np.testing.assert_allclose(sorted(peak), [0.05, 0.5], rtol=0.2)


@pytest.mark.parametrize("published", [False, True])
def test_lars_is_a_plain_loop(published):
    rng = np.random.default_rng(0)
    start = [rng.normal(size=(3, 2)), np.zeros((2, 2)), rng.normal(size=3)]
    gradients = [[rng.normal(size=w.shape) for w in start] for _ in range(4)]
    parameters = [nn.Parameter(torch.from_numpy(w.copy())) for w in start]
    optimizer = LARS(parameters, 0.3, 0.9, 0.1, published)
    for step in gradients:
        for p, g in zip(parameters, step, strict=True):
            p.grad = torch.from_numpy(g)
        optimizer.step()
    for k, w in enumerate(start):
        velocity = np.zeros_like(w)
        for step in gradients:
            g, size = step[k], np.sqrt((w**2).sum())
            if published or w.ndim > 1:
                trust = 1e-3 * size / (np.sqrt((g**2).sum()) + 0.1 * size)
                rate = trust if size > 0 or published else 1.0
                change = rate * 0.3 * (g + 0.1 * w)
            else:
                change = 0.3 * g
            velocity = 0.9 * velocity + change
            w = w - velocity
        np.testing.assert_allclose(parameters[k].detach().numpy(), w, atol=1e-12)
    assert bool(parameters[1].any()) != published  # began at zero


def test_norms_that_are_stacked_are_no_layers_to_lars():
    """Their rows move by the plain rate; or, as published, each by one of its own."""
    start, slope = torch.tensor([[3.0, 4.0], [0.3, 0.4]]), torch.tensor([[1.0, 0.0], [0.0, 1.0]])
    trusts = {False: torch.ones(2, 1), True: 1e-3 * torch.tensor([[5.0], [0.5]])}
    for published, trust in trusts.items():
        parameter = nn.Parameter(start.clone())
        parameter.grad = slope
        LARS([{"params": [parameter], "stacked": True}], 0.1, published=published).step()
        torch.testing.assert_close(parameter.detach(), start - 0.1 * trust * slope)


def test_what_asks_for_its_own_rate_may_be_overruled():
    model = nn.Sequential(nn.Linear(3, 2))
    model[0].weight._optim = {"lr_scale": 0.1, "weight_decay": 0.0}
    (group,) = parameter_groups(model, 0.5, 1e-4, own_rates=False)
    assert (group["lr"], group["weight_decay"], len(group["params"])) == (0.5, 1e-4, 2)


# Schedules


def rates(updates, *epoch, **config):
    settings = TrainingConfig("set", optimizer="sgd", learning_rate=1.0, **config)
    optimizer = build_optimizer(nn.Linear(1, 1), settings)
    schedule, found = build_schedule(optimizer, settings, updates, *epoch), []
    for _ in range(updates):
        found.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule.step()
    return np.array(found)


def test_step_is_step_lr_every_30_of_100_epochs():
    optimizer = torch.optim.SGD(nn.Linear(1, 1).parameters(), 1.0)
    schedule, expected = torch.optim.lr_scheduler.StepLR(optimizer, 30), []
    for _ in range(100):
        expected += [schedule.get_last_lr()[0]] * 7  # updates an epoch
        optimizer.step()
        schedule.step()
    np.testing.assert_allclose(rates(700, schedule="step"), expected)


def test_cosine_rises_for_ten_epochs_and_falls_to_nothing():
    found = rates(1000, schedule="cosine", warmup=0.1)
    assert found[0] < 0.011
    assert (np.diff(found[:100]) > 0).all()
    np.testing.assert_allclose(found[100], 1)
    np.testing.assert_allclose(found[550], 0.5)
    assert (np.diff(found[100:]) < 0).all()
    assert found[-1] < 1e-5


def test_cosine_annealing_comes_after_its_warm_up():
    found = rates(1000, schedule="cosine-annealing", warmup=0.1)
    np.testing.assert_allclose(found[:101], np.linspace(1e-4, 1, 101), rtol=1e-12)
    np.testing.assert_allclose(found[100:], 0.5 * (1 + np.cos(np.pi * np.arange(900) / 900)))
    cosine = 0.5 * (1 + np.cos(np.pi * np.arange(1000) / 1000))
    np.testing.assert_allclose(rates(1000, schedule="cosine-annealing", warmup=0.0), cosine)


@pytest.mark.parametrize(
    "schedule", ["step", "constant", "cosine", "cosine-annealing", "one-cycle"]
)
@pytest.mark.parametrize("updates", [1, 2, 3, 10, 11])
def test_a_schedule_may_be_as_short_as_one_wants(schedule, updates):
    found = rates(updates, schedule=schedule, warmup=0.1)
    assert np.isfinite(found).all()
    assert (found > 0).any()


def test_rates_may_change_by_epoch():
    for schedule in ("step", "cosine", "cosine-annealing"):
        found = rates(57, 4, schedule=schedule, warmup=0.1, rate_per="epoch")
        epochs = [set(found[k : k + 4]) for k in range(0, 57, 4)]  # the last is short
        assert all(len(each) == 1 for each in epochs)
        assert len(set.union(*epochs)) > (3 if schedule == "step" else 13)
    with pytest.raises(ConfigError, match="one-cycle changes the rate per update"):
        TrainingConfig("set", rate_per="epoch")


def test_first_weights_are_drawn_as_published(tiny):
    config = read_recipe("paper-gated-ln", tiny, width=0.125)
    network = build_objective(config, read_splits(config.folders, True)[0]).model.network
    encoder = network.encoder
    for name, bias in (("convs.conv3", 0.0), ("cells.conv3.conv", None), ("dense.fc7", 0.1)):
        part = encoder.get_submodule(name)
        bound = part.weight[0].numel() ** -0.5
        spread = float(part.weight.detach().std())
        assert part.weight.abs().max() <= bound
        assert spread == pytest.approx(bound / 3**0.5, rel=0.05)
        if bias is None:
            assert 0 < part.bias.abs().max() <= bound
        else:
            assert (part.bias == bias).all()
    assert {cell.epsilon for cell in encoder.cells.values()} == {1e-5}


# Batches


def test_batches_come_in_order_and_what_goes_wrong_comes_too(no_thread_left):
    def draw():
        yield from range(5)
        raise ConfigError("no more")

    found = []
    with pytest.raises(ConfigError, match="no more"):
        for item in prefetch_items(draw):
            found.append(item)
    assert found == list(range(5))


def test_only_so_many_batches_are_drawn_ahead(no_thread_left):
    drawn = []

    def draw():
        for k in range(100):
            drawn.append(k)
            yield k

    batches = prefetch_items(draw, ahead=2)
    assert next(batches) == 0
    batches.close()
    assert len(drawn) <= 5


# Runs


@pytest.mark.parametrize(
    ("objective", "augmentation"),
    [
        ("supervised", "tactile"),
        ("supervised", "image"),
        ("simclr", "image"),
        ("simsiam", "tactile"),
        ("autoencoder", "tactile"),
        ("predictive", "image"),
    ],
)
def test_a_run_of_every_objective_can_be_repeated(tiny, tmp_path, objective, augmentation):
    config = TrainingConfig(
        tiny, **SMALL, objective=objective, augmentation=augmentation, masking=0.25, updates=3
    )
    seen = []
    best = train(config, tmp_path / "a", seen.append)
    train(config, tmp_path / "b")
    assert equal(weights(tmp_path / "a" / "last.pt"), weights(tmp_path / "b" / "last.pt"))
    assert [p.update for p in seen if not p.metrics] == [1, 2, 3]  # of two an epoch
    assert [p.metrics["epoch"] for p in seen if p.metrics] == [1, 2]
    assert all(0 <= p.metrics["waiting"] <= 1 for p in seen if p.metrics)
    model, saved = load_checkpoint(best)
    assert saved["config"]["objective"] == objective
    assert predict(SweepSet.read(Path(tiny), "test"), run_on(model)).shape == (3, 22, 3)
    again = []
    train(config, tmp_path / "a", again.append)
    assert not again, "a finished run is finished"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.filterwarnings("default:The AccumulateGrad node's stream does not match:UserWarning")
@pytest.mark.parametrize("encoder", ["zhuang-intersection-ln", "gru", "mamba", "resnet18"])
@pytest.mark.parametrize("objective", ["supervised", "simclr", "simsiam", "autoencoder"])
def test_an_update_is_replayed_on_a_gpu_with_the_gradients_of_its_kernels(
    tiny, encoder, objective, monkeypatch
):
    for backend in (torch.backends.cuda.matmul, torch.backends.cudnn):
        monkeypatch.setattr(backend, "allow_tf32", False)
    config = TrainingConfig(
        tiny, encoder=encoder, width=1 / 32, objective=objective, augmentation="tactile",
        dropout=0.0, precision="fp32",
    )  # fmt: skip
    training, _ = read_splits(config.folders, True)
    learning = build_objective(config, training).cuda().train()
    batches = TrainingBatches(training, 6, 0, device="cuda")
    views = [loads for *loads, labels in [next(batches.epoch(0, v)) for v in (0, 1)]]
    draws = torch.Generator("cuda").manual_seed(0)
    seen, labels = learning.see(views[: learning.views], draws), torch.arange(6).cuda() % 3
    with torch.no_grad():
        for module in learning.modules():  # what is drawn in the network is another draw
            if hasattr(module, "p"):
                module.p = 0.0
    before = {name: buffer.clone() for name, buffer in learning.named_buffers()}
    loss_of = capture_loss(learning, seen, labels, bf16=False)
    assert loss_of is not None
    assert all(torch.equal(b, before[name]) for name, b in learning.named_buffers())
    losses, gradients = [], []
    for loss in (learning.loss(seen, labels), loss_of(*seen, labels)):
        learning.zero_grad()
        loss.backward()
        losses.append(loss.item())
        gradients.append([p.grad.clone() for p in learning.parameters() if p.grad is not None])
    assert losses[1] == pytest.approx(losses[0], rel=1e-4)
    for one, other in zip(*gradients, strict=True):
        assert torch.allclose(one, other, rtol=1e-3, atol=1e-5)


def test_an_update_that_is_no_graph_is_told_and_leaves_the_objective(tiny, monkeypatch, caplog):
    training, _ = read_splits([Path(tiny)], True)
    learning = build_objective(TrainingConfig(tiny, encoder="resnet18", width=1 / 32), training)
    *loads, labels = next(TrainingBatches(training, 6, 0).epoch(0))
    seen = learning.see([loads], torch.Generator())
    before = {name: buffer.clone() for name, buffer in learning.named_buffers()}

    def tried(loss, tensors, **_):
        loss(*tensors)  # batch norm's means move
        raise RuntimeError("operation not permitted when stream is capturing\nCompile with ...")

    monkeypatch.setattr(torch.cuda, "make_graphed_callables", tried)
    assert capture_loss(learning, seen, labels, bf16=False) is None
    (said,) = caplog.messages
    assert "(operation not permitted when stream is capturing)" in said
    assert all(torch.equal(b, before[name]) for name, b in learning.named_buffers())


def test_a_contrast_is_of_two_sweeps_of_an_object(tmp_path):
    """Trained and validated with; what has one sweep of each object is refused in a line."""
    for sweeps, name in ((2, "two"), (1, "one")):
        write_tiny_set(tmp_path / name, sweeps=sweeps)
    runs = []
    for pairs, temperature in (("two-sweeps", 0.1), ("one-sweep", 0.1), ("two-sweeps", 1.0)):
        config = TrainingConfig(
            str(tmp_path / "two"), **SMALL, objective="simclr", augmentation="image", pairs=pairs,
            temperature=temperature, updates=2,
        )  # fmt: skip
        seen = []
        train(config, tmp_path / f"{pairs}-{temperature}", seen.append)
        runs.append([p.metrics["validation_loss"] for p in seen if p.metrics])
    assert np.isfinite(runs).all()
    assert runs[0] != runs[1], "pairs are of two sweeps"
    assert runs[0] != runs[2], "at the temperature that is told"
    config = replace(config, data=str(tmp_path / "one"), pairs="two-sweeps")
    with pytest.raises(ConfigError, match="no object has two sweeps"):
        train(config, tmp_path / "refused")


def test_training_learns(tiny, tmp_path):
    config = TrainingConfig(tiny, **SMALL, updates=50, learning_rate=2e-2)
    lines = []
    best = train(config, tmp_path / "run", lambda p: lines.append(p.metrics) if p.metrics else None)
    assert lines[-1]["loss"] < 0.6 * lines[0]["loss"]
    found = history(tmp_path / "run")
    assert [int(line["epoch"]) for line in found] == list(range(1, 26))
    scores = [float(h["validation_top1"]) + float(h["validation_top1_noisy"]) for h in found]
    model, saved = load_checkpoint(best)
    kept = saved["metrics"]
    assert kept["validation_top1"] + kept["validation_top1_noisy"] == max(scores)
    test = SweepSet.read(Path(tiny), "test")
    assert hits(predict(test, run_on(model))[:, -1], test.sweeps.labels).mean() > 0.6


@pytest.mark.parametrize("updates", [1, 6])
def test_a_run_that_diverges_says_so(tiny, tmp_path, updates):
    """By its gradients, or after its last update by what the network answers."""
    config = TrainingConfig(
        tiny, **SMALL, optimizer="sgd", schedule="constant", learning_rate=9e37, updates=updates
    )
    with pytest.raises(ModelError, match="training diverged in epoch"):
        train(config, tmp_path / "run")


def test_the_initialised_network_is_what_training_begins_with(tiny, tmp_path):
    config = TrainingConfig(tiny, **SMALL, objective="simclr", updates=1, seed=5)
    at_rest = TrainingConfig(
        tiny, **SMALL, objective="simclr", updates=1, seed=5, learning_rate=1e-30, weight_decay=0
    )
    begun = weights(initialise(config, tmp_path / "a"))
    still = weights(train(at_rest, tmp_path / "b"))
    assert equal(begun, still)
    assert not equal(begun, weights(train(config, tmp_path / "c")))


# The probe


def test_the_probe_is_logistic_regression():
    """Two far clouds of tiny features: they are told apart only if they are standardised."""
    rng = np.random.default_rng(0)
    labels = torch.from_numpy(rng.integers(0, 2, 400))
    features = torch.from_numpy(rng.normal(size=(400, 5)) * 1e-3).float()
    features[:, 2] += 4e-3 * labels + 7
    part = features[:300], labels[:300], features[300:], labels[300:], 2
    layer, history = linear_probe(*part, ProbeConfig(epochs=20))
    right = (layer(features[300:]).argmax(1) == labels[300:]).float().mean().item()
    assert right > 0.95
    assert right == pytest.approx(max(line["validation_top1"] for line in history), abs=0.02)
    _, plain = linear_probe(*part, ProbeConfig(epochs=20, standardise=False))
    assert plain[-1]["validation_top1"] < 0.8


def test_a_probed_network_is_a_classifier_of_the_frozen_features(tiny, tmp_path):
    config = TrainingConfig(tiny, **SMALL, objective="simclr", augmentation="tactile", updates=4)
    trained = train(config, tmp_path / "run")
    probed = probe(trained, tmp_path / "probe", ProbeConfig(epochs=30))
    before, after = weights(trained), weights(probed)
    frozen = [name for name in before if not name.startswith("network.decoder.")]
    assert all(torch.equal(before[name], after[name]) for name in frozen)
    model, saved = load_checkpoint(probed)
    assert (saved["network"]["decoder"], saved["network"]["readout"]) == ("linear", "last")
    train_set = SweepSet.read(Path(tiny), "train")
    found = hits(predict(train_set, run_on(model))[:, -1], train_set.sweeps.labels).mean()
    assert found > 0.6
    assert saved["metrics"]["validation_top1"] >= 0


def test_a_probe_of_few_sweeps_does_without_the_silent_ones(tmp_path):
    write_tiny_set(tmp_path / "set")
    name = SweepManifest.read(tmp_path / "set").split["train"][0]
    (tmp_path / "set" / f"{name}.npz").unlink()
    write_object(tmp_path / "set", name, np.zeros((1, SAMPLES, 30, 6), np.float32), {})
    config = TrainingConfig(str(tmp_path / "set"), **SMALL)
    best = probe(initialise(config, tmp_path / "run"), tmp_path / "probe", ProbeConfig(epochs=2))
    assert load_checkpoint(best)[1]["metrics"]["epoch"] == 2


# Killed and shared: in processes of their own


def child(tiny, folder, *arguments, torchrun=0):
    command = [str(CHILD), tiny, str(folder), *arguments]
    runner = ["-m", "torch.distributed.run", "--nproc-per-node", str(torchrun), "--standalone"]
    done = subprocess.run(
        [sys.executable, *(runner if torchrun else []), *command],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert not (torchrun and done.stderr), "several processes say no more than one"
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]


def test_a_killed_run_ends_as_one_that_was_not(tiny, tmp_path):
    """kill -9 in an epoch's middle, with the best network saved but not the run, and at the end."""
    (found,) = child(tiny, tmp_path / "killed", "killed")
    assert found["deaths"] == [-9] * 4
    config = TrainingConfig(tiny, **SMALL, epochs=4, dropout=0.2, attender="gpt")
    train(config, tmp_path / "whole")
    for name in ("last.pt", "best.pt"):
        assert equal(weights(tmp_path / "killed" / name), weights(tmp_path / "whole" / name))
    killed, whole = (history(tmp_path / run) for run in ("killed", "whole"))
    for line in (*killed, *whole):
        line.pop("seconds")
    assert killed == whole


@pytest.mark.slow
@pytest.mark.parametrize("objective", ["supervised", "simclr"])
def test_two_devices_train_as_one(tiny, tmp_path, objective):
    ranks = child(tiny, tmp_path / "two", objective, torchrun=2)
    assert [r["devices"] for r in ranks] == [2, 2]
    assert ranks[0]["digest"] == ranks[1]["digest"]
    whole = {**SMALL, "objective": objective, "dropout": 0.0, "updates": 3, "precision": "fp32"}
    train(TrainingConfig(tiny, **whole), tmp_path / "one")
    one, two = weights(tmp_path / "one" / "last.pt"), weights(tmp_path / "two" / "last.pt")
    numbers = b"".join(t.numpy().tobytes() for t in two.values())
    assert hashlib.sha256(numbers).hexdigest() == ranks[0]["digest"]
    losses = [[float(line["loss"]) for line in history(tmp_path / run)] for run in ("one", "two")]
    if objective == "supervised":  # batch norm sees half of the batch in the other
        assert losses[1] == pytest.approx(losses[0], abs=1e-4), "of both shares"
        for name in one:
            torch.testing.assert_close(one[name], two[name], atol=2e-5, rtol=1e-3)
