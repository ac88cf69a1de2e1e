import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from tactile_rt.classifier.resampler import Resampler
from tactile_rt.core.errors import ConfigError, RecordingError, SourceError, TactileError
from tactile_rt.sets.manifest import SPLITS, SweepManifest
from tactile_rt.sets.objects import read_object, read_sweeps
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.datasets import dataset
from tactile_rt.sim_backend.datasets.dataset import (
    describe_set,
    fingerprint,
    make_sweeps,
    simulate_sweep,
)
from tactile_rt.sim_backend.datasets.inventory import check_sums
from tactile_rt.sim_backend.datasets.recipe_files import recipe_of_set
from tactile_rt.sim_backend.datasets.recipe_objects import ShapeObjects
from tactile_rt.sim_backend.datasets.recipes import ObjectChoice, Range, SweepChoice, SweepRecipe
from tactile_rt.sim_backend.objects.catalogue import load_object, make_object
from tactile_rt.sim_backend.randomisation import Randomisation
from tactile_rt.sim_backend.sensor_model import SensorModel
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, UNITS
from tactile_rt.testing import cut_chunks

# Short sweeps of few objects: what is tested here is where they end up.
RECIPE = SweepRecipe(
    lead_ms=45,
    length_ms=225,
    objects=ObjectChoice(
        categories=("mug",), classes={"cup": ("mug",)}, per_category=3, validation=1, test=1
    ),
    sweeps=SweepChoice(yaw_deg=Range((0, 360)), gap_mm=Range((0.5, 1)), draws=2),
)
NAMES = ["mug-0", "mug-1", "mug-2"]


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def shards(folder: Path) -> set[str]:
    return {path.stem for path in folder.glob("[!.]*.npz")}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set made by two processes in one go."""
    folder = tmp_path_factory.mktemp("sets") / "two"
    assert sorted(make_sweeps(RECIPE, folder, processes=2)) == NAMES
    return folder


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    """The work is done in this process: starting another takes longer than these sweeps."""
    monkeypatch.setattr(
        dataset, "run_processes", lambda work, names, processes: ((n, work(n)) for n in names)
    )


# What a set holds


def test_a_set_is_what_its_manifest_says(finished: Path) -> None:
    manifest = SweepManifest.read(finished)
    assert manifest == describe_set(RECIPE)
    assert manifest.kinds == {"cup": ("mug",)}
    assert {"tactile_rt", "mujoco", "numpy"} <= set(manifest.versions)
    assert manifest.settings == asdict(PROFILES["realtime"])
    assert sorted(p.name for p in finished.iterdir()) == [
        "SHA256SUMS", "manifest.json", "mug-0.npz", "mug-1.npz", "mug-2.npz"
    ]  # fmt: skip
    for split, name in zip(SPLITS, NAMES, strict=True):
        sweeps = read_sweeps(finished, split)
        assert sweeps.objects.tolist() == [name] * 2
        assert sweeps.labels.tolist() == [0, 0]
        assert sweeps.values.shape == (2, 25, 30, 6)
        assert np.isfinite(sweeps.values).all()


def test_nothing_is_felt_in_the_lead_and_something_after_it(finished: Path) -> None:
    lead = SweepManifest.read(finished).lead
    assert lead == 5
    for split in SPLITS:
        values = read_sweeps(finished, split).values
        assert (values[:, :lead] == 0).all()
        forces = abs(values[..., [u == "N" for u in UNITS]])
        assert 1e-5 < forces.max() < 0.1


def test_the_stored_parameters_are_those_of_the_sweep(finished: Path) -> None:
    """Simulating them again gives the stored values, by way of the live stream's resampler."""
    stored = read_sweeps(finished, "validation").values[1]
    parameters = read_object(finished, "mug-1")[1]
    assert parameters["draw"].tolist() == [0, 1]
    assert parameters["touches"].tolist() == [True, True]
    assert parameters["unstable"].tolist() == [False, False]
    sweep = described({key: values[1] for key, values in parameters.items()})
    simulation = SweepSimulation(
        load_array("mouse"), make_object("mug", 1), sweep, PROFILES[RECIPE.profile]
    )
    loads = np.concatenate(
        [np.zeros(((RECIPE.lead + 1) * 9, 30, 6)), *(simulation.advance(n) for n in (100, 7, 91))]
    )
    resampler = Resampler(RECIPE.period_ns, 1e3 / SAMPLE_MS)
    outputs = [resampler.push(chunk) for chunk in cut_chunks(loads, 1e3 / SAMPLE_MS, samples=50)]
    again = np.concatenate([out.values for out in outputs if out is not None])
    assert len(again) >= 25
    assert np.array_equal(again[:25], stored)


