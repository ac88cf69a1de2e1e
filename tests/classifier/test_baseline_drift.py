"""The slope of quiet samples and the levels of still ones, against least squares by numpy."""

import numpy as np
import pytest

from tactile_rt.classifier.baseline_drift import Drift, RestLevels

BOTH = np.ones(2, dtype=bool)  # elements, of one channel
SIGMA = np.full((2, 1), 0.5, dtype=np.float32)
BLOCK, BLOCKS = 20, 8


def fit(samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, slope and variance about the line of the means of blocks; of each element."""
    means = samples[..., 0].reshape(-1, BLOCK, 2).mean(axis=1)
    times = np.arange(len(means)) * BLOCK + (BLOCK - 1) / 2
    (slope, start), left, *_ = np.polyfit(times, means, 1, full=True)
    return start + slope * times.mean(), slope, left / (len(times) - 2)


def drifting(slope: float, noise: float, seed: int = 0, n: int = BLOCK * BLOCKS) -> np.ndarray:
    ramp = slope * np.arange(n)[:, None, None]
    return ramp + np.random.default_rng(seed).normal(size=(n, 2, 1)) * noise


def follow(samples: np.ndarray, valid: np.ndarray = BOTH) -> Drift:
    drift = Drift()
    whole = [drift.add(at, sample, valid, SIGMA) for at, sample in enumerate(samples)]
    assert whole == [(at + 1) % BLOCK == 0 for at in range(len(samples))]
    return drift


@pytest.mark.parametrize("noise", [0.05, 0.8])  # below what is assumed, and above
def test_a_slope_is_that_of_least_squares_and_where_it_leads_is_known_to_six_errors(noise):
    samples = drifting(0.05, noise, seed=4)
    mean, slope, variance = fit(samples)
    drift = follow(samples)
    assert drift.found and drift.straight and drift.span == BLOCK * (BLOCKS - 1)
    assert drift.slope[:, 0] == pytest.approx(slope, rel=1e-9)
    middle = (BLOCK * BLOCKS - 1) / 2
    squares = BLOCK**2 * (BLOCKS**3 - BLOCKS) / 12
    error = np.sqrt(np.maximum(variance, 0.5**2 / BLOCK) / squares)
    for at in (middle - 600, middle + 40):
        there = mean + (at - middle) * slope
        off = 6 * np.hypot((at - middle) * error, 0.5) * [[1.0], [-1.0]]
        for part, right in (
            (0.999 * off, True),
            (1.001 * off[:1], False),
            (1.001 * off[1:], False),
        ):
            assert all(drift.leads_to(at, (there + p)[:, None], SIGMA) == right for p in part)


def test_a_slope_is_one_beyond_six_errors_and_close_to_a_line():
    samples = drifting(0.0, 0.4, seed=1)
    slope, variance = fit(samples)[1:]
    squares = BLOCK**2 * (BLOCKS**3 - BLOCKS) / 12
    limit = 6 * np.sqrt(np.maximum(variance, 0.5**2 / BLOCK) / squares)
    ramp = np.arange(len(samples))[:, None]
    for times, found in ((0.99, [False, False]), (1.01, [True, True])):
        drift = follow(samples + (ramp * (times * limit - slope))[..., None])
        assert list(drift.slope[:, 0] != 0) == found and drift.found == any(found)
    bend = np.where(np.arange(BLOCKS) % 2, 1.0, -1.0).repeat(BLOCK)[:, None, None]
    away = np.sqrt(4 * 0.5**2 / BLOCK / (fit(0 * samples + bend)[2][0]))
    assert follow(drifting(0.3, 0.0) + 0.99 * away * bend).straight
    bent = follow(drifting(0.3, 0.0) + 1.01 * away * bend)
    assert not bent.straight and not bent.found and not bent.leads_to(0, samples[0], SIGMA)


def test_a_slope_that_begins_late_is_found_from_there_on_and_needs_trusted_samples():
    assert not follow(drifting(0.05, 0.1)[:-BLOCK]).found
    drift = follow(np.concatenate([np.zeros((400, 2, 1)), drifting(0.2, 0.0, n=420)]))
    assert drift.straight and drift.slope[:, 0] == pytest.approx(0.2)
    assert drift.span == 20 * BLOCK  # a block less of what was flat with each that slopes
    long = follow(drifting(0.2, 0.0, n=40 * BLOCK))
    assert long.span == BLOCK * 29  # of the latest thirty blocks
    one = follow(drifting(0.2, 0.0), np.array([True, False]))
    assert one.found and one.slope[0] > 0 and one.slope[1] == 0


def returns(levels: RestLevels, away: float, quiet: int, first: float = 0.0) -> list[bool]:
    """Three rests, each after a move; what is said at the end of each."""
    said = []
    for level in (first, away, away):
        for value in (level, 1e3):
            for k in range(20):
                sample = np.full((2, 1), value * (1 + k * (value == 1e3)), dtype=np.float32)
                found = levels.confirm_rest(sample, BOTH, SIGMA, quiet)
                assert not found or k == 19
            said.append(found)
    return said


def test_a_level_is_rest_at_its_third_return_if_longer_than_the_baseline_was_quiet():
    assert returns(RestLevels(), 0.0, 59) == [False] * 4 + [True, False]
    assert returns(RestLevels(), 0.0, 60) == [False] * 6
    # medians of 20 samples differ by 60 in the square of their errors, pi / 20 of the noise's
    away = 0.5 * np.sqrt(60 * np.pi / 20)
    assert returns(RestLevels(), 0.999 * away, 0) == [False] * 4 + [True, False]
    assert returns(RestLevels(), 1.001 * away, 0) == [False] * 6


@pytest.mark.parametrize(("wild", "rests"), [(2, True), (3, False)])
def test_so_many_samples_of_a_still_stretch_may_be_wild(wild, rests):
    levels, far = RestLevels(), np.float32(0.5 * np.sqrt(60.5))
    said = []
    for k in range(200):
        moves = (k // 20) % 2
        value = 1e3 * k if moves else far * (k % 20 < wild)
        said.append(levels.confirm_rest(np.full((2, 1), value, np.float32), BOTH, SIGMA, 0))
    assert any(said) == rests


def test_an_element_that_is_not_trusted_throughout_a_stretch_says_nothing_of_it():
    levels, nothing, said = RestLevels(), RestLevels(), []
    for k in range(100):
        values = np.array([[1e3 * k * ((k // 20) % 2)], [1e3 * k]], dtype=np.float32)
        said.append(levels.confirm_rest(values, np.array([True, k % 20 == 0]), SIGMA, 0))
    assert said == [k == 99 for k in range(100)]
    assert not any(nothing.confirm_rest(SIGMA, ~BOTH, SIGMA, 0) for _ in range(100))
