"""Contact impulses: the laws that they have to obey."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.sim_backend.rods.friction import CREEP, impulses


def solved(response: np.ndarray, free: np.ndarray, friction: float) -> np.ndarray:
    count = len(free) // 3
    found, drag = np.zeros(3 * count), np.zeros(count)
    for _ in range(200):  # each call goes on from the last one's
        impulses(count, response, free, friction, drag, found)
    return found


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 0.3, 0.5, 1.0]))
def test_one_contact_obeys_signorini_and_coulomb(seed: int, friction: float) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 5)) * 10 ** rng.uniform(-1, 1, (3, 1))  # whiskers give unevenly
    response, free = root @ root.T, rng.normal(size=3)
    n, *t = solved(response, free, friction)
    after = response @ [n, *t] + free
    size = abs(free).max()
    assert n >= 0
    if free[0] >= 0:
        assert n == 0 and not np.any(t), "what parts is not held"
        return
    assert after[0] == pytest.approx(0, abs=1e-6 * size)
    slip, drag = np.hypot(*after[1:]), np.hypot(*t)
    assert drag <= friction * n * (1 + 1e-6)
    if friction and slip > 100 * CREEP:
        assert drag == pytest.approx(friction * n, rel=1e-3), "what slides has all its friction"
        assert t @ after[1:] == pytest.approx(-drag * slip, rel=1e-6), "against the slip"


@given(st.integers(0, 2**32 - 1))
def test_contacts_without_friction_solve_the_complementarity_problem(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(2, 6))
    root = rng.normal(size=(3 * count, 20))
    response, free = root @ root.T, rng.normal(size=3 * count)
    found = solved(response, free, 0.0)
    normal, gap = found[::3], (response @ found + free)[::3]
    assert (normal >= 0).all() and gap.min() >= -1e-5
    assert abs(normal * gap).max() <= 1e-5
    assert not found[1::3].any() and not found[2::3].any()


def test_a_sliding_contact_is_not_opened_by_its_friction() -> None:
    """As the convex cones of many engines do: there the slip shows along the normal, too."""
    response = np.diag([1.0, 0.5, 0.5])
    found = solved(response, np.array([-1.0, 8.0, 0.0]), 0.5)
    np.testing.assert_allclose(response @ found + [-1.0, 8.0, 0.0], [0, 7.75, 0], atol=1e-9)
