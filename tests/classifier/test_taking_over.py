"""One classifier takes the place of another in the middle of a stream."""

from pathlib import Path

import numpy as np
import pytest

from tactile_rt.classifier.classifier import Classifier
from tests.helpers.tiny_model import CARD, PERIOD_NS, STEPS, SUBSTEPS, write_model
from tests.helpers.touch_streams import QUIET, SAME_RATE, push_all, same, signal, stream

TOUCHES = [(QUIET, QUIET + 60, 1.0), (QUIET + 160, QUIET + 220, 1.0)]
CHUNKS = stream(signal(TOUCHES, 420))
BETWEEN = (QUIET + 110) // 7  # chunks: after the first touch and its episode
WITHIN = (QUIET + 5) // 7


def test_who_goes_on_decides_as_the_one_before_would_have(model: Path) -> None:
    alone = push_all(Classifier(model, SAME_RATE), CHUNKS)
    old, new = Classifier(model, SAME_RATE), Classifier(model, SAME_RATE)
    first = push_all(old, CHUNKS[:BETWEEN])
    assert not old.deciding and len(first) == STEPS
    assert new.go_on_from(old) and new.detector.ready
    assert same(first + push_all(new, CHUNKS[BETWEEN:]), alone)
    assert len(alone) == 2 * STEPS


@pytest.mark.parametrize(
    "change", [{"period_ns": PERIOD_NS + 1}, {"floor": tuple(2 * f for f in CARD.floor)}]
)
def test_who_hears_otherwise_cannot_go_on(tmp_path: Path, model: Path, change: dict) -> None:
    old = Classifier(model, SAME_RATE)
    push_all(old, CHUNKS[:BETWEEN])
    new = Classifier(write_model(tmp_path / "other.onnx", **change), SAME_RATE)
    assert not new.go_on_from(old)
    assert not new.detector.ready


def test_it_is_deciding_from_the_onset_to_the_end_of_both_touch_and_episode(model: Path) -> None:
    classifier = Classifier(model, SAME_RATE)
    assert not classifier.deciding
    deciding = []
    for chunk in CHUNKS:
        classifier.push(chunk)
        deciding.append(classifier.deciding)
    turns = (np.flatnonzero(np.diff(deciding)) + 1) * 7
    # A touch ends with its twentieth quiet sample.
    ends = [QUIET, QUIET + 60 + 20, QUIET + 160, QUIET + 220 + 20]
    assert len(turns) == 4 and (abs(turns - ends) <= 10).all()


def test_who_forgets_is_as_at_the_beginning(model: Path) -> None:
    classifier = Classifier(model, SAME_RATE)
    push_all(classifier, CHUNKS[:WITHIN])
    assert classifier.deciding
    classifier.forget()
    assert not classifier.deciding and not classifier.detector.ready
    assert same(push_all(classifier, CHUNKS), push_all(Classifier(model, SAME_RATE), CHUNKS))


def test_a_step_is_as_long_as_its_samples(model: Path) -> None:
    assert Classifier(model, SAME_RATE).step_ms == SUBSTEPS * 9.0