def described(parameters: dict[str, Any]) -> Sweep:
    """The sweep that the stored parameters describe."""
    return Sweep(**{f.name: float(parameters[f.name]) for f in fields(Sweep)})


def test_any_single_sweep_can_be_made_again_alone(finished: Path) -> None:
    recipe = recipe_of_set(SweepManifest.read(finished).recipe)
    record = simulate_sweep(recipe, load_object("mug-2"), 1)
    assert np.array_equal(record.values, read_sweeps(finished, "test").values[1])
    stored = {key: values[1] for key, values in read_object(finished, "mug-2")[1].items()}
    assert stored.pop("geometry") == fingerprint(make_object("mug", 2))
    assert record.parameters == stored


def test_a_fingerprint_tells_shapes_apart() -> None:
    mug = make_object("mug", 0)
    assert fingerprint(mug) == fingerprint(make_object("mug", 0))
    moved = [piece.copy() for piece in mug.pieces]
    moved[0].apply_translation((1e-6, 0, 0))
    others = [make_object("mug", 1), replace(mug, pieces=tuple(moved))]
    others.append(replace(mug, pieces=mug.pieces[1:]))
    assert len({fingerprint(o) for o in [mug, *others]}) == 4


def test_the_raw_kilohertz_is_what_the_simulation_gave() -> None:
    recipe = replace(RECIPE, period_ms=1, lead_ms=20, length_ms=60)
    target = make_object("mug", 0)
    record = simulate_sweep(recipe, target, 0)
    assert record.values.shape == (60, 30, 6)
    assert not record.values[:20].any()
    sweep = described(record.parameters)
    loads = SweepSimulation(load_array("mouse"), target, sweep, PROFILES["realtime"]).advance(40)
    assert np.array_equal(record.values[20:], loads.astype(np.float32))


def test_several_animals_share_the_world_of_a_set(tmp_path: Path) -> None:
    path = tmp_path / "two.toml"
    path.write_text(
        '[[animal]]\narray = "mouse"\n[[animal]]\narray = "mouse"\n'
        "mount = { position_mm = [300.0, 0.0, 0.0] }\n"
    )
    recipe = replace(RECIPE, array=str(path), sweeps=SweepChoice(distance_mm=150.0))
    assert describe_set(recipe).spec.elements[::30] == ("1.A0", "2.A0")
    record = simulate_sweep(recipe, make_object("mug", 0), 0)
    assert record.values.shape == (25, 60, 6)


def test_a_finished_set_gets_a_lost_manifest_back(finished: Path, copied: Path) -> None:
    (copied / "manifest.json").unlink()
    with pytest.raises(ConfigError, match="no manifest"):
        list(make_sweeps(replace(RECIPE, seed=1), copied, processes=1))
    list(make_sweeps(RECIPE, copied, processes=1))
    assert files(copied) == files(finished)


def test_a_point_of_a_grid_that_misses_stays_and_a_draw_is_repeated() -> None:
    target = make_object("mug", 0)
    beyond = replace(
        RECIPE, length_ms=90, sweeps=SweepChoice(distance_mm=Range(each=(5.5, 60.0)), gap_mm=0.1)
    )
    near, far = (simulate_sweep(beyond, target, i) for i in range(2))
    assert (near.parameters["touches"], far.parameters["touches"]) == (True, False)
    assert near.values.any() and not far.values.any()

    half = replace(beyond, sweeps=SweepChoice(distance_mm=Range((-20, 60)), draws=6))
    draws = [simulate_sweep(half, target, i) for i in range(6)]
    assert all(d.parameters["touches"] for d in draws)
    own = [half.rng("mug-0", i) for i in (*range(6), *range(6))]
    firsts = [half.sweeps.draw(own[i], i, own[6 + i]).distance_mm for i in range(6)]
    kept = [d.parameters["distance_mm"] for d in draws]
    assert any(a != b for a, b in zip(firsts, kept, strict=True)), "one was drawn again"
    assert any(a == b for a, b in zip(firsts, kept, strict=True))


