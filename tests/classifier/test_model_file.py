import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.decision_rules import OpenSetRule, PredictionSetRule
from tactile_rt.classifier.model_file import (
    StateTensor,
    element_order,
    load_model,
    probe_logits,
    read_model,
    shipped_model,
)
from tactile_rt.core.errors import ConfigError, ModelError, SpecMismatch
from tactile_rt.testing import small_spec
from tests.helpers.tiny_model import CARD, GRAPH, LABELS, WINDOW, write_model
from tests.helpers.touch_streams import reordered


def refusal(path: Path, said: str, load: Callable[[Path], object] = load_model) -> str:
    """Load what cannot be loaded; give the error, which is one line that begins with this."""
    with pytest.raises(ModelError, match=f"^{path}{said}") as caught:
        load(path)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_the_card_comes_back_as_it_was_written(tmp_path: Path) -> None:
    provenance = {"commands": ["tactile-rt train"], "seed": 3}
    path = write_model(tmp_path / "m.onnx", temperature=1.5, provenance=provenance)
    session, card = load_model(path)
    assert card == msgspec.structs.replace(CARD, temperature=1.5, provenance=provenance)
    assert card.array == small_spec()
    assert {i.name for i in session.get_inputs()} == {
        "samples", "offset", "sigma", "steps", "total"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("objects", "found"),
    [
        ({"classes": {"cup": ["mug", "can"], "disc": ["gear"]}}, ("cup", "cup", "disc")),
        ({"classes": {"cup": "mug"}}, (None,) * 3),
        ({"classes": 3}, (None,) * 3),
        ("mug", (None,) * 3),
    ],
)
def test_categories_count_as_the_classes_that_the_first_set_says(objects, found) -> None:
    card = msgspec.structs.replace(CARD, provenance={"sweep_set": {"objects": objects}})
    assert tuple(map(card.class_of.get, ("mug", "can", "gear"))) == found


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


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "it is empty"),
        (b'{\n\t"version": 2}', "it is text"),
        (
            b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\n",
            "it is a Git LFS pointer, not the file itself: `git lfs pull`",
        ),
        (b"PK\x03\x04\x00\x00", "it is a zip archive, as checkpoints are; `tactile-rt export`"),
    ],
)
def test_what_is_often_taken_for_a_model_is_named(tmp_path: Path, content, said: str) -> None:
    path = tmp_path / "m.onnx"
    path.write_bytes(content)
    refusal(path, f" is not a readable ONNX model: .*{said}")


