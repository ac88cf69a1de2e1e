"""Sets that are learnt from together, things of no category, networks that begin with another."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tactile_rt.classifier.decision_rules import UNKNOWN
from tactile_rt.classifier.model_file import load_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.sensor_spec import ChannelSpec, SensorSpec
from tactile_rt.models.checkpoints import load_checkpoint
from tactile_rt.models.implausible import IMPLAUSIBLE
from tactile_rt.models.training.loop import train
from tactile_rt.models.training.recipes import read_recipe
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.splits import join_manifests
from tests.helpers.tiny_sweeps import plate, write_tiny_set

SMALL = f"--encoder gru --set attender=none --set decoder=linear --set width={1 / 32}".split()
QUICK = "--set batch=6 --set updates=3".split()
FAULTS = {"implausible": 0.2}


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    """One set with things of no category, and one of other categories that has none to validate."""
    folder = tmp_path_factory.mktemp("sets")
    write_tiny_set(folder / "one", outliers=4, faults=FAULTS, sweeps=2)
    write_tiny_set(folder / "other", categories=("cone", "star"))
    return folder


@pytest.fixture(scope="module")
def run(sets, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "both"
    options = {"encoder": "gru", "attender": "none", "decoder": "linear", "width": 1 / 32}
    config = read_recipe(
        "default", str(sets / "one"), also=(str(sets / "other"),), batch=6, updates=3, **options
    )
    train(config, folder)
    return folder


def test_what_is_told_apart_is_all_categories_and_then_the_refusals(run):
    model, saved = load_checkpoint(run / "best.pt")
    assert saved["categories"] == ["ball", "cube", "cone", "star"]
    assert saved["refusals"] == [UNKNOWN, *IMPLAUSIBLE]
    assert model.network.config.classes == 9
    assert 0 <= saved["metrics"]["validation_top1"] <= 1


def test_the_exported_file_refuses_and_has_prediction_sets(run, tmp_path, call):
    code, _, said = call("export", run / "best.pt", tmp_path / "m.onnx")
    assert not code, said
    _, card = load_model(tmp_path / "m.onnx")
    assert card.classes == ("ball", "cube", "cone", "star")
    assert card.refusals == (UNKNOWN, *IMPLAUSIBLE)
    assert len(card.unknown.thresholds) == 22
    assert card.candidates == (), "five objects are too few for any prediction set"
    assert len(card.provenance["also"]) == 1
    unseen = card.provenance["unseen_objects"]  # of the first set
    assert unseen and not any(name.startswith("star") for name in unseen)
    code, shown, _ = call("model", "show", tmp_path / "m.onnx")
    assert "4: ball, cube, cone, star" in shown and "swapped channels" in shown


def test_a_run_goes_on_with_the_same_sets_only(sets, run, call, refused):
    again = ("train", sets / "one", run, *SMALL, *QUICK)
    assert "another configuration (other also)" in refused(*again)
    code, _, said = call(*again, "--also", sets / "other")
    assert not code, said


def test_sets_of_two_arrays_are_refused(sets, tmp_path, refused):
    write_tiny_set(tmp_path / "robot", spec=plate(1, 4))
    also = ("--also", tmp_path / "robot", *SMALL, *QUICK)
    assert "cannot be joined" in refused("train", sets / "one", tmp_path / "run", *also)
    assert not (tmp_path / "run").exists()


def test_a_network_begins_with_what_another_knew_by_the_same_name(sets, run, tmp_path, call):
    knew, before = load_checkpoint(run / "best.pt")
    # no rate to speak of: the weights stay what they began as
    begun = "--set batch=6 --set updates=1 --set learning_rate=1e-12 --from".split()
    code, _, said = call("train", sets / "other", tmp_path / "next", *begun, run / "best.pt")
    assert not code, said
    model, after = load_checkpoint(tmp_path / "next" / "best.pt")
    assert after["categories"] == ["cone", "star"] and after["refusals"] == []
    old, new = knew.state_dict(), model.state_dict()
    rows = [before["categories"].index(name) for name in ("cone", "star")]
    for name, weight in new.items():
        expected = old[name]
        if name.startswith("network.decoder."):
            expected = expected[rows]
        assert torch.allclose(weight, expected, atol=1e-6), name
    assert after["network"]["width"] == before["network"]["width"], "the network is the other's"


def test_what_cannot_be_begun_with_is_said(sets, run, tmp_path, refused):
    write_tiny_set(tmp_path / "robot", spec=plate(1, 4))
    wide = ("--set", "width=0.0625", *QUICK)
    for data, begin, more, said in (
        (sets / "other", tmp_path / "no.pt", (), "no checkpoint"),
        (sets / "other", run / "best.pt", wide, "it has another width"),
        (tmp_path / "robot", run / "best.pt", (), "training cannot begin with"),
    ):
        assert said in refused("train", data, tmp_path / "a", "--from", begin, *more)


def test_things_of_no_category_are_what_unknown_is_learnt_from(sets, tmp_path, call):
    """After some updates things of none are less likely to be taken for known ones."""
    code, _, said = call("train", sets / "one", tmp_path / "r", *SMALL, "--set", "batch=6",
                         "--set", "updates=150", "--set", "learning_rate=0.01")  # fmt: skip
    assert not code, said
    model, saved = load_checkpoint(tmp_path / "r" / "best.pt")
    at = [*saved["categories"], *saved["refusals"]].index(UNKNOWN)

    def unknown(name):
        with np.load(sets / "one" / f"{name}.npz") as arrays:
            values = torch.from_numpy(arrays["values"][:, 24:134])
        window = values.unflatten(1, (22, 5))
        silent = torch.full((len(values), 30, 6), 1e-9)
        with torch.inference_mode():
            return model(window, 0 * silent, silent)[:, -1].softmax(-1)[:, at].mean()

    assert unknown("thing-0") > 0.5 > unknown("ball-5")


def test_a_network_that_began_with_another_has_met_its_objects(sets, run, tmp_path, call):
    begun = ("--from", run / "best.pt", *QUICK)
    assert not call("train", sets / "one", tmp_path / "next", *begun)[0]
    assert not call("export", tmp_path / "next" / "best.pt", tmp_path / "m.onnx")[0]
    assert "star-0" in load_model(tmp_path / "m.onnx")[1].provenance["trained_objects"][""]


def test_sets_of_two_sensors_are_refused(sets, tmp_path, call):
    sensor = SensorSpec(channels=(ChannelSpec(name="fx", unit="N", range=1.0, resolution=1e-3),))
    manifest = SweepManifest.read(sets / "other")
    replace(manifest, sensor=sensor).write(tmp_path)
    with pytest.raises(ConfigError, match="cannot be joined: the sensor"):
        join_manifests([manifest, SweepManifest.read(tmp_path)])


def test_a_layer_over_categories_is_probed_and_exported_without_refusals(run, tmp_path, call):
    code, _, said = call("probe", run / "best.pt", tmp_path / "probe", "--epochs", 2)
    assert not code, said
    code, _, said = call("export", tmp_path / "probe" / "best.pt", tmp_path / "p.onnx")
    assert not code, said
    card = load_model(tmp_path / "p.onnx")[1]
    assert card.labels == ("ball", "cube", "cone")
    assert "star-0" in card.provenance["trained_objects"][""], "seen when it was trained"
    assert card.provenance["training"]["probe"]["epochs"] == 2


def test_no_set_is_tested_on_that_the_model_was_trained_on(sets, run, tmp_path, call):
    call("export", run / "best.pt", tmp_path / "m.onnx")
    card = load_model(tmp_path / "m.onnx")[1]
    assert "star-0" in card.provenance["trained_objects"][""]
    code, _, said = call("eval", tmp_path / "m.onnx", sets / "other")
    assert not code, said
    spoilt = SweepManifest.read(sets / "other")
    split = {**spoilt.split, "test": spoilt.split["train"], "train": ()}
    folder = tmp_path / "spoilt"
    replace(spoilt, split=split).write(folder)
    for name in split["test"]:
        (folder / f"{name}.npz").write_bytes((sets / "other" / f"{name}.npz").read_bytes())
    code, _, said = call("eval", tmp_path / "m.onnx", folder)
    assert code == 2 and "may have been trained on objects that" in said
