"""Models beside mice: the weights, the fits, their errors and the power, each by another way."""

from itertools import combinations

import numpy as np
import pytest
from scipy import stats

from tactile_rt.alignment import gate
from tactile_rt.alignment.example import Brain
from tactile_rt.alignment.gate import Mice
from tactile_rt.alignment.rdm import rdm
from tactile_rt.alignment.statistics import student

PAIRS = list(combinations(range(6), 2))


def distances(features):
    """Squared distances (..., 15) of features (..., 6, feature)."""
    return np.stack([((features[..., a, :] - features[..., b, :]) ** 2).sum(-1) for a, b in PAIRS],
                    axis=-1)  # fmt: skip


def brain_rdms(rng, number, brain=None, lost=0.0, shared=None):
    brain = brain or Brain()
    shared = brain.geometry(rng) if shared is None else shared
    return np.stack(
        [rdm(brain.rates(rng, brain.features(rng, shared, lost), 90)) for _ in range(number)]
    )


def weighted(x, y, covariance):
    """Correlation of two vectors whose entries vary together, by generalised least squares."""
    inverse = np.linalg.inv(covariance)
    ones = np.ones(len(x))
    x, y = (v - (ones @ inverse @ v) / (ones @ inverse @ ones) for v in (x, y))
    return (x @ inverse @ y) / np.sqrt((x @ inverse @ x) * (y @ inverse @ y))


def covariance_of(features, own):
    """Entry by entry, for features (6, feature) that all deviate alike."""
    made = np.zeros((2, 15, 15))
    for i, (a, b) in enumerate(PAIRS):
        for j, (c, d) in enumerate(PAIRS):
            common = (a == c) + (b == d) - (a == d) - (b == c)
            made[0, i, j] = (features[a] - features[b]) @ (features[c] - features[d]) * common
            made[1, i, j] = common**2
    return made[0] / np.trace(made[0]) + own * made[1] / np.trace(made[1])


def test_entries_vary_as_the_weights_say():
    """Features that deviate a little at random: the covariance of their distances, by trial."""
    rng = np.random.default_rng(0)
    features = rng.normal(size=(6, 5))
    moved = features + 0.02 * rng.normal(size=(200_000, 6, 5))
    found = np.cov(distances(moved).T)
    np.testing.assert_allclose(
        found / np.trace(found), covariance_of(features, 0.0), rtol=0, atol=1e-3
    )


def test_fits_are_weighted_correlations(monkeypatch):
    monkeypatch.setattr(gate, "OWN", 0.3)
    rng = np.random.default_rng(1)
    mice = distances(rng.normal(size=(6, 5)) + 0.3 * rng.normal(size=(4, 6, 5)))
    square = np.zeros((6, 6))
    for value, (a, b) in zip(mice.mean(axis=0), PAIRS, strict=True):
        square[a, b] = square[b, a] = value
    centre = np.eye(6) - 1 / 6
    values, vectors = np.linalg.eigh(-centre @ square @ centre / 2)
    assert values[0] == pytest.approx(0, abs=1e-9)  # of the constant one
    # What all distances have in common makes all values larger by as much.
    covariance = covariance_of(vectors[:, 1:] * np.sqrt(values[1:] - values[1]), 0.3)
    model = distances(rng.normal(size=(3, 6, 5)))
    factors = np.array([1.0, 1.1, 1.2, 1.3])
    found = Mice(mice, factors).compare(model[:, None])
    expected = [
        [k * weighted(m, y, covariance) for y, k in zip(mice, factors, strict=True)] for m in model
    ]
    np.testing.assert_allclose(found.fits, expected, atol=1e-6)
    pairs = [
        factors[i] * factors[j] * weighted(mice[i], mice[j], covariance)
        for i, j in combinations(range(4), 2)
    ]
    assert found.ceiling == pytest.approx(np.mean(pairs), abs=1e-6)


