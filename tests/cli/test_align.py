"""`tactile-rt align`, on the shipped model and synthetic animals."""

import json

import numpy as np
import pytest

from tactile_rt.alignment import save_benchmark
from tactile_rt.alignment.paper_code import freeze_paper_code
from tactile_rt.alignment.stimuli_input import SHIPPED
from tactile_rt.alignment.strict import freeze_strict
from tactile_rt.classifier.model_file import shipped_model
from tests.helpers import brains

pytest.importorskip("onnx")

MODEL = shipped_model()


@pytest.fixture(scope="module")
def frozen(tmp_path_factory):
    """Benchmarks of six animals and of one."""
    folder = tmp_path_factory.mktemp("frozen")
    rng = np.random.default_rng(1)
    shared = brains.geometry(rng)
    for number in (6, 1):
        made = freeze_strict(brains.animals(rng, number, shared=shared), 20)
        save_benchmark(made, folder / f"{number}.json")
    return folder


def test_score_report_and_a_baseline(call, frozen, tmp_path):
    scores, page = tmp_path / "scores.json", tmp_path / "page.html"
    code, out, _ = call(
        "align", "score", MODEL, "--benchmark", frozen / "6.json", "--json", scores,
        "--out", page,
    )  # fmt: skip
    assert code == 0 and "mouse13" in out and "raw sensor" in out
    model = json.loads(scores.read_text())["models"][0]
    assert model["layers"][0] == "encoder.layer0"
    assert page.read_text().startswith("<!doctype html>")
    again = tmp_path / "again.html"
    assert call("align", "report", scores, "--out", again)[0] == 0
    assert again.read_text() == page.read_text()
    other = tmp_path / "other.json"
    other.write_bytes(scores.read_bytes())
    assert call("align", "report", scores, other, "--out", again)[0] == 0
    assert "<h3>mouse13 (other.json) <small>score" in again.read_text()
    # The model is no worse than itself; random geometries are no match for it, though.
    told = tmp_path / "gate.json"
    code, out, _ = call(
        "align", "gate", MODEL, "--benchmark", frozen / "6.json", "--baseline", scores,
        "--reference", MODEL, "--json", told,
    )  # fmt: skip
    found = json.loads(told.read_text())
    verdicts = {check["name"]: check["verdict"] for check in found["checks"]}
    assert verdicts == {
        "validity": "pass", "turing": "fail", "regression": "pass", "fidelity": "pass"
    }  # fmt: skip
    assert code == found["exit_code"] == 1
    assert {tap["layer"] for tap in found["taps"]} >= {"encoder.layer0", "output"}


def test_the_gate_without_neural_data(call):
    code, out, err = call("align", "gate", MODEL, "--reference", MODEL)
    assert (code, err) == (0, "")
    assert out.startswith("fidelity: pass")


def test_a_baseline_of_other_stimuli_is_no_baseline(call, done, frozen, tmp_path):
    arrays = dict(np.load(SHIPPED))
    np.savez(tmp_path / "felt.npz", **arrays | {"values": 1.1 * arrays["values"]})
    scores, benchmark = tmp_path / "scores.json", ("--benchmark", frozen / "6.json")
    felt = ("--stimuli", tmp_path / "felt.npz")
    done("align", "score", MODEL, *benchmark, *felt, "--json", scores)
    code, _, err = call("align", "gate", MODEL, *benchmark, "--baseline", scores)
    assert code == 3 and "scored on other stimuli (felt.npz)" in err


def test_stimuli_without_names_are_neither_gated_nor_decoded_by(call, done, tmp_path):
    rng = np.random.default_rng(0)
    patterns = brains.geometry(rng)
    rates = {f"animal-{i}": brains.padded(rng, patterns=patterns) for i in range(6)}
    benchmark = ("--benchmark", tmp_path / "paper.json")
    save_benchmark(freeze_paper_code(rates, 20), benchmark[1])
    for command, code in (("gate", 3), ("decode", 2)):
        found, out, err = call("align", command, MODEL, *benchmark)
        assert (found, out) == (code, "")
        assert "paper.json was built with protocol paper-code" in err and err.count("\n") == 1
    out, _ = done("align", "score", MODEL, *benchmark, "--json", "-")
    (model,) = json.loads(out)["models"]
    assert model["score"] is not None and model["turing"] == model["turing_why"] == ""


def test_what_the_gate_cannot_read_is_an_input_error(call, frozen, tmp_path):
    broken = tmp_path / "broken.onnx"
    broken.write_bytes(b"no model")
    text = tmp_path / "broken.json"
    text.write_text("{")
    for arguments in (
        (broken, "--reference", MODEL),
        (tmp_path / "none.onnx", "--reference", MODEL),
        (MODEL, "--benchmark", frozen / "6.json", "--baseline", text),
        (MODEL, "--baseline", text),
        (MODEL, "--reference", MODEL, "--stimuli", text),
        (MODEL, "--reference", MODEL, "--json", tmp_path / "none" / "x.json"),
        (MODEL,),
    ):
        code, out, err = call("align", "gate", *arguments)
        assert (code, out) == (3, ""), arguments
        assert err.startswith("tactile-rt: ") and err.count("\n") == 1, arguments
    for arguments in (("--no-such-option",), ()):
        assert call("align", "gate", *arguments)[0] == 3


