"""The whole picture: the scene, the map of forces beside it, their traces below."""

import mujoco
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from numpy.typing import NDArray

from tactile_rt.sim_backend.views.camera import Camera
from tactile_rt.sim_backend.views.footage import Footage
from tactile_rt.sim_backend.views.panels import (
    INK,
    QUIET,
    ForceMap,
    draw_scale,
    draw_traces,
    rostral_sign,
)
from tactile_rt.sim_backend.views.scale import ForceScale

__all__ = ["Sheet"]

WIDE, TALL = 12.8, 7.2  # inches: 16 : 9
SCENE = (0.0, 0.265, 0.62, 0.62)  # left, bottom, width, height in fractions
MAP = (0.635, 0.4, 0.35, 0.425)


class Sheet:
    """Pictures of a recorded simulation, one a frame. What stays is drawn once.

    Args:
        footage: what to draw.
        camera: of the scene.
        scale: of the forces.
        title: what is seen, one line.
        detail: how it is seen (projection, speed), one line in small print.
        pixels: width of the pictures; their height is 9/16 of it.

    Attributes:
        size: (width, height) of the pictures, both even.
        scene_size: (width, height) of the scene in them.
    """

    def __init__(
        self,
        footage: Footage,
        camera: Camera,
        scale: ForceScale,
        title: str,
        detail: str = "",
        pixels: int = 1280,
    ) -> None:
        self._footage = footage
        self.size = scaled_size(pixels)
        self.scene_size = scene_size(pixels)
        dpi = self.size[0] / WIDE
        figure = Figure(figsize=(WIDE, self.size[1] / dpi), dpi=dpi)
        self._canvas = FigureCanvasAgg(figure)
        figure.text(0.02, 0.945, title, fontsize=16, weight="bold", color=INK, va="center")
        figure.text(0.02, 0.905, detail, fontsize=10.5, color=QUIET, va="center")

        width, height = self.scene_size
        scene = figure.add_axes(SCENE)
        scene.axis("off")
        # As many cells as pixels, so that none is resampled.
        blank = np.full((height, width, 3), 255, dtype=np.uint8)
        self._scene = scene.imshow(blank, aspect="auto", interpolation="nearest")
        legend = _draw_ruler(figure, camera, scale)

        middle = MAP[0] + MAP[2] / 2
        head = "force on each whisker's base"
        figure.text(middle, 0.862, head, ha="center", fontsize=12, color=INK)
        how = "colour: size, arrow: direction along the cheek"
        figure.text(middle, 0.833, how, ha="center", fontsize=9.5, color=QUIET)
        self._map = ForceMap(figure, MAP, footage.spec, scale, _mirrored(footage, camera))
        draw_scale(figure, (middle - 0.1, 0.345, 0.2, 0.016), scale)

        traces = figure.add_axes((0.06, 0.085, 0.925, 0.165))
        draw_traces(traces, footage.times_ms, 1e3 * footage.forces, footage.spec.elements)
        self._cursor = traces.axvline(0, color=INK, lw=1.3)
        self._clock = figure.text(
            0.985, 0.945, "", ha="right", va="center", fontsize=14, color=INK, family="monospace"
        )
        self._legend = legend
        for artist in (self._scene, *legend, self._cursor, self._clock):
            artist.set_animated(True)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)
        self._figure = figure

    def frame(self, frame: int, scene: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The picture of one frame: (height, width, 3) RGB.

        Args:
            frame: of the footage.
            scene: its (height, width, 3) picture of `scene_size`.
        """
        time = float(self._footage.times_ms[frame])
        self._scene.set_data(scene)
        cells = self._map.show(self._footage.loads[frame])
        self._cursor.set_xdata([time, time])
        self._clock.set_text(f"t = {time:5.0f} ms")
        self._canvas.restore_region(self._still)
        for artist in (self._scene, *self._legend, *cells, self._cursor, self._clock):
            self._figure.draw_artist(artist)
        pixels: NDArray[np.uint8] = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        return pixels


def scaled_size(pixels: int) -> tuple[int, int]:
    """(width, height) of a sheet about so many pixels wide: even, as video formats want them."""
    width = 2 * round(pixels / 2)
    return width, 2 * round(width * TALL / WIDE / 2)


def scene_size(pixels: int) -> tuple[int, int]:
    """(width, height) of the scene in a sheet so many pixels wide."""
    width, height = scaled_size(pixels)
    return round(SCENE[2] * width), round(SCENE[3] * height)


def _draw_ruler(figure: Figure, camera: Camera, scale: ForceScale) -> list[Artist]:
    """A force arrow as long as it is at the point looked at, and what it stands for."""
    left, y = SCENE[0] + 0.022, SCENE[1] + 0.03
    long = scale.arrow_mm / camera.extent_mm * SCENE[3] * TALL / WIDE
    arrow = FancyArrowPatch(
        (left, y),
        (left + long, y),
        transform=figure.transFigure,
        arrowstyle="-|>",
        mutation_scale=14,
        lw=3,
        shrinkA=0,
        shrinkB=0,
        color=scale.colour(scale.top_mn),
    )
    figure.add_artist(arrow)
    clear = {"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.7}
    words = f"{scale.arrow_mm:g} mm · arrow of {scale.top_mn:g} mN"
    return [arrow, figure.text(left, y + 0.022, words, fontsize=10, color=INK, bbox=clear)]


def _mirrored(footage: Footage, camera: Camera) -> bool:
    """Whether the map is to be mirrored so that its nose is where the picture's is."""
    data = mujoco.MjData(footage.model)
    footage.restore(0, data)
    whisker = footage.model.site_bodyid[footage.model.site(footage.spec.elements[0]).id]
    head = data.xmat[footage.model.body_parentid[whisker]].reshape(3, 3)
    lateral, rostral = camera.right @ head[:, 0], camera.right @ head[:, 1]
    signs = rostral_sign(footage.spec)
    if len(set(signs.tolist())) > 1:  # a face: its right side on the left when seen from ahead
        return bool(lateral > 0.5)
    return bool(signs[0] * rostral < -0.5)