def test_errors_are_jackknives_and_bounds_are_of_student():
    rng = np.random.default_rng(3)
    rdms, model = brain_rdms(rng, 7), brain_rdms(rng, 1)
    mice = Mice(rdms, np.ones(7))
    found = mice.compare(model[None])

    def unit(x, part=0):
        y = x @ mice._maps[part]
        return y / np.linalg.norm(y)

    def difference(these, part=0):
        fit = np.mean([unit(model[0], part) @ unit(rdms[i], part) for i in these])
        pairs = [unit(rdms[i], part) @ unit(rdms[j], part) for i, j in combinations(these, 2)]
        return fit - np.mean(pairs)

    assert found.fit[0] - found.ceiling == pytest.approx(difference(range(7)))
    without = [difference([i for i in range(7) if i != k]) for k in range(7)]
    stimuli = [difference(range(7), part) for part in range(1, 7)]
    expected = np.sqrt(6 * np.var(without) + 5 * np.var(stimuli))
    assert found.error[0] == pytest.approx(expected)
    t = stats.t.ppf(0.875, 5)
    assert found.floor[0] == pytest.approx(found.fit[0] - t * expected, abs=1e-3)
    fits = [np.mean([unit(rdms[i]) @ unit(rdms[j]) for j in range(7) if j != i]) for i in range(7)]
    t = stats.t.ppf(0.9, 6)
    bound = np.mean(fits) - t * np.sqrt(1 + 1 / 7) * np.std(fits, ddof=1)
    assert found.bound == pytest.approx(bound, abs=1e-3)
    # Without a stimulus, none of its entries counts.
    changed = model + 9 * np.array([0 in pair for pair in PAIRS])
    np.testing.assert_allclose(unit(changed[0], 1), unit(model[0], 1), atol=1e-9)


def test_layers_are_chosen_on_the_other_mice():
    rng = np.random.default_rng(4)
    brain = Brain()
    shared = brain.geometry(rng)
    mice = Mice(brain_rdms(rng, 6, brain, shared=shared), np.ones(6))
    good, bad = brain_rdms(rng, 2, brain, shared=shared)[0], brain_rdms(rng, 1, brain)[0]
    alone = mice.compare(good[None, None])
    both = mice.compare(np.stack([bad, good, np.full(15, np.nan)])[None])
    np.testing.assert_allclose(both.fits, alone.fits)
    assert np.isnan(mice.compare(np.full((1, 2, 15), np.nan)).fit).all()


def test_verdicts_and_power_on_a_brain_of_known_truth():
    """Roughly what the benchmark measures at length: damage is found, and power foretells it."""
    worse, within, foretold = {0.0: [], 0.5: [], 1.0: []}, [], []
    for seed in range(12):
        rng = np.random.default_rng([9, seed])
        brain = Brain()
        shared = brain.geometry(rng)
        mice = Mice(brain_rdms(rng, 11, brain, shared=shared), np.ones(11))
        for lost, found in worse.items():
            models = brain_rdms(rng, 20, brain, lost, shared)[:, None]
            compared = mice.compare(models)
            found.append(compared.worse.mean())
            if not lost:
                within.append(compared.within.mean())
        power = mice.power(seed)
        foretold.append([power.passes, power.fails[0.5]])
    assert np.mean(worse[0.0]) < 0.25
    assert np.mean(worse[0.5]) > 0.7
    assert np.mean(worse[1.0]) > 0.95
    assert np.mean(within) > 0.85
    passes, fails = np.mean(foretold, axis=0)
    assert passes == pytest.approx(1 - np.mean(worse[0.0]), abs=0.15)
    assert fails == pytest.approx(np.mean(worse[0.5]), abs=0.15)


@pytest.mark.parametrize("cases", [8, 10])
def test_students_points(cases):
    for degrees in range(1, 31):
        expected = stats.t.ppf(1 - 1 / cases, degrees)
        assert student(degrees, cases) == pytest.approx(expected, abs=5e-4)
    assert student(1000, cases) == pytest.approx(stats.norm.ppf(1 - 1 / cases), abs=5e-4)
