from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from tactile_rt.core.errors import RecordingError
from tactile_rt.core.stream.sensor_spec import channel_limits
from tactile_rt.models.evaluation.svm import fit
from tactile_rt.sets.manifest import SweepManifest
from tactile_rt.sets.objects import write_object, write_skipped
from tactile_rt.sim_backend.datasets.card import write_card
from tactile_rt.sim_backend.datasets.card_survey import (
    Features,
    check_separability,
    survey,
    window_features,
)
from tactile_rt.testing import small_spec

SPEC = small_spec()  # 3 elements
UNITS = ("N", "N m")
LIMITS = channel_limits(replace(SPEC, channels=("fx", "mx"), units=UNITS))
LEAD, SAMPLES = 4, 40
MANIFEST = SweepManifest(
    spec=replace(SPEC, channels=("fx", "mx"), units=UNITS),
    period_ns=45_000_000,
    lead=LEAD,
    categories=("bowl", "mug"),
    split={
        "train": tuple(f"{c}-{i}" for i in range(4) for c in ("bowl", "mug")),
        "validation": ("bowl-4", "mug-4"),
        "test": ("bowl-5", "mug-5"),
        "withheld": ("goblet-0",),
    },
    recipe={"name": "made-up", "profile": "none", "seed": 7},
    withheld=("goblet",),
    versions={"mujoco": "4.0.0"},
)
FORCE = {"bowl": 1e-4, "mug": 3e-4, "goblet": 1e-3}


def sweeps_of(name: str) -> np.ndarray:
    """Two sweeps: whisker 0 always feels its category's force, whisker 1 in the first alone."""
    values = np.zeros((2, SAMPLES, *MANIFEST.spec.shape), dtype=np.float32)
    values[:, LEAD + 3 :, 0, 0] = FORCE[MANIFEST.category(name)]
    values[0, LEAD + 5 :, 1, 0] = -2e-5
    return values


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    MANIFEST.write(tmp_path)
    for k, name in enumerate(MANIFEST.names()):
        parameters = {
            "yaw_deg": np.array([k, 100 + k]),
            "touches": np.array([True, True]),
            "geometry": np.array(["f0", "f0"]),
        }
        write_object(tmp_path, name, sweeps_of(name), parameters)
    return tmp_path


def test_a_card_counts_what_is_there(folder: Path) -> None:
    card, examples = survey(folder, fit)
    assert card.objects == {
        "train": {"bowl": 4, "mug": 4},
        "validation": {"bowl": 1, "mug": 1},
        "test": {"bowl": 1, "mug": 1},
        "withheld": {"goblet": 1},
    }
    assert card.sweeps["train"] == {"bowl": 8, "mug": 8}
    assert card.samples == 13 * sweeps_of("mug-0").size
    assert card.parameters == {"yaw_deg": (0, 56, 112), "touches": (1, 1, 1)}
    assert list(card.coverage.values()) == [1.0, 0.5, 0.0]
    assert card.whiskers_touched == 1.5
    assert (card.without_touch, card.misses, card.not_finite) == (0, 0, 0)
    assert card.largest == (pytest.approx(1e-3), "goblet-0, sweep 0")
    peaks = [FORCE[c] for c, n in (("bowl", 12), ("mug", 12), ("goblet", 2)) for _ in range(n)]
    assert sum(card.load_counts) == len(peaks) + 13
    assert card.median_load == pytest.approx(np.median([*peaks, *[2e-5] * 13]))
    at = np.searchsorted(card.load_edges, 2e-5) - 1
    assert card.load_counts[at] == 13
    assert set(examples) == {"bowl", "mug", "goblet"}
    assert np.array_equal(examples["mug"], abs(sweeps_of("mug-0")[0, :, :, 0]))


def test_misses_noise_clips_and_nonsense_are_told_apart(folder: Path) -> None:
    values = sweeps_of("mug-0")
    values[0] = 0
    write_object(
        folder, "mug-0", values, {"touches": np.array([False, True]), "unstable": np.array([0, 1])}
    )
    values = sweeps_of("mug-1")
    values[0, 9, 2, 1] = np.nan
    values[1, 9, 2] = (2.0, -0.02)
    values[1, 10, 2] = (6e-3, 6e-6)
    write_object(folder, "mug-1", values, {})
    values = np.zeros_like(values)
    values[..., 0] = np.random.default_rng(0).normal(size=values.shape[:3]) * 1e-5  # a sensor's
    values[..., 0] = np.clip(values[..., 0], -1.5e-5, 1.5e-5)
    values[:, 0, :, 0] = 1.5e-5
    write_object(folder, "mug-2", values, {})
    card, _ = survey(folder, fit)
    assert (card.misses, card.unstable, card.without_touch, card.not_finite) == (1, 1, 3, 1)
    assert card.clips == {
        "1 N (published)": 1,
        "0.01 N m (published)": 1,
        "0.005 N (networks)": 2,
        "5e-06 N m (networks)": 2,
    }
    assert card.largest == (2.0, "mug-1, sweep 1")


