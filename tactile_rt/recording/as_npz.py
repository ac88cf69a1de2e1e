"""A recording as numpy arrays in one file, which `numpy.load` reads; see `flat`.

Texts are JSON lines in arrays of bytes: in numpy's own text each takes the room of the longest.
"""

from collections.abc import Generator, Iterable
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from tactile_rt.recording.description import Description
from tactile_rt.recording.flat import (
    ABOUT,
    COLUMNS,
    TEXTS,
    Told,
    about_of,
    about_text,
    raws_of,
    spec_text,
)
from tactile_rt.recording.reader import Raw
from tactile_rt.stream import RecordingError, concatenate

__all__ = ["read_npz", "write_npz"]


def write_npz(what: str, about: Description, raws: Iterable[Raw], file: BinaryIO) -> int:
    """Write it; the number of samples.

    Raises:
        RecordingError: there is none.
    """
    told = Told()
    chunks = list(told.chunks(about.spec, raws))
    if not chunks:
        raise RecordingError(f"{what} has no samples")
    whole = concatenate(chunks)
    texts = {
        topic: np.frombuffer("".join(f"{line}\n" for line in lines).encode(), np.uint8)
        for topic, lines in told.texts.items()
    }
    arrays: dict[str, Any] = {
        **{name: getattr(whole, name) for name in COLUMNS},
        **told.times(),
        **texts,
        "utc_offset_ns": np.int64(about.utc_offset_ns),
        "spec": np.str_(about.spec.to_json()),
        ABOUT: np.str_(about_text(about)),
    }
    np.savez(file, **arrays)
    return len(whole)


def read_npz(path: Path) -> tuple[Description, Generator[Raw, None, None]]:
    """What it is of, and its messages.

    Arrays of one's own need `COLUMNS` and ``spec``.

    Raises:
        RecordingError: it is damaged, or holds something else.
    """
    try:
        with path.open("rb") as file, np.load(file) as found:
            arrays = {name: found[name] for name in found.files}
    except MemoryError:
        raise
    except Exception as error:  # numpy and zipfile raise a dozen unrelated types for a bad file
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(f"{path} is damaged, or no .npz ({reason})") from None
    what = str(path)
    if ABOUT in arrays:
        about = about_of(what, str(arrays[ABOUT]))
    elif "spec" in arrays:
        offset = int(arrays.get("utc_offset_ns", np.int64(0)))
        about = spec_text(what, str(arrays["spec"]), offset)
    else:
        raise RecordingError(
            f"{what} does not say what array it is of: it needs `spec`, as ArraySpec.to_json gives"
        )
    texts = {topic: _lines(arrays[topic]) for topic in TEXTS if topic in arrays}
    return about, raws_of(what, about, arrays, texts)


def _lines(data: NDArray[np.uint8]) -> list[str]:
    return data.tobytes().decode().split("\n")[:-1]
