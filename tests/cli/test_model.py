"""`tactile-rt model`: what a file is, whether it is whole, how fast it runs."""

import hashlib

import pytest
from msgspec.structs import replace

from tactile_rt.classifier.decision_rules import OpenSetRule, PredictionSetRule
from tactile_rt.classifier.model_file import load_model, probe_logits, read_model, shipped_model
from tactile_rt.classifier.onnx_check import graph_sha256
from tests.helpers.tiny_model import GRAPH, WINDOW, write_model


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
        f"{len(data) / 1e6:.2f} MB, fp16, metadata version {card.version}",
        f"{sum(contents.operators.values())} operators, opset 20",
        "mouse-right: 30 elements x fx, fy, fz, mx, my, mz at 1000 Hz",
        "a step is 5 x 9 ms, an episode 22 steps",
        "13: ball, other, bottle",
        "embedding 128 units",
    ):
        assert said in words


def test_show_says_what_the_file_knows_of_sensor_and_rules(call, tmp_path):
    rule = PredictionSetRule("1 - posterior", 0.95, (0.9,) * 4, 200)
    path = write_model(
        tmp_path / "m.onnx",
        sensor={"rate_hz": 80.0, "note": "\x1b[2J"},
        unknown=OpenSetRule("entropy", "logits", (1.0, 1.0, 1.5, 2.0)),
        candidates=(rule, replace(rule, coverage=0.8, noise=1.0)),
    )
    code, out, err = call("model", "show", path)
    assert (code, err) == (0, "")
    words = " ".join(out.split())
    for said in (
        "embedding 2 units",
        "sensor rate_hz: 80 note: ?[2J",
        "unknown entropy of the logits above 1 to 2, by step",
        "prediction sets 95 % by 1 - posterior, of 200 objects",
        "80 % by 1 - posterior, of 200 objects up to 1 x the rated noise",
    ):
        assert said in words
    _, out, _ = call("model", "show", write_model(path, unknown=OpenSetRule("x", "logits", (1.0,))))
    assert "unknown x of the logits above 1 probe" in " ".join(out.split())
    assert "prediction set" not in out


REMEMBERS = GRAPH.replace("Where(known, load, none)", "Where(known, load, load)")


def test_verify_finds_a_graph_that_remembers_bad_samples(call, tmp_path):
    path = write_model(tmp_path / "m.onnx", REMEMBERS)
    code, _, err = call("model", "verify", path)
    assert (code, err.count("\n")) == (2, 1)
    assert f"{path}: an invalid (NaN) sample must count as no load" in err


def test_a_stranger_s_text_cannot_command_the_terminal(done, tmp_path):
    path = write_model(
        tmp_path / "m.onnx",
        name="\x1b[2Jgone",
        labels=("[red]a", "b", "c", "d", "e"),
        provenance={"network": "x\x1b]0;x\x07", "commands": ["\x1b[2J", 5]},
    )
    out, _ = done("model", "show", path)
    assert "?[2Jgone" in out
    assert "[red]a" in out
    assert not set(out) & {"\x1b", "\x07"}


def test_verify_a_sealed_file(call, sealed):
    path = sealed()
    code, out, err = call("model", "verify", path)
    assert (code, err) == (0, "")
    assert out.splitlines()[0] == f"sha256: {hashlib.sha256(path.read_bytes()).hexdigest()}"
    assert "graph: as it was exported" in out
    assert "embedding: 2 units, finite" in out
    assert "bad samples: NaN and infinity are no load" in out
    assert "parity: logits within 0.0e+00 of those stored" in out


def test_verify_finds_another_graph(call, sealed):
    path = sealed(hashes={"graph": "0" * 64})
    code, _, err = call("model", "verify", path)
    assert (code, err.count("\n")) == (2, 1)
    assert f"{path}: the graph is not the exported one: sha256 " in err


@pytest.mark.parametrize(
    ("precision", "difference", "right"),
    [("fp32", 2e-3, False), ("fp32", 1e-5, True), ("int8", 2e-3, True)],
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
def test_a_bad_file_is_one_line(refused, tmp_path, what):
    path = tmp_path / "m.onnx"
    for content, said in ((None, "no model file"), (b"garbage", "is not a readable ONNX model")):
        if content is not None:
            path.write_bytes(content)
        assert said in refused("model", what, path)


def test_bench_times_steps(done, sealed):
    out, _ = done("model", "bench", shipped_model(), "--steps", 50)
    for said in ("step_p50", "step_tail", "load", "size", "memory"):
        assert f"inference.model.{said}" in out


def test_bench_refuses_a_window(refused, tmp_path):
    path = write_model(tmp_path / "m.onnx", WINDOW, kind="window", state=())
    assert "only step models are timed" in refused("model", "bench", path)
