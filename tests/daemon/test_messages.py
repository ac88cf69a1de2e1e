"""Numbers in messages: as few digits as numpy's own shortest text of a float32, and no fewer."""

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.daemon.messages import shortest


def digits(text):
    return len(re.sub(r"e.*|[-.]", "", text).strip("0"))


@given(st.lists(st.floats(width=32, allow_nan=False, allow_infinity=False), max_size=40))
def test_each_number_is_the_same_and_as_short_as_numpy_writes_it(numbers):
    singles = np.array(numbers, np.float32)
    made = shortest(singles)
    assert np.array_equal(made.astype(np.float32), singles)
    assert np.array_equal(np.signbit(made), np.signbit(singles))
    for single, number in zip(singles, made.tolist(), strict=True):
        assert digits(repr(number)) <= digits(str(single)) <= 9


def test_at_the_edges_of_what_a_float32_can_be():
    random = np.random.default_rng(0)
    bits = random.integers(0, 2**32, 20_000, dtype=np.uint32).view(np.float32)
    powers = np.concatenate([2.0 ** np.arange(-149, 128), 10.0 ** np.arange(-44, 38)])
    forces = random.normal(size=20_000) * 10.0 ** random.uniform(-13, 8, 20_000)
    singles = np.concatenate([bits[np.isfinite(bits)], powers, forces]).astype(np.float32)
    made = shortest(singles)
    assert np.array_equal(made.astype(np.float32), singles)
    assert [digits(repr(n)) for n in made.tolist()] == [digits(str(n)) for n in singles]


@pytest.mark.parametrize("shape", [(0,), (2, 3, 1), ()])
def test_the_shape_stays_and_so_does_what_is_no_number(shape):
    assert shortest(np.full(shape, 0.1, np.float32)).shape == shape
    odd = np.array([np.nan, np.inf, -np.inf, -0.0], np.float32)
    assert repr(shortest(odd).tolist()) == "[nan, inf, -inf, -0.0]"
    assert shortest(np.array([[0.1, 0.2], [0.3, 0.4]], np.float32).T)[0, 1] == 0.3
