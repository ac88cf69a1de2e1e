"""`tactile-rt label`: from a recording to a model that decides on it, and refusals in one line."""

import json
import re
import shlex
import shutil
from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.model_file import load_model
from tactile_rt.core.errors import ConfigError
from tactile_rt.models.datasets import SweepSet, join_sets
from tactile_rt.models.disturbances import CLEAN, Disturbance
from tactile_rt.models.evaluation.measures import cut_windows, run_over
from tactile_rt.models.training.batches import TrainingBatches
from tactile_rt.recording import Recording
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.sensor_faults import SensorFaults
from tests.helpers.labelled import ARRAY, record_touches, touched
from tests.helpers.source_tree import ROOT
from tests.helpers.tiny_sweeps import LEAD, SAMPLES, write_tiny_set

PAGE = ROOT / "docs" / "how-to" / "labelling.md"
SOUND = {"noise": 1.0, "gain": 0.0, "dead": 0.0}
SMALL = "--encoder gru --set attender=none --set decoder=linear --set width=0.03125".split()


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text("utf-8"), re.S)


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    """A folder with the tutorial's recording, its labels, and a simulated set of the array."""
    folder = tmp_path_factory.mktemp("label")
    record_touches(folder / "night.mcap", ["mug"] * 12 + ["cup"] * 12)
    (folder / "labels.csv").write_text("".join(blocks("csv")))
    write_tiny_set(folder / "data" / "robot", spec=ARRAY, categories=("mug", "bowl"))
    return folder


@pytest.fixture(scope="module")
def night(here):
    """The tutorial's set, made by hand of what the command is made of."""
    from tactile_rt.recording.labelled_set import write_set
    from tactile_rt.recording.labelling import find_labelled, intervals_beside

    path = here / "night.mcap"
    write_set(here / "set", find_labelled([path], intervals_beside([path])))
    return here / "set"


def lines_of(call, *words):
    code, out, err = call(*words)
    assert not code, err
    return out, err


def test_the_tutorial_does_what_it_says(here, call, monkeypatch):
    monkeypatch.chdir(here)
    said = {}
    for block in blocks("sh"):
        words = shlex.split(block)[1:]
        if words[0] == "train":  # all that is not as on the page: minutes are seconds here
            updates = 8 if words[2] == "runs/night" else 2
            words += f"--set updates={updates} --set width=0.03125".split()
            words = [w for k, w in enumerate(words) if "--from" not in words or k < len(words) - 2]
        said[" ".join(words[:3])] = lines_of(call, *words)
    (promised,) = re.findall(r"^    (night: .*)$", PAGE.read_text("utf-8"), re.M)
    assert said["label night.mcap night"][1].strip() == promised
    assert "1 unseen" not in said["eval night.onnx night"][0]
    assert "none added to that of the" in " ".join(said["eval night.onnx night"][0].split())
    decisions = [json.loads(line) for line in (here / "decisions.jsonl").read_text().splitlines()]
    assert sum(d["final"] for d in decisions) == 24
    assert set(load_model(here / "night.onnx")[1].labels) == {"mug", "cup"}
    manifest = SweepManifest.read(here / "both")
    assert manifest.period_ns == SweepManifest.read(here / "data" / "robot").period_ns


def fed(model, path):
    """Samples, offset and sigma of every window that a classifier fed its network."""
    classifier, windows = Classifier(model, ARRAY), []
    stepper = classifier._stepper
    run = stepper.run

    def noted():
        windows.append(
            [stepper.samples[0].copy(), stepper._offset.array[0], stepper._sigma.array[0]]
        )
        windows[-1][1:] = [a.copy() for a in windows[-1][1:]]
        return run()

    stepper.run = noted
    for chunk in Recording(path):
        classifier.push(chunk)
    steps = classifier.card.steps
    taken = [windows[k : k + steps] for k in range(0, len(windows), steps)]
    return (
        np.stack([[step[0] for step in one] for one in taken]),
        np.stack([one[0][1] for one in taken]),
        np.stack([one[0][2] for one in taken]),
    )


