"""`tactile-rt model`: what a file is, whether it is whole, how fast it runs."""

import hashlib
import json

import msgspec
import pytest

from tactile_rt.benchmarks import roofline
from tactile_rt.model_checks import probe_logits
from tactile_rt.model_file import load_model, read_model, shipped_model
from tactile_rt.onnx_reading import graph_sha256

pytest.importorskip("onnx")

from tiny_model import CARD, write_model


@pytest.fixture
def sealed(tmp_path):
    """A tiny model with everything that an export stores; changed as asked."""

    def write(**changes):
        path = write_model(tmp_path / "m.onnx")
        stored = {
            "hashes": {"graph": graph_sha256(path.read_bytes())},
            "probe": tuple(map(tuple, probe_logits(*load_model(path)).tolist())),
        }
        return write_model(path, **(stored | changes))

    return write


def test_show_says_what_the_shipped_model_is(call):
    code, out, err = call("model", "show", shipped_model())
    card, contents, data = read_model(shipped_model())
    assert (code, err) == (0, "")
    words = " ".join(out.split())
    for said in (
        f"{len(data) / 1e6:.2f} MB, fp32, metadata version {card.version}",
        f"{sum(contents.operators.values())} operators, opset 20",
        "mouse-right: 30 elements x fx, fy, fz, mx, my, mz at 1000 Hz",
        "a step is 5 x 9 ms, an episode 22 steps",
        "24: beehive, birdcage",
    ):
        assert said in words


def test_a_stranger_s_text_cannot_command_the_terminal(call, tmp_path):
    path = write_model(
        tmp_path / "m.onnx",
        name="\x1b[2Jgone",
        labels=("[red]a", "b\x07", "c\x1b]0;x\x07", "d", "e"),
    )
    code, out, _ = call("model", "show", path)
    assert code == 0
    assert "?[2Jgone" in out
    assert "[red]a" in out
    assert not set(out) & {"\x1b", "\x07"}


def test_verify_a_sealed_file(call, sealed):
    path = sealed()
    code, out, err = call("model", "verify", path)
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == f"sha256 {hashlib.sha256(path.read_bytes()).hexdigest()}"
    assert "graph: as it was exported" in out
    assert "parity: logits within 0.0e+00 of those stored" in out


def test_verify_says_what_a_file_does_not_store(call):
    code, out, _ = call("model", "verify", shipped_model())
    assert code == 0
    assert "probe: 22 finite steps, the same again after a reset" in out


def test_verify_finds_another_graph(call, sealed):
    path = sealed(hashes={"graph": "0" * 64})
    code, _, err = call("model", "verify", path)
    assert code == 2
    assert f"{path}: the graph is another than was exported: sha256 " in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("precision", "difference", "right"),
    [("fp32", 2e-3, False), ("fp32", 1e-5, True), ("int8", 2e-3, True), ("int8", 0.5, False)],
)
def test_verify_compares_the_probe_at_the_precision_s_bar(
    call, sealed, precision, difference, right
):
    path = sealed()
    probe = [list(row) for row in load_model(path)[1].probe]
    probe[2][3] += difference
    code, _, err = call(
        "model", "verify", sealed(precision=precision, probe=tuple(map(tuple, probe)))
    )
    assert (code == 0) == right
    if not right:
        assert f"logits of the probe episode differ by {difference:.1e}" in err


@pytest.mark.parametrize("what", ["show", "verify", "bench"])
def test_a_bad_file_is_one_line(call, tmp_path, what):
    path = tmp_path / "m.onnx"
    for content, said in ((None, "no model file"), (b"garbage", "is not a readable ONNX model")):
        if content is not None:
            path.write_bytes(content)
        code, out, err = call("model", what, path)
        assert (code, out) == (2, "")
        assert said in err
        assert err.count("\n") == 1


def test_bench_times_steps_beside_the_machine_s_limit(call, sealed, monkeypatch):
    machine = roofline.Machine(1e11, 4e11, 3e10)
    monkeypatch.setattr(roofline, "measure_machine", lambda repetitions: machine)
    code, out, _ = call("model", "bench", shipped_model(), "--steps", 50)
    assert code == 0
    for said in ("step_p50", "step_tail", "over_roofline", "load", "size", "memory"):
        assert f"inference.model.{said}" in out


def test_bench_refuses_a_window(call, tmp_path):
    fields = {**msgspec.to_builtins(CARD), "kind": "window", "state": []}
    path = write_model(tmp_path / "m.onnx", metadata=json.dumps(fields))
    code, _, err = call("model", "bench", path)
    assert code == 2
    assert "only steps are timed" in err
