"""The record of contacts against the elastica, and the loads against themselves without it."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bench.sim.beams import flat
from bench.sim.pegs import SLIDE_MM_S, _steps, press, presses
from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import read_object, read_sweeps
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.datasets.dataset import make_sweeps, simulate_sweep
from tactile_rt.sim_backend.datasets.recipe_files import recipe_of_set
from tactile_rt.sim_backend.datasets.recipes import ObjectChoice, Range, SweepChoice, SweepRecipe
from tactile_rt.sim_backend.mujoco_world import ContactProbe, contact_distances
from tactile_rt.sim_backend.objects.catalogue import make_object
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.world import PROFILES

PLAIN = SweepRecipe(
    lead_ms=45,
    length_ms=270,
    objects=ObjectChoice(categories=("mug",), per_category=3, validation=1, test=1),
    sweeps=SweepChoice(yaw_deg=Range((0, 360)), gap_mm=Range((0.5, 1)), draws=2),
)
RECIPE = replace(PLAIN, contacts=True)


DEEP = [c for c in presses() if c.depth > 0.5]


@pytest.mark.parametrize("case", DEEP[2::301], ids=lambda c: f"{c.whisker} {c.bend}")
def test_a_peg_is_recorded_where_the_elastica_has_it(case) -> None:
    """Arc length and force from the solver of `beams.py`, which knows no links."""
    assert press(case, PROFILES["dataset"]).contact_error < 0.005 * flat(case.whisker).length
    profile = PROFILES["mujoco"]
    whisker = replace(flat(case.whisker, case.bend), friction=abs(case.friction))
    kind, probe, seen = mujoco.mjtState.mjSTATE_FULLPHYSICS, None, []
    for model, data in _steps(case, profile, SLIDE_MM_S):
        probe = probe or ContactProbe(model, [whisker], profile)
        state = np.empty(mujoco.mj_stateSize(model, kind))
        mujoco.mj_getState(model, data, state, kind)
        seen.append(probe.read(state, data.mocap_pos[0])[0])
    touching, force, moment = np.mean(seen[-8:], axis=0)
    assert touching == 1
    assert moment / force * 1e3 == pytest.approx(case.arc, abs=0.02 * whisker.length)
    # of a force with friction, the normal part
    normal = np.hypot(*case.force) / np.hypot(1.0, case.friction)
    assert force * 1e3 == pytest.approx(normal, rel=0.06)


def simulation(profile: str) -> SweepSimulation:
    """A mug that passes the mouse."""
    mug = make_object("mug", 0)
    return SweepSimulation(load_array("mouse"), mug, Sweep(gap_mm=0.5), PROFILES[profile])


def test_looking_at_contacts_changes_no_load() -> None:
    loads = simulation("realtime").advance(240)
    looking = simulation("realtime")
    pieces = [looking.advance_with_contacts(n) for n in (100, 1, 139)]
    assert np.array_equal(np.concatenate([p[0] for p in pieces]), loads)
    contacts = np.concatenate([p[1] for p in pieces])
    assert contacts.shape == (240, 30, 3)
    touching = contacts[..., 0] > 0
    assert contacts[..., 0].min() == 0 and contacts[..., 0].max() == 1
    assert np.array_equal(touching, contacts[..., 1] > 0)
    # whiskers carry loads where they touch, and only whiskers that touched do
    assert 0.01 < touching.mean() < 0.9
    assert not loads[:, ~touching.any(axis=0)].any()
    lengths = np.array([w.length for w in load_array("mouse").whiskers]) * 1e-3
    arc = contacts[..., 2] / np.where(touching, contacts[..., 1], 1)
    assert (arc <= lengths * (1 + 1e-9)).all() and arc[touching].min() > 0


def test_by_mujoco_contacts_are_looked_at_now_and_then() -> None:
    loads, every, held = (simulation("mujoco").advance_with_contacts(120, n) for n in (0, 1, 3))
    assert np.array_equal(loads[0], every[0]) and np.array_equal(loads[0], held[0])
    assert not loads[1].any() and every[1].any()
    assert np.array_equal(held[1][1::3], held[1][::3])
    assert np.array_equal(held[1][::3, :, 0], every[1][::3, :, 0])
    # The solver starts from what it saw last, and stops within its tolerance.
    assert held[1][::3, :, 1] == pytest.approx(every[1][::3, :, 1], rel=0.01, abs=1e-7)


def test_distances_are_of_what_touches_most_of_the_time() -> None:
    felt = np.array([[0.5, 2, 6], [0.49, 2, 6], [1, 0, 0], [0, 0, 0]], dtype=np.float32)
    assert contact_distances(felt)[0] == 3
    assert np.isnan(contact_distances(felt)[1:]).all()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sets") / "with"
    list(make_sweeps(RECIPE, folder, processes=1))
    return folder


def test_a_set_with_contacts_holds_the_loads_of_one_without(made: Path) -> None:
    sweeps, manifest = read_sweeps(made, "train"), SweepManifest.read(made)
    assert manifest.recipe["contacts"] is True
    assert recipe_of_set(manifest.recipe) == RECIPE
    contacts = sweeps.contacts
    assert contacts.shape == sweeps.values.shape[:3] and contacts.dtype == np.float32
    for index in range(2):
        plain = simulate_sweep(PLAIN, make_object("mug", 0), index)
        assert plain.contacts is None
        assert np.array_equal(plain.values, sweeps.values[index])
        again = simulate_sweep(RECIPE, make_object("mug", 0), index)
        assert again.parameters == plain.parameters
        assert np.array_equal(again.contacts, contacts[index], equal_nan=True)
    assert np.isnan(contacts[:, : manifest.lead]).all()
    touching = np.isfinite(contacts)
    assert 0.01 < touching.mean() < 0.9
    force = np.linalg.norm(sweeps.values[..., :3], axis=-1)
    assert force[touching].mean() > 20 * force[~touching].mean()
    assert "contacts" not in read_object(made, "mug-0")[1]


def test_a_set_without_contacts_holds_none(tmp_path: Path) -> None:
    list(make_sweeps(PLAIN, tmp_path, processes=1, splits=("test",)))
    with np.load(tmp_path / "mug-2.npz") as arrays:
        assert "contacts" not in arrays.files
    assert read_sweeps(tmp_path, "test").contacts is None
    with pytest.raises(ConfigError, match=r"other recipe\.contacts"):
        list(make_sweeps(RECIPE, tmp_path, processes=1))


def test_a_miss_touches_nothing() -> None:
    grid = replace(RECIPE, sweeps=SweepChoice(distance_mm=Range(each=(60.0,))))
    record = simulate_sweep(grid, make_object("mug", 0), 0)
    assert record.contacts is not None and np.isnan(record.contacts).all()


def test_damaged_contacts_are_told(made: Path, tmp_path: Path) -> None:
    for path in made.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with np.load(tmp_path / "mug-1.npz") as arrays:
        kept = dict(arrays)
    np.savez(tmp_path / "mug-1.npz", **{**kept, "contacts": kept["contacts"][:, :3]})
    with pytest.raises(RecordingError, match=r"mug-1\.npz is damaged \(contacts"):
        read_sweeps(tmp_path, "validation")
    del kept["contacts"]
    np.savez(tmp_path / "mug-1.npz", **kept)
    with pytest.raises(RecordingError, match=r"mug-1\.npz is damaged"):
        read_sweeps(tmp_path, "validation")
