"""Decoding the stimuli, against a plain loop, and what chance gives."""

import itertools

import numpy as np
import pytest

from tactile_rt.alignment.decoding import (
    DISTANCE,
    SHAPE,
    decode,
    decode_paper,
    decode_rdm,
    mean_decoded,
)
from tactile_rt.alignment.rdm import rdm


def loop(patterns, labels, folds):
    """Nearest class mean, one stimulus after the other; equals share the credit."""
    values = patterns - patterns.mean(axis=1, keepdims=True)
    values = values / np.linalg.norm(values, axis=1, keepdims=True)
    right = 0.0
    for i in range(6):
        far = {}
        for label in set(labels):
            members = [j for j in range(6) if labels[j] == label and folds[j] != folds[i]]
            far[label] = np.linalg.norm(values[i] - values[members].mean(axis=0))
        least = [label for label, d in far.items() if d <= min(far.values()) + 1e-9]
        right += (labels[i] in least) / len(least)
    return right / 6


def test_against_a_plain_loop():
    rng = np.random.default_rng(0)
    for _ in range(20):
        patterns = rng.normal(size=(6, 9))
        found = decode(patterns)
        assert found.shape == pytest.approx(loop(patterns, SHAPE, DISTANCE))
        assert found.distance == pytest.approx(loop(patterns, DISTANCE, SHAPE))


def test_chance_is_of_all_relabellings():
    patterns = np.random.default_rng(1).normal(size=(6, 9))
    found = decode(patterns)
    null = np.array(
        [loop(patterns[list(p)], SHAPE, DISTANCE) for p in itertools.permutations(range(6))]
    )
    assert found.shape_chance == pytest.approx(null.mean())
    assert found.shape_p == pytest.approx((null >= found.shape - 1e-9).mean())


def test_noise_is_decoded_as_by_a_guess_in_few_and_in_many_dimensions():
    rng = np.random.default_rng(2)
    for units in (20, 1000):
        found = [decode(rng.normal(size=(6, units))) for _ in range(80)]
        # s.e. of a mean of 80 accuracies of six correlated decisions: 0.025
        assert np.mean([d.shape for d in found]) == pytest.approx(1 / 2, abs=0.08)
        assert np.mean([d.distance for d in found]) == pytest.approx(1 / 3, abs=0.08)
        assert np.mean([d.shape_chance for d in found]) == pytest.approx(1 / 2, abs=0.02)


def test_what_is_plain_is_found():
    rng = np.random.default_rng(3)
    shape, distance = rng.normal(size=(2, 40)), rng.normal(size=(3, 40))
    patterns = shape[list(SHAPE)] + distance[list(DISTANCE)] + 0.01 * rng.normal(size=(6, 40))
    found = decode(patterns)
    assert (found.shape, found.distance) == (1, 1)
    # Renaming shapes (2) and distances (6) changes nothing: six stimuli can show no more.
    assert min(found.shape_p, found.distance_p) == pytest.approx(12 / 720)
    # Nor does, for shapes as far apart as these, which convex goes with which concave.
    assert found.shape_p == pytest.approx(72 / 720)


def test_an_rdm_has_all_that_is_needed():
    patterns = np.random.default_rng(4).normal(size=(6, 9))
    assert decode(patterns) == decode_rdm(rdm(patterns))


def test_nothing_to_decode():
    assert np.isnan(decode(np.ones((6, 4))).shape)


def test_the_papers_variant_is_below_a_guess_on_noise():
    pytest.importorskip("sklearn")
    rng = np.random.default_rng(5)
    found = decode_paper(rng.normal(size=(6, 1000)))
    assert found.shape == found.distance == 0
    assert max(found.shape_chance, found.distance_chance) < 0.1


def test_the_papers_variant_uses_one_thread_whatever_others_use():
    pytest.importorskip("sklearn")
    threadpoolctl = pytest.importorskip("threadpoolctl")
    seen = []

    def fit(values, labels):
        seen.append({pool["num_threads"] for pool in threadpoolctl.threadpool_info()})
        return 0.0

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tactile_rt.alignment.decoding._leave_one_out", fit)
        decode_paper(np.random.default_rng(0).normal(size=(6, 9)))
    assert seen and set().union(*seen) == {1}


def test_the_row_of_animals_is_their_mean():
    rng = np.random.default_rng(6)
    several = [decode(rng.normal(size=(6, 9))) for _ in range(5)]
    found = mean_decoded([*several, decode(np.ones((6, 4)))])
    assert found.shape == pytest.approx(np.mean([d.shape for d in several]))
    assert found.distance_chance == pytest.approx(np.mean([d.distance_chance for d in several]))
    assert np.isnan(found.shape_p)
    assert np.isnan(mean_decoded([]).shape)