def test_an_object_that_can_never_touch_is_given_up() -> None:
    recipe = replace(RECIPE, length_ms=90, sweeps=SweepChoice(distance_mm=60.0))
    assert not simulate_sweep(recipe, make_object("mug", 0), 0).parameters["touches"]


def test_what_a_profile_cannot_simulate_is_drawn_again_or_marked(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    seen: list[float] = []

    class Unstable(SweepSimulation):
        def __init__(self, array, target, sweep, *rest) -> None:
            super().__init__(array, target, sweep, *rest)
            self.sweep = sweep

        def advance(self, samples):
            seen.append(self.sweep.yaw_deg)
            if len(seen) < 3:
                raise SourceError("unstable")
            return super().advance(samples)

    monkeypatch.setattr(dataset, "SweepSimulation", Unstable)
    target, recipe = make_object("mug", 0), replace(RECIPE, length_ms=90)
    record = simulate_sweep(recipe, target, 0)
    assert len(set(seen)) == 3
    assert record.parameters["yaw_deg"] == seen[-1]
    assert not record.parameters["unstable"]

    seen.clear()
    grid = replace(recipe, sweeps=SweepChoice(yaw_deg=Range(each=(0.0, 30.0)), gap_mm=0.1))
    record = simulate_sweep(grid, target, 1)
    assert (seen, record.parameters["yaw_deg"]) == ([30.0], 30.0)
    assert record.parameters["unstable"] and record.parameters["touches"]
    assert record.values.shape == (10, 30, 6)
    assert not record.values.any()


def test_sensors_and_randomisation_change_what_is_felt_and_not_what_is_done() -> None:
    target = make_object("mug", 0)
    recipe = replace(RECIPE, length_ms=180)
    plain = simulate_sweep(recipe, target, 0)
    noisy = simulate_sweep(replace(recipe, sensor=SensorModel(noise_force=1e-5)), target, 0)
    assert noisy.parameters == plain.parameters
    error = noisy.values - plain.values
    # Nine samples go into one, Hann-weighted over two periods: variance 3/8 * 18 / 9^2.
    assert error[..., :3].std() == pytest.approx(1e-5 * np.sqrt(3 / 8 * 18) / 9, rel=0.05)
    assert not error[..., 3:].any()
    other = simulate_sweep(replace(recipe, sensor=SensorModel(noise_force=1e-5)), target, 1)
    assert not np.array_equal(other.values[:4], noisy.values[:4]), "every sweep has its own noise"

    softer = replace(recipe, randomisation=Randomisation(young_modulus=0.3))
    varied = simulate_sweep(softer, target, 0)
    assert varied.parameters == plain.parameters
    assert not np.array_equal(varied.values, plain.values)
    dropped = SensorModel(drop_probability=0.95)
    lost = simulate_sweep(replace(recipe, sensor=dropped), target, 0)
    assert lost.values.shape == plain.values.shape


def test_readings_beyond_the_range_are_counted_not_told_one_by_one(caplog) -> None:
    narrow = replace(RECIPE, length_ms=180, sensor=SensorModel(range_force=1e-5))
    record = simulate_sweep(narrow, make_object("mug", 0), 0)
    assert abs(record.values[..., :3]).max() == pytest.approx(1e-5)
    assert 0 < record.parameters["saturated"] < 0.5
    assert "range" not in caplog.text


# Interruptions


def test_an_interrupted_run_keeps_what_it_has_and_ends_the_same(
    finished: Path, tmp_path: Path
) -> None:
    """And one process makes the same set as two."""
    run = make_sweeps(RECIPE, tmp_path, processes=1)
    first = next(run)
    run.close()  # what Ctrl-C in the consumer comes to
    kept = shards(tmp_path)
    assert first in kept and len(kept) < len(NAMES)
    names = list(make_sweeps(RECIPE, tmp_path, processes=1))
    assert names[: len(kept)] == sorted(kept), "what was there is reported first, and not made anew"
    assert sorted(names) == NAMES
    assert files(tmp_path) == files(finished)


def test_categories_grow_alike_so_that_one_may_stop_any_time() -> None:
    objects = msgspec.structs.replace(
        RECIPE.objects, categories=("bottle", "chair", "mug"), per_category=9, validation=1, test=2
    )
    manifest = dataset.describe_set(replace(RECIPE, objects=objects))
    order = dataset._interleave_splits(manifest, set(manifest.names()))
    assert sorted(order) == sorted(manifest.names())
    for share in (2, 3):
        begun = order[: len(order) // share]
        number = [sum(manifest.category(n) == c for n in begun) for c in manifest.categories]
        assert max(number) - min(number) <= 1
    assert set(manifest.split["test"]) <= set(order[: len(order) // 2])


def test_an_object_that_another_run_finished_meanwhile_is_left_alone(finished: Path) -> None:
    before = files(finished)
    assert dataset._Work(RECIPE, finished)("mug-1") is None
    assert files(finished) == before


@pytest.mark.usefixtures("here")
def test_one_split_alone_is_what_the_whole_set_has_of_it(finished: Path, tmp_path: Path) -> None:
    assert list(make_sweeps(RECIPE, tmp_path, processes=1, splits=("test",))) == ["mug-2"]
    assert (tmp_path / "mug-2.npz").read_bytes() == (finished / "mug-2.npz").read_bytes()
    assert SweepManifest.read(tmp_path) == SweepManifest.read(finished)
    assert check_sums(tmp_path) == 2
    with pytest.raises(RecordingError, match="is unfinished"):
        read_sweeps(tmp_path, "train")


def test_a_finished_set_starts_no_process(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from tactile_rt.sim_backend.datasets import engines

    monkeypatch.setattr(engines, "_start", None)
    before = files(finished)
    assert list(make_sweeps(RECIPE, finished)) == NAMES
    assert files(finished) == before


def test_an_object_that_cannot_be_made_is_listed_and_not_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # as if of meshes, among which there are broken ones
    monkeypatch.setattr(dataset, "choose_objects", ShapeObjects)
    monkeypatch.setattr(ObjectChoice, "generated", False)
    monkeypatch.setattr(
        dataset, "run_processes", lambda work, names, processes: [(n, "no volume") for n in names]
    )
    assert list(make_sweeps(RECIPE, tmp_path, splits=("test",))) == ["mug-2"]
    assert (tmp_path / "skipped.json").read_text() == '{\n "mug-2": "no volume"\n}'
    monkeypatch.setattr(dataset, "run_processes", lambda work, names, processes: iter(names[1:]))
    assert list(make_sweeps(RECIPE, tmp_path, splits=("test",))) == ["mug-2"]


def test_a_shape_that_cannot_be_made_ends_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        dataset, "run_processes", lambda work, names, processes: [(n, "it died") for n in names]
    )
    with pytest.raises(TactileError, match="mug-2 cannot be made: it died"):
        list(make_sweeps(RECIPE, tmp_path))
    assert not (tmp_path / "skipped.json").exists()


# What is refused


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"splits": ("tests",)}, "no split 'tests': there are train, validation, test"),
        ({"engine": "rays"}, r"no engine 'rays'; did you mean ray\?"),
    ],
)
def test_a_mistake_is_found_before_anything_is_written(
    tmp_path: Path, options: dict, complaint: str
) -> None:
    with pytest.raises(ConfigError, match=complaint):
        list(make_sweeps(RECIPE, tmp_path, **options))
    assert list(tmp_path.iterdir()) == []


