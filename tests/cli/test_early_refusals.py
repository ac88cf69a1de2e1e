"""What cannot be is refused before torch is loaded: its seconds are for those who train."""

import json
import resource

import pytest

from tests.helpers.processes import run_program
from tests.helpers.tiny_sweeps import write_tiny_set

torch = pytest.importorskip("torch")
for module in ("lightning", "onnx", "matplotlib"):
    pytest.importorskip(module)

from tactile_rt.models.training.config import TrainingConfig  # noqa: E402
from tactile_rt.models.training.loop import train  # noqa: E402

# Commands of JSON lines, in one process; of each what it said, and what it had loaded.
CHILD = """
import contextlib, io, json, sys
from tactile_rt.cli import main
for line in sys.stdin:
    sys.argv = ["tactile-rt", *json.loads(line)]
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            main()
    except SystemExit as end:
        loaded = [m for m in ("torch", "lightning", "sklearn", "matplotlib") if m in sys.modules]
        print(json.dumps([end.code, said.getvalue(), loaded]))
"""
MOST_S = 1.2  # of CPU time, on a machine that is busy; it takes 0.3, and with torch 2 to 6


def children(commands):
    lines = "".join(json.dumps([str(word) for word in one]) + "\n" for one in commands)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = run_program(program=CHILD, input=lines)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert not done.stderr
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return [json.loads(line) for line in done.stdout.splitlines()], used


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A sweep set, a run of it, and files that are something else."""
    folder = tmp_path_factory.mktemp("early")
    write_tiny_set(folder / "set")
    small = {"encoder": "gru", "width": 1 / 32, "batch": 6, "updates": 1}
    train(TrainingConfig(str(folder / "set"), **small), folder / "run")
    for name in ("junk.pt", "junk.onnx", "junk.json", "junk.npz"):
        (folder / name).write_text("junk\n")
    plan = f'data = "{folder}/none"\n[[cell]]\nencoder = "gru"\n'
    (folder / "plan.toml").write_text(plan)
    (folder / "gptt.toml").write_text(plan + 'attender = "gptt"\n')
    (folder / "utf16.toml").write_bytes(b"\xff\xfe")
    moved = torch.load(folder / "run" / "best.pt")
    moved["config"]["data"] = str(folder / "moved")
    torch.save(moved, folder / "moved.pt")
    return folder


def test_what_cannot_be_is_refused_before_torch_is_loaded(made):
    out, best, data = made / "out", made / "run" / "best.pt", made / "set"
    no_set, no_checkpoint = "is not a sweep set", "is not a checkpoint of `tactile-rt train`"
    cases = [
        (("train", made / "none", out), f"{made}/none {no_set}"),
        (("train", data, out, "--also", made / "none"), f"{made}/none {no_set}"),
        (("train", data, out, "--recipe", "defualt"), "no recipe 'defualt'; did you mean default"),
        (("train", data, out, "--encoder", "grru"), "encoder is 'grru', not one of"),
        (("train", data, out, "--from", made / "none.pt"), f"no checkpoint {made}/none.pt"),
        (("train", data, best), "best.pt: is not a folder"),
        (("train", data, out, "--from", made / "run" / "last.pt"), no_checkpoint),
        (("probe", made / "junk.pt", out), no_checkpoint),
        (("probe", best, made / "run"), "holds a training run"),
        (("probe", best, out, "--set", "readout=all"), "readout is 'all', not one of last, mean"),
        (("probe", best, out, "--data", made / "none"), no_set),
        (("export", made / "junk.pt", made / "a.onnx"), no_checkpoint),
        (("export", best, out / "a.onnx"), f"no folder {out} to write a.onnx in"),
        (("export", best, made / "a.onnx", "--kind", "epoch"), "--kind is 'epoch'"),
        (("export", made / "moved.pt", made / "a.onnx"), "is not here: name it by --data"),
        (("eval", made / "none.onnx", data), "no model file"),
        (("eval", made / "junk.onnx", data), "is not a readable ONNX model"),
        (("grid", "wide42", out), "no grid wide42: name a TOML file, or one of"),
        (("grid", made / "plan.toml", out), f"{made}/none {no_set}"),
        (("grid", made / "gptt.toml", out), "attender is 'gptt', not one of"),
        (("grid", made / "utf16.toml", out), "utf16.toml:1: not UTF-8 text"),
        (("grid", made / "junk.pt", out), "junk.pt:1: not TOML"),
        (("align", "score", best, "--benchmark", made / "none.json"), "none.json: cannot be read"),
        (("align", "score", best, "--benchmark", made / "junk.json"), "junk.json"),
        (("align", "decode", best, "--stimuli", made / "junk.npz"), "is no model input"),
        (("align", "decode", made / "junk.onnx"), "is not a readable ONNX model"),
        (("align", "report", made / "junk.json", "--out", made / "a.html"), "junk.json"),
        (("align", "gate", made / "junk.pt", "--reference", best), no_checkpoint),
    ]
    found, _ = children(command for command, _ in cases)
    assert len(found) == len(cases)
    for (command, expected), (code, said, loaded) in zip(cases, found, strict=True):
        assert expected in said, command
        assert (said.count("\n"), loaded) == (1, []), command
        assert code == (3 if "gate" in command else 2), command
    assert not out.exists()


@pytest.mark.parametrize(
    "command", [("train", "none", "run"), ("export", "none.pt", "a.onnx"), ("eval", "a.onnx", "no")]
)
def test_a_refusal_takes_little_time(command):
    ((code, _, _),), used = children([command])
    assert code == 2
    assert used < MOST_S


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("objects", "get", "raal", "out"), "no list 'raal'; did you mean real?"),
        (("objects", "check", "none"), "no folder none"),
        (("array", "fit", "plucks.mcap", "--array", "none.toml"), "none.toml: no such file"),
    ],
)
def test_a_wrong_word_is_told_before_an_extra_is_asked_for(words, said):
    without = "import sys; sys.modules.update(trimesh=None, mujoco=None)\n"
    done = run_program(program=without + CHILD, input=json.dumps(words), check=True)
    code, told, _ = json.loads(done.stdout)
    assert code == 2 and said in told and told.count("\n") == 1
