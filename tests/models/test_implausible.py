"""Loads that no touch makes: what is done to sound ones, and that it is no touch's any more."""

from dataclasses import replace

import numpy as np
import pytest

from tactile_rt.core.stream import ArraySpec
from tactile_rt.models.implausible import IMPLAUSIBLE, implausible
from tactile_rt.testing import small_spec


def array(elements: int, *channels: str) -> ArraySpec:
    units = tuple("N" if name[0] == "f" else "N m" for name in channels)
    return replace(small_spec(elements=elements), channels=channels, units=units)


SPEC = array(6, "fx", "fy", "fz", "mx", "my", "mz")


@pytest.fixture
def samples() -> np.ndarray:
    return np.random.default_rng(0).normal(size=(300, 4, 2, 6, 6)).astype(np.float32)


def made(name: str, samples: np.ndarray) -> np.ndarray:
    before = samples.copy()
    out = IMPLAUSIBLE[name](samples, SPEC, np.random.default_rng(1))
    assert np.array_equal(samples, before), "the sound ones are left alone"
    assert out.dtype == np.float32 and out.shape == samples.shape
    changed = (out != samples).reshape(len(samples), -1).any(axis=1)
    assert changed.all()
    return out


def test_swapped_channels_are_the_same_numbers_of_another_axis(samples: np.ndarray) -> None:
    out = made("swapped channels", samples)
    for vector in (slice(0, 3), slice(3, 6)):
        assert np.array_equal(np.sort(out[..., vector], axis=-1), np.sort(samples[..., vector], -1))
    both = (out != samples).reshape(300, -1, 2, 3).any(axis=(1, 3))  # (sweep, vector)
    assert 0.4 < both.all(axis=1).mean() < 0.6


def test_turned_channels_differ_by_their_signs_alone(samples: np.ndarray) -> None:
    out = made("turned channels", samples)
    assert np.array_equal(np.abs(out), np.abs(samples))
    turned = (out == -samples).all(axis=(1, 2, 3))  # (sweep, channel)
    assert np.array_equal(turned, (out != samples).any(axis=(1, 2, 3)))


def test_a_wrong_gain_is_wrong_by_far_and_alike_in_all_channels(samples: np.ndarray) -> None:
    ratio = made("wrong gain", samples) / samples
    one = ratio.reshape(300, -1)
    assert np.allclose(one, one[:, :1], rtol=1e-4)
    size = np.abs(np.log(one[:, 0]))
    assert np.log(2.5) < size.min() < size.max() < np.log(5.01)
    assert 0.4 < (one[:, 0] > 1).mean() < 0.6


def test_about_half_of_the_elements_are_missing(samples: np.ndarray) -> None:
    gone = (made("missing elements", samples) == 0).all(axis=(1, 2, 4))  # (sweep, element)
    assert set(gone.sum(axis=1)) <= {3, 4} and gone.any(axis=0).all()


def test_an_array_has_only_what_it_can_have() -> None:
    assert implausible(SPEC) == tuple(IMPLAUSIBLE)
    pressure = array(2, "fz")
    assert implausible(pressure) == ("turned channels", "wrong gain")
    one = np.ones((3, 2, 1, 2, 1), dtype=np.float32)
    out = IMPLAUSIBLE["turned channels"](one, pressure, np.random.default_rng(0))
    assert np.array_equal(out, -one)
