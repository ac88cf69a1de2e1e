"""Objects pass arrays of any shape so that nearly all sweeps touch."""

from pathlib import Path

import numpy as np
import pytest

from tactile_rt.project.placing import place_objects
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.objects.catalogue import make_object
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.world import PROFILES
from tests.helpers.source_tree import ROOT

DEFAULTS = (ROOT / "docs/arrays/robot.toml").read_text("utf-8").split("[[whisker]]")[0]
KINDS = ("bottle", "house", "mug")


def write_array(path: Path, seed: int) -> str:
    """Write an array of whiskers of any number and length, on a plate, in many directions."""
    rng = np.random.default_rng(seed)
    wide, high, length = np.exp(rng.uniform(np.log((8, 8, 20)), np.log((150, 150, 140))))
    tilt, rows = np.radians(rng.uniform(0, 50)), [DEFAULTS]
    for k in range(rng.integers(3, 16)):
        y, z = rng.uniform(-0.5, 0.5, 2) * (wide, high)
        theta, phi = rng.uniform(-tilt, tilt, 2)
        rows.append(
            f'[[whisker]]\nwhisker = "W{k}"\nrow = 1\ncol = {k}\nbase_y_mm = {y}\nbase_z_mm = {z}\n'
            f"arc_length_mm = {length * rng.uniform(0.7, 1.3)}\n"
            f"base_theta_rad = {np.pi / 2 + theta}\nbase_phi_rad = {phi}\n"
        )
    path.write_text("\n".join(rows))
    return str(path)


@pytest.mark.parametrize("seed", range(4))
def test_sweeps_touch_an_array_that_nobody_saw(seed: int, tmp_path: Path) -> None:
    animals = load_animals(write_array(tmp_path / "a.toml", seed))
    placing = place_objects(animals, KINDS)
    rng, touching = np.random.default_rng(100 + seed), []
    for number in range(30):
        sweep = Sweep(
            size_mm=placing.size_mm,
            yaw_deg=rng.uniform(0, 360),
            height_mm=rng.uniform(*placing.height_mm),
            distance_mm=rng.uniform(*placing.distance_mm),
        )
        target = make_object(KINDS[number % 3], 100 + number)
        touching.append(SweepSimulation(animals, target, sweep, PROFILES["realtime"]).touches)
    assert np.mean(touching) >= 0.9
    assert placing.touching >= 0.95


def test_objects_pass_a_mouse_as_they_always_do() -> None:
    placing = place_objects(load_animals("mouse"), KINDS)
    assert placing.size_mm == Sweep.size_mm and placing.distance_mm == (5.5, 8.0)
    assert placing.height_mm[0] < Sweep.height_mm < placing.height_mm[1]
