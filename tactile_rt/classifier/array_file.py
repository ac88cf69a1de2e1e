"""Array descriptions from files: JSON as `tactile-rt describe` writes it, or an ONNX model."""

from pathlib import Path
from typing import Any

import msgspec

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.settings import convert, make_node, read_text
from tactile_rt.core.stream import SPEC_VERSION, ArraySpec


def read_array(path: Path) -> ArraySpec:
    """Read the description of an array from a file.

    Args:
        path: The JSON form of an `ArraySpec`, or an ``.onnx`` model made for the array.

    Raises:
        ConfigError: The file cannot be read, or does not describe an array.
        ModelError: The model cannot be read.
    """
    if path.suffix == ".onnx":
        # Imported here, since a stream without a model needs no onnxruntime.
        from tactile_rt.classifier.model_file import read_model

        return read_model(path)[0].array
    text = read_text(path)
    if path.suffix == ".toml":
        raise ConfigError(
            f"{path} is TOML; an array must be JSON: make it with `tactile-rt describe sim:{path} "
            f"--out {path.stem}.json`"
        )
    try:
        return ArraySpec.from_json(text)
    except ConfigError as error:
        _raise_bad_field(text, path)
        raise ConfigError(f"{path}: {error}") from None


def _raise_bad_field(text: str, path: Path) -> None:
    """Raise an error that names the wrong key or value, if one is found."""
    try:
        fields = msgspec.json.decode(text, type=dict[str, Any])
    except msgspec.MsgspecError:
        raise ConfigError(f"{path}: not JSON, as `tactile-rt describe` writes it") from None
    if fields.pop("version", None) == SPEC_VERSION:
        convert(make_node(fields, str(path), 0, Path()), ArraySpec)
