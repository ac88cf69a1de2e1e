"""Parts of a LeRobot dataset (v3.0) other than its rows: ``meta/``, and camera films.

Names and shapes are those of https://github.com/huggingface/lerobot, ``datasets/utils.py``.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import require_extra

VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
CODEC = "libx264"
OPTIONS = {"g": "2", "crf": "20"}  # as LeRobot: every second frame is a key frame
LOOKED_AT = 100  # frames for the statistics
PIXELS = 16384  # of each of these frames, at most


@dataclass(frozen=True)
class CameraFilm:
    """Film of a camera, and when it was taken."""

    name: str
    path: Path  # file of the film, in any form that FFmpeg reads
    # time from the recording's first sample to the film's first frame, s; negative: before it
    begin_s: float
    size: tuple[int, int]  # (height, width) of a frame

    @property
    def key(self) -> str:
        """Name of the film's feature in the dataset."""
        return f"observation.images.{self.name}"

    def feature(self, fps: int) -> dict[str, Any]:
        """Return the film's entry for ``info.json``."""
        height, width = self.size
        return {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height, "video.width": width, "video.codec": "h264",
                "video.pix_fmt": "yuv420p", "video.is_depth_map": False, "video.fps": fps,
                "video.channels": 3, "has_audio": False,
            },
        }  # fmt: skip


def film_of(text: str) -> CameraFilm:
    """Parse a film of the command line: ``front=front.mp4`` or ``front=front.mp4@1.25``.

    Raises:
        ConfigError: The text has another form, the file is no film, or PyAV is missing.
    """
    name, equals, place = text.partition("=")
    file, at, seconds = place.rpartition("@")
    if not at:
        file, seconds = place, "0"
    try:
        begin_s = float(seconds)
    except ValueError:  # the @ is part of the file's name
        file, begin_s = place, 0.0
    if not (equals and name.replace("_", "").isalnum() and file and np.isfinite(begin_s)):
        raise ConfigError(f"--video must be NAME=FILE or NAME=FILE@SECONDS, not {text!r}")
    av = _import_av()
    try:
        with av.open(file) as film:
            stream = film.streams.video[0]
            size = stream.height - stream.height % 2, stream.width - stream.width % 2
    except FileNotFoundError:
        raise ConfigError(f"no film {file}") from None
    except (av.error.FFmpegError, IndexError) as error:
        raise ConfigError(f"{file} is no film: {error}") from None
    return CameraFilm(name, Path(file), begin_s, size)


