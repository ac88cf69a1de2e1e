from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of the tiny model, one for all tests of a module."""
    from tests.helpers.tiny_model import write_model  # needs onnx

    return write_model(tmp_path_factory.mktemp("model") / "tiny.onnx")
