"""Where convex pieces are kept, and that a user without a place for them has none."""

import os

import pytest

pytest.importorskip("trimesh")

import trimesh

from tactile_rt.sim_backend.objects.meshes import read_pieces, write_pieces
from tactile_rt.sim_backend.objects.solids import TactileObject


@pytest.fixture
def pieces():
    return TactileObject("box", "box", (trimesh.creation.box(),), 0.0, "by hand")


@pytest.mark.parametrize("relative", ["", "some/cache"])
def test_a_relative_folder_is_the_home_s(pieces, tmp_path, monkeypatch, relative):
    monkeypatch.delenv("TACTILE_RT_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", relative)
    monkeypatch.setenv("HOME", str(tmp_path))
    write_pieces("key", pieces)
    assert (tmp_path / ".cache" / "tactile_rt" / "pieces" / "key.npz").is_file()
    assert read_pieces("key") is not None


@pytest.mark.parametrize("home", ["~", "relative"])
def test_without_a_home_nothing_is_kept(pieces, tmp_path, monkeypatch, home):
    monkeypatch.delenv("TACTILE_RT_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path.replace("~", home))
    monkeypatch.chdir(tmp_path)
    write_pieces("key", pieces)
    assert read_pieces("key") is None
    assert os.listdir(tmp_path) == []