@pytest.mark.parametrize(
    ("graph", "said"),
    [
        (GRAPH.replace("18]", "99]"), "it uses opset 99, and onnxruntime .* reads .* at most"),
        (GRAPH.replace("ir_version: 9", "ir_version: 99"), "Unsupported model IR version: 99"),
        (GRAPH.replace("Sub(last, last)", "Sub(last, gone)"), "Invalid model. Node input 'gone'"),
        (GRAPH.replace("Sub(last, last)", "Explode(last, last)"), "This is an invalid model."),
    ],
)
def test_onnxruntime_s_reasons_are_said_without_its_source(
    tmp_path: Path, graph: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("onnx.checker.check_model", lambda *a, **k: None)
    path = write_model(tmp_path / "m.onnx", graph)
    message = refusal(path, f" is not a readable ONNX model: {said}")
    assert "onnxruntime_src" not in message
    assert len(message) < len(str(path)) + 350


def test_other_names_are_found_without_running_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("onnxruntime.InferenceSession", None)  # would be a TypeError
    for old, said in (("sigma", "disagree with its metadata at S, sigma"), ("logits", "`logits`")):
        path = write_model(tmp_path / "m.onnx", GRAPH.replace(old, "S"))
        refusal(path, f": .*{said}", read_model)
    stored = GRAPH.replace("float[B,3,2] sigma,", "float[B,3,2] sigma, int64[1] one,")
    assert read_model(write_model(tmp_path / "m.onnx", stored))[0] == CARD


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    for path in (tmp_path / "none.onnx", tmp_path):
        with pytest.raises(ModelError, match=f"^no model file {path}$"):
            load_model(path)


def test_onnx_without_our_metadata_is_told_apart_from_damage(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.onnx", metadata="")
    refusal(path, " is ONNX but not a tactile_rt model: .*tactile-rt export")


# The sum of two elements for a state of one.
SWAPPED = (
    GRAPH.replace("float[B,1] total_next)", "float[B,2] total_next)")
    .replace(
        "total_next = Add(total, sum)",
        "total_wide = Add(total, sum)\n  total_next = Concat<axis = 1>(total_wide, total_wide)",
    )
    .replace("steps_column, total_next, last", "steps_column, total_wide, last")
)


UNKNOWN = OpenSetRule(score="entropy", output="logits", thresholds=(1.5,))
RULE = PredictionSetRule(score="1 - posterior", coverage=0.95, quantiles=(0.9,) * 4, objects=200)
replaced = msgspec.structs.replace


def card_with(**fields: object) -> str:
    return json.dumps({**msgspec.to_builtins(CARD), **fields})


@pytest.mark.parametrize(
    ("metadata", "said"),
    [
        ("{", "has damaged metadata"),
        ("{}", "has metadata of version None; this release reads 3"),
        (card_with(version=4), "has metadata of version 4; this release reads 3"),
        ('{"version": 3}', "has damaged metadata: .*missing required field"),
        ('{"version": 3, "name": ' + "[" * 100_000, "has damaged metadata: "),
        (card_with(clip=[1e-3, float("1e308")]).replace("1e+308", "1e999"), "has damaged metadata"),
        (card_with(steps="many"), r"has damaged metadata: .*\$.steps"),
        (card_with(spec="{}"), "has damaged metadata: array spec of version None"),
        (card_with(spec="mouse"), "has damaged metadata: not an array spec"),
    ],
)
def test_metadata_that_cannot_be_read_says_why(tmp_path: Path, metadata: str, said: str) -> None:
    refusal(write_model(tmp_path / "m.onnx", metadata=metadata), f" {said}")


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
    refusal(path, f": the graph's inputs disagree with its metadata {where}")


def test_a_state_without_a_batch_axis_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of no further axes it is like the card's but for that."""
    monkeypatch.setattr("onnx.checker.check_model", lambda *a, **k: None)
    path = write_model(tmp_path / "m.onnx", GRAPH.replace("int64[B] steps,", "int64[] steps,"))
    refusal(path, ": .* disagree with its metadata at steps$")


@pytest.mark.parametrize(
    ("graph", "changes", "complaint"),
    [
        (GRAPH, {"labels": LABELS[:4]}, "no output `logits` of 4 classes"),
        (GRAPH.replace("logits", "scores"), {}, "no output `logits`, which its metadata promises"),
        (GRAPH.replace("total_next", "summed"), {}, "no output `total_next`"),
        (GRAPH, {"embedding": 3}, "no output `embedding` of 3 units"),
        (GRAPH.replace("embedding", "hidden"), {}, "no output `embedding`, which its metadata"),
        (SWAPPED, {}, "no output `total_next` like `total`"),
    ],
)
def test_outputs_that_the_card_promises_must_be_there(
    tmp_path: Path, graph: str, changes: dict, complaint: str
) -> None:
    refusal(write_model(tmp_path / "m.onnx", graph, **changes), f": {complaint}")


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"steps": 0}, r"Expected `int` >= 1 - at `\$.steps`"),
        ({"temperature": 0.0}, r"Expected `float` > 0.0 - at `\$.temperature`"),
        ({"floor": (1e-3,)}, "1 values of floor for 2 channels"),
        ({"floor": (1e-3, 0.0)}, r"Expected `float` > 0.0 - at `\$.floor\[.+\]`"),
        ({"period_ns": 1}, r"Expected `int` >= 1000 - at `\$.period_ns`"),
        ({"substeps": 10**12}, "samples has the shape 1000000000000x3x2"),
        ({"labels": ("a", "a", "b", "c", "d")}, "labels are missing or repeat"),
        ({"labels": ("a", "b", "c", "d", "\x1b[2J")}, "labels must be 1 to 200 printable"),
        ({"name": "x" * 3_000_000}, r"Expected `str` of length <= 200 - at `\$.name`"),
        ({"license": "\x1b[2J"}, "a licence must be at most 200 printable characters"),
        ({"steps": 1_000_000}, "an episode has 18000000 values"),
        ({"provenance": {"unseen_objects": "mug"}}, "unseen_objects of the provenance"),
        ({"state": (*CARD.state, StateTensor("samples", (1,), "float32"))}, "names of the state"),
        ({"state": (CARD.state[0], StateTensor("total", (2**40, 2**40), "float32"))},
         "total has the shape 1099511627776x1099511627776"),
        ({"state": (CARD.state[0], StateTensor("total", (-1,), "float32"))}, "total has the"),
        ({"state": tuple(StateTensor(f"s{i}", (2**28,), "int8") for i in range(9))}, "its state"),
        ({"state": (CARD.state[0], StateTensor("total", (1,), "object"))}, "state total has"),
        ({"probe": ((0.0,) * 5,) * 3}, "the probe must be 4 steps of 5 logits"),
        ({"embedding": 0}, "embedding must be 1 or more, not 0"),
        ({"sensor": "quiet"}, r"Expected `object`, got `str` - at `\$.sensor`"),
        ({"refusals": ("steps",)}, "refusals must be the last entries"),
        ({"refusals": LABELS}, "all labels are refusals"),
        ({"unknown": replaced(UNKNOWN, score="")}, "unknown.score must be 1 to 200 printable"),
        ({"unknown": replaced(UNKNOWN, output="state")}, r"Invalid enum .*\$.unknown.output"),
        ({"unknown": replaced(UNKNOWN, thresholds=())}, "unknown.thresholds: 0 values, neither 1"),
        ({"candidates": (RULE, replaced(RULE, coverage=1.0))},
         r"Expected `float` < 1.0 - at `\$.candidates\[.+\].coverage`"),
        ({"candidates": (replaced(RULE, quantiles=(0.1,)),)},
         r"candidates\[0\].quantiles: 1 values for 4 steps"),
        ({"candidates": (replaced(RULE, objects=0),)}, r"Expected `int` >= 1 .*objects"),
        ({"candidates": (replaced(RULE, noise=-1.0),)}, r"Expected `float` >= 0.* .*noise"),
        ({"kind": "window"}, "kind is window, but state is"),
        ({"kind": "film"}, r"Invalid enum value 'film'.*kind"),
    ],
)  # fmt: skip
def test_a_card_that_cannot_be_run_is_refused_before_it_is_run(
    tmp_path: Path, changes: dict, complaint: str
) -> None:
    path = write_model(tmp_path / "m.onnx", **changes)
    refusal(path, f" has damaged metadata: {complaint}", lambda p: Classifier(p, small_spec()))


