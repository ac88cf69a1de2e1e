"""What the commands say to a user's mistake: one line on stderr, exit code 2, nothing written."""

import os
import signal
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import trimesh

from tactile_rt.cli.app import starting
from tactile_rt.sets.objects import write_object
from tactile_rt.sim_backend.datasets.dataset import describe_set
from tactile_rt.sim_backend.datasets.recipe_files import read_recipe

TINY_SET = (
    "--recipe", "mouse12", "--set", "objects.per_category=3", "--set", "objects.validation=1",
    "--set", "objects.test=1", "--set", "sweeps.draws=1",
)  # fmt: skip


def tiny_recipe():
    """What `TINY_SET` says."""
    recipe = read_recipe("mouse12")
    objects = msgspec.structs.replace(recipe.objects, per_category=3, validation=1, test=1)
    return replace(recipe, objects=objects, sweeps=replace(recipe.sweeps, draws=1))


@pytest.fixture
def a_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"here already\n")
    return path


@pytest.fixture
def sweep_set(tmp_path):
    """A sweep set of three objects a category, every sweep a touch as noise makes one."""
    folder, rng = tmp_path / "set", np.random.default_rng(0)
    manifest = describe_set(tiny_recipe())
    manifest.write(folder)
    for names in manifest.split.values():
        for name in names:
            values = rng.normal(size=(1, 164, *manifest.spec.shape)).astype(np.float32) * 1e-4
            values[:, : manifest.lead] = 0
            write_object(folder, name, values, {})
    return folder


def test_a_set_cannot_be_made_in_or_under_a_file(refused, a_file):
    assert f"{a_file}: is not a folder" in refused("sweep", a_file, *TINY_SET)
    assert f"{a_file / 'set'}: Not a directory" in refused("sweep", a_file / "set", *TINY_SET)
    assert a_file.read_bytes() == b"here already\n"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--seed", -1), "seed must be 0 or more"),
        (("--split", "train,tests"), "no split 'tests': there are train, validation, test"),
        (("--profile", "fast"), "no profile 'fast'; there are realtime"),
    ],
)
def test_an_impossible_set_is_refused_before_anything_is_written(refused, tmp_path, options, said):
    assert said in refused("sweep", tmp_path / "set", *TINY_SET, *options)
    assert not (tmp_path / "set").exists()


def test_another_set_in_the_folder_is_one_line(refused, sweep_set):
    said = refused("sweep", sweep_set, *TINY_SET, "--seed", 1)
    assert "holds another sweep set (other recipe.seed)" in said


def test_a_split_named_twice_counts_once(done, sweep_set):
    _, err = done("sweep", sweep_set, *TINY_SET, "--split", "test, test")
    assert "12 sweeps" in err.replace("\n", " ")


def test_a_file_name_may_hold_a_plus_and_a_space(call, tmp_path):
    path = tmp_path / "a + b.stl"
    trimesh.creation.box((1, 1, 1)).export(path)
    source = f"sim:mouse?objects={path}"
    assert call("run", "--source", source, "--seconds", 0.1)[0] == 0


@pytest.mark.parametrize("made_of_it", [None, AttributeError("no attribute 'exc'")])
def test_an_interrupt_that_an_import_swallows_still_ends_the_program(made_of_it):
    handler = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), starting():
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except BaseException:  # as trimesh does around its optional imports, and torch
            if made_of_it:
                raise made_of_it from None
    assert signal.getsignal(signal.SIGINT) is handler


@pytest.fixture(scope="module")
def torch():
    for module in ("onnx", "onnxscript", "sklearn", "matplotlib"):
        pytest.importorskip(module)
    return pytest.importorskip("torch")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--set", "width=0.1"), "width must be a positive multiple of 1/32"),
        (("--set", "attender=lstm"), "attender is 'lstm', not one of gpt, mamba, none"),
        (("--seed", -1), "seed must be 0 to 4294967295"),
        (("--set", "learning_rate=nan"), "--set learning_rate=nan: nan is not a finite number"),
        (("--accelerator", "glove"), "accelerator is 'glove': "),
        (("--threads", 10**30), "'--threads'"),
    ],
)
def test_options_that_cannot_be_trained_with_leave_no_run(
    torch, refused, sweep_set, tmp_path, options, said
):
    assert said in refused("train", sweep_set, tmp_path / "run", *options)
    assert not (tmp_path / "run").exists()


def test_a_run_that_cannot_begin_can_be_begun_again_with_other_options(
    torch, refused, call, sweep_set, tmp_path
):
    command = ("train", sweep_set, tmp_path / "run", "--set", f"width={1 / 32}", "--epochs", 1)
    assert "a batch of 99 is more than the 12 sweeps" in refused(*command, "--set", "batch=99")
    assert not (tmp_path / "run").exists()
    assert call(*command, "--set", "batch=12")[0] == 0
    assert "another configuration" in refused(*command, "--set", "batch=6")


def test_an_interrupted_run_goes_on_to_the_same_end(torch, sweep_set, tmp_path):
    from tactile_rt.models.training.config import TrainingConfig
    from tactile_rt.models.training.loop import train

    config = TrainingConfig(str(sweep_set), width=1 / 32, epochs=3, batch=4)

    def interrupt(at):
        if at.epoch == 1 and at.update == 5:  # in the middle of the second epoch
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config, tmp_path / "cut", interrupt)
    begun = []
    train(config, tmp_path / "cut", lambda at: begun.append(at.update))
    assert begun[0] == 4, "the first epoch was kept"
    train(config, tmp_path / "whole")
    histories = [
        [line.rsplit(",", 1)[0] for line in (tmp_path / run / "history.csv").read_text().split()]
        for run in ("cut", "whole")  # all but the seconds that each epoch took
    ]
    assert histories[0] == histories[1]
    assert len(histories[0]) == 4
    ends = [torch.load(tmp_path / run / "last.pt")["model"] for run in ("cut", "whole")]
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


