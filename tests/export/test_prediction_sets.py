"""The coverage of a rule holds on draws that it was not fitted on."""

import numpy as np
import pytest

from tactile_rt.classifier.decision_rules import UNKNOWN, mass_above
from tactile_rt.core.errors import RecordingError
from tactile_rt.export.decision_thresholds import fit_open_set, fit_prediction_sets

STEPS, CLASSES = 22, 10


def objects(
    rng: np.random.Generator, n: int, sweeps: int = 4
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Posteriors (sweep, step, class), labels and names: hard objects are hard in all sweeps."""
    labels = rng.integers(0, CLASSES, n).repeat(sweeps)
    skill = rng.normal(1.0, 1.5, n).repeat(sweeps)
    logits = rng.normal(size=(n * sweeps, STEPS, CLASSES))
    logits[np.arange(n * sweeps), :, labels] += skill[:, None] * np.linspace(0.3, 2, STEPS)
    raised = np.exp(2 * logits)
    names = np.array([f"o-{k}" for k in range(n)]).repeat(sweeps)
    return (raised / raised.sum(axis=-1, keepdims=True)).astype(np.float32), labels, names


def kept(rule, posteriors: np.ndarray, labels: np.ndarray) -> float:
    inside = [
        all(labels[k] in rule.prediction_set(p, step) for step, p in enumerate(steps, start=1))
        for k, steps in enumerate(posteriors)
    ]
    return float(np.mean(inside))


@pytest.mark.parametrize("sweeps", [1, 4])
@pytest.mark.parametrize("coverage", [0.8, 0.95])
def test_the_truth_is_in_the_prediction_set_at_every_step_as_often_as_its_coverage_says(
    coverage: float, sweeps: int
) -> None:
    rng = np.random.default_rng(0)
    found = []
    for _ in range(40):
        rule = fit_prediction_sets([objects(rng, 60, sweeps)], noise=1.0, coverage=coverage)
        found.append(kept(rule, *objects(rng, 40)[:2]))
    # one figure strays by the objects that its rule was fitted on, the mean by a sixth of it
    assert coverage - 0.015 < np.mean(found) < coverage + 0.04
    assert rule.objects == 60 and rule.noise == 1.0


def test_the_coverage_is_that_of_the_harder_group() -> None:
    rng = np.random.default_rng(1)
    hard = objects(rng, 200)
    easy = objects(rng, 200)
    easy[0][:] = 0.001
    easy[0][np.arange(800), :, easy[1]] = 0.991
    alone = fit_prediction_sets([hard], 1.0)
    both = fit_prediction_sets([easy, hard], 1.0)
    # of one name, as where some objects are in two sets
    assert both.quantiles == pytest.approx(alone.quantiles) and both.objects == 200


def test_too_few_objects_make_no_prediction_set() -> None:
    rng = np.random.default_rng(0)
    few, enough = objects(rng, 49), objects(rng, 90)
    assert fit_prediction_sets([few], 1.0) is None
    assert fit_prediction_sets([enough, few], 1.0) is None, "it would not be kept to all"


def test_sweeps_without_contact_do_not_count() -> None:
    posteriors, labels, names = objects(np.random.default_rng(0), 80)
    with_gaps = posteriors.copy()
    with_gaps[::4] = np.nan
    kept_of = np.arange(len(labels)) % 4 > 0
    same = fit_prediction_sets([(posteriors[kept_of], labels[kept_of], names[kept_of])], 1.0)
    assert fit_prediction_sets([(with_gaps, labels, names)], 1.0) == same
    silent = np.full_like(posteriors, np.nan), labels, names
    assert fit_prediction_sets([silent, (with_gaps, labels, names)], 1.0) == same
    with pytest.raises(RecordingError, match="no validation sweep has both a contact"):
        fit_prediction_sets([silent], 1.0)


def test_known_kinds_are_refused_no_more_than_said() -> None:
    rng = np.random.default_rng(0)
    names = np.array([f"o-{k}" for k in range(100)]).repeat(5)
    groups = [rng.beta(1, 9, (500, STEPS)), rng.beta(1, 3, (500, STEPS))]
    rule = fit_open_set([(group, names) for group in groups], refused=0.1)
    for group in groups:
        share = (group > np.array(rule.thresholds)).mean(axis=0)
        assert (share <= 0.1 + 1e-9).all()
    assert (np.array(rule.thresholds) < 0.65).all(), "nor much fewer than that"
    assert rule.score == f"posterior of {UNKNOWN}"


def test_new_objects_are_refused_no_more_than_said_where_few_told_the_threshold() -> None:
    rng, refused = np.random.default_rng(0), []
    for _ in range(200):
        few = rng.beta(1, 9, (12, 1)), np.array([f"o-{k}" for k in range(12)])
        (threshold,) = fit_open_set([few], refused=0.1).thresholds
        refused.append((rng.beta(1, 9, 500) > threshold).mean())
    assert 0.03 < np.mean(refused) <= 0.1


def test_a_network_that_is_sure_of_known_things_refuses_none_of_them() -> None:
    sure = np.full((300, STEPS), 1e-7) * np.random.default_rng(0).random((300, STEPS))
    rule = fit_open_set([(sure, np.array([f"o-{k}" for k in range(300)]))])
    assert rule.thresholds == (0.05,) * STEPS


def test_the_mass_above_a_class_is_that_of_the_more_probable_ones() -> None:
    p = np.array([[0.2, 0.5, 0.3], [1 / 3, 1 / 3, 1 / 3]], dtype=np.float32)
    assert mass_above(p) == pytest.approx(np.array([[0.8, 0, 0.5], [0, 1 / 3, 2 / 3]]))
    # a refusal has all of the posterior: of the classes, all are alike
    assert mass_above(np.zeros((1, 3))) == pytest.approx(np.array([[0, 1 / 3, 2 / 3]]))
