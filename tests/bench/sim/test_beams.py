"""Whiskers against beam theory: `tests/helpers/beams.py` works the references out."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import curve_fit

from bench.sim.beams import GRAVITY, ORIGIN, beams, flat, measure, ring
from tactile_rt.sim_backend.arrays.files import mouse_whiskers
from tactile_rt.sim_backend.world import PROFILES, Profile, add_whiskers, empty_world, set_damping
from tests.helpers import beams as theory

Floats = NDArray[np.float64]

NAMES = [w.name for w in mouse_whiskers()]
FINE = replace(PROFILES["accurate"], timestep_ms=0.05)


def test_straight_cones_and_cylinders_have_closed_forms() -> None:
    c2 = flat("C2", "straight")
    # a cone with radii R and r bends by 4 P L^3 / (3 pi E R^3 r)
    cone = 4 * c2.length**3 / (3 * np.pi * 5000 * c2.base_radius**3 * c2.tip_radius)
    assert theory.compliance(c2, 1) == pytest.approx(cone, rel=1e-8)
    assert theory.compliance(c2, 2) == pytest.approx(cone, rel=1e-8)
    rod = replace(c2, tip_radius=c2.base_radius, density_tip=c2.density_base)
    stiff, mass = float(theory.bending(rod, 0.0)), float(theory.line_mass(rod, 0.0))
    hertz = 1.8751040687**2 / rod.length**2 * np.sqrt(stiff / mass) / (2 * np.pi)
    assert theory.resonance(rod) == pytest.approx(hertz, rel=1e-6)
    assert theory.resonance(rod, 2) == pytest.approx(hertz, rel=1e-6)
    sag = mass * 9810 * rod.length**4 / (8 * stiff)
    assert theory.sag(rod, 9810) == pytest.approx(sag, rel=1e-6)


def test_the_published_figures_of_three_whiskers() -> None:
    """Straightened, with the densities of the rat (Belli et al. 2017): Hz."""
    for name, hertz in (("B0", 103.8), ("C2", 186.5), ("E5", 1379.0)):
        assert theory.resonance(flat(name, "straight")) == pytest.approx(hertz, rel=5e-4)


@pytest.mark.parametrize("name", NAMES)
def test_the_stored_beams_are_the_theory(name: str) -> None:
    stored, whisker = beams()[name], flat(name)
    assert stored.compliance == pytest.approx(theory.compliance(whisker, 1), rel=1e-6)
    assert stored.resonance_hz == pytest.approx(theory.resonance(whisker), rel=1e-6)
    assert stored.sag_mm == pytest.approx(theory.sag(whisker, GRAVITY * 1e6), rel=1e-6)
    # the first of both planes, which is what `set_damping` reports
    assert theory.resonance(whisker, 2) > stored.resonance_hz


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("profile", "looser"), [("dataset", 1), ("realtime", 2)])
def test_a_whisker_is_its_beam(profile: str, looser: int, name: str) -> None:
    errors = measure(flat(name), beams()[name], PROFILES[profile])
    assert abs(errors.static) <= 0.01
    assert abs(errors.resonance) <= 0.005 * looser
    assert abs(errors.sag) <= 0.01 * looser
    assert errors.reaction <= 1e-6


@pytest.mark.parametrize("name", ["E5", "C6", "C2", "B0"])
def test_links_converge_to_the_beam(name: str) -> None:
    few, more, many = (
        abs(measure(flat(name), beams()[name], Profile(links, 0.1, 0.01, "mujoco")).resonance)
        for links in (8, 16, 32)
    )
    assert more < few / 3 and many < more / 3  # in the second order: by four


@pytest.mark.parametrize("name", [n for n in NAMES if beams()[n].resonance_hz < 400])
def test_fine_steps_ring_as_the_beam(name: str) -> None:
    frequency, ratio = ring(flat(name), FINE)
    assert frequency == pytest.approx(beams()[name].resonance_hz, rel=0.03)
    assert ratio == pytest.approx(0.32, abs=0.02)


@pytest.mark.parametrize("name", ["B0", "C2"])
@pytest.mark.parametrize("profile", [PROFILES["accurate"], FINE])
def test_a_plucked_tip_rings_as_the_first_mode_does(profile: Profile, name: str) -> None:
    """What `ring` reads off a mode, seen in the free decay of a tip held and let go."""
    whisker = flat(name)
    world = empty_world(profile)
    add_whiskers(world, (whisker,), profile, ORIGIN)
    model = world.compile()
    set_damping(model)
    data = mujoco.MjData(model)
    period = 1e3 / beams()[name].resonance_hz
    data.xfrc_applied[-1, 1] = 10 * whisker.length / beams()[name].compliance  # a hundredth of it
    for _ in range(round(20 * period / model.opt.timestep)):
        mujoco.mj_step(model, data)
    data.xfrc_applied[:] = 0.0
    times, values = [], []
    for i in range(round(2.5 * period / model.opt.timestep)):
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        times.append((i + 1) * model.opt.timestep)
        values.append(data.xpos[-1, 1])
    t, y = np.array(times), np.array(values)

    def decay(t: Floats, rest: float, size: float, zeta: float, omega: float, at: float) -> Floats:
        swing = np.cos(omega * np.sqrt(1 - zeta**2) * t + at)
        return np.asarray(rest + size * np.exp(-zeta * omega * t) * swing)

    later = t > 0.3 * period  # by then the higher modes are gone
    guess = [y[-1], y[0] - y[-1], 0.3, 2 * np.pi / period, 0.0]
    (_, _, zeta, omega, _), _ = curve_fit(decay, t[later], y[later], p0=guess)
    frequency, ratio = ring(whisker, profile)
    assert zeta == pytest.approx(ratio, abs=0.005)
    assert omega / (2 * np.pi) * 1e3 == pytest.approx(frequency, rel=0.01)