@pytest.mark.parametrize("content", [b"", b"junk\n", b"PK\x03\x04 cut short"])
def test_a_damaged_checkpoint_is_one_line(torch, call, refused, sweep_set, tmp_path, content):
    folder = tmp_path / "run"
    options = ("--set", f"width={1 / 32}", "--epochs", 1, "--set", "batch=12")
    command = ("train", sweep_set, folder, *options)
    assert call(*command)[0] == 0
    for name in ("best.pt", "last.pt"):
        (folder / name).write_bytes(content)
    assert "last.pt is damaged" in refused(*command)
    model = tmp_path / "model.onnx"
    assert "is not a checkpoint" in refused("export", folder / "best.pt", model)
    assert not model.exists()


@pytest.fixture
def tiny_model(torch, tmp_path, sweep_set):
    """An untrained network for the mouse array, as a file; what is changed in its card."""
    import onnx

    from tactile_rt.classifier.model_file import METADATA_KEY
    from tactile_rt.core.stream.sensor_spec import channel_limits
    from tactile_rt.export.onnx_step import export_checkpoint
    from tactile_rt.models.checkpoints import fill_checkpoint, load_checkpoint
    from tactile_rt.models.ead import EADConfig, TactileClassifier
    from tactile_rt.models.training.config import TrainingConfig
    from tactile_rt.sets.manifest import SweepManifest

    manifest = SweepManifest.read(sweep_set)
    spec = manifest.spec
    network = EADConfig(classes=12, encoder="gru", attender="none", width=1 / 16)  # soon traced
    model = TactileClassifier(spec, network, channel_limits(spec))
    config = msgspec.to_builtins(TrainingConfig(str(sweep_set)))
    torch.save(fill_checkpoint(model, manifest, (), config, {}, {}), tmp_path / "best.pt")
    path = tmp_path / "tiny.onnx"
    trained = load_checkpoint(tmp_path / "best.pt")
    card = export_checkpoint(tmp_path / "best.pt", trained, [manifest], path, "tiny")

    def write(**changes):
        model = onnx.load(path)
        changed = msgspec.json.encode(msgspec.structs.replace(card, **changes)).decode()
        onnx.helper.set_model_props(model, {METADATA_KEY: changed})
        onnx.save(model, path)
        return path

    return write


def test_a_model_is_evaluated_only_on_what_it_was_made_for(
    tiny_model, refused, call, sweep_set, a_file, tmp_path
):
    path = tiny_model()
    assert "not a sweep set" in refused("eval", path, tmp_path / "none")
    assert f"no folder {a_file}" in refused("eval", path, sweep_set, "--json", a_file / "a.json")
    assert "is a folder" in refused("eval", path, sweep_set, "--json", tmp_path)
    assert "is not a folder" in refused("eval", path, sweep_set, "--pictures", a_file)
    pictures = tmp_path / "not" / "yet"
    code, out, err = call("eval", path, sweep_set, "--quick", "--pictures", pictures)
    assert (code, err) == (0, "")
    assert "nan" not in out  # one sweep of each object: there is nothing to fuse
    assert "dead whiskers" in out
    assert len(list(pictures.iterdir())) == 2

    spec = describe_set(tiny_recipe()).spec.to_json()
    changed = tiny_model(spec=spec.replace('"fx"', '"gx"'))
    other_array = f"was made for another array than that of {sweep_set}: channels[0]"
    assert other_array in refused("eval", changed, sweep_set)
    changed = tiny_model(period_ns=1_000_000)
    assert "a sample every 1000000 ns" in refused("eval", changed, sweep_set)
    changed = tiny_model(provenance={"unseen_objects": ["mug-2"]})
    assert "may have been trained on objects" in refused("eval", changed, sweep_set)


def test_a_model_is_evaluated_on_fewer_kinds_and_on_objects_from_elsewhere(
    tiny_model, refused, call, sweep_set, tmp_path
):
    """Labels are the model's, by their names; objects of another source were never trained on."""
    import json
    import shutil

    from tactile_rt.classifier.model_file import read_model
    from tactile_rt.sets.manifest import SweepManifest

    path = tiny_model()
    kinds = read_model(path)[0].labels
    own = SweepManifest.read(sweep_set).categories
    assert kinds == own
    more = tiny_model(labels=("anvil", *reversed(own[1:])))
    assert f"does not know {own[0]} of" in refused("eval", more, sweep_set)
    # Whatever the network says, each of its sayings is right under one of these namings.
    values, figures = [], tmp_path / "figures.json"
    for label in own:
        shifted = own[own.index(label) :] + own[: own.index(label)]
        model = tiny_model(labels=shifted)
        assert call("eval", model, sweep_set, "--quick", "--json", figures)[0] == 0
        rows = json.loads(figures.read_text())
        values.append({row["name"]: row["value"] for row in rows}["models.top-1"])
    assert sum(values) == pytest.approx(100)
    elsewhere = tmp_path / "elsewhere"
    shutil.copytree(sweep_set, elsewhere)
    file = elsewhere / "manifest.json"
    manifest = json.loads(file.read_text())
    manifest["recipe"]["objects"]["from"] = "/some/meshes"
    file.write_text(json.dumps(manifest))
    trained = {"unseen_objects": ["mug-2"], "sweep_set": {"objects": {"from": "shapes"}}}
    model = tiny_model(provenance=trained)
    assert "may have been trained on objects" in refused("eval", model, sweep_set)
    assert call("eval", model, elsewhere, "--quick")[0] == 0