def test_a_machine_that_does_not_see_the_folder_says_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="a cluster needs a shared file system"):
        dataset._Work(RECIPE, tmp_path / "elsewhere")("mug-0")
    assert not (tmp_path / "elsewhere").exists()


# Damage


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    for name, content in files(finished).items():
        (tmp_path / name).write_bytes(content)
    return tmp_path


def flip(path: Path, at: float) -> None:
    content = bytearray(path.read_bytes())
    content[int(at * len(content))] ^= 1
    path.write_bytes(content)


def test_sums_are_those_of_sha256sum(finished: Path) -> None:
    assert check_sums(finished) == 4
    subprocess.run(["sha256sum", "-c", "--quiet", "SHA256SUMS"], cwd=finished, check=True)


def test_a_damaged_shard_is_named(copied: Path) -> None:
    flip(copied / "mug-1.npz", 0.5)
    with pytest.raises(RecordingError, match=r"mug-1\.npz is damaged \(.*CRC"):
        read_sweeps(copied, "validation")
    (copied / "mug-2.npz").write_bytes((copied / "mug-2.npz").read_bytes()[:-5])
    with pytest.raises(RecordingError, match=r"mug-2\.npz is damaged"):
        read_sweeps(copied, "test")
    (copied / "mug-0.npz").unlink()
    bad = "3 of 4 files are missing or damaged: mug-0.npz, mug-1.npz, mug-2.npz"
    with pytest.raises(RecordingError, match=bad):
        check_sums(copied)


