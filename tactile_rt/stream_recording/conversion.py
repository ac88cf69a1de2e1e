"""A recording's samples as plain arrays or text."""

import csv
import io
from pathlib import Path
from typing import BinaryIO

import numpy as np

from tactile_rt.recording import write_whole
from tactile_rt.stream import ConfigError, RecordingError, concatenate
from tactile_rt.stream_recording.description import Description
from tactile_rt.stream_recording.reader import read_description, read_stream

__all__ = ["convert"]


def convert(path: str | Path, output: str | Path) -> int:
    """Write a recording's samples as ``.npz`` or ``.csv``, whole or not at all.

    npz: ``seq``, ``t_ns``, ``values``, ``valid`` as in `Chunk`; ``utc_offset_ns``; ``spec`` as
    `ArraySpec.from_json` reads it. csv: a line per sample, ``seq``, ``t_ns``, then a column
    ``ELEMENT.CHANNEL [UNIT]`` each, empty where it is not valid.

    Returns:
        Number of samples.

    Raises:
        ConfigError: an output of another kind.
        RecordingError: the recording is damaged.
    """
    output = Path(output)
    if output.suffix not in (".npz", ".csv"):
        raise ConfigError(f"{output} is neither .npz nor .csv")
    about = read_description(path)
    write = _write_csv if output.suffix == ".csv" else _write_npz
    n = 0

    def fill(file: BinaryIO) -> None:
        nonlocal n
        n = write(Path(path), about, file)

    write_whole(output, fill)
    return n


def _write_npz(path: Path, about: Description, file: BinaryIO) -> int:
    chunks = list(read_stream(path))
    if not chunks:
        raise RecordingError(f"{path} has no samples")
    whole = concatenate(chunks)
    np.savez(
        file, seq=whole.seq, t_ns=whole.t_ns, values=whole.values, valid=whole.valid,
        utc_offset_ns=np.int64(about.utc_offset_ns), spec=np.str_(about.spec.to_json()),
    )  # fmt: skip
    return len(whole)


def _write_csv(path: Path, about: Description, file: BinaryIO) -> int:
    spec, n = about.spec, 0
    text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
    lines = csv.writer(text, lineterminator="\n")
    columns = [
        f"{e}.{c} [{unit}]"
        for e in spec.elements
        for c, unit in zip(spec.channels, spec.units, strict=True)
    ]
    lines.writerow(["seq", "t_ns", *columns])
    for chunk in read_stream(path):
        good = np.repeat(chunk.valid, len(spec.channels), axis=1)
        flat = chunk.values.reshape(len(chunk), -1)
        for seq, t_ns, row, valid in zip(chunk.seq, chunk.t_ns, flat, good, strict=True):
            # str() of a float32 is the shortest text that reads back as the same number
            cells = [str(x) if ok else "" for x, ok in zip(row, valid, strict=True)]
            lines.writerow([seq, t_ns, *cells])
        n += len(chunk)
    text.detach()
    return n
