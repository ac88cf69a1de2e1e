import itertools
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tactile_rt.core.errors import ConfigError, RecordingError
from tactile_rt.sets.manifest import SPLITS, SweepManifest, has_object
from tactile_rt.sets.objects import (
    read_object,
    read_skipped,
    read_sweeps,
    write_object,
    write_skipped,
)
from tactile_rt.sets.splits import merge_categories, split_by_object
from tactile_rt.testing import small_spec

SPEC = small_spec()
SAMPLES = 11
MANIFEST = SweepManifest(
    spec=SPEC,
    period_ns=9_000_000,
    lead=4,
    categories=("bowl", "mug"),
    split={"train": ("bowl-0", "mug-0"), "validation": ("bowl-1",), "test": ("mug-1",)},
    recipe={"seed": 3, "profile": "realtime"},
)
NAMES = [name for names in MANIFEST.split.values() for name in names]


def sweeps_of(name: str, n: int = 2) -> np.ndarray:
    rng = np.random.default_rng(list(name.encode()))
    return rng.normal(size=(n, SAMPLES, *SPEC.shape)).astype(np.float32)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A finished set."""
    there = tmp_path / "deep" / "set"
    MANIFEST.write(there)
    for i, name in enumerate(NAMES, 1):
        write_object(there, name, sweeps_of(name, i), {"speed": np.arange(i)})
    return there


def test_what_is_written_is_read(folder: Path) -> None:
    assert SweepManifest.read(folder) == MANIFEST
    train = read_sweeps(folder, "train")
    assert len(train) == 3
    assert train.labels.tolist() == [0, 1, 1]
    assert train.objects.tolist() == ["bowl-0", "mug-0", "mug-0"]
    assert train.values.dtype == np.float32
    assert np.array_equal(train.values[:1], sweeps_of("bowl-0", 1))
    values, parameters = read_object(folder, "bowl-1")
    assert np.array_equal(values, sweeps_of("bowl-1", 3))
    assert {key: value.tolist() for key, value in parameters.items()} == {"speed": [0, 1, 2]}
    assert np.array_equal(train.values[1:], sweeps_of("mug-0", 2))
    assert read_sweeps(folder, "test").labels.tolist() == [1] * 4
    with np.load(folder / "mug-1.npz") as arrays:
        assert arrays["speed"].tolist() == [0, 1, 2, 3]


def test_a_category_may_have_a_dash_in_its_name(tmp_path: Path) -> None:
    manifest = replace(MANIFEST, categories=("t-rex", "t"), split={"train": ("t-rex-0", "t-12")})
    manifest.write(tmp_path)
    for name in manifest.split["train"]:
        write_object(tmp_path, name, sweeps_of(name), {})
    assert read_sweeps(tmp_path, "train").labels.tolist() == [0, 0, 1, 1]


class Unwritable:
    """An array that fails when half of the file is on the disk."""

    def __array__(self, dtype=None, copy=None):
        raise KeyboardInterrupt


def test_an_interrupted_write_leaves_nothing(folder: Path) -> None:
    before = {p.name: p.read_bytes() for p in folder.iterdir()}
    for name in ("mug-9", "mug-1"):  # a new object, and one that is there already
        with pytest.raises(KeyboardInterrupt):
            write_object(folder, name, sweeps_of(name), {"speed": Unwritable()})
    assert {p.name: p.read_bytes() for p in folder.iterdir()} == before
    assert not has_object(folder, "mug-9")


# Going on with a set that is there


def test_the_same_set_may_be_begun_again(folder: Path) -> None:
    before = (folder / "manifest.json").stat().st_mtime_ns
    MANIFEST.write(folder)
    assert (folder / "manifest.json").stat().st_mtime_ns == before


def test_a_recipe_that_json_spells_differently_is_still_the_same(tmp_path: Path) -> None:
    """JSON knows no tuples."""
    manifest = replace(MANIFEST, recipe={"speeds": (28.0, 40.0), "nested": {"a": (1,)}})
    manifest.write(tmp_path)
    manifest.write(tmp_path)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"recipe": {"seed": 4, "profile": "realtime"}}, "recipe.seed"),
        ({"recipe": {"seed": 3, "profile": "realtime", "sensor": {"gain": 0.1}}}, "recipe.sensor"),
        ({"lead": 5, "period_ns": 1}, "period_ns, lead"),
        ({"split": {**MANIFEST.split, "train": ("bowl-0",)}}, "split"),
        ({"spec": small_spec(rate_hz=500.0)}, "spec"),
    ],
)
def test_another_set_in_the_folder_is_refused_by_what_differs(
    folder: Path, change: dict, named: str
) -> None:
    before = (folder / "manifest.json").read_bytes()
    with pytest.raises(ConfigError, match=rf"holds another sweep set \(other {named}\)"):
        replace(MANIFEST, **change).write(folder)
    assert (folder / "manifest.json").read_bytes() == before


def test_a_folder_of_other_things_takes_no_set(tmp_path: Path) -> None:
    (tmp_path / "thesis.txt").write_text("of somebody")
    with pytest.raises(ConfigError, match=r"holds 'thesis.txt' and no sweep set"):
        MANIFEST.write(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]


# What is missing or damaged


def test_a_folder_without_a_set_is_named(tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(RecordingError, match=f"{folder} is not a sweep set: no manifest.json"):
            read_sweeps(folder, "train")


def manifest_with(**fields: object) -> bytes:
    return msgspec.json.encode({**msgspec.to_builtins(MANIFEST), **fields})


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (b"{", "is damaged"),
        (b'{"version": "\xff"}', "is damaged"),
        (b"{}", "is of version None; this release reads 2 and 3"),
        (manifest_with(version=4), "is of version 4; this release reads 2 and 3"),
        (manifest_with(lead="four"), r"is damaged: .*\$.lead"),
        (manifest_with(spec={}), r"is damaged: .*\$.spec"),
        (
            manifest_with(spec={**msgspec.to_builtins(SPEC), "rate_hz": -1}),
            "is damaged: .*rate_hz must be positive",
        ),
    ],
)
def test_a_damaged_manifest_is_named(folder: Path, content: bytes, complaint: str) -> None:
    path = folder / "manifest.json"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=f"^{path} {complaint}"):
        read_sweeps(folder, "train")
    with pytest.raises(RecordingError, match=f"^{path} {complaint}"):
        MANIFEST.write(folder)  # rather than over it


def test_an_unknown_split_is_named_with_the_known_ones(folder: Path) -> None:
    with pytest.raises(
        ConfigError, match=r"no split 'tests' in .*: it has train, validation, test"
    ):
        read_sweeps(folder, "tests")


def test_an_unfinished_set_says_how_to_finish_it(folder: Path) -> None:
    (folder / "mug-0.npz").unlink()
    with pytest.raises(
        RecordingError, match=r"1 of 2 objects of 'train' are missing \(mug-0 \.\.\.\); run"
    ):
        read_sweeps(folder, "train")
    assert len(read_sweeps(folder, "test")) == 4


def test_a_split_without_objects_or_of_unknown_ones_is_damage(folder: Path) -> None:
    (folder / "manifest.json").write_bytes(manifest_with(split={"train": []}))
    with pytest.raises(RecordingError, match="'train' has no objects"):
        read_sweeps(folder, "train")
    write_object(folder, "spoon-0", sweeps_of("spoon-0"), {})
    (folder / "manifest.json").write_bytes(manifest_with(split={"train": ["mug-1", "spoon-0"]}))
    with pytest.raises(RecordingError, match="spoon-0 has a category"):
        read_sweeps(folder, "train")


def spoil(path: Path, how: str) -> None:
    if how == "cut":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 10])
    elif how == "a bare array":
        with path.open("wb") as file:
            np.save(file, np.zeros(3))
    elif how == "without values":
        np.savez(path, speed=np.zeros(3))
    elif how == "objects":
        np.savez(path, values=np.array([None, {}], dtype=object))
    elif how == "a folder":
        path.unlink()
        path.mkdir()


@pytest.mark.parametrize("how", ["cut", "a bare array", "without values", "objects", "a folder"])
def test_a_damaged_object_is_named_with_the_remedy(folder: Path, how: str) -> None:
    path = folder / "mug-0.npz"
    spoil(path, how)
    with pytest.raises(RecordingError, match=rf"^{path} is damaged \(.+\): delete it and sweep"):
        read_sweeps(folder, "train")


def test_no_flipped_byte_is_read_as_other_values(folder: Path) -> None:
    path = folder / "mug-0.npz"
    whole = path.read_bytes()
    expected = read_sweeps(folder, "train").values
    found = 0
    for at in range(0, len(whole), 5):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
        try:
            values = read_sweeps(folder, "train").values
        except RecordingError:
            found += 1
        else:  # a byte that does not matter, such as a time stamp or another array
            assert np.array_equal(values, expected), at
    assert found > len(whole) // 5 // 2


def test_an_object_of_another_array_or_length_is_refused(folder: Path) -> None:
    write_object(folder, "mug-0", np.zeros((2, SAMPLES, 3, 6)), {})
    with pytest.raises(RecordingError, match=r"mug-0.npz holds \(2, 11, 3, 6\), not"):
        read_sweeps(folder, "train")
    write_object(folder, "mug-0", np.zeros((2, SAMPLES + 1, *SPEC.shape)), {})
    with pytest.raises(RecordingError, match=r"mug-0.npz holds sweeps of 12 samples, not 11"):
        read_sweeps(folder, "train")


# Objects that are withheld, skipped, or have a name of their own


def test_withheld_categories_have_no_label(tmp_path: Path) -> None:
    split = {**MANIFEST.split, "withheld": ("spoon-0", "spoon-1")}
    replace(MANIFEST, split=split, withheld=("spoon",)).write(tmp_path)
    for name in ("spoon-0", "spoon-1", "mug-1"):
        write_object(tmp_path, name, sweeps_of(name), {})
    assert read_sweeps(tmp_path, "withheld").labels.tolist() == [-1] * 4
    assert read_sweeps(tmp_path, "test").labels.tolist() == [1, 1]


def test_an_objects_category_may_be_told_apart_from_its_name(tmp_path: Path) -> None:
    split = {"train": ("02876657-1a-f0", "mug-0")}
    manifest = replace(MANIFEST, split=split, category_of={"02876657-1a-f0": "bowl"})
    manifest.write(tmp_path)
    for name in split["train"]:
        write_object(tmp_path, name, sweeps_of(name, 1), {})
    assert read_sweeps(tmp_path, "train").labels.tolist() == [0, 1]
    assert SweepManifest.read(tmp_path).category("02876657-1a-f0") == "bowl"


def test_categories_that_are_one_class_become_its_kinds() -> None:
    split = {**MANIFEST.split, "withheld": ("spoon-0",)}
    manifest = replace(MANIFEST, split=split, withheld=("spoon",), kind_of={"mug-1": "stein"})
    merged = merge_categories(manifest, {"round": ["mug"]})
    assert merged.categories == ("bowl", "round")
    assert [merged.label(n) for n in ("bowl-0", "mug-0", "mug-1", "spoon-0")] == [0, 1, 1, -1]
    assert merged.kind_of == {"mug-0": "mug", "mug-1": "stein"}
    assert merge_categories(manifest, {}) is manifest
    with pytest.raises(ConfigError, match="classes: no category 'mgu': there are bowl, mug"):
        merge_categories(manifest, {"round": ["mgu"]})
    with pytest.raises(ConfigError, match="classes: 'mug' is both round and flat"):
        merge_categories(manifest, {"round": ["mug"], "flat": ["mug"]})


def test_skipped_objects_are_not_missed(folder: Path) -> None:
    (folder / "mug-0.npz").unlink()
    assert read_skipped(folder) == {}
    write_skipped(folder, {"mug-0": "no volume"})
    assert read_skipped(folder) == {"mug-0": "no volume"}
    assert read_sweeps(folder, "train").objects.tolist() == ["bowl-0"]
    write_skipped(folder, {"mug-0": "no volume", "bowl-0": "no volume"})
    with pytest.raises(RecordingError, match="'train' has no objects"):
        read_sweeps(folder, "train")
    (folder / "skipped.json").write_text("{")
    with pytest.raises(RecordingError, match=r"skipped\.json is damaged"):
        read_sweeps(folder, "train")


def test_names_are_those_of_the_splits_asked_for() -> None:
    assert MANIFEST.names() == NAMES
    assert MANIFEST.names(["test", "test"]) == ["mug-1"]
    with pytest.raises(ConfigError, match="no split 'tests': there are train, validation, test"):
        MANIFEST.names(["tests"])


# Splitting


@given(
    st.lists(st.text("abc-", min_size=1, max_size=4), min_size=1, max_size=5, unique=True),
    st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 9)),
)
def test_a_split_puts_every_object_on_exactly_one_side(categories, counts) -> None:
    train, validation, test = counts
    split = split_by_object(categories, sum(counts), validation, test)
    assert tuple(split) == SPLITS
    names = [name for side in split.values() for name in side]
    assert len(names) == len(set(names))
    assert set(names) == {f"{c}-{i}" for c in categories for i in range(sum(counts))}
    for side, n in zip(split.values(), (train, validation, test), strict=True):
        per_category = [name.rpartition("-")[0] for name in side]
        assert all(per_category.count(c) == n for c in categories)


def test_more_test_objects_never_come_from_validation_to_training() -> None:
    """The last instances are the test: a larger set keeps the held-out side held out in kind."""
    for a, b in itertools.pairwise(range(3, 12)):
        small, large = (split_by_object(["mug"], n, 1, 1) for n in (a, b))
        assert set(small["train"]) < set(large["train"])
