"""`tactile-rt align board` and `align datasets`, on a made-up brain."""

import json
import shutil

import numpy as np
import pytest

from tactile_rt.classifier.model_file import shipped_model

pytest.importorskip("onnx")
pytest.importorskip("torch")
pytest.importorskip("h5py")

MODEL = shipped_model()


@pytest.fixture(scope="module")
def brain(tmp_path_factory):
    from tactile_rt.alignment.example import Brain
    from tactile_rt.alignment.example_files import write_example

    folder = tmp_path_factory.mktemp("board") / "brain"
    write_example(folder, Brain(mice=3, sessions=1, units=30, trials=12))
    return folder


def test_a_board_of_a_model_its_untrained_network_and_responses(done, brain, tmp_path):
    board, page = tmp_path / "board.json", tmp_path / "board.html"
    out, _ = done(
        "align", "board", MODEL, brain / "models" / "another-mouse.npz",
        "--data", f"example={brain / 'recordings'}", "--metric", "rsa", "--metric", "crossnobis",
        "--part", "all", "--part", "L5", "--json", board, "--out", page,
    )  # fmt: skip
    made = json.loads(board.read_text())
    assert [row["kind"] for row in made["rows"]] == [
        "model", "untrained", "model", "input", "animal"
    ]  # fmt: skip
    assert made["rows"][0]["parameters"] == made["rows"][1]["parameters"] > 0
    assert [(c["part"], c["metric"]) for c in made["columns"]] == [
        (part, metric) for part in ("all", "L5") for metric in ("rsa", "crossnobis")
    ]
    assert made["datasets"][0]["units"] == 90
    assert "another animal" in out and page.read_text().startswith("<!doctype html>")


def test_recordings_of_one_name_are_told_apart(done, brain, tmp_path):
    other = shutil.copytree(brain / "recordings", tmp_path / "others")
    files = ("--data", f"example={brain / 'recordings'}", "--data", f"example={other}")
    board, page = tmp_path / "board.json", tmp_path / "board.html"
    out, _ = done("align", "board", *files, "--metric", "rsa", "--json", board, "--out", page)
    made = json.loads(board.read_text())
    names = [one["name"] for one in made["datasets"]]
    assert names == [c["dataset"] for c in made["columns"]] == ["example", "example (others)"]
    assert out.count("shares of") == page.read_text().count("<table>") == 2


def test_another_seed_is_another_untrained_network(done, brain, tmp_path):
    scores = []
    for seed in (0, 1):
        board = tmp_path / "board.json"
        done(
            "align", "board", MODEL, "--data", f"example={brain / 'recordings'}",
            "--metric", "rsa", "--seed", seed, "--json", board,
        )  # fmt: skip
        made = json.loads(board.read_text())
        scores.append([row[0]["score"] for row in made["cells"][:2]])
    assert scores[0][0] == scores[1][0] and scores[0][1] != scores[1][1]


def test_the_datasets_are_listed(done):
    out, _ = done("align", "datasets")
    for said in ("000231", "example", "CC0-1.0"):
        assert said in out


def test_mistakes_are_one_line(refused, brain, tmp_path):
    data = ("--data", f"example={brain / 'recordings'}")
    np.savez(tmp_path / "odd.npz", a=np.zeros((5, 3)))
    for arguments, said in (
        ((), "name recordings: --data DATASET=PATH"),
        (("--data", "example"), "--data must be DATASET=PATH"),
        (("--data", "exmple=x"), "did you mean example"),
        ((*data, "--metric", "rsaa"), "did you mean rsa"),
        ((*data, "--part", "L7"), "no part of cortex"),
        ((*data, tmp_path / "odd.npz"), "is no layer"),
    ):
        assert said in refused("align", "board", *arguments)
