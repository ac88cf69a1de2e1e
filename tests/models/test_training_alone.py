"""Runs that cannot lie: one process a folder, a full disk, what a checkpoint says of itself."""

import os
import pickle
import resource
import subprocess
import zipfile
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import torch

from tactile_rt.core.errors import ConfigError, ModelError
from tactile_rt.models.checkpoints import describe_checkpoint, load_checkpoint, read_network_options
from tactile_rt.models.ead_config import CELLS
from tactile_rt.models.encoders import cells
from tactile_rt.models.grid.plan import read_grid
from tactile_rt.models.grid.pool import run_grid
from tactile_rt.models.training import loop
from tactile_rt.models.training.config import DivergedError, ProbeConfig, TrainingConfig
from tactile_rt.models.training.loop import Validation, train
from tactile_rt.models.training.probing import probe
from tests.helpers.holding import held_elsewhere
from tests.helpers.tiny_sweeps import write_tiny_set

SMALL = {"encoder": "gru", "decoder": "linear", "width": 1 / 32, "batch": 6}
OPTIONS = f"--encoder gru --set decoder=linear --set width={1 / 32} --set batch=6".split()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """12 training, 3 validation sweeps of three categories."""
    folder = tmp_path_factory.mktemp("data") / "set"
    write_tiny_set(folder)
    return str(folder)


