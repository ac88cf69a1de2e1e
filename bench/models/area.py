"""Benchmark area `models`: the shipped model on unseen objects, and the speed of training."""

import tempfile
from dataclasses import replace
from pathlib import Path

from bench.models.training_speed import training_speed
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.evidence.classification import evaluate_model
from tactile_rt.evidence.records import Record
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import recipe_of_set

__all__ = ["run"]


def run(quick: bool) -> list[Record]:
    """Sweep test objects of the shipped model afresh and classify them; time training steps.

    Quick: one sweep of each object, enough to see a broken model but not to quote; the full run
    makes the very test set that the model's card names.
    """
    _, card = load_model(shipped_model())
    recipe = recipe_of_set(card.provenance["sweep_set"], card.labels)
    if quick:
        recipe = replace(recipe, sweeps=replace(recipe.sweeps, draws=1))
    with tempfile.TemporaryDirectory() as folder:
        for _ in make_sweeps(recipe, Path(folder), splits=("test",)):
            pass
        accuracy = evaluate_model(shipped_model(), Path(folder))
    return [*accuracy, *training_speed(quick)]
