"""`bench models` needs nothing that it does not make, and takes no object from training."""

import pytest

from bench.models import area
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sim_backend.datasets.dataset import describe_set


@pytest.mark.parametrize("quick", [True, False])
def test_it_makes_what_it_evaluates(quick, monkeypatch):
    card, seen = load_model(shipped_model())[1], {}

    def make_sweeps(recipe, folder, splits):
        seen["folder"], seen["set"], seen["splits"] = folder, describe_set(recipe), splits
        return iter(())

    def evaluate_model(model, folder):
        assert (model, folder) == (shipped_model(), seen["folder"])
        return [Record("models.accuracy", 1.0, "")]

    monkeypatch.setattr(area, "make_sweeps", make_sweeps)
    monkeypatch.setattr(area, "evaluate_model", evaluate_model)
    monkeypatch.setattr(area, "training_speed", lambda quick: [Record("models.step", 1.0, "")])
    assert [r.name for r in area.run(quick)] == ["models.accuracy", "models.step"]
    assert seen["splits"] == ["test", "withheld"]
    made = seen["set"]
    assert set(made.categories) <= set(card.classes)
    unseen = set(card.provenance["unseen_objects"])
    assert set(made.split["test"]) <= unseen
    sizes = len(made.split["test"]), len(made.split["withheld"])
    assert sizes == ((24, 4) if quick else (288, 192))
    if not quick:
        assert set(made.split["test"]) == unseen


@pytest.mark.slow
def test_from_nothing_to_every_barred_figure():
    records = {r.name: r for r in area.run(quick=True)}
    barred = [name for name, r in records.items() if r.bar]
    assert barred == ["models.calibration error", "models.step.parity"]
    assert records["models.top-1"].value > 20  # in any pose; a broken model guesses: 2 %
    assert records["models.step.parity"].met