def test_running_a_model_writes_nothing_to_the_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """onnxruntime logs its failures to stderr unless told not to."""
    load_model(write_model(tmp_path / "m.onnx"))
    (tmp_path / "bad.onnx").write_bytes(b"garbage")
    refusal(tmp_path / "bad.onnx", "")
    assert capfd.readouterr() == ("", "")


def test_one_thread_runs_the_model(tmp_path: Path) -> None:
    session, _ = load_model(write_model(tmp_path / "m.onnx"))
    options = session.get_session_options()
    assert (options.intra_op_num_threads, options.inter_op_num_threads) == (1, 1)


def test_the_shipped_model_can_be_run() -> None:
    _, card = load_model(shipped_model())
    assert len(card.labels) == len(set(card.labels)) >= 12
    assert card.figures["parity"] <= 1e-5
    Classifier(shipped_model(), card.array)


# ---- what may differ between a model and a source


def test_a_source_with_the_elements_in_another_order_is_permuted() -> None:
    spec = small_spec(elements=4)
    assert element_order(spec, spec).tolist() == [0, 1, 2, 3]
    source = reordered(spec, (2, 0, 3, 1))
    order = element_order(spec, replace(source, name="other", rate_hz=17.0))
    values = np.array([ord(e[-1]) for e in source.elements])
    assert [source.elements[i] for i in order] == list(spec.elements)
    assert values[order].tolist() == [ord(e[-1]) for e in spec.elements]


