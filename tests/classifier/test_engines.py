"""Engines: the same steps whoever computes them, and nobody is imported who was not chosen."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from msgspec.structs import replace

from tactile_rt.classifier.classifier import Classifier
from tactile_rt.classifier.engines import ENGINES, Engine, check_engine, open_network
from tactile_rt.classifier.model_file import shipped_model
from tactile_rt.classifier.stepper import Stepper
from tactile_rt.errors import ConfigError, ModelError
from tests.helpers.tiny_model import CARD, STEPS, write_model
from tests.helpers.touch_streams import QUIET, SAME_RATE, push_all, signal, stream

ALL = [
    pytest.param(
        name,
        marks=pytest.mark.skipif(not engine.version, reason=f"{engine.package} is not installed"),
    )
    for name, engine in ENGINES.items()
]
# Of the logits' spread: float32 sums in another order; bfloat16 has 8 bits, and 20 layers round.
WITHIN = {"onnxruntime": 0.0, "openvino": 1e-4, "openvino-bf16": 0.15}


def episodes(stepper: Stepper, card, lanes: int = 1) -> np.ndarray:
    """(step, lane, class) logits of two episodes of loads, each from a state of zeros."""
    rng = np.random.default_rng(3)
    scale = np.array(card.scale, dtype=np.float32)
    sigma = np.broadcast_to(np.array(card.floor, dtype=np.float32), card.array.shape)
    said = []
    for _ in range(2):
        stepper.begin(scale * 0.5 * np.ones(card.array.shape, np.float32), sigma)
        for _ in range(card.steps):
            stepper.samples[:] = rng.standard_normal(stepper.samples.shape) * scale
            said.append(stepper.run().copy())
    return np.stack(said)


@pytest.mark.parametrize("engine", ALL)
@pytest.mark.parametrize("lanes", [1, 3])
def test_every_engine_says_what_onnxruntime_says(engine: str, lanes: int) -> None:
    network, card = open_network(shipped_model())
    expected = episodes(Stepper(network, card, lanes), card)
    network, card = open_network(shipped_model(), engine)
    found = episodes(Stepper(network, card, lanes), card)
    assert found.shape == expected.shape
    assert abs(found - expected).max() <= WITHIN[engine] * expected.std()


@pytest.mark.parametrize("engine", ALL)
def test_state_is_explicit_and_a_lane_is_reset_alone(engine: str, tmp_path: Path) -> None:
    network, card = open_network(write_model(tmp_path / "m.onnx"), engine)
    stepper = Stepper(network, card, lanes=2)
    zeros = np.zeros(card.array.shape, np.float32)
    stepper.begin(zeros, zeros)
    counted = []
    for step in range(STEPS):
        if step == 2:
            stepper.reset(1)
        counted.append(stepper.run()[:, 1].copy())  # steps so far
        assert np.array_equal(stepper.embedding[:, 0], counted[-1])
    assert np.array_equal(counted, [[1, 1], [2, 2], [3, 1], [4, 2]])


@pytest.mark.parametrize("engine", ALL)
def test_a_stream_is_decided_alike(engine: str, tmp_path: Path) -> None:
    model = write_model(tmp_path / "m.onnx")
    chunks = stream(signal([(QUIET, QUIET + 60, 1.0)], QUIET + 100))
    expected = push_all(Classifier(model, SAME_RATE), chunks)
    classifier = Classifier(model, SAME_RATE, engine=engine)
    found = push_all(classifier, chunks)
    assert classifier.engine == engine and classifier.remark == ""
    assert [(d.t_ns, d.label) for d in found] == [(d.t_ns, d.label) for d in expected]
    assert len(found) == STEPS


@pytest.mark.parametrize("engine", ALL)
def test_a_step_leaves_the_thread_s_arithmetic_alone(engine: str) -> None:
    network, card = open_network(shipped_model(), engine)
    episodes(Stepper(network, card), card)
    assert np.float32(1e-38) * np.float32(0.1) > 0


@pytest.mark.parametrize("engine", ALL)
def test_a_graph_that_disagrees_with_its_card_is_refused_by_every_engine(
    engine: str, tmp_path: Path
) -> None:
    steps, total = CARD.state
    path = write_model(tmp_path / "m.onnx", state=(replace(steps, shape=(2,)), total))
    with pytest.raises(ModelError, match=r"disagree with its metadata at steps"):
        Stepper(*open_network(path, engine))


def test_an_engine_that_is_not_there_is_told_with_what_installs_it(monkeypatch) -> None:
    with pytest.raises(ConfigError, match="no engine 'tpu'; there are onnxruntime, openvino"):
        check_engine("tpu")
    monkeypatch.setattr(Engine, "version", property(lambda engine: ""))
    with pytest.raises(
        ConfigError,
        match=r"^engine 'openvino' needs .*, which is not installed: .*pip install .*openvino",
    ):
        Classifier(shipped_model(), CARD.array, engine="openvino")


def test_execution_providers_are_onnxruntime_s_own(monkeypatch) -> None:
    monkeypatch.setattr(Engine, "version", property(lambda engine: "1.0"))
    monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CUDAExecutionProvider"])
    with pytest.raises(ConfigError, match="'openvino' has no execution providers: cuda"):
        Classifier(shipped_model(), CARD.array, engine="openvino", providers=("cuda",))


def test_nobody_imports_an_engine_that_was_not_chosen(tmp_path: Path) -> None:
    """Whether it is installed or not: here it is, and cannot be imported."""
    (tmp_path / "openvino").mkdir()
    (tmp_path / "openvino" / "__init__.py").write_text("raise SystemExit('imported')\n")
    code = (
        "from tactile_rt.classifier.model_file import read_model, shipped_model\n"
        "from tactile_rt.classifier.classifier import Classifier\n"
        "c = Classifier(shipped_model(), read_model(shipped_model())[0].array)\n"
        "print(c.engine)\n"
    )
    path = os.pathsep.join([str(tmp_path), *(p for p in sys.path if p)])
    done = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == "onnxruntime\n"
