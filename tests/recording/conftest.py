import pytest


@pytest.fixture
def path(tmp_path):
    """Where a test records to."""
    return tmp_path / "run.mcap"
