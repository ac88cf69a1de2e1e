"""Whiskers pressed on a peg against the elastica, and sweeps against themselves in finer steps."""

import hashlib
from dataclasses import astuple, replace
from importlib import resources

import numpy as np
import pytest

from bench.sim.area import run
from bench.sim.beams import flat
from bench.sim.catalogue import Difference, difference
from bench.sim.pegs import PEG_RADIUS_MM, Press, press, presses
from bench.sim.reference_model import reference_cost
from tactile_rt.sim_backend.world import PROFILES
from tests.helpers import beams as theory

CASES = {
    f"{p.whisker} {p.bend} {p.place} {p.depth} {p.friction:+}".replace("+0.0", "0"): p
    for p in presses()
}


def peg_of(case: Press) -> tuple[theory.Cone, theory.Peg]:
    whisker = flat(case.whisker, case.bend)
    place = case.place * whisker.length
    return whisker, theory.Peg(case.side, place, case.depth, case.friction, PEG_RADIUS_MM)


# some of thousands: solving all takes half an hour
NAMES = list(CASES)
SOME = NAMES[7::1051]
REST = [pytest.param(name, marks=pytest.mark.slow) for name in NAMES[50::211] if name not in SOME]
EACH = pytest.mark.parametrize("name", [*SOME, *REST])


@EACH
def test_the_stored_elastica_is_the_theory(name: str) -> None:
    stored = CASES[name]
    bent = theory.press(*peg_of(stored))
    assert stored.centre == pytest.approx(bent.centre, abs=1e-6)
    assert stored.moment == pytest.approx(bent.moment * 1e3, rel=1e-6)
    assert stored.force == pytest.approx(bent.force * 1e3, abs=1e-6 * bent.normal * 1e3)
    assert stored.contact == pytest.approx(bent.contact, abs=1e-6)


@EACH
def test_shooting_and_collocation_agree(name: str) -> None:
    whisker, peg = peg_of(CASES[name])
    bent = theory.press(whisker, peg)
    found = theory.collocate(whisker, peg, bent)
    assert found == pytest.approx((bent.s, bent.normal, bent.moment), rel=1e-8)


def test_a_faint_press_bends_a_straight_cone_as_a_beam() -> None:
    whisker, depth = flat("C2", "straight"), 1e-3
    bent = theory.press(whisker, theory.Peg(1, 9.0, depth))
    # a cone clamped at s = 0 and pushed at s, by unit load
    s = np.linspace(0, bent.s, 20001)
    give = np.trapezoid((bent.s - s) ** 2 / theory.bending(whisker, s), s)
    assert bent.normal == pytest.approx(depth / give, rel=1e-3)  # the contact rolls down the taper
    assert bent.moment == pytest.approx(-bent.normal * bent.s, rel=1e-4)  # the cone's side leans


@EACH
def test_the_elastica_balances_and_leans_by_the_angle_of_friction(name: str) -> None:
    whisker, peg = peg_of(CASES[name])
    bent = theory.press(whisker, peg)
    # moments about the clamp: the force acts where the surfaces touch
    x, y = bent.contact
    assert x * bent.force[1] - y * bent.force[0] == pytest.approx(bent.moment, rel=1e-8)
    normal = (bent.contact - bent.centre) / peg.radius
    lean = bent.direction - peg.side * theory.taper(whisker)  # of the cone's side
    along = np.array([np.cos(lean), np.sin(lean)])
    assert bent.force @ normal == pytest.approx(bent.normal, rel=1e-9)
    assert bent.force @ along == pytest.approx(peg.friction * bent.normal, abs=1e-12)
    # inextensible: as long bent as at rest
    length = np.linalg.norm(np.diff(theory.outline(whisker, peg, bent), axis=0), axis=1).sum()
    assert length == pytest.approx(whisker.length, rel=1e-3)


@EACH
def test_the_peg_slides_the_way_its_friction_says(name: str) -> None:
    """Moved along x without change of height, as the simulation moves it."""
    whisker, peg = peg_of(CASES[name])
    bent = theory.press(whisker, peg)
    step = (-1 if peg.friction < 0 else 1) * 1e-3 * whisker.length
    _, here = theory.touching(whisker, peg)
    _, there = theory.touching(whisker, replace(peg, x=peg.x + step))
    moved = replace(peg, x=peg.x + step, depth=peg.depth + peg.side * (there - here))
    slid = theory.slides(peg, bent, theory.press(whisker, moved))
    assert 0.5 <= slid / step <= 1.5


@pytest.mark.parametrize(
    ("profile", "light", "deeper"), [("realtime", 0.1, 0.05), ("dataset", 0.1, 0.05)]
)
def test_a_whisker_bends_over_a_peg_as_the_elastica(
    profile: str, light: float, deeper: float
) -> None:
    """Whiskers of a mouse and a robot, straight and curved either way, friction either way."""
    cases = {n: CASES[n] for n in NAMES[3::29]}
    found = {n: press(c, PROFILES[profile]) for n, c in cases.items()}
    assert len(found) > 150
    limit = {n: light if c.depth < 0.03 else deeper for n, c in cases.items()}
    assert {n: p.moment_error for n, p in found.items() if abs(p.moment_error) > limit[n]} == {}
    within = [abs(p.moment_error) <= 0.02 for n, p in found.items() if cases[n].depth > 0.03]
    assert np.mean(within) >= 0.95
    assert {n: p.contact_error for n, p in found.items() if p.contact_error > 0.2} == {}
    assert {n: p.lost for n, p in found.items() if p.lost} == {}
    assert {n: p.ripple for n, p in found.items() if p.ripple > 0.05} == {}


def test_a_wrong_elastica_is_seen() -> None:
    case = next(c for c in presses() if c.whisker == "mouse C2" and c.depth > 1 and c.friction > 0)
    right = press(case, PROFILES["dataset"])
    wrong = press(replace(case, friction=0.0), PROFILES["dataset"])
    assert abs(wrong.moment_error) > abs(right.moment_error) + 0.02
    assert wrong.force_error > 0.3
    assert (
        abs(press(replace(case, moment=1.1 * case.moment), PROFILES["dataset"]).moment_error) > 0.08
    )


def test_errors_of_a_sweep_are_what_they_say() -> None:
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(50, 3, 6))
    assert difference(truth, truth) == Difference(0, 0, pytest.approx(1), 0)
    loads = truth.copy()
    loads[..., :3] *= 1.02
    loads[..., 3:] += 0.1 * np.sqrt(np.mean(truth[..., 3:] ** 2))
    loads[7, 1, :3] *= 10
    off = difference(loads, truth)
    assert off.moment == pytest.approx(0.1)
    assert off.force > 0.02 and off.spike > 3
    silent = truth.copy()
    silent[:, 2, :3] = 0.0  # a whisker that nothing touches must not divide by nothing
    assert difference(silent, silent).spike == pytest.approx(1)
    late = np.concatenate([np.zeros((4, 3, 6)), truth])[:50]
    assert difference(late, truth).onset_ms == 4


def test_the_reference_model_is_frozen() -> None:
    packed = resources.files("bench.sim").joinpath("data/reference_model.xml.gz")
    assert hashlib.sha256(packed.read_bytes()).hexdigest().startswith("34592f3af85df393")
    assert reference_cost(20) > 0


@pytest.mark.slow
def test_the_benchmark_names_each_figure_once() -> None:
    records = run(quick=True)
    names = [r.name for r in records]
    assert len(set(names)) == len(names) and all(n.startswith("sim.") for n in names)
    assert all(np.isfinite(r.value) for r in records)
    assert any(r.bar for r in records) and astuple(records[0])