def test_training_gets_what_a_classifier_feeds_its_network(here, night, call, monkeypatch):
    run = here / "parity"
    lines_of(call, "train", night, run, *SMALL, "--set", "batch=8", "--set", "updates=1")
    lines_of(call, "export", run / "best.pt", here / "parity.onnx")
    samples, offset, sigma = fed(here / "parity.onnx", here / "night.mcap")
    assert samples.shape == (24, 22, 5, *ARRAY.shape)
    loads = samples - offset[:, None, None]
    by_time = {}  # what the classifier was fed, by the time of the touch
    for name in ("train", "validation", "test"):
        data = SweepSet.read(night, name)
        faults = {"faults": SOUND}
        data = replace(
            data, manifest=replace(data.manifest, recipe={**data.manifest.recipe, **faults})
        )
        assert data.manifest.faults == SensorFaults(**SOUND)
        onsets = [
            t for n in data.manifest.split[name] for t in np.load(night / f"{n}.npz")["onset_s"]
        ]
        place = [round((t - 2.2) / 3.4) for t in onsets]
        seen = []
        run_over(
            cut_windows(data), lambda *a, seen=seen: seen.append(a) or np.zeros((len(a[0]), 22, 2))
        )
        assert np.allclose(seen[0][0], samples[place], rtol=1e-6, atol=0)
        assert np.allclose(seen[0][1], offset[place], rtol=1e-6, atol=0)
        assert np.allclose(seen[0][2], sigma[place], rtol=1e-6, atol=0)
        batches = TrainingBatches(data, len(data.sweeps), seed=3, jitter=0)
        ((x, o, s, _),) = (tuple(t.numpy() for t in batch) for batch in batches.epoch(0))
        order = np.random.default_rng([3, 0]).permutation(len(data.sweeps))
        drawn = np.array(place)[order]
        unit = sigma[drawn][:, None, None]
        assert np.abs((x - o[:, None, None] - loads[drawn]) / unit).max() < 1e-6
        assert np.allclose(s, sigma[drawn], rtol=1e-6, atol=0)
        by_time |= dict.fromkeys(place)
    assert len(by_time) == 24, "every touch was compared"


def test_no_noise_is_added_to_recorded_sweeps_but_what_is_lacking(night):
    data = SweepSet.read(night, "train")
    values, rng = data.sweeps.values, np.random.default_rng(0)
    assert Disturbance(noise=1.0).disturb_samples(values, data, rng) == pytest.approx(
        values - values[:, :200].mean(axis=1, keepdims=True), abs=1e-9
    )
    twice = Disturbance(noise=2.0).disturb_samples(values, data, rng)
    added = twice - values + values[:, :200].mean(axis=1, keepdims=True)
    assert added.std(axis=(0, 1, 2)) == pytest.approx(3**0.5 * data.noise, rel=0.05)
    assert CLEAN.disturb_samples(values, data, rng) is values


def test_a_simulated_and_a_recorded_set_train_together_each_in_its_way(here, night):
    sets = [SweepSet.read(folder, "train") for folder in (here / "data" / "robot", night)]
    both = join_sets(sets)
    assert both.sweeps.values.shape[1] == 200 + max(110, SAMPLES - LEAD)
    simulated = ~both.recorded
    assert simulated.sum() == len(sets[0].sweeps)
    assert (both.sweeps.values[simulated][:, :200] == 0).all()
    own = sets[0].sweeps.values
    assert np.array_equal(
        both.sweeps.values[simulated][:, 200 : 200 + SAMPLES - LEAD], own[:, LEAD:]
    )
    # a sample sooner, as the baseline of a lead of 24 samples is ready only after it
    assert (both.noisy_starts[0][simulated] == 201).all()
    assert (sets[0].noisy_starts[0] == LEAD + 2).all()
    assert np.array_equal(both.sweeps.values[both.recorded][:, :310], sets[1].sweeps.values)
    for mixed, alone in zip(both.baselines, sets[1].baselines, strict=True):
        assert np.array_equal(mixed[both.recorded], alone)
        assert not mixed[simulated].any()


