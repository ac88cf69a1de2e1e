"""The layout of a picture: the scene, a map of the array's forces beside it, traces below."""

from dataclasses import dataclass
from typing import Any, Self

import mujoco
import numpy as np
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from matplotlib.text import Text
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec, rotation_matrices
from tactile_rt.sim_backend.arrays.files import SPECIES
from tactile_rt.sim_backend.views.footage import Camera, Footage

Place = tuple[float, float, float, float]  # left, bottom, width, height in fractions

WIDE, TALL = 12.8, 7.2  # inches: 16 : 9
SCENE: Place = (0.0, 0.265, 0.62, 0.62)
MAP: Place = (0.635, 0.4, 0.35, 0.425)
INK, QUIET, EMPTY = "#222222", "#6b6b6b", "#f2f2f2"
REACH = 0.36  # half the longest arrow, relative to a cell
HARDLY = 0.15  # share of a force in the plane of the map below which no arrow is drawn
NAMED = 6  # strongest traces that get a colour and a name
RGBA = tuple[float, float, float, float]

_COLOURS = colormaps["plasma_r"]
_UNTOUCHED: RGBA = (0.62, 0.62, 0.62, 1.0)
_LEAST = 0.01  # of the top: less is drawn as untouched
_LONGEST = 1.5  # largest length of an arrow, so that the arrow of a snap stays in the picture
_TOP_PERCENTILE = 98.0  # of the moments' strongest forces, which sets the top colour


def round_number(value: float) -> float:
    """Round to the nearest of ..., 1, 2, 5, 10, 20, ... on a logarithmic scale."""
    if not value > 0:
        return 1.0
    choices = [m * 10.0**e for e in range(-9, 10) for m in (1, 2, 5)]
    return min(choices, key=lambda c: abs(np.log(c / value)))


@dataclass(frozen=True)
class ForceScale:
    """Colours and arrow lengths of forces, or of other readings.

    Attributes:
        top: The size that gets the strongest colour, in `unit`.
        arrow_mm: The length of that size's arrow, mm in the world.
        per_si: The factor from SI to `unit`.
    """

    top: float
    arrow_mm: float
    unit: str = "mN"
    per_si: float = 1e3

    @classmethod
    def fitting(cls, sizes: NDArray[np.float64], extent_mm: float, unit: str = "N") -> Self:
        """Fit a scale to sizes (moment, element), SI, in a picture of given height."""
        strongest = sizes.max(axis=1)
        touched = strongest[strongest > 0.02 * strongest.max()]
        top = float(np.percentile(touched, _TOP_PERCENTILE)) / 1.2 if len(touched) else 1e-3
        power = int(np.clip(np.ceil(-np.log10(10 * top) / 3), 0, 4))
        unit, per_si = ("", "m", "u", "n", "p")[power] + unit, 1e3**power
        return cls(round_number(per_si * top), round_number(0.15 * extent_mm), unit, per_si)

    def draws(self, size: float) -> bool:
        """Return whether a force is large enough to be drawn."""
        return size >= _LEAST * self.top

    def colour(self, size: float) -> RGBA:
        """Return the RGBA colour of a force; grey if it is too small to draw."""
        if not self.draws(size):
            return _UNTOUCHED
        r, g, b, a = _COLOURS(0.12 + 0.83 * min(size / self.top, 1.0))
        return r, g, b, a

    def length(self, size: float) -> float:
        """Return the length of a force's arrow, mm."""
        return self.arrow_mm * min(size / self.top, _LONGEST)