def test_a_mistake_of_ours_is_no_verdict(call, monkeypatch):
    def broken(*_):
        raise ZeroDivisionError

    monkeypatch.setattr("tactile_rt.alignment.fidelity.check_fidelity", broken)
    code, out, err = call("align", "gate", MODEL, "--reference", MODEL)
    assert (code, out) == (3, "") and "ZeroDivisionError" in err


def test_a_file_that_only_fails_when_it_runs_is_an_input_error(call, tmp_path):
    import onnx

    model, odd = onnx.load(MODEL), tmp_path / "odd.onnx"
    graph = model.graph
    output = next(node for node in graph.node if "logits" in node.output)
    output.output[list(output.output).index("logits")] = "before"
    place = onnx.numpy_helper.from_array(np.array([99]), "place")
    nought = onnx.numpy_helper.from_array(np.array(0, np.float32), "nought")
    graph.initializer.extend([place, nought])
    graph.node.extend(
        onnx.helper.make_node(kind, inputs, outputs, **more)
        for kind, inputs, outputs, more in (
            ("Gather", ["samples", "place"], ["none"], {"axis": 1}),
            ("ReduceSum", ["none"], ["sum"], {"keepdims": 0}),
            ("Mul", ["sum", "nought"], ["zero"], {}),
            ("Add", ["before", "zero"], ["logits"], {}),
        )
    )
    onnx.save(model, odd)
    for arguments in ((odd, "--reference", MODEL), (MODEL, "--reference", odd)):
        code, out, err = call("align", "gate", *arguments)
        assert (code, out) == (3, "")
        assert "odd.onnx: its layers cannot be read" in err and err.count("\n") == 1


def test_decode(call, frozen, tmp_path):
    table = tmp_path / "table.json"
    code, out, _ = call("align", "decode", MODEL, "--benchmark", frozen / "1.json", "--json", table)
    assert code == 0 and "encoder.layer1" in out
    rows = json.loads(table.read_text())
    assert rows[0]["name"] == "raw sensor input" and rows[-1]["name"] == "mouse-0"
    assert rows[0]["shape_chance"] == pytest.approx(0.5)


def test_the_row_of_animals_as_published(done, refused, tmp_path):
    """Decoded by mouse, then the mean: the paper's last row."""
    rng = np.random.default_rng(0)
    patterns = brains.geometry(rng)
    rates = {f"animal-{i}": brains.padded(rng, patterns=patterns) for i in range(3)}
    source, table = tmp_path / "rates.npz", tmp_path / "table.json"
    np.savez_compressed(source, **rates)
    out, _ = done("align", "decode", MODEL, "--animals", source, "--paper", "--json", table)
    rows = {(r["name"], r["variant"]): r for r in json.loads(table.read_text())}
    for variant in ("balanced", "paper"):
        mean = rows["animals, mean of 3", variant]
        each = [rows[f"animal-{i}", variant] for i in range(3)]
        assert mean["shape"] == pytest.approx(np.mean([r["shape"] for r in each]))
        assert mean["distance"] == pytest.approx(np.mean([r["distance"] for r in each]))
        assert mean["shape_p"] is None
    assert "animals, mean of 3" in out
    assert "no file" in refused("align", "decode", MODEL, "--animals", tmp_path / "none.npz")


def test_mistakes_are_one_line(refused, frozen, tmp_path):
    benchmark = ("--benchmark", frozen / "6.json")
    for arguments, said in (
        (("score", tmp_path / "none.pt", *benchmark), "no checkpoint"),
        (("score", MODEL, *benchmark, "--out", tmp_path / "x" / "p.html"), "no folder"),
        (
            ("report", frozen / "6.json", "--out", tmp_path / "p.html"),
            "not made by `tactile-rt align score",
        ),
        (("decode", MODEL, "--stimuli", tmp_path / "none.npz"), "no file"),
    ):
        assert said in refused("align", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_a_model_to_which_all_is_the_same_has_no_score_and_it_says_so(call, frozen, tmp_path):
    np.savez(tmp_path / "same.npz", layer=np.ones((6, 20)))
    code, out, err = call("align", "score", tmp_path / "same.npz", "--benchmark", frozen / "6.json")
    assert code == 0 and "- ± -" in out
    assert "same: no score: in no layer do its responses differ between stimuli\n" in err


def test_a_model_has_no_score_for_want_of_animals_and_it_says_so(call, frozen):
    code, _, err = call("align", "score", MODEL, "--benchmark", frozen / "1.json")
    said = "no score: the benchmark has 1 reliable animal, and a layer is chosen on the others"
    assert code == 0 and f"mouse13: {said}: two are needed\n" in err


def test_an_array_without_a_layer_s_name_is_refused(refused, frozen, tmp_path):
    np.save(tmp_path / "x.npy", np.ones((6, 20)))
    said = refused("align", "score", tmp_path / "x.npy", "--benchmark", frozen / "6.json")
    assert "in an .npz" in said
