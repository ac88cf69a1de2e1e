"""Support vector machines that say how far they are from a decision."""

from pathlib import Path

import numpy as np
import pytest

from tactile_rt.core.errors import ConfigError
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.evaluation.svm import fit, fit_svm
from tests.helpers.tiny_sweeps import write_tiny_set


def blobs(classes: list[int], n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """(sweep, feature) values about a corner each, and their labels."""
    rng = np.random.default_rng(0)
    labels = np.repeat(classes, n)
    corners = 3 * rng.normal(size=(10, 5))
    return (corners[labels] + rng.normal(size=(len(labels), 5))).astype(np.float32), labels


@pytest.mark.parametrize("classes", [[0, 1, 2, 5], [1, 3]])
def test_the_largest_margin_is_the_decision(classes: list[int]) -> None:
    x, y = blobs(classes)
    machine = fit(x, y, 10.0)
    margins = machine.margins(x, classes=7)
    assert margins.shape == (len(x), 7)
    assert np.mean(margins.argmax(axis=1) == machine(x)) > 0.99
    missing = [k for k in range(7) if k not in classes]
    assert np.isneginf(margins[:, missing]).all()
    assert np.isfinite(margins[:, classes]).all()


def test_one_category_is_nothing_to_tell_apart(tmp_path: Path) -> None:
    write_tiny_set(tmp_path / "set")
    train = SweepSet.read(tmp_path / "set", "train")
    one = train[np.flatnonzero(train.sweeps.labels == 0)]
    with pytest.raises(ConfigError, match="needs touches of two categories"):
        fit_svm(one, one)
