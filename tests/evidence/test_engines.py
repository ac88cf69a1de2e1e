"""Engines side by side: what is chosen, and on what."""

import numpy as np
import pytest

pytest.importorskip("onnx")

from tactile_rt.classifier.engines import ENGINES
from tactile_rt.classifier.model_card import decided
from tactile_rt.classifier.model_file import load_model, shipped_model
from tactile_rt.classifier.model_runs import file_outputs
from tactile_rt.evidence import engines
from tactile_rt.evidence.engines import EngineSteps, best_engine, engine_records, measure_engines

LABELS = np.arange(2000) % 7


def steps(name, ms, wrong=0, refused=""):
    labels = LABELS.copy()
    labels[:wrong] += 1
    return EngineSteps(name, "1.0", refused, np.full((4, 5), ms), labels)


def test_the_fastest_of_those_that_agree_is_chosen():
    default = steps("onnxruntime", 1.0)
    fast, faster = steps("openvino", 0.8), steps("openvino-bf16", 0.5, wrong=2)
    assert best_engine([default, fast, faster]) is faster  # 99.9 % are the same
    faster.labels[2] += 1
    assert best_engine([default, fast, faster]) is fast
    assert best_engine([default, steps("openvino", 0.96)]) is default  # not worth it
    assert best_engine([default, steps("openvino", 0.1, refused="cannot run it")]) is default


def test_turns_are_compared_side_by_side():
    """Half of the time all are twice as slow, and one more so by chance."""
    default, other = steps("onnxruntime", 1.0), steps("openvino", 0.9)
    default.ms[2:] *= 2
    other.ms[2:] *= 2
    other.ms[3] *= 5
    assert other.over(default) == pytest.approx(0.9)


def test_the_same_stream_is_decided_as_the_file_says(monkeypatch):
    monkeypatch.setattr(engines, "ENGINES", {"onnxruntime": ENGINES["onnxruntime"]})
    (found,) = measure_engines(shipped_model(), 50)
    session, card = load_model(shipped_model())
    assert found.ms.shape == (3, card.steps) and found.tail >= 1
    stream = engines._touches(card)
    next(stream)  # to warm up
    shape = (1, *card.array.shape)
    expected = []
    for _ in range(3):
        outputs = file_outputs(
            session, card, next(stream)[None], np.zeros(shape, np.float32),
            np.broadcast_to(np.array(card.floor, np.float32), shape).copy(),
        )  # fmt: skip
        for step, logits in enumerate(outputs["logits"][0], start=1):
            posterior = np.exp(logits / card.temperature)
            expected.append(decided(card, posterior / posterior.sum(), step))
    assert found.labels.tolist() == expected
    assert len(set(expected)) > 2  # it tells something apart


def test_figures_name_the_stream_and_mark_what_disagrees():
    default, bf16 = steps("onnxruntime", 1.0), steps("openvino-bf16", 0.5, wrong=3)
    broken = steps("openvino", 1.0, refused="OpenVINO cannot run it")
    found = {r.name: r for r in engine_records([default, broken, bf16], "a")}
    assert found["a.openvino_bf16.agreement"].value == pytest.approx(99.85)
    assert found["a.openvino_bf16.agreement"].met is False
    assert engines.STREAM in found["a.openvino_bf16.agreement"].anchor
    assert found["a.openvino.steps"].how == "OpenVINO cannot run it"
    assert found["a.openvino_bf16.over_onnxruntime"].value == 0.5