@pytest.fixture(scope="module")
def trained(tiny, tmp_path_factory):
    """The folder of a run that is done."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    train(TrainingConfig(tiny, **SMALL, objective="simclr", updates=1), folder)
    return folder


# One process a folder


def test_a_second_training_in_a_folder_is_refused(tiny, refused, tmp_path):
    folder = tmp_path / "run"
    with held_elsewhere(folder) as pid:
        said = refused("train", tiny, folder, *OPTIONS, "--set", "updates=1")
        assert f"folder {folder} is in use by process {pid}: wait" in said
        assert not folder.exists()


def test_of_processes_that_train_together_the_first_has_the_folder(tiny, tmp_path, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "8")  # too many for the batch, which comes after the lock
    config = TrainingConfig(tiny, **SMALL)
    with held_elsewhere(tmp_path / "run"):
        for rank, said in (("0", "in use by process"), ("1", "too small to be shared by 8")):
            monkeypatch.setenv("RANK", rank)
            with pytest.raises(ConfigError, match=said):
                train(config, tmp_path / "run")


def test_a_second_probe_and_a_second_grid_in_a_folder_are_refused(tiny, trained, refused, tmp_path):
    (tmp_path / "grid.toml").write_text(f'data = "{tiny}"\n[[cell]]\nencoder = "gru"\n')
    with held_elsewhere(tmp_path / "out") as pid:
        said = refused("probe", trained / "best.pt", tmp_path / "out")
        assert f"is in use by process {pid}" in said
        with pytest.raises(ConfigError, match=f"is in use by process {pid}"):
            run_grid(read_grid(tmp_path / "grid.toml"), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_probe_never_takes_the_place_of_what_it_probes(trained, refused, tmp_path):
    before = (trained / "best.pt").read_bytes()
    same = tmp_path / "same"
    same.symlink_to(trained)
    for folder in (trained, same):
        assert f"{folder} holds a training run" in refused("probe", trained / "best.pt", folder)
    lone = tmp_path / "lone"  # a checkpoint that was copied, without its run
    lone.mkdir()
    (lone / "best.pt").write_bytes(before)
    assert f"{lone} holds" in refused("probe", lone / "best.pt", lone)
    assert before == (trained / "best.pt").read_bytes() == (lone / "best.pt").read_bytes()
    assert not (trained / "history.csv").read_text().count("validation_top1")


def test_the_probe_s_steps_are_chosen_by_the_command(trained, call, refused, tmp_path):
    said = refused("probe", trained / "best.pt", tmp_path / "p", "--set", "readout=all")
    assert "readout is 'all', not one of last, mean" in said
    found = {}
    for readout in ("last", "mean"):
        options = ("--epochs", 3, "--set", f"readout={readout}")
        assert call("probe", trained / "best.pt", tmp_path / readout, *options)[0] == 0
        config = ProbeConfig(epochs=3, readout=readout)
        again = probe(trained / "best.pt", tmp_path / "again", config)
        found[readout] = load_checkpoint(tmp_path / readout / "best.pt")[1]
        assert found[readout]["network"]["readout"] == readout
        weight = found[readout]["model"]["network.decoder.weight"]
        assert torch.equal(weight, load_checkpoint(again)[1]["model"]["network.decoder.weight"])
    assert found["last"]["metrics"] != found["mean"]["metrics"]


# A full disk


@pytest.fixture(params=["a limit of a file's size", "a file system of its own"])
def disk(request, tmp_path):
    """A folder, and how to leave it so many bytes while a block runs."""
    if request.param.startswith("a limit"):
        yield tmp_path, _limited
        return
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=8m", "tmpfs", str(folder)]
    with suppress(OSError):
        if subprocess.run(mount, capture_output=True).returncode == 0:
            try:
                yield folder, lambda left: _filled(folder, left)
            finally:
                subprocess.run(["umount", "-l", str(folder)], check=True)
            return
    pytest.skip("only root mounts")


@contextmanager
def _limited(left):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (left, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def _filled(folder, left):
    space = os.statvfs(folder)
    ballast = folder / "ballast"
    ballast.write_bytes(bytes(max(space.f_bavail * space.f_frsize - left, 0)))
    try:
        yield
    finally:
        ballast.unlink()


@pytest.mark.parametrize("left", [12_288, 65_536])
def test_a_full_disk_leaves_the_checkpoints_as_they_were(tiny, disk, refused, call, left):
    place, full = disk
    folder = place / "run"
    config = TrainingConfig(tiny, **SMALL, epochs=3)

    def stop(at):
        if at.metrics and at.epoch == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, folder, stop)
    kept = {name: (folder / name).read_bytes() for name in ("last.pt", "config.json")}
    command = ("train", tiny, folder, *OPTIONS, "--epochs", 3)
    with full(left):
        said = refused(*command)
    assert f"cannot use {folder}/" in said
    assert "No space left on device" in said or "File too large" in said
    assert not list(folder.rglob("*.partial"))
    assert {name: (folder / name).read_bytes() for name in kept} == kept
    load_checkpoint(folder / "best.pt")
    assert call(*command)[0] == 0
    train(config, place / "whole")
    ends = [torch.load(place / run / "last.pt")["model"] for run in ("run", "whole")]
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


# What a checkpoint says of itself


def test_a_checkpoint_is_described_as_torch_reads_it(trained):
    def plain(value):
        if isinstance(value, dict):
            return {key: plain(one) for key, one in value.items()}
        return None if isinstance(value, torch.Tensor) else value

    saved = torch.load(trained / "best.pt", weights_only=True)
    assert describe_checkpoint(trained / "best.pt") == plain(saved)
    assert read_network_options(trained / "best.pt")["encoder"] == "gru"
    assert saved["period_ns"] == 9_000_000  # of which the array of weights says nothing


class _Command:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def test_what_is_no_checkpoint_is_refused_by_one_wording(trained, tmp_path):
    whole = (trained / "best.pt").read_bytes()
    files = {
        "empty": b"",
        "text": b"junk\n",
        "end": whole[: len(whole) // 2],
        "middle": whole[: len(whole) // 3] + whole[len(whole) // 2 :],
        "last.pt": (trained / "last.pt").read_bytes(),
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("a.txt", "a")
    pickled = {"list": [1, 2], "command": _Command(tmp_path / "touched"), "cut": None}
    for name, content in pickled.items():
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            data = pickle.dumps(content)
            archive.writestr("archive/data.pkl", data[: -1 if name == "cut" else None])
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    for path in sorted(tmp_path.iterdir()):
        wordings = set()
        for read in (describe_checkpoint, read_network_options, load_checkpoint):
            with pytest.raises(ModelError) as refusal:
                read(path)
            wordings.add(str(refusal.value))
        (said,) = wordings
        assert said.startswith(f"{path} is not a checkpoint of `tactile-rt train`: ")
        assert "\n" not in said
    assert not (tmp_path / "touched").exists(), "nothing in it is obeyed"
    with pytest.raises(ModelError, match=f"no checkpoint {tmp_path / 'none'}"):
        describe_checkpoint(tmp_path / "none")


def test_cells_have_the_names_that_are_known_without_torch():
    assert tuple(cells.CELLS) == CELLS


# What a run goes on from


@pytest.mark.parametrize(
    ("file", "change", "said"),
    [
        ("config.json", None, "config.json is missing, so that this run cannot be identified"),
        ("best.pt", None, r"no checkpoint .*: delete .*last.pt to begin the run anew"),
        ("best.pt", lambda b: b[:900], r"is not a checkpoint .*: delete .*last.pt to begin"),
        ("history.csv", lambda b: b"\xff\xfe", "history.csv is damaged: delete it to go on"),
        ("history.csv", lambda b: b"".join(b.splitlines(True)[:-1]), "history.csv is damaged"),
    ],
)
def test_a_run_that_has_lost_something_says_so(tiny, tmp_path, file, change, said):
    config = TrainingConfig(tiny, **SMALL, updates=4)
    train(config, tmp_path / "run")
    path = tmp_path / "run" / file
    whole = path.read_bytes()
    if change is None:
        path.unlink()
    else:
        path.write_bytes(change(whole))
    with pytest.raises((ConfigError, ModelError), match=said):
        train(config, tmp_path / "run")
    path.write_bytes(whole)
    train(config, tmp_path / "run")


def test_a_run_without_its_history_goes_on(tiny, tmp_path):
    config = TrainingConfig(tiny, **SMALL, epochs=2)

    def stop(progress):
        if progress.metrics:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "run", stop)
    history = tmp_path / "run" / "history.csv"
    history.unlink()
    train(config, tmp_path / "run")
    assert [line.split(",")[0] for line in history.read_text().splitlines()] == ["epoch", "2"]
    train(config, tmp_path / "run")


def test_a_set_may_be_called_by_another_path(tiny, tmp_path, monkeypatch):
    train(TrainingConfig(tiny, **SMALL, updates=1), tmp_path / "run")
    monkeypatch.chdir(Path(tiny).parent)
    train(TrainingConfig("set", **SMALL, updates=1), tmp_path / "run")
    (tmp_path / "link").symlink_to(tiny)
    train(TrainingConfig(str(tmp_path / "link"), **SMALL, updates=1), tmp_path / "run")
    with pytest.raises(ConfigError, match="other batch"):
        train(TrainingConfig(tiny, **{**SMALL, "batch": 4}, updates=1), tmp_path / "run")


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        (("--accelerator", "tpu"), "accelerator is 'tpu'"),
        (("--set", "jitter=99999999"), "jitter is 99999999 samples, but a sweep has"),
        (("--set", "learning_rate=1e300"), "learning_rate must be below 1e+38"),
        (("--set", "epochs=99999999999999999999"), "epochs=99999999999999999999: more than 64"),
        (("--set", "begin=none.pt"), "no checkpoint none.pt"),
    ],
)
def test_what_cannot_be_trained_is_one_line(tiny, refused, tmp_path, asked, said):
    assert said in refused("train", tiny, tmp_path / "run", *OPTIONS, *asked)


def test_a_folder_that_cannot_be_is_refused_before_torch_is_loaded(tiny, refused, tmp_path):
    (tmp_path / "file").write_text("mine")
    said = refused("train", tiny, tmp_path / "file" / "run", *OPTIONS)
    assert f"{tmp_path / 'file'}: is not a folder" in said
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("asked", ["momentum=1", "seed=-1"])
def test_a_probe_s_settings_are_held_to_their_ranges(trained, refused, tmp_path, asked):
    name = asked.split("=")[0]
    said = refused("probe", trained / "best.pt", tmp_path / "p", "--set", asked)
    assert f"{name} must be" in said


def test_a_validation_without_a_touch_is_told_before_the_training(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(
        loop, "Validation", lambda config, data, *rest: Validation(config, data[:0], *rest)
    )
    with pytest.raises(ConfigError, match="no touch was found in the validation sweeps"):
        train(TrainingConfig(tiny, **SMALL, objective="simclr", updates=1), tmp_path / "run")


def test_a_validation_that_is_no_number_is_a_divergence(tiny, tmp_path, monkeypatch):
    monkeypatch.setattr(Validation, "__call__", lambda *_: ({}, float("nan")))
    with pytest.raises(DivergedError, match="diverged in epoch 1"):
        train(TrainingConfig(tiny, **SMALL, updates=1), tmp_path / "run")
    assert not (tmp_path / "run" / "best.pt").exists()