@pytest.mark.usefixtures("here")
def test_damage_is_never_declared_sound_and_can_be_made_good(copied: Path, finished: Path) -> None:
    flip(copied / "mug-1.npz", 0.5)
    list(make_sweeps(RECIPE, copied, processes=1))
    with pytest.raises(RecordingError, match=r"damaged: mug-1\.npz; delete"):
        check_sums(copied)
    (copied / "mug-1.npz").unlink()
    list(make_sweeps(RECIPE, copied, processes=1))
    assert files(copied) == files(finished)


def test_a_set_without_sums_says_so(copied: Path) -> None:
    (copied / "SHA256SUMS").write_text("nonsense")
    with pytest.raises(RecordingError, match="SHA256SUMS is damaged"):
        check_sums(copied)
    (copied / "SHA256SUMS").unlink()
    with pytest.raises(RecordingError, match="has no SHA256SUMS: the set is unfinished"):
        check_sums(copied)


# The whole of it, killed


MAIN = """
import sys
from pathlib import Path
from tactile_rt.sim_backend.datasets.dataset import make_sweeps
from tactile_rt.sim_backend.datasets.recipe_files import recipe_of_set
import msgspec
if __name__ == "__main__":
    folder, recipe, engine = sys.argv[1:]
    recipe = recipe_of_set(msgspec.json.decode(recipe))
    for _ in make_sweeps(recipe, Path(folder), 2, engine=engine):
        pass
"""
LARGER = replace(
    RECIPE,
    objects=ObjectChoice(categories=("mug", "bowl"), per_category=5, validation=1, test=1),
    sweeps=replace(RECIPE.sweeps, draws=6),
)


def start(folder: Path, recipe: SweepRecipe, engine: str = "processes") -> subprocess.Popen:
    import msgspec

    path = folder.parent / "main.py"
    path.write_text(MAIN)
    text = msgspec.json.encode(recipe.to_dict()).decode()
    command = [sys.executable, str(path), str(folder), text, engine]
    return subprocess.Popen(command, start_new_session=True)


@pytest.mark.slow
def test_kill_minus_nine_at_any_moment_changes_nothing(tmp_path: Path) -> None:
    whole, often = tmp_path / "whole", tmp_path / "killed"
    assert start(whole, LARGER).wait() == 0
    moments, kills, sweeps = random.Random(0), 0, 0
    while True:
        run = start(often, LARGER)
        enough = written(often) + moments.uniform(0, 0.25) * written(whole)
        while run.poll() is None and written(often) < enough:
            time.sleep(0.01)
        time.sleep(moments.uniform(0, 0.1))
        if run.poll() is not None:
            assert run.returncode == 0
            break
        # The whole run, or its parent alone, as whoever runs out of memory.
        if kills % 2:
            os.killpg(run.pid, signal.SIGKILL)
        else:
            run.kill()
        run.wait()
        kills += 1
        found = sum(len(read_object(often, name)[0]) for name in shards(often))
        assert found >= sweeps, "a finished sweep was lost"
        sweeps = found
    assert kills >= 3
    found = {name: content for name, content in files(often).items() if name[0] != "."}
    assert found == files(whole)


def written(folder: Path) -> int:
    """Bytes of sweeps."""
    return sum(path.stat().st_size for path in folder.glob("[!.]*.npz"))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_a_cluster_with_a_killed_worker_makes_the_same_set(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    whole, cluster = tmp_path / "whole", tmp_path / "cluster"
    assert start(whole, LARGER).wait() == 0
    run = start(cluster, LARGER, "ray")
    while run.poll() is None and not shards(cluster):
        time.sleep(0.05)
    killed = ray_workers(run.pid)[0]
    os.kill(killed, signal.SIGKILL)
    assert run.wait() == 0
    assert files(cluster) == files(whole)


def ray_workers(session: int) -> list[int]:
    """Processes of a session's Ray that are at a task."""
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        found = []
        for path in Path("/proc").glob("[0-9]*/cmdline"):
            try:
                command = path.read_bytes()
                pid = int(path.parent.name)
                if command.startswith(b"ray::_call") and os.getsid(pid) == session:
                    found.append(pid)
            except (OSError, ProcessLookupError):
                continue
        if found:
            return found
        time.sleep(0.05)
    raise AssertionError("no Ray worker at a task")
