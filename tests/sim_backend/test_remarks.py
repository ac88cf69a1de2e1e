"""What is told of whiskers that cannot be had as they are described."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("numba")

from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.sweep_simulation import ringing
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


def test_loads_beyond_the_sensor_are_told_once(caplog: pytest.LogCaptureFixture) -> None:
    url = f"sim:{ROBOT}?objects=bottle-3&pace=fast&sweeps=1&seed=4&range_force=1e-5"
    with caplog.at_level(logging.WARNING), open_source(url) as source:
        list(source)
    told = [r.getMessage() for r in caplog.records]
    assert sum("is beyond the 1e-05 N that the sensor can read" in line for line in told) == 1
