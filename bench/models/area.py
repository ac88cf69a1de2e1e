"""Benchmark area `models`: the shipped model on unseen objects, and the speed of training."""

import tempfile
from dataclasses import replace
from pathlib import Path

import msgspec

from bench.models.training_speed import training_speed
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.models.evaluation.model_file import evaluate_model
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sets.manifest import WITHHELD
from tactile_rt.sim_backend.datasets.dataset import describe_set, make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import recipe_of_set
from tactile_rt.sim_backend.datasets.recipes import SweepRecipe

QUICK_DRAWS = 4  # sweeps of an object: as many as the most that are fused


def run(quick: bool) -> list[Record]:
    """Sweep test objects of the shipped model afresh and classify them; time training steps.

    Quick: four sweeps of one object of each category, enough to see a broken model but not to
    quote; the full run makes the very test set that the model's card names.
    """
    _, card = load_model(shipped_model())
    recipe = recipe_of_set(card.provenance["sweep_set"])
    if quick:
        recipe = _few(recipe)
    splits = [s for s in ("test", WITHHELD) if describe_set(recipe).split.get(s)]
    with tempfile.TemporaryDirectory() as folder:
        for _ in make_sweeps(recipe, Path(folder), splits=splits):
            pass
        accuracy = evaluate_model(shipped_model(), Path(folder))
    return [*accuracy, *training_speed(quick)]


def _few(recipe: SweepRecipe) -> SweepRecipe:
    """The last test object of every category, and one of each that training never saw."""
    per_withheld = min(1, recipe.objects.per_withheld)
    return replace(
        recipe,
        objects=msgspec.structs.replace(recipe.objects, test=1, per_withheld=per_withheld),
        sweeps=replace(recipe.sweeps, draws=QUICK_DRAWS),
    )