def test_the_card_is_written_beside_the_set(folder: Path) -> None:
    write_skipped(folder, {"mug-9": "no volume"})
    card = write_card(folder, fit)
    assert [s.classes for s in card.separability] == [("mug", "bowl")]
    text = (folder / "README.md").read_text()
    assert "26 simulated sweeps of 13 objects" in text
    assert "| mug | 4 / 8 | 1 / 2 | 1 / 2 | - |" in text
    assert "| goblet | - | - | - | 1 / 2 |" in text
    assert "| all | 8 / 16 | 2 / 4 | 2 / 4 | 1 / 2 |" in text
    assert "| mug-9 | no volume |" in text
    assert "mujoco 4.0.0" in text
    assert "| mug, bowl | 100.0 | 50 |" in text
    assert "nan" not in text
    picture = imread(folder / "card.png")
    assert min(picture.shape[:2]) > 200
    assert picture[..., :3].std() > 0.05, "something is drawn"
    first = text
    write_card(folder, fit)
    assert (folder / "README.md").read_text() == first


def test_an_unfinished_set_has_a_card_of_what_is_there(folder: Path) -> None:
    for name in MANIFEST.split["test"]:
        (folder / f"{name}.npz").unlink()
    card = write_card(folder, fit)
    assert "test" not in card.sweeps
    assert card.separability == []
    assert "Not checked" in (folder / "README.md").read_text()
    for path in folder.glob("*.npz"):
        path.unlink()
    with pytest.raises(RecordingError, match="has no sweeps yet"):
        write_card(folder, fit)


def test_a_set_that_nothing_touched_has_a_card(folder: Path) -> None:
    for name in MANIFEST.names():
        write_object(folder, name, np.zeros_like(sweeps_of(name)), {})
    card = write_card(folder, fit)
    assert (card.without_touch, card.whiskers_touched, card.median_load) == (26, 0, 0)


# Separability


def clouds(categories: list[str], n: int, spread: float, seed: int) -> Features:
    """Sweeps of each category around a place of its own."""
    rng = np.random.default_rng(seed)
    centres = np.eye(len(categories), 8)
    values = [c + spread * rng.normal(size=(n, 8)) for c in centres]
    return Features(np.concatenate(values).astype(np.float32), np.repeat(np.array(categories), n))


def test_what_differs_is_told_apart_and_what_does_not_is_guessed() -> None:
    names = ["car", "chair", "house", "mug", "spoon"]
    apart = check_separability(clouds(names, 40, 0.05, 0), clouds(names, 40, 0.05, 1), fit)
    published = ("mug", "house", "chair", "car")
    assert [s.classes for s in apart] == [published[:2], published[:3], published]
    assert all(s.accuracy > 0.99 for s in apart)
    alike = check_separability(clouds(names, 40, 50.0, 0), clouds(names, 40, 50.0, 1), fit)
    assert all(abs(s.accuracy - 1 / len(s.classes)) < 0.1 for s in alike)
    others = clouds(["a", "b", "cup"], 9, 0.1, 0)
    assert [s.classes for s in check_separability(others, others, fit)] == [
        ("cup", "a"), ("cup", "a", "b")
    ]  # fmt: skip
    assert check_separability(clouds(["a"], 3, 1.0, 0), clouds(["a"], 3, 1.0, 1), fit) == []


def test_a_machine_sees_one_second_from_the_first_touch() -> None:
    values = np.zeros((200, 2, 2), dtype=np.float32)
    values[60:, 1, 0] = np.arange(140) * 1e-6
    seen = window_features(values, 60, 9.0, LIMITS).reshape(22, 2, 2)
    steps = np.arange(110).reshape(22, 5).mean(axis=1) * 1e-6
    assert seen[:, 1, 0] == pytest.approx(np.log1p(steps / 1e-5), rel=1e-5)
    assert not seen[:, 0].any()
    values[:] = -1.0
    limits = -np.log1p(np.array([5e-3 / 1e-5, 5e-6 / 5e-8]))
    seen = window_features(values, 190, 9.0, LIMITS).reshape(22, 2, 2)  # beyond the end, too
    assert seen == pytest.approx(np.broadcast_to(limits, (22, 2, 2)), rel=1e-6)
