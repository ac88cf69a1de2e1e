"""A recording as HDF5, piece by piece: it need not fit into memory; see `as_arrays`.

Beside the arrays it names the axes of `values`: ``elements``, ``channels`` and ``units``, with the
attributes ``frame`` (of mounting), ``rate_hz`` and ``utc_offset_ns``. It needs the extra ``hdf5``.
"""

import io
import os
from collections.abc import Generator, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from tactile_rt.errors import RecordingError, TactileError
from tactile_rt.extras import lacking
from tactile_rt.recording.as_arrays import (
    ABOUT,
    BLOCK,
    COLUMNS,
    TEXTS,
    Told,
    about_of,
    about_text,
    raws_of,
)
from tactile_rt.recording.description import Description
from tactile_rt.recording.layout import Raw
from tactile_rt.stream import Chunk, concatenate

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

__all__ = ["need_h5py", "read_hdf5", "write_hdf5"]

PIECE = 1024  # samples that are stored together, with a checksum


def need_h5py() -> Any:
    """The module.

    Raises:
        ConfigError: the extra is not installed.
    """
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise lacking("HDF5 needs", "hdf5", error) from None
    return h5py


def write_hdf5(what: str, about: Description, raws: Iterable[Raw], file: BinaryIO) -> int:
    """Write it; the number of samples.

    Raises:
        ConfigError: the extra is not installed.
        RecordingError: there is no sample.
        OSError: the disk is full.
    """
    h5py = need_h5py()
    told, spec, n = Told(), about.spec, 0
    with _Patient(os.dup(file.fileno()), "r+b") as patient, h5py.File(patient, "w") as made:
        for block in _blocks(told.chunks(spec, raws)):
            for name in COLUMNS:
                _append(made, name, getattr(block, name), n)
            n += len(block)
            patient.check()
        if not n:
            raise RecordingError(f"{what} has no samples")
        text = h5py.string_dtype()
        for name, lines in told.texts.items():
            made.create_dataset(name, data=lines, dtype=text, shape=(len(lines),))
        for name, times in told.times().items():
            made.create_dataset(name, data=times)
        for name in ("elements", "channels", "units"):
            made.create_dataset(name, data=list(getattr(spec, name)), dtype=text)
        made.create_dataset(ABOUT, data=about_text(about), dtype=text)
        made.attrs.update(frame=spec.frame, rate_hz=spec.rate_hz, utc_offset_ns=about.utc_offset_ns)
    return n


class _Patient(io.FileIO):
    """A file that tells of a full disk when the library is done with it, not in its midst.

    HDF5 would tell of every piece that it cannot write, in dozens of lines each.
    """

    def __init__(self, handle: int, mode: str) -> None:
        super().__init__(handle, mode)
        self._failed: OSError | None = None

    def check(self) -> None:
        """Tell what has failed.

        Raises:
            OSError: something could not be written.
        """
        if self._failed is not None:
            raise self._failed

    def write(self, data: "ReadableBuffer") -> int:
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while left and self._failed is None:
                left = left[super().write(left) :]
        except OSError as error:
            self._failed = error
        return size

    def __exit__(self, *_: object) -> None:
        self.close()
        self.check()


def _append(made: Any, name: str, data: Any, n: int) -> None:
    if not n:
        made.create_dataset(
            name, data=data, maxshape=(None, *data.shape[1:]), chunks=(PIECE, *data.shape[1:]),
            fletcher32=True,
        )  # fmt: skip
        return
    made[name].resize(n + len(data), axis=0)
    made[name][n:] = data


def _blocks(chunks: Iterator[Chunk]) -> Iterator[Chunk]:
    waiting: list[Chunk] = []
    n = 0
    for chunk in chunks:
        waiting.append(chunk)
        n += len(chunk)
        if n >= BLOCK:
            yield concatenate(waiting)
            waiting, n = [], 0
    if waiting:
        yield concatenate(waiting)


def read_hdf5(path: Path) -> tuple[Description, Generator[Raw, None, None]]:
    """What it is of, and its messages.

    Raises:
        ConfigError: the extra is not installed.
        RecordingError: it is damaged, or holds something else.
    """
    h5py = need_h5py()
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        reason = " ".join(str(error).split())
        raise RecordingError(f"{path} is damaged, or no HDF5 ({reason})") from None
    try:
        if ABOUT not in file:
            raise RecordingError(f"{path} is no recording of tactile-rt: it has no `{ABOUT}`")
        about = about_of(str(path), file[ABOUT].asstr()[()])
    except BaseException:
        file.close()
        raise
    return about, _raws(path, about, file)


def _raws(path: Path, about: Description, file: Any) -> Generator[Raw, None, None]:
    with closing(file):
        try:
            arrays = {name: file[name] for name in file if name not in (*TEXTS, ABOUT)}
            texts = {topic: list(file[topic].asstr()) for topic in TEXTS if topic in file}
            yield from raws_of(str(path), about, arrays, texts)
        except (TactileError, GeneratorExit):
            raise
        except Exception as error:  # as for any damaged file
            reason = " ".join(str(error).split()) or type(error).__name__
            raise RecordingError(f"{path} is damaged ({reason})") from None
