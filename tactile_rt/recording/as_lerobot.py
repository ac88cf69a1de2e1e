"""Conversion of recordings to a LeRobot dataset (v3.0): an episode each, a row per camera frame.

    data/chunk-000/file-000.parquet      rows, one file per episode
    videos/...                           camera films, if any
    meta/info.json, tasks, episodes, stats
    meta/tactile_rt/episode-000000.json  the recording's units, frame, calibration, UTC offset

Goal: a camera has 30 frames a second, a sensor a thousand samples, and no sample may be lost; but
LeRobot has a single rate, that of the rows, and arrays of fixed shape.

Plan: a row holds all samples since the previous row, padded to the length of the fullest row, and
their number. A row at time t holds samples up to t and none after it, as a policy could know only
these then. ``observation.state``, which every policy reads, is the newest sample.

The data are read and written piece by piece; they need not fit into memory.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError, RecordingError, SpecMismatch
from tactile_rt.core.files import replace_folder
from tactile_rt.core.stream import NS_PER_S, ArraySpec, Chunk
from tactile_rt.recording import lerobot_meta as meta
from tactile_rt.recording.conversion import about_text
from tactile_rt.recording.reader import Recording

STATE = "observation.state"
TACTILE = "observation.tactile"
COUNT = f"{TACTILE}.count"
BLOCK_ROWS = 256  # written at once
MOST_PADDING = 8  # padded cells per sample; more: the samples are too uneven for rows
FREE_CELLS = 1_000_000  # padded cells that are allowed in addition

_Arrays = dict[str, NDArray[Any]]


def write_dataset(
    recordings: Sequence[Recording],
    folder: Path,
    fps: int = 30,
    task: str = "",
    films: Sequence[meta.CameraFilm] = (),
) -> int:
    """Write recordings of one array as episodes of a dataset; return the number of samples.

    Args:
        folder: The dataset to write; an existing one is replaced.
        task: Description of the task of all episodes; if empty, the note ``task`` of each
            recording, or its array's name.

    Raises:
        ConfigError: An extra is missing, or a film cannot be used.
        RecordingError: A recording is damaged, has no samples, or its samples are spread too
            unevenly for rows.
        SpecMismatch: The recordings are of different arrays.
    """
    pa, pq = meta.import_pyarrow()
    if films and len(recordings) != 1:
        raise ConfigError("films need a single recording: make one dataset per recording")
    spec = recordings[0].spec
    for other in recordings[1:]:
        if differing := spec.differences(other.spec):
            raise SpecMismatch(f"{other.path} has another array: {differing[0]}")
    ends = [_find_row_ends(recording, fps) for recording in recordings]
    width = max(int(np.diff(end, prepend=0).max()) for end in ends)
    schema = _make_schema(pa, spec, width)
    n, first, episodes = 0, 0, []
    with replace_folder(folder) as made:
        tasks: dict[str, int] = {}
        for k, (recording, end) in enumerate(zip(recordings, ends, strict=True)):
            about = recording.description
            name = task or about.session.get("task") or spec.name
            episode = meta.Episode(k, len(end), first, name, tasks.setdefault(name, len(tasks)))
            state, values = meta.Statistics(), meta.Statistics()
            path = made / meta.DATA.format(chunk_index=k // 1000, file_index=k % 1000)
            path.parent.mkdir(parents=True, exist_ok=True)
            # Dictionary encoding would merge NaNs of different bits.
            with pq.ParquetWriter(path, schema, compression="zstd", use_dictionary=False) as file:
                for columns, samples in _read_blocks(recording, end, width):
                    n += len(samples["seq"])
                    state.add(columns[STATE])
                    values.add(samples["values"], samples["valid"])
                    columns |= episode.columns(columns["frame_index"], fps)
                    file.write_table(_make_table(pa, schema, columns))
            episode.statistics[STATE] = state.compute()
            episode.statistics[f"{TACTILE}.values"] = values.compute(repeat=width)
            for film in films:
                episode.statistics[film.key] = meta.write_film(film, made, len(end), fps)
            beside = made / "meta" / "tactile_rt" / f"episode-{k:06d}.json"
            beside.parent.mkdir(parents=True, exist_ok=True)
            beside.write_text(about_text(about), "utf-8")
            episodes.append(episode)
            first += episode.rows
        meta.write_meta(
            made, fps, {**_describe_features(spec, width), **meta.FRAME}, episodes, tasks, films
        )
    return n


def _find_row_ends(recording: Recording, fps: int) -> NDArray[np.int64]:
    """Return the number of samples up to the end of each row, (row,). Row k ends k / fps seconds
    after the first sample."""
    t_ns = np.concatenate([chunk.t_ns for chunk in recording] or [np.zeros(0, np.int64)])
    if not len(t_ns):
        raise RecordingError(f"{recording.path} has no samples")
    # Integers, so that a sample taken exactly at the time of a row is in that row.
    times = t_ns.tolist()
    row = [-(-max(0, t - times[0]) * fps // NS_PER_S) for t in times]
    most = FREE_CELLS + MOST_PADDING * len(row)
    if max(row) >= most:
        raise _make_uneven_error(recording, max(row), len(row))
    # Where time goes back, samples keep their order.
    last = np.maximum.accumulate(np.array(row, np.int64))
    ends = np.searchsorted(last, np.arange(last[-1] + 1), side="right")
    if len(ends) * int(np.diff(ends, prepend=0).max()) > most:
        raise _make_uneven_error(recording, len(ends), len(row))
    return ends


def _make_uneven_error(recording: Recording, rows: int, samples: int) -> RecordingError:
    return RecordingError(
        f"{recording.path}: its {samples} samples are spread over {rows} rows too unevenly for "
        "arrays of one length: convert what was recorded without a pause"
    )


def _read_blocks(
    recording: Recording, ends: NDArray[np.int64], width: int
) -> Iterator[tuple[_Arrays, _Arrays]]:
    """Yield (columns, samples in them) of `BLOCK_ROWS` rows at a time."""
    spec = recording.spec
    counts = np.diff(ends, prepend=0)
    chunks = iter(recording)
    held: _Arrays = {
        "seq": np.zeros(0, np.int64), "t_ns": np.zeros(0, np.int64),
        "values": np.zeros((0, *spec.shape), np.float32),
        "valid": np.zeros((0, spec.shape[0]), np.bool_),
    }  # fmt: skip
    newest = np.zeros(spec.shape, np.float32)
    for first in range(0, len(counts), BLOCK_ROWS):
        count = counts[first : first + BLOCK_ROWS]
        need = int(count.sum())
        more, n = list[Chunk](), len(held["seq"])
        while n < need:
            more.append(next(chunks))
            n += len(more[-1])
        whole: _Arrays = {
            name: np.concatenate([kept, *(getattr(c, name) for c in more)])
            for name, kept in held.items()
        }
        samples = {name: values[:need] for name, values in whole.items()}
        held = {name: values[need:] for name, values in whole.items()}
        columns: _Arrays = {
            "frame_index": np.arange(first, first + len(count)), COUNT: count,
        }  # fmt: skip
        begins = np.cumsum(count) - count
        row = np.repeat(np.arange(len(count)), count)
        within = np.arange(need) - begins[row]
        for name, values in samples.items():
            padded = np.zeros((len(count), width, *values.shape[1:]), values.dtype)
            padded[row, within] = values
            columns[f"{TACTILE}.{name}"] = padded
        states = []
        for begin, many in zip(begins, count, strict=True):
            mine = slice(begin, begin + many)
            newest = _find_newest(newest, samples["values"][mine], samples["valid"][mine])
            states.append(newest.ravel())
        columns[STATE] = np.array(states)
        yield columns, samples


def _find_newest(
    before: NDArray[np.float32], values: NDArray[np.float32], valid: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Return each element's newest valid values, (element, channel), or those in `before`."""
    found = before.copy()
    for element in np.flatnonzero(valid.any(axis=0)):
        found[element] = values[np.flatnonzero(valid[:, element])[-1], element]
    return found


