"""Rates in the layout of the published `.npz`: one array (row, 6, unit) per animal."""

import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.models.alignment.rdm import STIMULI

__all__ = ["read_published", "write_published"]

Floats = NDArray[np.float64]

# The published code saved this option of `numpy.savez` as if it were an animal.
NOT_AN_ANIMAL = "allow_pickle"
LARGEST = 1 << 30  # bytes; the published ones have some tens of millions


def read_published(path: Path) -> dict[str, Floats]:
    """Rates of every animal, (row, 6, unit), NaN-padded; see `neural.published_layout`.

    The published file has an entry ``allow_pickle``, an option that was saved as if it were an
    animal: it is passed over, and nothing is ever unpickled.

    The stimulus axis has no names in such a file, so only protocol paper-code can use it.

    Raises:
        ConfigError: not such a file.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > LARGEST:
            raise ValueError(f"it would be {size} bytes")
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files if name != NOT_AN_ANIMAL}
    except FileNotFoundError:
        raise ConfigError(f"no file {path}") from None
    except Exception as error:  # numpy and zipfile raise a dozen unrelated types for a bad file
        reason = " ".join(str(error).split()) or type(error).__name__
        raise ConfigError(f"{path}: not an npz file of numbers ({reason})") from None
    if not arrays:
        raise ConfigError(f"{path}: holds no animal")
    for name, array in arrays.items():
        if array.ndim != 3 or array.shape[1] != len(STIMULI) or array.dtype.kind not in "fiu":
            raise ConfigError(
                f"{path}: {name} is {array.dtype} {array.shape}, not numbers "
                f"(row, {len(STIMULI)} stimuli, unit)"
            )
        if array.shape[0] < 2 or array.shape[2] < 2:
            raise ConfigError(f"{path}: {name} {array.shape} has fewer than two rows or units")
        if np.isinf(array).any():
            raise ConfigError(f"{path}: {name} holds an infinite rate")
    return {name: array.astype(np.float64) for name, array in arrays.items()}


def write_published(rates: dict[str, Floats], path: Path) -> None:
    """Write rates in this layout."""
    with path.open("wb") as file:
        np.savez_compressed(file, **rates)  # type: ignore[arg-type]
