"""Half-ranges are kept and filled, what is off stays, and every draw is a whisker array."""

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.files import mouse_whiskers, rat_whiskers
from tactile_rt.sim_backend.arrays.whisker_array import MOUNT, WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.randomisation import Randomisation

MOUSE = WhiskerArray("mouse-right", mouse_whiskers(), MOUNT, Path("head.stl"))
RAT = WhiskerArray("rat-right", rat_whiskers())
FIELDS = [f.name for f in fields(Randomisation)]
RELATIVE = ("young_modulus", "density", "damping_ratio", "friction", "length", "radius")
RELATIVE += ("curvature",)
SHARED = ("young_modulus", "density", "damping_ratio", "friction", "mount_mm", "mount_deg")

# randomised: (attributes of a whisker or of the mount that it changes)
CHANGES = {name: (name,) for name in RELATIVE} | {
    "density": ("density_base", "density_tip"),
    "radius": ("base_radius", "tip_radius"),
    "angles_deg": ("angles",),
    "base_mm": ("base",),
    "mount_mm": ("position",),
    "mount_deg": ("roll_pitch_yaw",),
}


def deviation(name: str, drawn: WhiskerArray, nominal: WhiskerArray) -> NDArray[np.float64]:
    """(whisker or 1, values) by how much a draw differs, in the units of the half-range."""
    pairs: list[tuple[object, object]] = (
        [(drawn.mount, nominal.mount)]
        if name.startswith("mount")
        else list(zip(drawn.whiskers, nominal.whiskers, strict=True))
    )
    rows = []
    for one, other in pairs:
        a, b = (np.array([getattr(x, c) for c in CHANGES[name]]).ravel() for x in (one, other))
        rows.append(a / b - 1 if name in RELATIVE else a - b)
    return np.array(rows) * (180 / math.pi if name.endswith("_deg") else 1)


def size(name: str) -> float:
    """A half-range to test with."""
    return 0.2 if name in RELATIVE else 3.0


def test_off_it_returns_the_very_same_array() -> None:
    assert Randomisation().draw(np.random.default_rng(0), MOUSE) is MOUSE


@pytest.mark.parametrize("randomisation", [Randomisation(), Randomisation(length=0.1, mount_mm=1)])
def test_what_else_is_drawn_stays_the_same(randomisation: Randomisation) -> None:
    plain, used = np.random.default_rng(4), np.random.default_rng(4)
    randomisation.draw(used, MOUSE)
    assert plain.random(5).tolist() == used.random(5).tolist()


def test_the_generator_decides_everything_and_each_draw_is_another() -> None:
    randomisation = Randomisation(**dict.fromkeys(FIELDS, 0.1))
    one, same = np.random.default_rng(4), np.random.default_rng(4)
    first, second = randomisation.draw(one, MOUSE), randomisation.draw(one, MOUSE)
    assert first == randomisation.draw(same, MOUSE) != second
    assert second == randomisation.draw(same, MOUSE)


@pytest.mark.parametrize("name", FIELDS)
def test_each_quantity_changes_its_own_attributes_only(name: str) -> None:
    drawn = Randomisation(**{name: size(name)}).draw(np.random.default_rng(2), MOUSE)
    assert drawn.name == MOUSE.name
    restored = replace(
        drawn,
        mount=replace(
            drawn.mount,
            **{c: getattr(MOUSE.mount, c) for c in CHANGES[name] if name.startswith("mount")},
        ),
        whiskers=tuple(
            replace(w, **{c: getattr(n, c) for c in CHANGES[name] if not name.startswith("mount")})
            for w, n in zip(drawn.whiskers, MOUSE.whiskers, strict=True)
        ),
    )
    assert restored == MOUSE != drawn
    assert (deviation(name, drawn, MOUSE) != 0).all()


@pytest.mark.parametrize("name", FIELDS)
def test_draws_are_uniform_over_the_half_range(name: str) -> None:
    rng = np.random.default_rng(7)
    randomisation = Randomisation(**{name: size(name)})
    few = replace(MOUSE, whiskers=MOUSE.whiskers[10:13])
    draws = np.array(
        [deviation(name, randomisation.draw(rng, few), few) for _ in range(400)]
    )  # (draw, whisker or 1, value)
    assert np.abs(draws).max() <= size(name) * (1 + 1e-9)
    uniform = stats.uniform(-size(name), 2 * size(name))
    for column in draws.reshape(400, -1).T:
        assert stats.kstest(column, uniform.cdf).pvalue > 1e-3
    if name in RELATIVE:  # both ends by one factor
        np.testing.assert_allclose(draws[..., 0], draws[..., -1], rtol=1e-9, atol=1e-12)
        draws = draws[..., :1]
    if name in SHARED:
        np.testing.assert_allclose(draws, draws[:, :1].repeat(draws.shape[1], 1), atol=1e-12)
        draws = draws[:, :1]
    across = np.corrcoef(draws.reshape(400, -1).T) - np.eye(draws[0].size)
    assert np.abs(across).max() < 0.2


@pytest.mark.parametrize("name", FIELDS)
def test_what_one_quantity_draws_does_not_depend_on_the_others(name: str) -> None:
    everything = Randomisation(**{n: size(n) / 2 for n in FIELDS})
    alone = Randomisation(**{name: size(name) / 2})
    both = [r.draw(np.random.default_rng(3), RAT) for r in (everything, alone)]
    np.testing.assert_array_equal(*(deviation(name, array, RAT) for array in both))


@settings(max_examples=40, deadline=None)
@given(
    ranges=st.fixed_dictionaries({n: st.floats(0, 0.9) for n in FIELDS}),
    seed=st.integers(0, 2**32),
    array=st.sampled_from([MOUSE, RAT]),
)
def test_every_draw_is_a_whisker_array(
    ranges: dict[str, float], seed: int, array: WhiskerArray
) -> None:
    ranges |= {n: min(ranges[n], 0.5) for n in ("length", "radius")}
    drawn = Randomisation(**ranges).draw(np.random.default_rng(seed), array)
    for whisker, nominal in zip(drawn.whiskers, array.whiskers, strict=True):
        assert isinstance(whisker, Whisker)  # which refuses what no whisker can have
        assert whisker.name == nominal.name
        assert all(type(v) is float for v in (*whisker.angles, *whisker.base, whisker.length))
    for name in FIELDS:
        assert np.abs(deviation(name, drawn, array)).max() <= ranges[name] * (1 + 1e-9) + 1e-12


def test_a_straight_whisker_stays_straight() -> None:
    straight = replace(MOUSE, whiskers=tuple(replace(w, curvature=0.0) for w in MOUSE.whiskers[:2]))
    drawn = Randomisation(curvature=0.5).draw(np.random.default_rng(0), straight)
    assert [w.curvature for w in drawn.whiskers] == [0.0, 0.0]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"length": -0.1}, "length must be 0 or more, not -0.1"),
        ({"mount_deg": float("inf")}, "mount_deg must be 0 or more, not inf"),
        ({"radius": 1.0}, "radius is relative and must be less than 1, not 1.0"),
        ({"friction": 5}, "friction is relative and must be less than 1, not 5"),
    ],
)
def test_what_cannot_be_is_refused(given: dict[str, float], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        Randomisation(**given)
