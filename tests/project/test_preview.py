"""What a project is to sweep, looked at before: shares, advice, and a picture."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tactile_rt.project import making
from tactile_rt.project.folder import Project, new_project


@pytest.fixture
def project(tmp_path: Path, monkeypatch) -> Project:
    """One of two kinds, of each of which one sweep is tried."""
    monkeypatch.setattr(making, "PREVIEW_S", 0.0)
    return new_project(tmp_path / "mine", "hx711_whisker", ("mug", "gear"))


def test_shares_are_told_and_one_picture_is_written(call, project: Project) -> None:
    before = {path: path.read_bytes() for path in project.folder.iterdir()}
    code, table, err = call("make", project.folder, "--preview")
    assert code == 0 and "preview.png shows" in err.replace("\n", " "), err
    assert [line.split() for line in table.splitlines()[1:]] == [
        ["mug", "1", "100", "0"], ["gear", "1", "100", "0"],
    ]  # fmt: skip
    picture = project.folder / "preview.png"
    assert {p: p.read_bytes() for p in project.folder.iterdir() if p != picture} == before
    with Image.open(picture) as image:
        assert np.asarray(image.convert("RGB")).std() > 10


def test_what_misses_or_saturates_is_said_with_what_to_change(call, project: Project) -> None:
    for file, key, value in (("array", "range", 1e-12), ("sweeps", "height_mm", 500)):
        path = project.folder / f"{file}.toml"
        path.write_text(path.read_text().replace(f"{key} = ", f"{key} = {value}  # "))
        code, out, err = call("make", project.folder, "--preview", "--json", "-")
        assert code == 0, err
        for row in json.loads(out):
            missed = key == "height_mm"
            assert (row["touch"], row["beyond"]) == ((0, 0) if missed else (100, 100))
            assert ("other `height_mm`" if missed else "more `distance_mm`") in row["change"]
