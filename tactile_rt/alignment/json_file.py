"""JSON files of structs, with arrays as lists and NaN as null, written atomically."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_origin

import msgspec
import numpy as np

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import refuse_lfs_pointer, write_whole

T = TypeVar("T")
LARGEST = 1e12  # largest number in a file: larger numbers cannot be plotted

if TYPE_CHECKING:
    Number = float
else:

    class Number(np.float64):
        """Number that is stored as null if it is NaN."""


def encode(value: Any) -> bytes:
    """Encode structs as JSON: arrays as lists, null for numbers that are not finite."""
    return msgspec.json.encode(value, enc_hook=lambda array: array.tolist())


def write_json(value: Any, path: Path) -> None:
    """Write structs to a JSON file, atomically."""
    text = msgspec.json.format(encode(value), indent=1)
    write_whole(path, lambda out: out.write(text + b"\n"))


def read_json(path: Path, kind: type[T], made_by: str) -> T:
    """Read a struct from a file written by `write_json`, and check its kind and version."""
    refuse_lfs_pointer(path)
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind, dec_hook=_decode_numbers)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigError(
            f"{path} is damaged, or was not made by `{made_by}` of this release: {error}"
        ) from None


def _decode_numbers(kind: Any, value: Any) -> Any:
    numbers = np.array(value, dtype=np.float64)
    if (np.abs(numbers) > LARGEST).any():
        raise ValueError(f"numbers must be at most {LARGEST:g}")
    if get_origin(kind) is np.ndarray:
        return numbers
    return kind(numbers)
