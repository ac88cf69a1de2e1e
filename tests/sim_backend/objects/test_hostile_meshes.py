"""Mesh files that are made to exhaust who reads them are refused at once, in one line."""

import pytest

from tests.helpers.hostile_files import MESHES
from tests.helpers.measured import measured

pytest.importorskip("trimesh")


@pytest.mark.parametrize("name", MESHES)
def test_a_hostile_mesh_is_refused(name, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    suffix, content = MESHES[name]()
    path = tmp_path / f"hostile{suffix}"
    path.write_bytes(content)
    # a second of it is for the simulator to be imported
    measured("whisk", tmp_path / "out.npz", "--object", path).assert_refused(path.name)