class Sheet:
    """A renderer of footage with map and traces; static parts are drawn once.

    Attributes:
        size: The (width, height) of the pictures in pixels, both even.
        scene_size: The (width, height) in pixels of the scene in the pictures.
    """

    def __init__(
        self,
        footage: Footage,
        camera: Camera,
        scale: ForceScale,
        title: str,
        detail: str,
        pixels: int,
    ) -> None:
        self._footage = footage
        self.size = _round_size(pixels)
        self.scene_size = scene_size(pixels)
        dpi = self.size[0] / WIDE
        figure = Figure(figsize=(WIDE, self.size[1] / dpi), dpi=dpi)
        self._canvas = FigureCanvasAgg(figure)
        figure.text(0.02, 0.945, title, fontsize=16, weight="bold", color=INK, va="center")
        figure.text(0.02, 0.905, detail, fontsize=10.5, color=QUIET, va="center")

        width, height = self.scene_size
        scene = figure.add_axes(SCENE)
        scene.axis("off")
        # As many cells as pixels, so that nothing is resampled.
        blank = np.full((height, width, 3), 255, dtype=np.uint8)
        self._scene = scene.imshow(blank, aspect="auto", interpolation="nearest")
        self._legend = _draw_ruler(figure, camera, scale)

        middle = MAP[0] + MAP[2] / 2
        spec = footage.spec
        read = [c for c, u in zip(spec.channels, spec.units, strict=True) if u == spec.units[0]]
        what = "force" if spec.units[0] == "N" else f"size of {', '.join(read)}"
        figure.text(middle, 0.862, f"{what} at each base", ha="center", fontsize=12, color=INK)
        how = "colour: size, arrow: direction of the force in y and z"
        figure.text(middle, 0.833, how, ha="center", fontsize=9.5, color=QUIET)
        self._map = ForceMap(figure, MAP, spec, scale, _must_mirror(footage, camera))
        draw_scale(figure, (middle - 0.1, 0.345, 0.2, 0.016), scale)

        traces = figure.add_axes((0.06, 0.085, 0.925, 0.165))
        draw_traces(traces, footage.times_ms, scale.per_si * footage.sizes, spec.elements)
        traces.set_ylabel(f"{'force' if what == 'force' else 'size'} at base ({scale.unit})")
        self._cursor = traces.axvline(0, color=INK, lw=1.3)
        self._clock = figure.text(0.985, 0.905, "", color=INK, fontsize=14, family="monospace")
        self._clock.set(ha="right", va="center")
        for artist in (self._scene, *self._legend, self._cursor, self._clock):
            artist.set_animated(True)
        self._canvas.draw()
        self._still = self._canvas.copy_from_bbox(figure.bbox)
        self._figure = figure

    def picture(self, moment: int, scene: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Draw the (height, width, 3) RGB picture of a moment.

        Args:
            scene: the moment's (height, width, 3) scene, of `scene_size`.
        """
        time = float(self._footage.times_ms[moment])
        self._scene.set_data(scene)
        cells = self._map.show(self._footage.loads[moment], self._footage.sizes[moment])
        self._cursor.set_xdata([time, time])
        self._clock.set_text(f"t = {time:5.0f} ms")
        self._canvas.restore_region(self._still)
        for artist in (self._scene, *self._legend, *cells, self._cursor, self._clock):
            self._figure.draw_artist(artist)
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def _round_size(pixels: int) -> tuple[int, int]:
    """Round a sheet's (width, height), pixels, to even numbers, as video formats need."""
    width = 2 * round(pixels / 2)
    return width, 2 * round(width * TALL / WIDE / 2)


def scene_size(pixels: int) -> tuple[int, int]:
    """Compute the scene's (width, height), pixels, in a sheet that is `pixels` wide."""
    width, height = _round_size(pixels)
    return round(SCENE[2] * width), round(SCENE[3] * height)


def _draw_ruler(figure: Figure, camera: Camera, scale: ForceScale) -> list[Artist]:
    """Draw a labelled reference arrow, as long as the top force's arrow in the scene."""
    right, y = SCENE[0] + SCENE[2] - 0.022, SCENE[1] + 0.03  # bases are often on the left
    long = scale.arrow_mm / camera.extent_mm * SCENE[3] * TALL / WIDE
    head: dict[str, Any] = {"arrowstyle": "-|>", "mutation_scale": 14, "shrinkA": 0, "shrinkB": 0}
    places, colour = ((right - long, y), (right, y)), scale.colour(scale.top)
    arrow = FancyArrowPatch(*places, transform=figure.transFigure, color=colour, lw=3, **head)
    figure.add_artist(arrow)
    clear = {"facecolor": "white", "edgecolor": "none", "pad": 1.5, "alpha": 0.7}
    words = f"{scale.arrow_mm:g} mm · arrow of {scale.top:g} {scale.unit}"
    label = figure.text(right, y + 0.022, words, fontsize=10, color=INK, bbox=clear, ha="right")
    return [arrow, label]


def _must_mirror(footage: Footage, camera: Camera) -> bool:
    """Return whether to mirror the map, so that its rostral side matches the scene's."""
    data = mujoco.MjData(footage.model)
    footage.restore(0, data)
    whisker = footage.model.site_bodyid[footage.model.site(footage.spec.elements[0]).id]
    head = data.xmat[footage.model.body_parentid[whisker]].reshape(3, 3)
    lateral, rostral = camera.right @ head[:, 0], camera.right @ head[:, 1]
    signs = rostral_sign(footage.spec)
    if len(set(signs.tolist())) > 1:  # a face: from the front, its right side is on the left
        return bool(lateral > 0.5)
    return bool(signs[0] * rostral < -0.5)


class ForceMap:
    """A map of the array's grid: each cell shows its force by colour and arrow.

    The arrow in a cell is the component of the force along y and z of the mount frame, rostral and
    dorsal on an animal; it is longest if all of the force is in that plane.

    Args:
        place: left, bottom, width and height in the figure, as fractions.
        mirrored: whether column 0 is on the right, as in a picture with +y on the left.
    """

    def __init__(
        self,
        figure: Figure,
        place: Place,
        spec: ArraySpec,
        scale: ForceScale,
        mirrored: bool = False,
    ) -> None:
        self._scale = scale
        self._rostral = rostral_sign(spec)
        self._flip = -1.0 if mirrored else 1.0
        self._turns = rotation_matrices(spec.orientations)
        rows, columns = spec.grid_shape
        x = [columns - 1 - column if mirrored else column for _, column in spec.grid]
        self._centres = np.array([(c, row) for c, (row, _) in zip(x, spec.grid, strict=True)])
        self._cells: list[tuple[Rectangle, FancyArrowPatch, Text]] = []
        axes, page = figure.add_axes(place), figure.get_size_inches()
        cell_pt = 72 * float(min(page[0] * place[2] / columns, page[1] * place[3] / rows))
        small = float(np.clip(0.18 * cell_pt, 5.5, 8))
        for (cx, cy), name in zip(self._centres, spec.elements, strict=True):
            cell = Rectangle((cx - 0.47, cy - 0.47), 0.94, 0.94, facecolor=EMPTY)
            arrow = FancyArrowPatch((cx, cy), (cx, cy), arrowstyle="-|>", lw=0.035 * cell_pt)
            arrow.set(mutation_scale=0.2 * cell_pt, visible=False)
            label = axes.text(cx - 0.41, cy - 0.42, name, va="top", fontsize=small, color="0.6")
            axes.add_patch(cell)
            axes.add_patch(arrow)
            self._cells.append((cell, arrow, label))
        nose = "nose" if spec.name.partition("-")[0] in SPECIES else "+y"
        if len(set(self._rostral.tolist())) == 1:
            nose = f"{nose} →" if self._flip * self._rostral[0] > 0 else f"← {nose}"
        else:  # both sides of a face
            sides = ("left", "right") if mirrored else ("right", "left")
            nose = f"      {nose}      ".join(sides)
        axes.text((columns - 1) / 2, rows - 0.1, nose, ha="center", fontsize=10, color=QUIET)
        axes.set_xlim(-0.6, columns - 0.4)
        axes.set_ylim(rows - 0.1, -0.6)
        axes.set_aspect("equal", anchor="N")
        axes.axis("off")

    def show(self, loads: NDArray[np.float64], sizes: NDArray[np.float64]) -> list[Artist]:
        """Update the map to loads (element, 6), SI, element frames, and sizes (element,).

        Returns:
            The artists that differ from the map of an untouched array, in drawing order.
        """
        forces = np.einsum("eij,ej->ei", self._turns, loads[:, :3])
        changed: list[Artist] = []
        for i, (force, (cx, cy)) in enumerate(zip(forces, self._centres, strict=True)):
            size = self._scale.per_si * float(sizes[i])
            felt = self._scale.draws(size)
            cell, arrow, label = self._cells[i]
            ink = "white" if size > 0.5 * self._scale.top else INK
            cell.set_facecolor(self._scale.colour(size) if felt else EMPTY)
            label.set_color(ink if felt else "0.6")
            rightward, downward = self._flip * self._rostral[i] * force[1], -force[2]
            along = np.array([rightward, downward]) / max(float(np.linalg.norm(force)), 1e-12)
            arrow.set_visible(felt and float(np.linalg.norm(along)) > HARDLY)
            arrow.set_color(ink)
            dx, dy = (REACH * along).tolist()
            arrow.set_positions((cx - dx, cy + 0.08 - dy), (cx + dx, cy + 0.08 + dy))
            if felt:
                changed += [cell, arrow, label]
        return changed


def rostral_sign(spec: ArraySpec) -> NDArray[np.float64]:
    """Return (element,) signs: 1 if columns count rostrally, -1 if caudally (left of a face)."""
    place = np.array(spec.positions)
    columns = np.array([column for _, column in spec.grid], dtype=np.float64)
    signs = np.ones(len(columns))
    for side in (place[:, 0] >= 0, place[:, 0] < 0):
        if side.any():
            y, c = place[side, 1], columns[side]
            signs[side] = 1.0 if (y - y.mean()) @ (c - c.mean()) >= 0 else -1.0
    return signs


def draw_scale(figure: Figure, place: Place, scale: ForceScale) -> None:
    """Draw a horizontal colour bar of the forces at a place in figure fractions."""
    steps = np.linspace(0.02 * scale.top, scale.top, 64)
    colours = ListedColormap([scale.colour(f) for f in steps])
    bar = figure.colorbar(
        ScalarMappable(Normalize(0, scale.top), colours),
        cax=figure.add_axes(place),
        orientation="horizontal",
        extend="max",
    )
    bar.set_ticks([0, scale.top / 2, scale.top])
    bar.set_ticklabels(["0", f"{scale.top / 2:g}", f"{scale.top:g} {scale.unit}"])
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=9.5, length=0, colors=QUIET)


def draw_traces(
    axes: Axes, times_ms: NDArray[np.float64], forces: NDArray[np.float64], names: tuple[str, ...]
) -> None:
    """Draw forces (sample, element), mN, over time; colour and name only the strongest."""
    peaks = forces.max(axis=0)
    top = max(float(peaks.max()), 1e-6)
    for rank, i in enumerate(np.argsort(-peaks)):
        if peaks[i] < 0.01 * top:
            break
        named = rank < NAMED
        hue = colormaps["tab10"](rank) if named else (0.75, 0.75, 0.75, 1.0)
        (line,) = axes.plot(times_ms, forces[:, i], color=hue, lw=1.5 if named else 0.7)
        line.set(zorder=2 - rank / 100, label=names[i] if named else f"_{names[i]}")
    if peaks.any():
        axes.legend(loc="upper right", ncols=NAMED, fontsize=9, frameon=False)
    axes.set_xlim(0, float(times_ms[-1]))
    axes.set_ylim(0, 1.2 * top)
    axes.set_xlabel("time (ms)", color=INK)
    axes.set_ylabel("force on base (mN)", color=INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=9.5)
