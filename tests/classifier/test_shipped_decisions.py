"""What the shipped model decides on the shipped recording, number by number.

`python -m tests.classifier.test_shipped_decisions` writes the file anew, where a model or the
recording has changed on purpose.
"""

from pathlib import Path

import numpy as np
import pytest

from tactile_rt import Classification, Classifier, shipped_model
from tactile_rt.recording.replay import DEMO
from tactile_rt.sources.opening import open_source

FILE = Path(__file__).parent / "data" / "shipped_decisions.npz"
ROUNDING = 2e-6  # of probabilities: processors multiply in other orders


def classify(left_out_s: float = 0.0) -> list[Classification]:
    """Every decision on the recording, without its first seconds."""
    with open_source(f"replay:{DEMO}?speed=0") as source:
        classifier = Classifier(shipped_model(), source.spec)
        later = (chunk for chunk in source if chunk.t_ns[0] >= left_out_s * 1e9)
        return [one for chunk in later for one in classifier.push(chunk)]


def decide() -> dict[str, np.ndarray]:
    """Every decision on the recording, as arrays."""
    made = classify()
    return {
        "label": np.array([one.label for one in made]),
        "onset_ns": np.array([one.onset_ns for one in made]),
        "t_ns": np.array([one.t_ns for one in made]),
        "step": np.array([one.step for one in made]),
        "probabilities": np.array([one.probabilities for one in made], np.float32),
        "prediction_set": np.array([",".join(one.prediction_set) for one in made]),
    }


def test_every_decision_is_the_one_that_it_was() -> None:
    found = decide()
    with np.load(FILE) as file:
        was = dict(file)
    assert found.keys() == was.keys()
    np.testing.assert_allclose(
        found.pop("probabilities"), was.pop("probabilities"), rtol=0, atol=ROUNDING
    )
    for name, values in was.items():
        assert (found[name] == values).all(), name
    assert len(was["label"]) == 132


@pytest.mark.parametrize("left_out_s", [0.9, 1.2, 3.0, 4.8, 6.6])
def test_a_stream_that_is_joined_within_a_touch_is_decided_from_the_next_one_on(left_out_s):
    found = [one for one in classify(left_out_s) if one.final]
    later = [o for o in classify() if o.final and o.onset_ns > (left_out_s + 0.3) * 1e9]
    assert [one.label for one in found] == [one.label for one in later]
    assert all(abs(a.onset_ns - b.onset_ns) < 2e7 for a, b in zip(found, later, strict=True))


if __name__ == "__main__":
    np.savez_compressed(FILE, **decide())