def test_touches_without_labels_are_for_pretraining_alone(here, call, refused):
    folder = here / "bare"
    lines_of(call, "label", here / "night.mcap", folder, "--unlabelled")
    manifest = SweepManifest.read(folder)
    assert manifest.categories == ("unlabelled",) and len(manifest.names()) == 24
    err = refused("train", folder, here / "no", *SMALL)
    assert "bare holds touches without labels: learn from them by --recipe simclr" in err
    err = refused("train", here / "data" / "robot", here / "no", "--also", folder, *SMALL)
    assert "holds touches without labels" in err


def test_a_simulated_set_does_not_go_on_with_it(night):
    assert SweepManifest.read(night).version == 3
    with pytest.raises(ConfigError, match=r"holds another sweep set \(other version\)"):
        replace(SweepManifest.read(night), version=2).write(night)


def test_a_set_is_replaced_on_demand_and_nothing_else_is(here, night, tmp_path, call, refused):
    recording = here / "night.mcap"
    out = tmp_path / "set"
    shutil.copytree(night, out)
    err = refused("label", recording, out)
    assert f"{out} already exists: name another folder, or give --force" in err
    _, err = lines_of(call, "label", recording, out, "--force", "--shares", "0.5,0.25,0.25")
    assert "24 of 24 touches" in err
    assert "is made of recordings, by `tactile-rt label`" in refused("sweep", out)
    assert [p.name for p in tmp_path.iterdir()] == ["set"]
    lines_of(call, "sweep", out, "--verify")
    err = refused("label", recording, here / "data" / "robot", "--force")
    assert "is not a set of recordings, and is not replaced" in err
    (out / "notes.txt").touch()
    err = refused("label", recording, out, "--force")
    assert f"{out} holds 'notes.txt', too, and is not replaced" in err
    err = refused("label", recording, tmp_path / "no" / "set")
    assert "no folder" in err


def test_what_is_wrong_is_one_line(here, tmp_path, refused):
    recording = here / "night.mcap"
    alone = tmp_path / "alone.mcap"
    alone.write_bytes(recording.read_bytes())
    out, said = tmp_path / "set", tmp_path / "said.csv"
    said.write_text("start_s,end_s,label\n0,10,mug\n5,x,mug\n")
    for words, why in (
        ((alone, out), "no labels.csv beside"),
        ((recording, out, "--labels", said), "said.csv:3: end_s: expected a number, got 'x'"),
        ((recording, out, "--by-name", "--unlabelled"), "exclude one another: give one"),
        ((recording, recording, out), "is named twice: name it once"),
        ((recording, out, "--shares", "much"), "--shares must be TRAIN,VALIDATION,TEST"),
        ((recording, out, "--like", tmp_path), "is not a sweep set"),
        ((recording, tmp_path / "o\udcff"), "o\\udcff' is not UTF-8: rename it"),
        ((recording, out, "--json", recording), "is another file of this command"),
        ((recording, out, "--json", here / "labels.csv"), "holds the labels that are read"),
        ((recording, out, "--json", out), "is another file of this command"),
    ):
        assert why in refused("label", *words)
        assert not out.exists()


def test_a_quiet_recording_holds_no_touch(tmp_path, refused):
    from tactile_rt.testing import cut_chunks
    from tests.helpers.recordings import write

    path = write(tmp_path / "mug.mcap", cut_chunks(touched(["mug"])[:500], 250.0), ARRAY)
    err = refused("label", path, tmp_path / "set", "--by-name")
    assert "no touch can be used: intervals in which no touch begins: 1" in err
