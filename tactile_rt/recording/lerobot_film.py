"""What a camera saw beside a recording, as LeRobot wants it: a frame for each row."""

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.packages import lacking

__all__ = ["VIDEO", "CameraFilm", "film_of", "write_film"]

VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
CODEC = "libx264"
OPTIONS = {"g": "2", "crf": "20"}  # as LeRobot: any frame is found within two
LOOKED_AT = 100  # frames, of which statistics are made
PIXELS = 16384  # of each, at most


@dataclass(frozen=True)
class CameraFilm:
    """A film and when it was taken.

    Attributes:
        path: The file of the film, in any form that FFmpeg reads.
        begin_s: The time of the film's first frame after the recording's first sample, s; below 0
            it was before.
        size: The (height, width) of a frame.
    """

    name: str
    path: Path
    begin_s: float
    size: tuple[int, int]

    @property
    def key(self) -> str:
        """The name of its feature."""
        return f"observation.images.{self.name}"

    def feature(self, fps: int) -> dict[str, Any]:
        """As ``info.json`` has it."""
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
    """A film as it is named on the command line: ``front=front.mp4`` or ``front=front.mp4@1.25``.

    Raises:
        ConfigError: It is not named so, no film, or PyAV is missing.
    """
    name, equals, place = text.partition("=")
    file, at, seconds = place.rpartition("@")
    if not at:
        file, seconds = place, "0"
    try:
        begin_s = float(seconds)
    except ValueError:  # an @ in the name of the file
        file, begin_s = place, 0.0
    if not (equals and name.replace("_", "").isalnum() and file and np.isfinite(begin_s)):
        raise ConfigError(f"--video is NAME=FILE or NAME=FILE@SECONDS, not {text!r}")
    av = _need_av()
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
    """Write the frame of each row: the newest that there was; before the first one, that.

    Returns:
        The statistics of colours, from 0 to 1, as LeRobot has them: of every so many frames.

    Raises:
        ConfigError: The film cannot be decoded.
    """
    av = _need_av()
    path = folder / VIDEO.format(video_key=film.key, chunk_index=0, file_index=0)
    path.parent.mkdir(parents=True)
    height, width = film.size
    seen = []
    try:
        with av.open(str(path), "w") as made:
            stream = made.add_stream(CODEC, rate=fps, options=OPTIONS)
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            stream.time_base = Fraction(1, fps)
            for k, frame in enumerate(_frames(av, film, rows, fps)):
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
        **{f"q{q:02d}": np.percentile(colours, q, axis=0) for q in (1, 10, 50, 90, 99)},
    }  # fmt: skip
    shaped = {name: value.reshape(3, 1, 1) for name, value in found.items()}
    return {**shaped, "count": np.array([len(seen)])}


def _frames(av: Any, film: CameraFilm, rows: int, fps: int) -> Iterator[Any]:
    """A decoded frame for each row."""
    with av.open(str(film.path)) as file:
        # Times are read first: whoever writes a frame gives it others.
        decoded = ((frame.time or 0.0, frame) for frame in file.decode(video=0))
        now = following = next(decoded, None)
        if now is None:
            raise ConfigError(f"{film.path} has no frame")
        first = now[0]
        for k in range(rows):
            # A hundredth of a frame: times of a film are rounded to its own clock.
            until = (k + 0.01) / fps - film.begin_s
            while following is not None and following[0] - first <= until:
                now, following = following, next(decoded, None)
            yield now[1]


def _need_av() -> Any:
    try:
        import av
    except ModuleNotFoundError as error:
        raise lacking("films need", "lerobot", error) from None
    return av
