"""Classical estimates against analytic loads and the elastica of the peg benchmark."""

import numpy as np
import pytest

from tactile_rt.classifier import contact_point
from tactile_rt.classifier.contact_point import ESTIMATES, WhiskerShapes
from tactile_rt.core.errors import ConfigError

ONE = np.zeros(1, dtype=np.int64)


def shapes(length=0.02, curvature=0.0, base=5e-5, tip=5e-6, young=5e9) -> WhiskerShapes:
    return WhiskerShapes(*(np.array([v]) for v in (length, curvature, base, tip, young)))


def push(point, force) -> np.ndarray:
    """Loads at the base of a force at a point: M = r x F."""
    return np.concatenate([force, np.cross(point, force)])[None]


@pytest.mark.parametrize("name", ESTIMATES)
@pytest.mark.parametrize("force", [(0, 1e-9, 0), (0, -3e-10, 4e-10), (2e-9, 1e-9, 0)])
def test_a_straight_cantilever_is_exact(name: str, force: tuple) -> None:
    """So faint a push that nothing bends, with and without friction along the whisker."""
    for distance in (0.001, 0.0123, 0.0199):
        found = ESTIMATES[name](push((distance, 0, 0), force), ONE, shapes())
        assert found == pytest.approx(distance, rel=2e-4)


def test_the_resting_shape_corrects_for_its_curvature() -> None:
    """A point of the parabola, its arc length by a closed formula, force across and along."""
    a, x = 20.0, 0.012
    arc = x * np.sqrt(1 + (2 * a * x) ** 2) / 2 + np.arcsinh(2 * a * x) / (4 * a)
    at = (x, a * x**2, 0.0)
    curved = shapes(curvature=a)
    for force in ((-2e-10, 5e-10, 0.0), (0.0, 0.0, 1e-10), (3e-10, 1e-10, -2e-10)):
        loads = push(at, force)
        assert contact_point.resting(loads, ONE, curved) == pytest.approx(arc, rel=2e-3)
        assert contact_point.bent(loads, ONE, curved) == pytest.approx(arc, rel=5e-3)
    assert abs(contact_point.straight(loads, ONE, curved)[0] - arc) > 0.02 * arc


def test_the_bent_whisker_finds_the_peg_of_the_elastica() -> None:
    """Loads and arc length from the independent solver of the peg benchmark."""
    pytest.importorskip("mujoco")
    pytest.importorskip("numba")
    from bench.sim.beams import flat
    from bench.sim.pegs import presses

    worst = dict.fromkeys(ESTIMATES, 0.0)
    for case in [c for c in presses() if c.depth > 0.3][::89]:
        whisker, truth = flat(case.whisker, case.bend), case.arc
        loads = np.array([[*case.force, 0, 0, 0, case.moment * 1e-3]]) * 1e-3
        radii = whisker.base_radius * 1e-3, whisker.tip_radius * 1e-3
        of = shapes(whisker.length * 1e-3, whisker.curvature * 1e3, *radii, whisker.young_modulus)
        for name, estimate in ESTIMATES.items():
            error = abs(estimate(loads, ONE, of)[0] * 1e3 - truth) / whisker.length
            worst[name] = max(worst[name], error)
    assert worst["bent"] < 0.005
    assert worst["resting"] > 0.05, "what takes no bend into account is off"
    assert worst["straight"] > 0.05


def test_three_dimensions_are_the_plane_turned() -> None:
    """About its own axis a straight whisker looks the same from everywhere."""
    rng = np.random.default_rng(0)
    plane = push((0.011, -0.002, 0), (1e-5, 2e-4, 0))
    for angle in rng.uniform(0, 2 * np.pi, 3):
        c, s = np.cos(angle), np.sin(angle)
        turn = np.kron(np.eye(2), [[1, 0, 0], [0, c, -s], [0, s, c]])
        for estimate in ESTIMATES.values():
            a = estimate(plane, ONE, shapes())
            assert estimate(plane @ turn.T, ONE, shapes()) == pytest.approx(a, rel=1e-9)


def test_nothing_felt_and_nonsense_stay_within_the_whisker() -> None:
    loads = np.vstack([np.zeros((1, 6)), np.random.default_rng(1).normal(size=(50, 6))])
    for estimate in ESTIMATES.values():
        found = estimate(loads, np.zeros(51, dtype=np.int64), shapes(curvature=10.0))
        assert np.isfinite(found).all() and found.min() >= 0 and found.max() <= 0.02 * (1 + 1e-12)
        assert estimate(np.zeros((0, 6)), np.zeros(0, dtype=np.int64), shapes()).shape == (0,)


def test_shapes_are_complete() -> None:
    with pytest.raises(ConfigError, match="tip_radius needs a finite value for each whisker"):
        WhiskerShapes(*(np.ones(2),) * 3, np.ones(1), np.ones(2))