def _describe_features(spec: ArraySpec, width: int) -> dict[str, dict[str, Any]]:
    """Return the entries of the columns for ``info.json``."""
    elements, channels, feature = list(spec.elements), list(spec.channels), meta.describe_feature
    flat = [f"{e}.{c}" for e in elements for c in channels]
    return {
        STATE: feature("float32", len(flat), names=flat),
        COUNT: feature("int64", 1),
        f"{TACTILE}.seq": feature("int64", width),
        f"{TACTILE}.t_ns": feature("int64", width),
        f"{TACTILE}.values": feature(
            "float32", width, *spec.shape,
            names={"sample": None, "element": elements, "channel": channels},
        ),
        f"{TACTILE}.valid": feature("bool", width, spec.shape[0]),
    }  # fmt: skip


def _make_schema(pa: Any, spec: ArraySpec, width: int) -> Any:
    kinds = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}
    fields = []
    for name, feature in {**_describe_features(spec, width), **meta.FRAME}.items():
        kind = kinds[feature["dtype"]]
        for size in reversed(feature["shape"] if feature["shape"] != [1] else []):
            kind = pa.list_(kind, size)
        fields.append(pa.field(name, kind))
    return pa.schema(fields)


def _make_table(pa: Any, schema: Any, columns: _Arrays) -> Any:
    arrays = []
    for field in schema:
        column = columns[field.name]
        made = pa.array(column.ravel())
        if pa.types.is_fixed_size_list(field.type):  # an array of one number is stored as a scalar
            for size in reversed(column.shape[1:]):
                made = pa.FixedSizeListArray.from_arrays(made, size)
        arrays.append(made)
    return pa.Table.from_arrays(arrays, schema=schema)
