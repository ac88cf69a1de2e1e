"""A recording as plain arrays or text, and these, or an episode of a LeRobot dataset, as a
recording again: bit for bit."""

from collections.abc import Generator, Iterable
from contextlib import closing
from pathlib import Path
from typing import BinaryIO

from tactile_rt.errors import ConfigError
from tactile_rt.files import write_whole
from tactile_rt.recording.as_arrays import TEXTS, read_npz, write_npz
from tactile_rt.recording.as_csv import beside, read_csv, write_csv
from tactile_rt.recording.as_hdf5 import need_h5py, read_hdf5, write_hdf5
from tactile_rt.recording.as_lerobot import is_dataset, read_dataset
from tactile_rt.recording.description import RECOVERED, Description
from tactile_rt.recording.layout import SAMPLES, Raw, decode_samples, samples_in
from tactile_rt.recording.lerobot_meta import need_pyarrow
from tactile_rt.recording.reader import Recording
from tactile_rt.recording.writer import McapFile
from tactile_rt.stream import Chunk

__all__ = ["chunks_of", "convert", "outputs_of"]

MCAP, HDF5 = ".mcap", (".h5", ".hdf5")
READERS = {".npz": read_npz, ".csv": read_csv, **dict.fromkeys(HDF5, read_hdf5)}


def outputs_of(output: str | Path) -> list[Path]:
    """The files that `convert` makes for this name."""
    path = Path(output)
    return [path, beside(path)] if path.suffix == ".csv" else [path]


def convert(path: str | Path, output: str | Path, episode: int = 0) -> int:
    """Write a recording as ``.npz``, ``.csv`` or ``.h5``, or any of these, or an episode of a
    LeRobot dataset that was made of recordings, as another of them or a recording again.

    All forms hold samples, description, decisions, events and health, and the chunks in which the
    samples came; raw packets stay behind. They are laid out in
    docs/reference/recording.md. What is written appears whole or not at all.

    Returns:
        Number of samples.

    Raises:
        ConfigError: a file of another kind, or an extra is not installed.
        RecordingError: what is read is damaged, or has no samples.
    """
    path, output = Path(path), Path(output)
    _check_kind(path)
    _check_output(output)
    if path.suffix == output.suffix == MCAP:
        raise ConfigError(f"{path} is a recording already: {output} would be no other")
    about, raws = _read(path, episode)
    n = 0

    def fill(file: BinaryIO) -> None:
        nonlocal n
        n = _write(str(path), about, raws, file, output)

    with closing(raws):
        write_whole(output, fill)
    return n


def chunks_of(path: str | Path) -> tuple[Description, Generator[Chunk, None, None]]:
    """What a recording of any form is of, and its chunks, as they were recorded.

    Raises:
        ConfigError: no such file, a file of another kind, or an extra is not installed.
        RecordingError: it is damaged; the chunks raise it, too.
    """
    path = Path(path)
    _check_kind(path)
    about, raws = _read(path)
    return about, (decode_samples(r.data, about.spec.shape) for r in raws if r.topic == SAMPLES)


def _check_kind(path: Path) -> None:
    """Refuse what is no form of a recording, or needs an extra that is not there."""
    if is_dataset(path):
        need_pyarrow()
    else:
        _check_output(path)


def _check_output(path: Path) -> None:
    if path.suffix not in (MCAP, *READERS):
        raise ConfigError(f"{path} is neither .mcap nor {', '.join(READERS)}")
    if path.suffix in HDF5:
        need_h5py()


def _read(path: Path, episode: int = 0) -> tuple[Description, Generator[Raw, None, None]]:
    if is_dataset(path):
        return read_dataset(path, episode)
    if path.suffix == MCAP:
        recording = Recording(path)
        return recording.description, recording.raw(SAMPLES, *TEXTS)
    if not path.is_file():
        raise ConfigError(f"no file {path}")
    return READERS[path.suffix](path)


def _write(what: str, about: Description, raws: Iterable[Raw], file: BinaryIO, output: Path) -> int:
    if output.suffix == ".csv":
        return write_csv(what, about, raws, file, output)
    if output.suffix == ".npz":
        return write_npz(what, about, raws, file)
    if output.suffix in HDF5:
        return write_hdf5(what, about, raws, file)
    made, n = McapFile(file, about), 0
    if about.recovered:
        made.note(RECOVERED, {"by": "tactile_rt"})
    for raw in raws:
        made.add(raw.topic, raw.data, raw.t_ns)
        if raw.topic == SAMPLES:
            n += samples_in(raw.data)
    made.finish()
    return n
