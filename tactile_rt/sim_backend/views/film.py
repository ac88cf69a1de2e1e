"""Footage as pictures and videos: scene, map and traces in one picture for each moment."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import write_whole
from tactile_rt.sim_backend.views.footage import Camera, Footage, framing
from tactile_rt.sim_backend.views.sheet import ForceScale, Sheet, scene_size
from tactile_rt.sim_backend.views.stage import Dressed, Stage

__all__ = ["IMAGES", "VIDEOS", "Film", "camera_of", "check_suffix", "write_image", "write_video"]

IMAGES = (".png", ".jpg")
VIDEOS = (".mp4",)
QUALITY = "20"  # of H.264, constant rate factor: 18 is as the eye sees it, 23 the usual

Pixels = NDArray[np.uint8]


def camera_of(footage: Footage, view: str, aspect: float = 1.5) -> Camera:
    """The camera of a named view, on the whiskers at rest and on what presses them most."""
    dressed = Dressed(footage.model, footage.spec)
    footage.restore(0, dressed.data)
    left = all(x < 0 for x, _, _ in footage.spec.positions)
    whiskers = dressed.points()
    footage.restore(footage.strongest, dressed.data)
    points = np.concatenate([whiskers, dressed.object_points()])
    return framing(view, points, aspect, left)


class Film:
    """Complete pictures of footage; to be closed.

    Args:
        pixels: width of the pictures; their height is 9/16 of it.

    Raises:
        ConfigError: no such view, or this machine has no OpenGL to draw with.
    """

    def __init__(
        self,
        footage: Footage,
        view: str = "oblique",
        title: str = "",
        detail: str = "",
        pixels: int = 1280,
    ) -> None:
        self.footage = footage
        width, height = scene_size(pixels)
        camera = camera_of(footage, view, width / height)
        scale = ForceScale.fitting(footage.forces, camera.extent_mm)
        self._stage = Stage(footage, camera, scale, width, height)
        self._sheet = Sheet(footage, camera, scale, title, detail, pixels)
        self.size = self._sheet.size

    def picture(self, moment: int) -> Pixels:
        """(height, width, 3) RGB picture of a moment of the footage."""
        return self._sheet.picture(moment, self._stage.picture(moment))

    def __iter__(self) -> Iterator[Pixels]:
        return map(self.picture, range(len(self.footage)))

    def close(self) -> None:
        """Free what the pictures were drawn with."""
        self._stage.close()


def check_suffix(path: Path) -> str:
    """Return the suffix of a file's name: one of `IMAGES` and `VIDEOS`."""
    suffix = path.suffix.lower()
    if suffix not in IMAGES + VIDEOS:
        raise ConfigError(
            f"{path}: give a name that ends in {', '.join(IMAGES)} for a picture, "
            f"or {', '.join(VIDEOS)} for a video"
        )
    return suffix


def write_image(path: Path, pixels: Pixels) -> None:
    """Write a picture (height, width, 3) RGB as .png or .jpg."""
    kind = "PNG" if path.suffix.lower() == ".png" else "JPEG"
    write_whole(path, lambda file: Image.fromarray(pixels).save(file, kind, optimize=True))


def write_video(path: Path, pictures: Iterable[Pixels], fps: int) -> None:
    """Write pictures (height, width, 3) RGB of one even size as .mp4 (H.264)."""
    write_whole(path, lambda file: _write_mp4(file, pictures, fps))


def _write_mp4(out: BinaryIO, pictures: Iterable[Pixels], fps: int) -> None:
    # by its name, as what comes first is moved there at the end
    with av.open(str(out.name), "w", "mp4", options={"movflags": "+faststart"}) as file:
        stream = file.add_stream("libx264", rate=fps, options={"crf": QUALITY})
        stream.pix_fmt = "yuv420p"  # what every player plays
        for k, pixels in enumerate(pictures):
            if k == 0:
                stream.height, stream.width = pixels.shape[:2]
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
            file.mux(stream.encode(picture))
        file.mux(stream.encode())