def write_film(film: CameraFilm, folder: Path, rows: int, fps: int) -> dict[str, NDArray[Any]]:
    """Write one frame per dataset row: the newest by then, or else the film's first.

    Returns:
        The statistics of colours, from 0 to 1, of regularly sampled frames, by LeRobot's names.

    Raises:
        ConfigError: The film cannot be decoded.
    """
    av = _import_av()
    path = folder / VIDEO.format(video_key=film.key, chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    height, width = film.size
    seen = []
    try:
        with av.open(str(path), "w") as made:
            stream = made.add_stream(CODEC, rate=fps, options=OPTIONS)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.time_base = Fraction(1, fps)
            for k, frame in enumerate(_decode_frames(av, film, rows, fps)):
                if k % max(1, rows // LOOKED_AT) == 0:
                    pixels = frame.to_ndarray(format="rgb24").reshape(-1, 3)
                    seen.append(pixels[:: max(1, len(pixels) // PIXELS)] / 255.0)
                one = frame.reformat(width=width, height=height, format="yuv420p")
                one.pts, one.time_base = k, Fraction(1, fps)
                made.mux(stream.encode(one))
            made.mux(stream.encode())
    except av.error.FFmpegError as error:
        raise ConfigError(f"{film.path} cannot be decoded: {error}") from None
    colours = np.concatenate(seen)
    found = {
        "min": colours.min(axis=0), "max": colours.max(axis=0), "mean": colours.mean(axis=0),
        "std": colours.std(axis=0),
        **{name: np.quantile(colours, q, axis=0) for name, q in QUANTILES.items()},
    }  # fmt: skip
    shaped = {name: value.reshape(3, 1, 1) for name, value in found.items()}
    return {**shaped, "count": np.array([len(seen)])}


def _decode_frames(av: Any, film: CameraFilm, rows: int, fps: int) -> Iterator[Any]:
    """Yield, for each row, the frame to show at its time."""
    with av.open(str(film.path)) as file:
        # Times are read first: writing a frame changes its time.
        decoded = ((frame.time or 0.0, frame) for frame in file.decode(video=0))
        now = following = next(decoded, None)
        if now is None:
            raise ConfigError(f"{film.path} has no frame")
        first = now[0]
        for k in range(rows):
            # Tolerance of a hundredth of a frame: a film's times are rounded to its own clock.
            until = (k + 0.01) / fps - film.begin_s
            while following is not None and following[0] - first <= until:
                now, following = following, next(decoded, None)
            yield now[1]


def _import_av() -> Any:
    with require_extra("films need", "lerobot"):
        import av
    return av


def describe_feature(kind: str, *shape: int, names: Any = None) -> dict[str, Any]:
    """Return the entry of a column of the rows for ``info.json``."""
    return {"dtype": kind, "shape": list(shape), "names": names}


INFO = "meta/info.json"
DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
CODEBASE = "v3.0"
IN_CHUNK = 1000  # files of a folder
# Further columns of every row.
NUMBERS = ("frame_index", "episode_index", "index", "task_index")
FRAME = {"timestamp": describe_feature("float32", 1)}
FRAME |= {name: describe_feature("int64", 1) for name in NUMBERS}
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
MOST_KEPT = 10_000  # rows that are kept for quantiles


def import_pyarrow() -> tuple[Any, Any]:
    """Import ``pyarrow`` and ``pyarrow.parquet``, or name the extra that is missing."""
    with require_extra("LeRobot datasets need", "lerobot"):
        import pyarrow
        import pyarrow.parquet
    return pyarrow, pyarrow.parquet


@dataclass
class Episode:
    """Episode of the dataset, made of one recording, with its rows and statistics."""

    index: int
    rows: int
    first: int
    task: str
    task_index: int
    # statistics of each feature, as `Statistics.compute` gives them
    statistics: dict[str, dict[str, NDArray[Any]]] = field(default_factory=dict)

    def columns(self, frame: NDArray[np.int64], fps: int) -> dict[str, NDArray[Any]]:
        """Return the columns, except samples, of some rows of the episode.

        Args:
            frame: (row,) Numbers of the rows within the episode.
        """
        return {
            "timestamp": (frame / fps).astype(np.float32),
            "frame_index": frame,
            "episode_index": np.full(len(frame), self.index),
            "index": frame + self.first,
            "task_index": np.full(len(frame), self.task_index),
        }


class Statistics:
    """Running statistics of a feature, with which policies scale their inputs.

    Quantiles are of at most `MOST_KEPT` regularly sampled rows; all else is of all rows.
    """

    def __init__(self) -> None:
        self._n: Any = 0
        self._sum: Any = 0.0
        self._squares: Any = 0.0
        self._least: Any = np.inf
        self._most: Any = -np.inf
        self._kept: list[NDArray[np.float32]] = []
        self._every, self._seen = 1, 0

    def add(self, values: NDArray[np.float32], valid: NDArray[np.bool_] | None = None) -> None:
        """Add some rows to the statistics.

        Args:
            values: (n, ...) Values of the rows.
            valid: (n, ...) Mask of the values that count, with the leading axes of `values`.
        """
        good = np.isfinite(values)
        if valid is not None:
            good &= valid.reshape(valid.shape + (1,) * (values.ndim - valid.ndim))
        exact = np.where(good, values, 0).astype(np.float64)
        self._n = self._n + good.sum(axis=0)
        self._sum = self._sum + exact.sum(axis=0)
        self._squares = self._squares + (exact**2).sum(axis=0)
        for row in np.where(good, values, np.nan)[(-self._seen) % self._every :: self._every]:
            self._kept.append(row)
        self._seen += len(values)
        if len(values):
            self._least = np.minimum(self._least, np.where(good, values, np.inf).min(axis=0))
            self._most = np.maximum(self._most, np.where(good, values, -np.inf).max(axis=0))
        while len(self._kept) > MOST_KEPT:
            self._kept, self._every = self._kept[::2], 2 * self._every

    def compute(self, repeat: int = 0) -> dict[str, NDArray[Any]]:
        """Return the statistics by LeRobot's names; 0 where no value was valid.

        Args:
            repeat: Number of copies along a new first axis; 0 for no such axis.
        """
        n = np.maximum(self._n, 1)
        mean = self._sum / n
        one = {
            "min": self._least, "max": self._most, "mean": mean,
            "std": np.sqrt(np.maximum(self._squares / n - mean**2, 0)),
        }  # fmt: skip
        kept = np.array(self._kept)
        kept[:, np.isnan(kept).all(axis=0)] = 0  # values that were never valid
        one |= {name: np.nanquantile(kept, q, axis=0) for name, q in QUANTILES.items()}
        one = {name: np.where(np.isfinite(value), value, 0.0) for name, value in one.items()}
        if repeat:
            one = {k: np.broadcast_to(v, (repeat, *v.shape)) for k, v in one.items()}
        return {**one, "count": np.array([self._seen])}


def write_meta(
    folder: Path,
    fps: int,
    features: Mapping[str, Mapping[str, Any]],
    episodes: Sequence[Episode],
    tasks: Mapping[str, int],
    films: Sequence[CameraFilm],
) -> None:
    """Write the folder ``meta/`` of a dataset, except ``meta/tactile_rt``."""
    pa, pq = import_pyarrow()
    info = {
        "codebase_version": CODEBASE,
        "robot_type": "tactile_rt",
        "total_episodes": len(episodes),
        "total_frames": sum(e.rows for e in episodes),
        "total_tasks": len(tasks),
        "chunks_size": IN_CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(episodes)}"},
        "data_path": DATA,
        "video_path": VIDEO if films else None,
        "features": {**features, **{film.key: film.feature(fps) for film in films}},
    }
    (folder / INFO).write_bytes(msgspec.json.format(msgspec.json.encode(info), indent=4))
    (folder / "meta" / "stats.json").write_bytes(msgspec.json.encode(_merge_statistics(episodes)))
    pq.write_table(_make_task_table(pa, tasks), folder / "meta" / "tasks.parquet")
    path = folder / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    path.parent.mkdir(parents=True)
    rows = [_describe_episode(e, fps, films) for e in episodes]
    pq.write_table(pa.Table.from_pylist(rows), path, compression="zstd")


def _describe_episode(episode: Episode, fps: int, films: Sequence[CameraFilm]) -> dict[str, Any]:
    chunk, file = divmod(episode.index, IN_CHUNK)
    row: dict[str, Any] = {
        "episode_index": episode.index,
        "tasks": [episode.task],
        "length": episode.rows,
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": episode.first,
        "dataset_to_index": episode.first + episode.rows,
        "meta/episodes/chunk_index": 0,
        "meta/episodes/file_index": 0,
    }
    for film in films:
        row |= {
            f"videos/{film.key}/chunk_index": 0,
            f"videos/{film.key}/file_index": 0,
            f"videos/{film.key}/from_timestamp": 0.0,
            f"videos/{film.key}/to_timestamp": episode.rows / fps,
        }
    for feature, found in episode.statistics.items():
        row |= {f"stats/{feature}/{name}": value.tolist() for name, value in found.items()}
    return row


def _merge_statistics(episodes: Sequence[Episode]) -> dict[str, Any]:
    """Merge the statistics of all episodes; quantiles are averaged, as LeRobot does."""
    made: dict[str, Any] = {}
    for feature in episodes[0].statistics:
        each = [e.statistics[feature] for e in episodes]
        counts = [int(found["count"][0]) for found in each]
        mean = partial(np.average, axis=0, weights=counts)
        whole = {name: mean([f[name] for f in each]) for name in ("mean", *QUANTILES)}
        spread = [f["std"] ** 2 + (f["mean"] - whole["mean"]) ** 2 for f in each]
        made[feature] = {
            "min": np.min([f["min"] for f in each], axis=0).tolist(),
            "max": np.max([f["max"] for f in each], axis=0).tolist(),
            "std": np.sqrt(mean(spread)).tolist(),
            "count": [sum(counts)],
            **{name: value.tolist() for name, value in whole.items()},
        }
    return made


def _make_task_table(pa: Any, tasks: Mapping[str, int]) -> Any:
    """Make the table of tasks in pandas' form, with tasks as index, for LeRobot."""
    index = "__index_level_0__"
    text = {"pandas_type": "unicode", "numpy_type": "object"}
    about = {
        "index_columns": [index],
        "column_indexes": [
            {"name": None, "field_name": None, **text, "metadata": {"encoding": "UTF-8"}}
        ],
        "columns": [
            {
                "name": "task_index", "field_name": "task_index", "pandas_type": "int64",
                "numpy_type": "int64", "metadata": None,
            },
            {"name": None, "field_name": index, **text, "metadata": None},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }  # fmt: skip
    table = pa.table({"task_index": list(tasks.values()), index: list(tasks)})
    return table.replace_schema_metadata({"pandas": msgspec.json.encode(about)})
