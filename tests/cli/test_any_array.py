"""`probe`, `grid` and `align` on an array that is not the mouse's: they work, or say in one line
why not."""

import numpy as np
import pytest

from tactile_rt.classifier.model_file import read_model
from tests.helpers.tiny_sweeps import plate, write_tiny_set

for module in ("torch", "lightning", "onnx", "matplotlib"):
    pytest.importorskip(module)

ROBOT = plate(2, 4)
TINY = ("--encoder", "gru", "--set", "attender=none", "--epochs", 1, "--set", "batch=4",
        "--set", "width=0.0625", "--set", "precision=fp32")  # fmt: skip


@pytest.fixture
def trained(done, tmp_path):
    """A tiny network on a tiny set: (the set, best.pt)."""

    def train(spec=ROBOT, name="robot", **more):
        data, run = tmp_path / name, tmp_path / f"{name}-run"
        write_tiny_set(data, spec=spec, **more)
        done("train", data, run, *TINY)
        return data, run / "best.pt"

    return train


def felt(path, spec, seed=0):
    """What `tactile-rt whisk` would write of this array."""
    from tactile_rt.core.stream.stimuli import STIMULI

    values = np.random.default_rng(seed).normal(size=(6, 110, *spec.shape)) * 1e-4
    np.savez(
        path, stimuli=np.array(STIMULI), values=values.astype(np.float32),
        elements=np.array(spec.elements), channels=np.array(spec.channels),
        units=np.array(spec.units),
    )  # fmt: skip
    return path


@pytest.mark.parametrize(
    ("spec", "period_ns", "turned"),
    [
        (ROBOT, 9_000_000, True),
        (plate(1, 1, "fx fy fz"), 9_000_000, False),
        (plate(1, 5, "my mz"), 12_500_000, False),
    ],
    ids=["2 x 4 x 6", "1 x 1 x 3", "1 x 5 x 2"],
)
def test_probe_and_grid_take_any_array(call, refused, trained, tmp_path, spec, period_ns, turned):
    data, best = trained(spec, period_ns=period_ns)
    code, _, err = call("probe", best, tmp_path / "probed", "--epochs", 2)
    assert code == 0 and "validation top-1" in err
    plan = tmp_path / "grid.toml"
    head = f'data = "{data}"\nbatch = 4\nseeds = 1\nwidth = 0.0625\n'
    head += "search = { learning_rate = [1e-3], warmup = [0.1], updates = 2 }\n"
    head += "growth = { first = 2, most = 2, gain = 0.01 }\n"
    cell = '[[cell]]\nencoder = "gru"\n'
    views = '[[cell]]\nencoder = "resnet18"\nobjective = "simclr"\naugmentation = "{}"\n'
    plan.write_text(head + cell + views.format("image"))
    code, _, err = call("grid", plan, tmp_path / "out", "--processes", 1)
    assert code == 0 and "svm, seed 0" in err and "resnet18 simclr image, seed 0: top-1" in err
    plan.write_text(head + cell + views.format("tactile"))
    if turned:
        assert call("grid", plan, tmp_path / "turned", "--processes", 1)[0] == 0
        return
    # What cannot be done with the array is said before anything is trained.
    said = refused("grid", plan, tmp_path / "other", "--processes", 1)
    assert "cannot be mirrored and turned (augmentation 'tactile')" in said


def test_a_network_is_not_used_at_another_sample_period(refused, trained, tmp_path):
    _, best = trained()
    other = tmp_path / "other"
    write_tiny_set(other, spec=ROBOT, period_ns=12_500_000)
    for command in (("probe", best, tmp_path / "p", "--data", other),
                    ("export", best, tmp_path / "x.onnx", "--data", other)):  # fmt: skip
        said = refused(*command)
        assert f"{best} takes steps of 5 samples, not 4 as" in said and "every 12.5 ms" in said


def test_align_takes_any_array_with_its_own_stimuli(call, refused, trained, tmp_path):
    _, best = trained()
    model = tmp_path / "robot.onnx"
    assert call("export", best, model, "--license", "MIT")[0] == 0
    assert read_model(model)[0].license == "MIT"
    stimuli = felt(tmp_path / "robot.npz", ROBOT)
    for file in (best, model):
        said = refused("align", "decode", file)
        assert f"but {file} was trained on A0, A1, A2, A3, ... (8): make its input with" in said
        code, out, _ = call("align", "decode", file, "--stimuli", stimuli)
        assert code == 0 and "raw sensor" in out and "encoder.laye" in out
    code, out, _ = call("align", "gate", model, "--reference", best, "--stimuli", stimuli)
    assert code == 0 and out.startswith("fidelity: pass")


def test_align_says_of_what_it_cannot_compare(call, refused, trained, tmp_path):
    slow = trained(ROBOT, "slow", period_ns=12_500_000)[1]
    onnx = tmp_path / "slow.onnx"
    assert call("export", slow, onnx)[0] == 0
    stimuli = felt(tmp_path / "robot.npz", ROBOT)
    for file in (slow, onnx):
        said = refused("align", "decode", file, "--stimuli", stimuli)
        assert f"{file} takes 22 steps of 4 samples, but the stimuli are 22 of 5" in said
    moments = trained(plate(2, 4, "my mz"), "moments")[1]
    said = refused("align", "decode", moments, "--stimuli", stimuli)
    assert "has the channels fx, fy, fz, mx, ... (6), but" in said
    assert "only a model of base forces and moments" in said
