"""Files that are no such files, each in its own way: one line that names them."""

import json
from datetime import datetime

import msgspec
import numpy as np
import pytest

from tactile_rt.alignment import load_benchmark
from tactile_rt.alignment.json_file import write_json
from tactile_rt.alignment.layers import Layers
from tactile_rt.alignment.report import report_page
from tactile_rt.alignment.results import model_result, read_results, results_of
from tactile_rt.alignment.stimuli_input import SHIPPED, read_stimuli
from tactile_rt.alignment.strict import freeze_strict
from tests.helpers import brains
from tests.helpers.refusals import refusal

FELT = read_stimuli()
DEEP = 100_000


@pytest.fixture(scope="module")
def scores(tmp_path_factory):
    """A file of scores of two models."""
    rng = np.random.default_rng(1)
    shared = brains.geometry(rng)
    benchmark = freeze_strict(brains.animals(rng, 3, shared=shared), 10)
    made = []
    for masking in (0.0, 0.5):
        traces = {"encoder.0": brains.responses(rng, shared, 20)[:, None].astype(np.float32)}
        logits = np.zeros((6, 1, 2), np.float32)
        of = {"masking": masking}
        layers = Layers("model", traces, {"encoder.0": 0}, logits, 1, training=of)
        made.append(model_result(benchmark, layers, layers))
    path = tmp_path_factory.mktemp("scores") / "scores.json"
    write_json(results_of(benchmark, FELT, made), path)
    assert "0.5" in report_page(read_results(path))
    return path


@pytest.mark.parametrize("read", [load_benchmark, read_results])
@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"\xff\xfe{}",
        b'{"kind": "\xff", "schema": 2, "protocol": "\xff"}',
        b"[" * DEEP,
        b'{"schema": 2, "x": ' + b"[" * DEEP + b"]" * DEEP + b"}",
    ],
    ids=["nothing", "no UTF-8", "no UTF-8 in a text", "deep", "deep within"],
)
def test_what_is_no_json_of_ours_is_refused_in_a_line(tmp_path, read, content):
    path = tmp_path / "odd.json"
    path.write_bytes(content)
    assert "odd.json" in refusal(read, path)


@pytest.mark.parametrize(
    "place, value",
    [
        (("kind",), "tactile_rt alignment scores 1"),
        (("benchmark", "targets", 0, "chosen", "rdm"), []),
        (("benchmark", "a2a", "animals"), ["nobody"]),
        (("benchmark", "a2a", "pooled", 0), 1e308),
        (("benchmark", "stimuli"), ["a"]),
        (("raw", "layers"), ["x"]),
        (("raw", "corrected"), []),
        (("raw", "rdms"), [0.5]),
        (("models", 0, "chosen"), []),
        (("models", 1, "units"), []),
        (("models", 1, "untrained", "corrected"), [[]]),
    ],
)
def test_scores_whose_tables_cannot_be_drawn_are_refused(scores, tmp_path, place, value):
    found = json.loads(scores.read_bytes())
    inside = found
    for key in place[:-1]:
        inside = inside[key]
    inside[place[-1]] = value
    (tmp_path / "odd.json").write_text(json.dumps(found))
    assert "odd.json" in refusal(read_results, tmp_path / "odd.json")


def test_a_share_of_masking_that_is_no_number_is_not_compared(scores):
    read = read_results(scores)
    odd = [msgspec.structs.replace(m, groups={"masking": "much"}) for m in read.models]
    drawn = report_page(msgspec.structs.replace(read, models=(*odd, read.models[0])))
    assert "With and without masking" not in drawn


@pytest.mark.parametrize(
    "name, value",
    [
        ("stimuli", np.array("convex-close")),
        ("channels", np.zeros((2, 3))),
        ("values", np.full((6, 110, 30, 6), "a")),
        ("values", np.full((6, 110, 30, 6), 1e300)),
        ("values", np.full((6, 110, 30, 6), datetime(2020, 1, 1), "M8[s]")),
    ],
)
def test_an_input_of_other_types_is_refused_in_a_line(tmp_path, name, value):
    np.savez(tmp_path / "odd.npz", **dict(np.load(SHIPPED)) | {name: value})
    assert "odd.npz" in refusal(read_stimuli, tmp_path / "odd.npz")
