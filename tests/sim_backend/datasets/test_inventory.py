"""What is told of a set once it is made: what of it is no use."""

import os
from pathlib import Path

import numpy as np
import pytest

from tactile_rt.sets.objects import write_object, write_skipped
from tactile_rt.sim_backend.datasets.inventory import Tally, remove_leftovers, tally


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two objects of two sweeps, one that could not be made."""
    values = np.zeros((2, 3, 1, 6), np.float32)
    for name, touches, unstable in (
        ("a", (True, False), (True, False)),
        ("b", (True,) * 2, (0, 0)),
    ):
        flags = {"touches": np.array(touches), "unstable": np.array(unstable, np.bool_)}
        flags["saturated"] = np.array([0.2, 0.0])
        write_object(tmp_path, name, values, flags)
    write_skipped(tmp_path, {"c": "no triangles"})
    return tmp_path


def test_misses_failures_and_skipped_objects_are_counted(folder: Path) -> None:
    counts = tally(folder, ["a", "b", "c"], 2)
    assert counts == Tally(sweeps=4, misses=1, unstable=1, saturated=2, skipped=1)
    assert counts.shortcomings == (
        "1 miss the array (larger `size_mm`, less `distance_mm`, other `height_mm`), "
        "2 exceed the sensor's `range` (more `distance_mm`), "
        "1 could not be simulated, 1 objects are left out (skipped.json says why)"
    )
    assert tally(folder, ["b"], 2).misses == 0
    assert Tally(sweeps=4).shortcomings == ""


def test_leftovers_are_removed_once_no_one_writes_them(tmp_path: Path) -> None:
    stale = [tmp_path / name for name in (".mug-0.npz.ab12", ".manifest.json.ef")]
    kept = [tmp_path / name for name in (".bowl-0.npz.cd34", ".SHA256SUMS.gh", ".hidden", "a.npz")]
    for path in (*stale, *kept):
        path.touch()
    for path in (*stale, *kept[2:]):
        os.utime(path, (0, 0))
    remove_leftovers(tmp_path)
    assert sorted(tmp_path.iterdir()) == sorted(kept)
