"""A recording as text: a line per sample, and all else in a file beside it; see `as_arrays`.

    seq,t_ns,A0.fx [N],...,bits
    0,1000000,0.00012,...,
    1,2000000,,...,3:0000c07f0000c07f     element 3 was not valid, and this is what it read

    run.csv.json     about, chunk_samples, chunk_log_ns, decisions, events, health

A cell is empty where its element has no trustworthy value, so that nobody takes it for one. Bits
that text does not give back (of these, and of NaN) are in the last column, as ELEMENT:HEX, element
from 0, its channels little-endian float32.
"""

import csv
import io
from collections.abc import Generator, Iterable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError, RecordingError
from tactile_rt.files import write_whole
from tactile_rt.recording.as_arrays import ABOUT, COLUMNS, Told, about_of, about_text, raws_of
from tactile_rt.recording.description import Description
from tactile_rt.recording.layout import Raw
from tactile_rt.stream import ArraySpec, Chunk, concatenate

__all__ = ["beside", "read_csv", "told_of", "told_text", "write_csv"]

BITS = "bits"
BATCH = 4096


def beside(path: Path) -> Path:
    """Where what is no sample goes."""
    return path.with_name(f"{path.name}.json")


def write_csv(
    what: str, about: Description, raws: Iterable[Raw], file: BinaryIO, output: Path
) -> int:
    """Write it, and the file beside `output`; the number of samples.

    Raises:
        RecordingError: there is no sample.
    """
    told, n = Told(), 0
    text = io.TextIOWrapper(file, encoding="utf-8", newline="", write_through=True)
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(_columns(about.spec))
    for chunk in told.chunks(about.spec, raws):
        lines.writerows(_rows(chunk))
        n += len(chunk)
    text.detach()
    if not n:
        raise RecordingError(f"{what} has no samples")
    data = told_text(about, told)
    write_whole(beside(output), lambda other: other.write(data))
    return n


def _columns(spec: ArraySpec) -> list[str]:
    of = zip(spec.channels, spec.units, strict=True)
    channels = [f"{channel} [{unit}]" for channel, unit in of]
    return ["seq", "t_ns", *(f"{e}.{c}" for e in spec.elements for c in channels), BITS]


def _rows(chunk: Chunk) -> Iterator[list[Any]]:
    channels = chunk.values.shape[2]
    shown = np.repeat(chunk.valid, channels, axis=1)
    hidden = ~chunk.valid | np.isnan(chunk.values).any(axis=2)
    flat = chunk.values.reshape(len(chunk), -1)
    rows = zip(chunk.seq, chunk.t_ns, flat, shown, hidden, chunk.values, strict=True)
    for seq, t_ns, row, show, hide, values in rows:
        # str() of a float32 is the shortest text that reads back as the same number
        cells = [str(x) if ok else "" for x, ok in zip(row, show, strict=True)]
        bits = [f"{e}:{values[e].astype('<f4').tobytes().hex()}" for e in np.flatnonzero(hide)]
        yield [seq, t_ns, *cells, " ".join(bits)]


def told_text(about: Description, told: Told) -> bytes:
    """What a recording is of and all that is no sample, as JSON."""
    further = {
        ABOUT: msgspec.Raw(about_text(about).encode()),
        **{name: times.tolist() for name, times in told.times().items()},
        **{topic: [msgspec.Raw(t.encode()) for t in texts] for topic, texts in told.texts.items()},
    }
    return msgspec.json.encode(further)


def told_of(path: Path) -> tuple[Description, dict[str, Any], dict[str, list[str]]]:
    """What a recording is of, its arrays besides samples, and its texts, from a file that
    `told_text` was written to.

    Raises:
        ConfigError: There is none.
        RecordingError: It is damaged.
    """
    try:
        found = msgspec.json.decode(path.read_bytes(), type=dict[str, msgspec.Raw])
        about = about_of(str(path), bytes(found.pop(ABOUT)).decode())
        texts: dict[str, list[str]] = {}
        arrays: dict[str, Any] = {}
        for name, raw in found.items():
            if name.startswith("chunk_") or name.endswith("_log_ns"):
                arrays[name] = np.array(msgspec.json.decode(raw, type=list[int]), np.int64)
            else:
                items = msgspec.json.decode(raw, type=list[msgspec.Raw])
                texts[name] = [bytes(item).decode() for item in items]
    except FileNotFoundError:
        raise ConfigError(
            f"no {path}, which says what array {path.stem} is of: `tactile-rt convert` makes both; "
            "`tactile-rt import` reads tables of others"
        ) from None
    except (msgspec.MsgspecError, KeyError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path} is damaged ({error})") from None
    return about, arrays, texts


def read_csv(path: Path) -> tuple[Description, Generator[Raw, None, None]]:
    """What it is of, and its messages.

    Raises:
        ConfigError: the file beside it is missing.
        RecordingError: it is damaged, or holds something else.
    """
    about, arrays, texts = told_of(beside(path))
    whole = concatenate(list(_chunks(path, about.spec)))
    arrays |= {name: getattr(whole, name) for name in COLUMNS}
    return about, raws_of(str(path), about, arrays, texts)


def _chunks(path: Path, spec: ArraySpec) -> Iterator[Chunk]:
    columns = _columns(spec)
    with path.open(encoding="utf-8", newline="") as file:
        lines = csv.reader(file)
        if next(lines, None) != columns:
            raise RecordingError(
                f"{path}:1: these are not the columns of {spec.name}: {', '.join(columns[:4])}, ..."
            )
        number = 2
        while batch := [row for _, row in zip(range(BATCH), lines, strict=False)]:
            for k, row in enumerate(batch, number):
                if len(row) != len(columns):
                    raise RecordingError(f"{path}:{k}: {len(row)} columns, not {len(columns)}")
            try:
                yield _chunk(batch, spec.shape)
            except (ValueError, IndexError) as error:
                last = number + len(batch) - 1
                raise RecordingError(f"{path}: lines {number} to {last}: {error}") from None
            number += len(batch)
        if number == 2:
            raise RecordingError(f"{path} has no samples")


def _chunk(rows: list[list[str]], shape: tuple[int, int]) -> Chunk:
    cells = [[float(cell) if cell else np.nan for cell in row[2:-1]] for row in rows]
    values: NDArray[np.float32] = np.array(cells).astype(np.float32).reshape(-1, *shape)
    full = np.array([[cell != "" for cell in row[2:-1]] for row in rows])
    valid = np.logical_and.reduce(full.reshape(-1, *shape), axis=2)
    for k, row in enumerate(rows):
        for pair in row[-1].split():
            element, _, bits = pair.partition(":")
            values[k, int(element)] = np.frombuffer(bytes.fromhex(bits), "<f4", shape[1])
    numbers = np.array([[int(row[0]), int(row[1])] for row in rows], np.int64)
    return Chunk(numbers[:, 0].copy(), numbers[:, 1].copy(), values, valid)
