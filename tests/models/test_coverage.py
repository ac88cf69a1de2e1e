"""The coverage of a model is counted as it is decided."""

from pathlib import Path

import numpy as np
import pytest

from tactile_rt.classifier.decision_rules import MASS_ABOVE, POSTERIOR, UNKNOWN, PredictionSetRule
from tactile_rt.classifier.decision_rules import OpenSetRule as Rule
from tactile_rt.core.stream import Timing
from tactile_rt.models.datasets import SweepSet
from tactile_rt.models.evaluation.measured_coverage import measure_coverage, named_faults
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import Sweeps
from tactile_rt.testing import small_spec
from tests.helpers.tiny_model import CARD, PERIOD_NS, STEPS, SUBSTEPS, write_model

LEAD = 40
# the tiny model's logits are 0, the step, the sum of all windows, the last sample, sigma
LABELS = ("none", "late", "strong", UNKNOWN, "wrong gain")
FLOOR = np.array(CARD.floor, dtype=np.float32)


@pytest.fixture(autouse=True)
def _steps_of_the_tiny_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SweepSet, "timing", Timing(STEPS, SUBSTEPS))


def touched(*loads: float, labels: tuple[int, ...]) -> SweepSet:
    """Sweeps of whiskers that all feel so much from `LEAD` on."""
    values = np.zeros((len(loads), LEAD + STEPS * SUBSTEPS + 8, 3, 2), dtype=np.float32)
    values[:, LEAD:] = np.array(loads)[:, None, None, None]
    names = np.array([f"thing-{k}" for k in range(len(loads))])
    manifest = SweepManifest(small_spec(), PERIOD_NS, LEAD, LABELS[:3], {"test": tuple(names)})
    return SweepSet(manifest, Sweeps(values, np.array(labels), names), FLOOR, FLOOR)


def model(tmp_path: Path, **changes: object) -> Path:
    return write_model(tmp_path / "m.onnx", labels=LABELS, refusals=LABELS[3:], **changes)


def test_a_model_without_refusals_has_no_coverage(tmp_path: Path) -> None:
    assert measure_coverage(write_model(tmp_path / "m.onnx"), touched(0.1, labels=(1,))) is None


def test_covered_is_what_has_the_truth_in_the_prediction_set_of_every_step(tmp_path: Path) -> None:
    # of 0.1 "late" is most probable at every step, of 10 "strong"
    data = touched(0.1, 10.0, 10.0, labels=(1, 2, 1))
    narrow = PredictionSetRule(MASS_ABOVE, 0.9, (0.0,) * STEPS, 80)
    found = measure_coverage(model(tmp_path, candidates=(narrow,)), data)
    assert (found.nominal, found.covered.value, found.size.value) == (0.9, 2 / 3, 1.0)
    wide = replace_quantiles(narrow, 1.0)
    found = measure_coverage(model(tmp_path, candidates=(wide,)), data)
    assert (found.covered.value, found.size.value) == (1.0, 3.0)
    first = replace_quantiles(narrow, 1.0, first=0.0)  # one step is enough to break it
    assert measure_coverage(model(tmp_path, candidates=(first,)), data).covered.value == 2 / 3


def replace_quantiles(
    rule: PredictionSetRule, q: float, first: float | None = None
) -> PredictionSetRule:
    quantiles = (q if first is None else first, *(q,) * (STEPS - 1))
    return PredictionSetRule(rule.score, rule.coverage, quantiles, rule.objects)


def test_things_of_no_known_kind_are_counted_as_refused_or_not(tmp_path: Path) -> None:
    strange = touched(0.1, 0.1, labels=(-1, -1))
    for threshold, share in ((1.0, 0.0), (0.0, 1.0)):
        rule = Rule(POSTERIOR, "logits", (threshold,))
        found = measure_coverage(model(tmp_path, unknown=rule), strange)
        assert found.unknown.value == share
        assert np.isnan(found.covered.value) and np.isnan(found.nominal)


def test_a_fault_is_named_where_a_label_that_is_one_is_decided(tmp_path: Path) -> None:
    data = touched(10.0, 10.0, labels=(0, 0))
    (found,) = named_faults(model(tmp_path), data)
    assert (found[0], found[1].value) == ("wrong gain", 0.0), "the strong one is decided"
    # the label that is most probable of every strong touch is now that of a fault
    other = ("none", "late", "wrong gain", UNKNOWN, "turned channels")
    path = write_model(tmp_path / "o.onnx", labels=other, refusals=other[2:])
    named = {name: one.value for name, one in named_faults(path, data)}
    assert named == {"wrong gain": 1.0, "turned channels": 0.0}  # turned, they are not strong


def test_touches_that_are_not_found_count_against_no_coverage(tmp_path: Path) -> None:
    all_classes = PredictionSetRule(MASS_ABOVE, 0.9, (1.0,) * STEPS, 80)
    found = measure_coverage(
        model(tmp_path, candidates=(all_classes,)), touched(0.1, 0.0, labels=(1, 1))
    )
    assert (found.covered.value, found.size.value) == (1.0, 3.0)
