import json
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

pytest.importorskip("onnx")

from tiny_model import CARD, GRAPH, LABELS, write_model

from tactile_rt.classifier import Classifier
from tactile_rt.model_file import StateTensor, load_model, shipped_model
from tactile_rt.stream import ModelError
from tactile_rt.testing import small_spec


def test_the_card_comes_back_as_it_was_written(tmp_path: Path) -> None:
    provenance = {"commands": ["tactile-rt train"], "seed": 3}
    path = write_model(tmp_path / "m.onnx", temperature=1.5, provenance=provenance)
    session, card = load_model(path)
    assert card == msgspec.structs.replace(CARD, temperature=1.5, provenance=provenance)
    assert card.array == small_spec()
    assert {i.name for i in session.get_inputs()} == {
        "samples", "offset", "sigma", "steps", "total"
    }  # fmt: skip


def test_a_batch_is_a_batch_of_independent_streams(tmp_path: Path) -> None:
    session, _ = load_model(write_model(tmp_path / "m.onnx"))
    rng = np.random.default_rng(0)
    feed = {
        "samples": rng.normal(size=(4, 3, 3, 2)).astype(np.float32),
        "offset": rng.normal(size=(4, 3, 2)).astype(np.float32),
        "sigma": np.ones((4, 3, 2), dtype=np.float32),
        "steps": np.arange(4),
        "total": rng.normal(size=(4, 1)).astype(np.float32),
    }
    together = session.run(["logits"], feed)[0]
    for i in range(4):
        alone = session.run(["logits"], {k: v[i : i + 1] for k, v in feed.items()})[0]
        assert np.array_equal(alone[0], together[i])


def test_a_batch_frozen_into_the_graph_is_refused_unless_it_is_one(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="batch size is fixed"):
        load_model(write_model(tmp_path / "m.onnx", GRAPH.replace("[B", "[2")))


@pytest.mark.parametrize("content", [b"", b"garbage" * 100, b"\x08\x08", b"PK\x03\x04"])
def test_a_file_that_is_not_onnx_is_named_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "m.onnx"
    path.write_bytes(content)
    with pytest.raises(ModelError, match=f"^{path} is not a readable ONNX model: .+") as caught:
        load_model(path)
    assert "\n" not in str(caught.value)


def test_a_model_cut_short_is_named(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.onnx")
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ModelError, match=f"^{path} "):
        load_model(path)


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "none.onnx", tmp_path):
        with pytest.raises(ModelError, match=f"^no model file {path}$"):
            load_model(path)


def test_onnx_without_our_metadata_is_told_apart_from_damage(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.onnx", metadata="")
    with pytest.raises(
        ModelError, match=r"is ONNX but not a tactile_rt model: .*tactile-rt export"
    ):
        load_model(path)


def card_with(**fields: object) -> str:
    return json.dumps({**msgspec.to_builtins(CARD), **fields})


@pytest.mark.parametrize(
    ("metadata", "complaint"),
    [
        ("{", "has damaged metadata"),
        ("[1]", "has damaged metadata"),
        ("{}", "has metadata of version None; this release reads 1"),
        (card_with(version=2), "has metadata of version 2; this release reads 1"),
        ('{"version": 1}', "has damaged metadata: .*missing required field"),
        (card_with(steps="many"), r"has damaged metadata: .*\$.steps"),
        (card_with(spec="{}"), "has damaged metadata: array spec of version None"),
        (card_with(spec="mouse"), "has damaged metadata: not an array spec"),
    ],
)
def test_metadata_that_cannot_be_read_says_why(
    tmp_path: Path, metadata: str, complaint: str
) -> None:
    path = write_model(tmp_path / "m.onnx", metadata=metadata)
    with pytest.raises(ModelError, match=f"^{path} {complaint}"):
        load_model(path)


@pytest.mark.parametrize(
    ("changes", "where"),
    [
        ({"substeps": 5}, "at samples$"),
        ({"spec": small_spec(elements=4).to_json()}, "at offset, samples, sigma$"),
        ({"state": CARD.state[:1]}, "at total$"),
        ({"state": (*CARD.state, StateTensor("more", (2,), "float32"))}, "at more$"),
        ({"state": (StateTensor("steps", (), "int64"), StateTensor("total", (2,), "float32"))},
         "at total$"),
        ({"state": (StateTensor("steps", (), "int32"), CARD.state[1])}, "at steps$"),
    ],
)  # fmt: skip
def test_a_graph_that_disagrees_with_its_card_is_refused(
    tmp_path: Path, changes: dict, where: str
) -> None:
    path = write_model(tmp_path / "m.onnx", **changes)
    with pytest.raises(
        ModelError, match=f"^{path}: the graph's inputs disagree with its metadata {where}"
    ):
        load_model(path)


@pytest.mark.parametrize(
    ("graph", "changes", "complaint"),
    [
        (GRAPH, {"labels": LABELS[:4]}, "no output `logits` of 4 classes"),
        (GRAPH.replace("logits", "scores"), {}, "no output `logits` of 5 classes"),
        (GRAPH.replace("total_next", "summed"), {}, "no output `total_next`"),
    ],
)
def test_outputs_that_the_card_promises_must_be_there(
    tmp_path: Path, graph: str, changes: dict, complaint: str
) -> None:
    path = write_model(tmp_path / "m.onnx", graph, **changes)
    with pytest.raises(ModelError, match=f"^{path}: {complaint}"):
        load_model(path)


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"period_ns": 0}, "period_ns must be positive"),
        ({"steps": 0}, "steps must be positive"),
        ({"temperature": 0.0}, "temperature must be positive"),
        ({"temperature": -1.0}, "temperature must be positive"),
        ({"floor": (1e-3,)}, "1 values of floor for 2 channels"),
        ({"clip": (1.0, 1.0, 1.0)}, "3 values of clip for 2 channels"),
        ({"scale": ()}, "0 values of scale for 2 channels"),
        ({"floor": (1e-3, 0.0)}, "floor must be positive"),
    ],
)
def test_a_card_that_cannot_be_run_is_refused_before_it_is_run(
    tmp_path: Path, changes: dict, complaint: str
) -> None:
    path = write_model(tmp_path / "m.onnx", **changes)
    with pytest.raises(ModelError, match=f"^{path} has damaged metadata: {complaint}"):
        Classifier(path, small_spec())


def test_running_a_model_writes_nothing_to_the_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """onnxruntime logs its failures to stderr unless told not to."""
    load_model(write_model(tmp_path / "m.onnx"))
    (tmp_path / "bad.onnx").write_bytes(b"garbage")
    with pytest.raises(ModelError):
        load_model(tmp_path / "bad.onnx")
    assert capfd.readouterr() == ("", "")


def test_one_thread_runs_the_model(tmp_path: Path) -> None:
    session, _ = load_model(write_model(tmp_path / "m.onnx"))
    options = session.get_session_options()
    assert (options.intra_op_num_threads, options.inter_op_num_threads) == (1, 1)


def test_loading_a_model_leaves_the_process_s_arithmetic_alone(tmp_path: Path) -> None:
    """A runtime may flush subnormal numbers to zero, for itself; not in the user's simulation."""
    path = write_model(tmp_path / "m.onnx")
    code = f"""
import sys
from pathlib import Path
from tactile_rt.model_file import load_model
load_model(Path({str(path)!r}))
assert sys.float_info.min / 2 > 0
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_the_shipped_model_can_be_run() -> None:
    _, card = load_model(shipped_model())
    assert len(card.labels) == len(set(card.labels)) >= 12
    assert card.figures["parity"] <= 1e-5
    Classifier(shipped_model(), card.array)
