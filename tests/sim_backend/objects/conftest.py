from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def pieces_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where pieces are kept for all tests: the same mesh is cut once."""
    return tmp_path_factory.mktemp("pieces")


@pytest.fixture(autouse=True)
def _keep_pieces(pieces_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TACTILE_RT_CACHE", str(pieces_folder))


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A place of one test's own to keep pieces."""
    monkeypatch.setenv("TACTILE_RT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"
