import shutil
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("trimesh")

from tactile_rt.recording import SPLITS, SweepManifest, read_sweeps
from tactile_rt.sim_backend.array import PROFILES, SAMPLE_MS, UNITS
from tactile_rt.sim_backend.dataset import PERIOD_NS, SweepRecipe, make_sweeps
from tactile_rt.sim_backend.objects import CATEGORIES, make_object
from tactile_rt.sim_backend.sweep import Sweep, SweepSimulation, draw_sweep
from tactile_rt.sim_backend.whiskers import mouse_whiskers
from tactile_rt.stream import ConfigError
from tactile_rt.testing import cut
from tactile_rt.timebase import Resampler

RECIPE = SweepRecipe(categories=("mug",), objects=3, validation=1, test=1, sweeps=1)
NAMES = ["mug-0", "mug-1", "mug-2"]


def files(folder: Path) -> dict[str, dict[str, bytes]]:
    """The bytes of every array of every object."""
    found = {}
    for path in sorted(folder.glob("*.npz")):
        with np.load(path) as arrays:
            found[path.stem] = {name: arrays[name].tobytes() for name in arrays}
    return found


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set made by two processes in one go."""
    folder = tmp_path_factory.mktemp("sets") / "two"
    assert sorted(make_sweeps(RECIPE, folder, processes=2)) == NAMES
    return folder


def test_a_set_is_what_its_manifest_says(finished: Path) -> None:
    manifest = SweepManifest.read(finished)
    assert manifest == RECIPE.manifest()
    assert sorted(p.name for p in finished.iterdir()) == [
        "manifest.json", "mug-0.npz", "mug-1.npz", "mug-2.npz"
    ]  # fmt: skip
    seen: set[str] = set()
    for split, name in zip(SPLITS, NAMES, strict=True):
        sweeps = read_sweeps(finished, split)
        assert sweeps.objects.tolist() == [name]
        assert sweeps.labels.tolist() == [0]
        assert sweeps.values.shape == (1, 164, 30, 6)
        assert sweeps.values.dtype == np.float32
        assert np.isfinite(sweeps.values).all()
        assert not seen & set(sweeps.objects)
        seen |= set(sweeps.objects)


def test_nothing_is_felt_in_the_lead_and_something_after_it(finished: Path) -> None:
    lead = SweepManifest.read(finished).lead
    assert lead * PERIOD_NS >= 200_000_000  # long enough for a tare
    for split in SPLITS:
        values = read_sweeps(finished, split).values
        assert (values[:, :lead] == 0).all()
        forces = abs(values[..., [u == "N" for u in UNITS]])
        assert 1e-5 < forces.max() < 0.1


def test_the_stored_parameters_are_those_of_the_sweep(finished: Path) -> None:
    """Simulating them again gives the stored values."""
    with np.load(finished / "mug-1.npz") as arrays:
        stored = arrays["values"][0]
        sweep = Sweep(**{k: float(v[0]) for k, v in arrays.items() if k != "values"})
    lead = SweepManifest.read(finished).lead
    simulation = SweepSimulation(
        mouse_whiskers(), make_object("mug", 1), sweep, PROFILES[RECIPE.profile]
    )
    assert simulation.touches
    rest = np.zeros((round(lead * PERIOD_NS * 1e-6 / SAMPLE_MS), 30, 6))
    loads = np.concatenate([rest, *(simulation.advance(n) for n in (100, 7, 393))])
    resampler = Resampler(PERIOD_NS, 1e3 / SAMPLE_MS)
    outputs = [resampler.push(chunk) for chunk in cut(loads, 1e3 / SAMPLE_MS, samples=50)]
    again = np.concatenate([out.values for out in outputs if out is not None])
    assert len(again) > 60
    assert np.array_equal(again, stored[: len(again)])


def test_an_interrupted_run_keeps_what_it_has_and_ends_the_same(
    finished: Path, tmp_path: Path
) -> None:
    """And one process makes the same set as two."""
    run = make_sweeps(RECIPE, tmp_path, processes=1)
    first = next(run)
    run.close()  # what Ctrl-C in the consumer comes to
    kept = files(tmp_path)
    assert first in kept and len(kept) < len(NAMES)
    names = list(make_sweeps(RECIPE, tmp_path, processes=1))
    assert names[: len(kept)] == sorted(kept), "what was there is reported first, and not made anew"
    assert sorted(names) == NAMES
    assert files(tmp_path) == files(finished)


def test_a_deleted_object_is_made_again_as_it_was(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "set"
    shutil.copytree(finished, folder)
    (folder / "mug-2.npz").unlink()
    untouched = {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}
    assert list(make_sweeps(RECIPE, folder, processes=1, splits=("train",))) == ["mug-0"]
    assert not (folder / "mug-2.npz").exists(), "another split was asked for"
    assert list(make_sweeps(RECIPE, folder, processes=1, splits=("test",))) == ["mug-2"]
    assert files(folder) == files(finished)
    assert untouched.items() <= {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}.items()


def test_a_finished_set_starts_no_process(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tactile_rt.sim_backend import dataset

    monkeypatch.setattr(dataset, "multiprocessing", None)
    assert sorted(make_sweeps(RECIPE, finished)) == NAMES


def test_another_recipe_in_the_same_folder_is_refused(finished: Path) -> None:
    before = files(finished)
    other = SweepRecipe(categories=("mug",), objects=3, validation=1, test=1, sweeps=1, seed=1)
    with pytest.raises(ConfigError, match=r"another sweep set \(other recipe\)"):
        list(make_sweeps(other, finished))
    assert files(finished) == before


def test_an_unknown_split_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no split 'tests': there are train, validation, test"):
        list(make_sweeps(RECIPE, tmp_path, splits=("tests",)))
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(ConfigError, match="no split"):
        RECIPE.count(("train", "tests"))


def test_counts_are_of_objects_in_all_categories() -> None:
    recipe = SweepRecipe(objects=10, validation=2, test=3)
    assert recipe.count(("train",)) == 5 * len(CATEGORIES)
    assert recipe.count(SPLITS) == 10 * len(CATEGORIES)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"profile": "quick"}, "no profile 'quick': there are realtime"),
        ({"objects": 2, "validation": 1, "test": 1}, "2 objects cannot be split"),
        ({"validation": 0}, "each side needs at least one"),
        ({"test": 0}, "each side needs at least one"),
        ({"sweeps": 0}, "sweeps must be at least 1, not 0"),
    ],
)
def test_an_impossible_recipe_is_refused(change: dict, complaint: str) -> None:
    with pytest.raises(ConfigError, match=complaint):
        SweepRecipe(**change)


def test_sweeps_are_drawn_over_all_yaws_and_from_the_seed_alone() -> None:
    rng = np.random.default_rng(0)
    drawn = [draw_sweep(rng) for _ in range(400)]
    yaw = np.array([s.yaw_deg for s in drawn])
    assert np.histogram(yaw, bins=8, range=(0, 360))[0].min() > 25
    assert min(s.gap_mm for s in drawn) > 0
    assert min(s.distance_mm for s in drawn) >= 5.5  # nearer, stiff whiskers jam
    again = np.random.default_rng(0)
    assert [draw_sweep(again) for _ in range(400)] == drawn
