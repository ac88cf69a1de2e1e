"""Bad data stops with one line before training starts, through the command line."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from tactile_rt.classifier.model_file import load_model
from tactile_rt.sets.manifest import SweepManifest, object_path
from tactile_rt.sets.objects import read_object, write_object
from tests.helpers.tiny_sweeps import write_tiny_set

pytest.importorskip("torch")

from tactile_rt.models.datasets import SweepSet, check_sets


@pytest.fixture
def folder(tmp_path):
    write_tiny_set(tmp_path / "set", objects=3)
    return tmp_path / "set"


@pytest.fixture
def unfit(folder, tmp_path, refused):
    """Train on the set, expect one line and no run, and return the line."""

    def run():
        said = refused("train", folder, tmp_path / "run", "--set", "batch=2", "--encoder", "gru")
        assert not (tmp_path / "run").exists()
        return said

    return run


def rewrite(folder, name, change):
    values, _ = read_object(folder, name)
    object_path(folder, name).unlink()
    write_object(folder, name, change(values), {})


def resplit(folder, **changed):
    path = folder / "manifest.json"
    manifest = SweepManifest.read(folder)
    path.write_bytes(msgspec.json.encode(replace(manifest, **changed)))


@pytest.mark.parametrize("name", ["cube-0", "cone-1"])  # of the training and validation split
def test_values_that_are_no_number(folder, unfit, name):
    def spoil(values):
        values[0, 70, 12, 3] = np.nan
        return values

    rewrite(folder, name, spoil)
    said = unfit()
    assert f"{name}.npz: sweep 0 holds values that are not finite" in said


def test_sweeps_shorter_than_a_window(folder, unfit):
    for name in SweepManifest.read(folder).names():
        rewrite(folder, name, lambda values: values[:, :100])
    assert "sweeps of 100 samples are shorter than a window of 110" in unfit()


def test_a_label_that_is_none(folder, unfit):
    resplit(folder, categories=("ball", "cube"), withheld=("cone",))
    assert "cone-0 of 'train' is of the withheld category 'cone', which has no label" in unfit()
    resplit(folder, categories=("ball", "cube"), withheld=())
    assert "cone-0 has a category that is not listed" in unfit()


@pytest.mark.parametrize(
    ("other", "said"),
    [("test", "in 'train' and in 'test'"), ("validation", "in 'train' and in 'validation'")],
)
def test_an_object_on_two_sides_of_the_split(folder, unfit, other, said):
    split = SweepManifest.read(folder).split
    resplit(folder, split={**split, other: (*split[other], "cube-0")})
    assert f"the object cube-0 is {said}" in unfit()


def test_an_object_on_two_sides_under_two_names(folder, unfit):
    values, _ = read_object(folder, "cube-0")
    rewrite(folder, "cube-1", lambda _: values)
    assert "cube-1 is cube-0 by another name, on another side of the split" in unfit()


def test_sweeps_in_which_nothing_is_felt_are_no_twins_also_in_a_field(folder):
    field = np.full((1, 136, 30, 6), 5e-3, dtype=np.float32)
    for name in ("cube-0", "cube-1", "cone-2"):
        rewrite(folder, name, lambda _: field)
    check_sets(folder, [SweepSet.read(folder, "train"), SweepSet.read(folder, "validation")])


def test_good_data_is_trained_on_and_exported_wherever_it_lies_then(
    folder, tmp_path, call, refused
):
    run, moved, model = tmp_path / "run", tmp_path / "moved", tmp_path / "model.onnx"
    options = f"--encoder gru --set attender=none --set width={1 / 32}".split()
    quick = ("--set", "batch=2", "--set", "updates=1")
    code, _, said = call("train", folder, run, *options, *quick)
    assert not code, said
    folder.rename(moved)
    said = refused("export", run / "best.pt", model)
    assert f"{folder}, a sweep set that {run}/best.pt was trained on, is not here" in said

    # As many categories, in another order: every name that it told would be wrong.
    manifest = SweepManifest.read(moved)
    resplit(moved, categories=manifest.categories[::-1])
    said = refused("export", run / "best.pt", model, "--data", moved)
    assert not model.exists()
    assert "best.pt has other categories than" in said
    assert "(the same in another order): name what it was trained on by --data" in said

    resplit(moved, categories=manifest.categories)
    code, _, said = call("export", run / "best.pt", model, "--data", moved)
    assert not code, said
    assert load_model(model)[1].labels == manifest.categories