def test_anything_else_that_differs_is_said_exactly() -> None:
    spec = small_spec(elements=4)
    source = reordered(spec, (2, 0, 3, 1))
    moved = replace(source, positions=((9.0, 9.0, 9.0), *source.positions[1:]))
    for other, said in [
        (small_spec(elements=3), f"lacks {spec.elements[3]}"),
        (small_spec(elements=5), "^A4 unknown to the model$"),
        (replace(source, elements=("new", *source.elements[1:])),
         f"lacks {source.elements[0]}; new unknown to the model"),
        (moved, r"positions\[2\] is \(9.0, 9.0, 9.0\), not"),
        (replace(source, channels=source.channels[::-1]), r"channels\[0\] is"),
        (replace(source, frame="elsewhere"), "frame is 'elsewhere', not"),
    ]:  # fmt: skip
        with pytest.raises(SpecMismatch, match=said):
            element_order(spec, other)


# ---- versions, kinds, providers


def test_sensor_and_rules_come_back_as_they_were_written(tmp_path: Path) -> None:
    given = {
        "sensor": {"rate_hz": 80.0, "range": {"bx": [-0.1, 0.1]}, "noise_density": None},
        "unknown": UNKNOWN,
        "candidates": (RULE, replaced(RULE, coverage=0.8, noise=1.0)),
    }
    path = write_model(tmp_path / "m.onnx", **given)
    session, card = load_model(path)
    assert card == replaced(CARD, **given)
    by_step = replaced(UNKNOWN, output="embedding", thresholds=(1.0, 2.0, 3.0, 4.0))
    assert read_model(write_model(path, unknown=by_step))[0].unknown == by_step
    # Places: nothing acts on them yet.
    plain = probe_logits(*load_model(write_model(tmp_path / "plain.onnx")))
    assert np.array_equal(probe_logits(session, card), plain)


def test_fields_that_a_later_release_adds_are_passed_over(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.onnx", metadata=card_with(colour="red"))
    assert load_model(path)[1] == CARD


def test_a_window_is_loaded_only_where_one_is_wanted(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.onnx", WINDOW, kind="window", state=())
    refusal(path, " is a model of kind 'window'; this needs 'step'")
    session, card = load_model(path, kind="window")
    assert probe_logits(session, card).shape == (4, 5)
    write_model(path, WINDOW.replace("B,T", "B,7"), kind="window", state=())
    with pytest.raises(ModelError, match=r"disagree with its metadata at samples$"):
        load_model(path, kind=None)


def test_a_provider_that_is_not_there_is_refused_not_replaced(tmp_path: Path) -> None:
    path = write_model(tmp_path / "m.onnx")
    with pytest.raises(ConfigError, match=r"^no NoSuchProvider in this onnxruntime: it has .*CPU"):
        load_model(path, providers=("NoSuchProvider", "CPUExecutionProvider"))


GOLDEN = [0.0, 4.0, 0.00201300555, -1.13864025e-05, 0.00100000005]


def test_the_probe_is_one_episode_of_the_same_input_everywhere(tmp_path: Path) -> None:
    session, card = load_model(write_model(tmp_path / "m.onnx"))
    logits = probe_logits(session, card)
    assert logits[:, 1].tolist() == [1, 2, 3, 4]  # steps since the reset
    # Golden: the input must never change, or stored probes would all miss.
    assert np.array_equal(logits, probe_logits(session, card))
    assert logits[-1].tolist() == pytest.approx(GOLDEN, rel=1e-6)
