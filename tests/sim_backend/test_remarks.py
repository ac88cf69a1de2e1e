"""What is told of whiskers that cannot be had as they are described."""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("numba")

import trimesh

from bench.sim.beams import flat
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.rods.world import Piece, RodWorld
from tactile_rt.sim_backend.sweep_simulation import ringing, strains
from tactile_rt.sim_backend.world import PROFILES
from tactile_rt.sources.opening import open_source

ROBOT = Path(__file__).parents[2] / "docs" / "arrays" / "robot.toml"


def test_whiskers_that_ring_as_they_should_are_not_told_of() -> None:
    for profile in PROFILES.values():
        assert ringing((load_array("mouse"),), profile) == ""
        assert ringing((load_array(str(ROBOT)),), profile) == ""


def test_whiskers_that_ring_too_shortly_are_told_of_in_one_line() -> None:
    array = load_array(str(ROBOT))
    wires = tuple(replace(w, damping_ratio=0.001 * (i + 1)) for i, w in enumerate(array.whiskers))
    line = ringing((replace(array, whiskers=wires),), PROFILES["realtime"])
    assert "of 8 whiskers ring shorter than they should at steps of 0.5 ms, A0 with a" in line
    assert "instead of 0.001" in line and line.count("\n") == 0


def test_a_strain_is_the_beam_s() -> None:
    """A cantilever bent at its end by d: curvature 3 d / L^2 at its base, so 3 d r / L^2."""
    whisker = flat("long steel")
    root = np.concatenate([np.zeros((1, 3)), whisker.orientation])[None]
    ball = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    ball.apply_translation((0.99 * whisker.length, 1.3, 0.0))
    world = RodWorld((whisker,), root, (Piece.of(ball),), 20, 4)
    way = np.zeros((1001, 3))
    way[:, 1] = -np.minimum(np.linspace(0, 2, 1001), 1) * 4.0
    world.advance(way)
    bent = 4.0 - (1.3 - 1.0 - whisker.base_radius)
    (strain,) = strains((whisker,), 20, world.angles)
    # the outermost cell's middle is a fortieth of the length away from the base
    wanted = 3 * bent * whisker.base_radius / (0.99 * whisker.length) ** 2 * (1 - 0.025 / 0.99)
    assert strain == pytest.approx(wanted, rel=0.02)


def test_loads_beyond_material_and_sensor_are_told_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "weak.toml"
    path.write_text(
        ROBOT.read_text(encoding="utf-8").replace(
            "friction = 0.3", "friction = 0.3\nstrain_limit = 1e-4"
        ),
        encoding="utf-8",
    )
    url = f"sim:{path}?objects=bottle-3&pace=fast&sweeps=1&seed=4&range_force=1e-5"
    with caplog.at_level(logging.WARNING), open_source(url) as source:
        list(source)
    told = [r.getMessage() for r in caplog.records]
    strained = [line for line in told if "stay bent or break" in line]
    assert strained and len({line.split()[1] for line in strained}) == len(strained)
    assert "more than its material bears (0.0001)" in strained[0]
    assert sum("is beyond the 1e-05 N that the sensor can read" in line for line in told) == 1
