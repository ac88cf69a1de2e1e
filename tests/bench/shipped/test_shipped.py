"""How the shipped model is remade: its sets can be joined, its weights stay the same in halves."""

from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("torch")
pytest.importorskip("trimesh")

import torch

from bench.shipped.__main__ import RECIPES, _write_weights
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.loop import initialise
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.objects.object_lists import read_list
from tests.helpers.source_tree import ROOT
from tests.helpers.tiny_sweeps import write_tiny_set


def test_everyday_things_are_of_kinds_that_are_known_or_else_to_be_refused() -> None:
    recipe = read_recipe(str(RECIPES / "everyday.toml"))
    real = read_recipe(str(ROOT / "bench/perception/recipes/real27.toml"))
    shapes = read_recipe("poses24")
    known = {*real.objects.categories, *shapes.objects.categories}
    assert set(recipe.objects.categories) <= known
    there = {thing.files[0].category for thing in read_list("everyday")}
    learnt = {*recipe.objects.categories, *recipe.objects.outliers}
    assert learnt <= there
    # what tests whether unknown things are told is learnt from nowhere
    withheld = {*real.objects.withheld, *shapes.objects.withheld}
    assert withheld & there and not withheld & learnt


def test_weights_in_half_precision_are_the_network(tmp_path: Path) -> None:
    write_tiny_set(tmp_path / "set")
    config = TrainingConfig(str(tmp_path / "set"), encoder="gru", width=1 / 8)
    whole = initialise(config, tmp_path / "run")
    half = tmp_path / "half.pt"
    _write_weights([whole, whole], half)
    assert half.stat().st_size < 0.6 * whole.stat().st_size
    (one, saved), (other, told) = load_checkpoint(whole), load_checkpoint(half)
    assert told["categories"] == saved["categories"]
    samples = torch.randn(2, 22, 5, 30, 6) * 1e-4
    rest = torch.zeros(2, 30, 6)
    with torch.inference_mode():
        a, b = one(samples, rest, rest + 1e-6), other(samples, rest, rest + 1e-6)
    assert torch.equal(other.inputs.scale, one.inputs.scale)
    assert torch.allclose(a, b, atol=2e-3) and not torch.equal(a, b)


def test_the_weights_are_the_mean_of_the_networks(tmp_path: Path) -> None:
    write_tiny_set(tmp_path / "set")
    config = TrainingConfig(str(tmp_path / "set"), encoder="gru", width=1 / 8)
    runs = [initialise(replace(config, seed=k), tmp_path / f"run{k}") for k in (0, 1)]
    _write_weights(runs, tmp_path / "mean.pt")
    one, other, mean = (
        torch.load(path, weights_only=True)["model"] for path in (*runs, tmp_path / "mean.pt")
    )
    for name, value in mean.items():
        between = (one[name] + other[name]) / 2 if value.is_floating_point() else one[name]
        assert torch.allclose(value.float(), between.float(), atol=1e-3), name
