"""Draw docs/pictures/objects.png: three instances of every category, to see that each is what it
says; and docs/pictures/objects-varied.png: six of each of any plan.

Orthographic view from above and to one side, z-buffered here because a painter's sort
(matplotlib's) tears pieces that touch. Run: python -m bench.pictures.objects
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from PIL import Image

from tactile_rt.sim_backend.objects.catalogue import (
    CATEGORIES,
    VARIED,
    WITHHELD,
    TactileObject,
    make_object,
)

Floats = npt.NDArray[np.float64]

PIXELS, FINE = 170, 3  # side of a picture, and how many times finer it is drawn before averaging
SPAN = 1.38  # width of a picture in object sizes
LIGHT = np.array([0.35, 0.45, 0.82])  # in view axes: right, up, toward the viewer


def view(yaw: float, pitch: float) -> Floats:
    """Return (3, 3) rows: right, up and toward the viewer, from yaw and pitch in radians."""
    c, s, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    return np.array([[-s, c, 0], [-sp * c, -sp * s, cp], [cp * c, cp * s, sp]])


def render(thing: TactileObject, yaw: float, pitch: float) -> Floats:
    """Draw an object: (PIXELS, PIXELS) grey, 0 black to 1 white."""
    side = PIXELS * FINE
    depth = np.full((side, side), -np.inf)
    grey = np.ones((side, side))
    axes = view(yaw, pitch)
    light = LIGHT / np.linalg.norm(LIGHT)
    for piece in thing.pieces:
        corners, normals = piece.triangles @ axes.T, piece.face_normals @ axes.T
        for points, normal in zip(corners, normals, strict=True):
            if normal[2] < 1e-6:
                continue  # seen from behind or edge on
            flat = (points[:, :2] / SPAN + 0.5) * side
            low = np.maximum(np.floor(flat.min(axis=0)).astype(int), 0)
            high = np.minimum(np.ceil(flat.max(axis=0)).astype(int) + 1, side)
            x, y = np.meshgrid(np.arange(low[0], high[0]), np.arange(low[1], high[1]))
            inside = np.ones(x.shape, bool)
            for a, b in zip(flat, np.roll(flat, -1, axis=0), strict=True):
                inside &= (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0]) >= -1e-9
            # the plane of the triangle gives the depth at every pixel
            px, py = (x / side - 0.5) * SPAN, (y / side - 0.5) * SPAN
            z = (
                points[0, 2]
                - (normal[0] * (px - points[0, 0]) + normal[1] * (py - points[0, 1])) / normal[2]
            )
            window = (slice(low[1], high[1]), slice(low[0], high[0]))
            nearer = inside & (z > depth[window])
            depth[window][nearer] = z[nearer]
            grey[window][nearer] = 0.28 + 0.62 * max(0.0, float(normal @ light))
    # a dark line where the depth jumps, so that thin parts stand out from what is behind them
    solid = np.where(np.isfinite(depth), depth, -1.0)
    edge = np.zeros_like(grey, bool)
    for axis in (0, 1):
        jump = np.abs(np.diff(solid, axis=axis)) > 0.035
        edge[:-1, :] |= jump if axis == 0 else False
        edge[:, :-1] |= jump if axis == 1 else False
    grey[edge] = 0.12
    fine: Floats = grey.reshape(PIXELS, FINE, PIXELS, FINE)
    return np.flipud(fine.mean(axis=(1, 3)))


def sheet(out: Path, kinds: dict[str, str], instances: int, across: int) -> None:
    """Write a contact sheet.

    Args:
        out: the picture.
        kinds: the title of every category.
        instances: of each category.
        across: how many categories stand side by side.
    """
    rows = -(-len(kinds) // across)
    figure = Figure(figsize=(across * instances * 1.3, rows * 1.6), dpi=110)
    panels = figure.subplots(rows, across)
    for panel in panels.flat:
        panel.axis("off")
    for panel, (category, title) in zip(panels.T.flat, kinds.items(), strict=False):
        pictures = [
            render(make_object(category, i), np.radians(-58 + 8 * i), np.radians(24))
            for i in range(instances)
        ]
        panel.imshow(np.hstack(pictures), cmap="gray", vmin=0, vmax=1)
        panel.set_title(title, fontsize=13, loc="left")
    figure.tight_layout()
    figure.savefig(out)
    Image.open(out).convert("L").save(out, optimize=True)  # half the size without colour


def main() -> None:
    """Draw both sheets."""
    known = {c: c for c in CATEGORIES}
    sheet(Path("docs/pictures/objects.png"), known | {c: f"{c} (withheld)" for c in WITHHELD}, 3, 4)
    sheet(Path("docs/pictures/objects-varied.png"), {VARIED + c: c for c in CATEGORIES}, 6, 2)


if __name__ == "__main__":
    main()
