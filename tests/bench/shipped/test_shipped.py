"""How the shipped model is remade: its sets can be joined, its weights stay the same in halves."""

from pathlib import Path

import torch

from bench.perception.make import SHAPES
from bench.shipped.__main__ import UPRIGHT, _write_weights
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.training.config import TrainingConfig
from tactile_rt.models.training.loop import initialise
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe
from tactile_rt.sim_backend.objects.object_lists import read_list
from tests.helpers.tiny_sweeps import write_tiny_set


def test_generated_things_are_of_the_shapes_of_real_ones_and_fold_alike() -> None:
    upright, posed = read_recipe(str(UPRIGHT)), read_recipe("shapes24")
    real = {thing.files[0].category for thing in read_list(SHAPES)}
    assert set(upright.objects.classes) == set(posed.objects.classes) <= real
    assert upright.objects.categories == posed.objects.categories
    assert not set(upright.objects.withheld) & set(upright.objects.categories)


def test_weights_in_half_precision_are_the_network(tmp_path: Path) -> None:
    write_tiny_set(tmp_path / "set")
    config = TrainingConfig(str(tmp_path / "set"), encoder="gru", width=1 / 8)
    whole = initialise(config, tmp_path / "run")
    half = tmp_path / "half.pt"
    _write_weights(whole, half)
    assert half.stat().st_size < 0.6 * whole.stat().st_size
    (one, saved), (other, told) = load_checkpoint(whole), load_checkpoint(half)
    assert told["categories"] == saved["categories"]
    samples = torch.randn(2, 22, 5, 30, 6) * 1e-4
    rest = torch.zeros(2, 30, 6)
    with torch.inference_mode():
        a, b = one(samples, rest, rest + 1e-6), other(samples, rest, rest + 1e-6)
    assert torch.equal(other.inputs.scale, one.inputs.scale)
    assert torch.allclose(a, b, atol=2e-3) and not torch.equal(a, b)
