"""What models are called where several stand in one table."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.alignment.loading import check_models, name_apart, read_responses
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.models.grid.outcomes import POINT
from tests.helpers.source_tree import ROOT

CHECKPOINT = ROOT / "bench" / "shipped" / "mouse13.pt"


@pytest.fixture
def run(tmp_path):
    """A function (folder) -> the best.pt of a training run in that folder."""

    def made(folder):
        path = tmp_path / folder / "best.pt"
        path.parent.mkdir(parents=True)
        shutil.copy(CHECKPOINT, path)
        return path

    return made


def test_a_run_is_called_by_its_folder(run, monkeypatch, tmp_path):
    assert check_models([run("runs/mine"), run("others/yours")]) == ("mine", "yours")
    monkeypatch.chdir(tmp_path / "runs" / "mine")
    assert check_models([Path("best.pt")]) == ("mine",)


def test_runs_of_a_grid_are_told_apart_by_the_folders_above(run):
    folders = ["gru_seed0/rate0.005", "gru_seed1/rate0.005", "s4_seed0/rate0.015"]
    assert check_models([run(f"runs/{folder}") for folder in folders]) == tuple(folders)


def test_a_run_of_a_grid_is_called_by_its_task(run):
    paths = [run("runs/gru_seed0/rate0.005"), run("runs/s4_seed0/rate0.015")]
    for path in paths:
        (path.parent / POINT).write_text("{}")
    assert check_models(paths) == ("gru_seed0", "s4_seed0")
    assert check_models([*paths, run("mine")]) == ("gru_seed0", "s4_seed0", "mine")
    other = run("runs/gru_seed0/rate0.5")
    (other.parent / POINT).write_text("{}")
    assert check_models([other, *paths])[:2] == ("gru_seed0/rate0.5", "gru_seed0/rate0.005")


def test_a_file_says_its_own_name(run, tmp_path):
    np.savez(tmp_path / "brain.npz", hidden=np.ones((6, 3)))
    paths = [shipped_model(), CHECKPOINT, run("mouse13"), tmp_path / "brain.npz"]
    assert check_models(paths) == (
        "mouse13", "mouse13 (mouse13.pt)", "mouse13 (best.pt)", "brain"
    )  # fmt: skip


def test_one_run_named_twice_is_one_run(run):
    path = run("runs/mine")
    assert check_models([path, path]) == ("mine", "mine (best.pt)")
    assert check_models([path] * 3)[2] == "mine (best.pt, 2)"


def test_files_of_one_name_are_told_apart_by_the_folders_above(tmp_path):
    paths = [tmp_path / folder / "model.npz" for folder in ("a", "b/x", "c/x", "d")]
    for path in paths:
        path.parent.mkdir(parents=True)
        np.savez(path, hidden=np.ones((6, 3)))
    assert check_models(paths) == (
        "model", "model (x/model.npz)", "model (c/x/model.npz)", "model (d/model.npz)"
    )  # fmt: skip


def test_no_name_that_is_made_is_one_that_is_there():
    paths = [Path(f"/runs/{name}") for name in ("a.onnx", "b.onnx", "c.onnx", "b.onnx")]
    assert name_apart(["m (b.onnx)", "m", "m", "m"], paths) == (
        "m (b.onnx)", "m", "m (c.onnx)", "m (b.onnx, 2)"
    )  # fmt: skip


RNG = np.random.default_rng(0)


def test_a_layer_is_of_the_encoder_unless_its_name_says_so(tmp_path):
    arrays = {"stem": RNG.normal(size=(6, 4)), "decoder.fc1": RNG.normal(size=(6, 22, 3))}
    np.savez(tmp_path / "a.npz", **arrays)
    traces = read_responses(tmp_path / "a.npz").traces
    assert {name: trace.shape for name, trace in traces.items()} == {
        "encoder.stem": (6, 1, 4),
        "decoder.fc1": (6, 22, 3),
    }


@pytest.mark.parametrize("names", [("stem", "encoder.stem"), ("encoder.stem", "stem")])
def test_no_layer_takes_the_place_of_another(tmp_path, names):
    np.savez(tmp_path / "a.npz", **{name: RNG.normal(size=(6, 4)) for name in names})
    with pytest.raises(ConfigError, match=r"arrays stem and encoder\.stem are the same layer"):
        read_responses(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"x": np.full((6, 4), 1e300)}, r"array x .* is no layer: finite"),
        ({"a": np.zeros((5, 3))}, "array a .* is no layer"),
        ({"a": np.full((6, 3), np.nan)}, "array a .* is no layer"),
        ({"a": np.array([None] * 6)}, "no archive of arrays"),
        ({}, "has no array"),
    ],
)
def test_what_is_no_layer_is_refused(tmp_path, arrays, said):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(ConfigError, match=said):
        read_responses(tmp_path / "a.npz")


def test_what_is_no_archive_is_refused(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK nonsense")
    with pytest.raises(ConfigError, match="no archive of arrays"):
        read_responses(tmp_path / "a.npz")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_responses(tmp_path / "none.npz")
