"""Footage, drawn: scene, map and traces in one picture for each moment."""

from collections.abc import Iterator
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from tactile_rt.sim_backend.views.camera import Camera, framing
from tactile_rt.sim_backend.views.footage import Footage
from tactile_rt.sim_backend.views.scale import ForceScale
from tactile_rt.sim_backend.views.sheet import Sheet, scene_size
from tactile_rt.sim_backend.views.stage import Dressed, Stage

__all__ = ["Film", "camera_of"]


def camera_of(
    footage: Footage, view: str, orthographic: bool = False, aspect: float = 1.5
) -> Camera:
    """The camera of a named view, on the whiskers at rest and on what presses them most.

    Raises:
        ConfigError: no such view.
    """
    dressed = Dressed(footage.model, footage.spec)
    footage.restore(0, dressed.data)
    left = all(x < 0 for x, _, _ in footage.spec.positions)
    whiskers = dressed.points()
    footage.restore(footage.strongest, dressed.data)
    points = np.concatenate([whiskers, dressed.object_points()])
    return framing(view, points, orthographic, aspect, left)


class Film:
    """Complete pictures of footage. A context manager.

    Args:
        footage: what to draw.
        view: a camera, or the name of a view.
        orthographic: of a named view.
        title: what is seen, one line.
        detail: how it is seen, one line in small print.
        pixels: width of the pictures; their height is 9/16 of it.

    Raises:
        ConfigError: no such view, or this machine has no OpenGL to draw with.
    """

    def __init__(
        self,
        footage: Footage,
        view: Camera | str = "oblique",
        orthographic: bool = False,
        title: str = "",
        detail: str = "",
        pixels: int = 1280,
    ) -> None:
        self.footage = footage
        width, height = scene_size(pixels)
        if isinstance(view, str):
            view = camera_of(footage, view, orthographic, width / height)
        scale = ForceScale.fitting(footage.forces, view.extent_mm)
        self._stage = Stage(footage, view, scale, width, height)
        self._sheet = Sheet(footage, view, scale, title, detail, pixels)
        self.size = self._sheet.size

    def picture(self, moment: int) -> NDArray[np.uint8]:
        """(height, width, 3) RGB picture of a moment of the footage."""
        return self._sheet.picture(moment, self._stage.picture(moment))

    def __iter__(self) -> Iterator[NDArray[np.uint8]]:
        return map(self.picture, range(len(self.footage)))

    def close(self) -> None:
        """Free what the pictures were drawn with."""
        self._stage.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
