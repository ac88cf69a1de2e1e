"""Held-out choice of layers and exact permutation, against loops and against chance."""

from itertools import permutations

import numpy as np
import pytest

from tactile_rt.alignment.rdm import rdm
from tactile_rt.alignment.statistics import held_out, highest, max_statistic, standard_error


def plain_held_out(values):
    """(layer, animal) -> score per animal."""
    scores = []
    for animal in range(values.shape[1]):
        others = [np.mean([v for i, v in enumerate(row) if i != animal]) for row in values]
        scores.append(values[int(np.argmax(others)), animal])
    return np.array(scores)


def test_each_animal_is_scored_on_the_layer_that_the_others_choose():
    values = np.random.default_rng(0).normal(size=(3, 7, 5))
    scores, chosen = held_out(values)
    for one, score, layer in zip(values, scores, chosen, strict=True):
        np.testing.assert_allclose(score, plain_held_out(one))
        np.testing.assert_allclose(one[layer, range(5)], score)


def test_one_animal_chooses_nothing():
    scores, chosen = held_out(np.ones((3, 1)))
    assert np.isnan(scores).all()
    assert (chosen == -1).all()
    assert np.isnan(max_statistic(np.random.default_rng(0).random((3, 15)), [range(15)], [1.0]).p)


def test_the_null_relabels_stimuli_and_chooses_layers_anew():
    rng = np.random.default_rng(1)
    patterns = rng.normal(size=(3, 6, 10))
    targets, factors = rng.random((4, 15)), np.array([1.1, 1.3, 1.0, 2.0])
    test = max_statistic(rdm(patterns), targets, factors)
    expected = []
    for order in permutations(range(6)):
        rdms = [1 - np.corrcoef(p[list(order)])[np.triu_indices(6, k=1)] for p in patterns]
        values = np.array([[np.corrcoef(r, t)[0, 1] for t in targets] for r in rdms]) * factors
        expected.append(plain_held_out(values).mean())
    np.testing.assert_allclose(test.null, expected, rtol=0, atol=1e-12)
    assert test.statistic == pytest.approx(expected[0])
    assert test.p == np.mean(np.array(expected) >= expected[0] - 1e-12)
    assert test.percentile_95 == pytest.approx(np.percentile(expected, 95))


def test_a_perfect_model_has_the_smallest_p_and_symmetries_count():
    rng = np.random.default_rng(2)
    target = rng.random(15)
    goal = np.stack([target + 0.01 * rng.normal(size=15) for _ in range(5)])
    assert max_statistic([target], goal, np.ones(5)).p == 1 / 720
    # Shape alone: 2 shapes and 3! x 3! distances leave this RDM as it is.
    shape = np.array([float((a < 3) != (b < 3)) for a in range(6) for b in range(a + 1, 6)])
    assert max_statistic([shape], [shape, shape], np.ones(2)).p == 72 / 720


def test_a_layer_without_an_rdm_takes_no_part():
    rng = np.random.default_rng(3)
    rdms, targets = rng.random((3, 15)), rng.random((4, 15))
    holed = np.vstack([rdms, np.full(15, np.nan), np.ones(15)])
    with_it, without = (max_statistic(r, targets, np.ones(4)) for r in (holed, rdms))
    assert (with_it.p, with_it.statistic) == (without.p, without.statistic)
    assert np.isnan(max_statistic(holed[3:], targets, np.ones(4)).statistic)


def test_the_highest_of_everything_is_no_evidence():
    """20 layers x 12 targets of random RDMs, corrected as the pooled animals are: 0.79 and 0.93."""
    rng = np.random.default_rng(4)
    factor = 0.329451 / 0.283455
    tops = factor * np.array(
        [highest(np.corrcoef(rng.random((20 + 12, 15)))[:20, 20:]) for _ in range(2000)]
    )
    assert np.median(tops) == pytest.approx(0.79, abs=0.01)
    assert np.percentile(tops, 95) == pytest.approx(0.93, abs=0.015)


def test_the_standard_error_counts_animals_that_have_a_score():
    assert standard_error([1.0, 2.0, np.nan, 3.0]) == pytest.approx(1 / np.sqrt(3))
    assert np.isnan(standard_error([1.0, np.nan]))
