"""Plucks: damped oscillators in closed form, found again in noise."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from tactile_rt.sim_backend.measuring.ringing import find_swings, fit_ring


def pluck(rate_hz, hz, ratio, size, seed=0, seconds=None) -> np.ndarray:
    """(n, 2) a whisker that is bent for 0.3 s, held for 0.1 s and let go, in noise of 1."""
    rng = np.random.default_rng(seed)
    omega = 2 * math.pi * hz
    seconds = seconds or 0.5 + 2 * math.log(10 * size) / (ratio * omega) + 3 / hz
    t = np.arange(round((seconds + 1) * rate_hz)) / rate_hz - 1 - rng.uniform() / rate_hz
    swing = omega * math.sqrt(1 - ratio**2)
    free = np.exp(-ratio * omega * t.clip(0)) * (
        np.cos(swing * t.clip(0)) + ratio / math.sqrt(1 - ratio**2) * np.sin(swing * t.clip(0))
    )
    bent = np.clip((t + 0.4) / 0.3, 0, 1)
    way = np.array([math.cos(seed), math.sin(seed)])
    return size * np.where(t < 0, bent, free)[:, None] * way + rng.standard_normal((len(t), 2))


def ring(away, rate_hz):
    (swing,) = find_swings([away], rate_hz)
    return fit_ring(away[swing.begin : swing.end], rate_hz)


@given(
    rate_hz=st.floats(80, 1000),
    share=st.floats(0.02, 0.4),
    ratio=st.floats(0.005, 0.2),
    size=st.floats(80, 3000),
    seed=st.integers(0, 1000),
)
def test_a_pluck_tells_frequency_and_damping(rate_hz, share, ratio, size, seed) -> None:
    hz = share * rate_hz
    assume(hz > 3)
    # What is above the noise lasts for two periods and a dozen samples.
    assume(math.log(size / 12) / (2 * math.pi * ratio) > 2)
    assume(math.log(size / 12) / (2 * math.pi * ratio * share) > 24)
    found = ring(pluck(rate_hz, hz, ratio, size, seed), rate_hz)
    assert found is not None
    assert abs(found.hz - hz) < 5 * found.hz_error + 1e-3 * hz
    assert abs(found.ratio - ratio) < 5 * found.ratio_error + 0.01 * ratio


@pytest.mark.parametrize(
    ("rate_hz", "hz", "ratio", "size"),
    [(80, 20, 0.05, 200), (200, 60, 0.02, 60), (1000, 120, 0.1, 300), (500, 9, 0.005, 100)],
)
def test_errors_are_as_large_as_they_are_said_to_be(rate_hz, hz, ratio, size) -> None:
    found = [ring(pluck(rate_hz, hz, ratio, size, seed), rate_hz) for seed in range(40)]
    off = np.array([((r.hz - hz) / r.hz_error, (r.ratio - ratio) / r.ratio_error) for r in found])
    assert (np.abs(off) < 1.96).mean() > 0.85
    assert (np.abs(off).mean(axis=0) < 1.2).all()
    assert (np.abs(np.median(off, axis=0)) < 0.8).all()


def test_a_whisker_that_is_led_back_does_not_swing() -> None:
    t = np.linspace(0, 3, 3000)
    bump = 300 * np.exp(-(((t - 1.5) / 0.3) ** 2))
    away = bump[:, None] + np.random.default_rng(0).standard_normal((3000, 1))
    assert ring(away, 1000) is None


def test_two_swings_at_once_are_none() -> None:
    t = np.arange(3000) / 1000
    both = sum(np.exp(-3 * t) * np.cos(2 * np.pi * hz * t) for hz in (31, 73))
    away = 300 * np.array(both)[:, None] + np.random.default_rng(0).standard_normal((3000, 1))
    assert ring(away, 1000) is None


def test_a_swing_too_fast_for_the_rate_is_none() -> None:
    assert ring(pluck(100, 47, 0.02, 500, seconds=2), 100) is None


def test_the_echo_of_a_pluck_in_another_whisker_is_left_out() -> None:
    rng = np.random.default_rng(0)
    loud, echo, own = (rng.standard_normal((6000, 1)) for _ in range(3))
    loud[1000:1200] += 1000
    echo[1000:1200] += 60
    own[4000:4200] += 60
    found = find_swings([loud, echo, own], 1000)
    assert [(s.element, s.begin) for s in found] == [(0, 1000), (2, 4000)]
