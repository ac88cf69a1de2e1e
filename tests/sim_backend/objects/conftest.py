from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Pieces are kept for one test only."""
    monkeypatch.setenv("TACTILE_RT_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"
