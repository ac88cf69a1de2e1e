"""Contact sheets: many objects in one picture, to see that each is what it should be."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_rt.core.files import write_whole
from tactile_rt.sim_backend.objects.solids import TactileObject

__all__ = ["draw_object", "write_contact_sheet"]

SIDE, ACROSS = 150, 8  # pixels of a picture, pictures in a row
POINTS = 200_000  # of an object's surface
LIGHT = np.array([0.35, 0.45, 0.82])  # in view axes: right, up, toward the viewer


def draw_object(thing: TactileObject) -> NDArray[np.float64]:
    """Draw an object from above and one side: (SIDE, SIDE), 0 black to 1 white."""
    yaw, pitch = np.radians(-58), np.radians(24)
    c, s, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    axes = np.array([[-s, c, 0], [-sp * c, -sp * s, cp], [cp * c, cp * s, sp]])
    solid: Any = trimesh.util.concatenate(list(thing.pieces))
    points, faces = trimesh.sample.sample_surface(solid, POINTS, seed=1)
    seen = points @ axes.T
    shade = 0.25 + 0.6 * np.maximum(solid.face_normals[faces] @ axes.T @ LIGHT, 0)
    order = np.argsort(seen[:, 2])  # the nearest is drawn last, every point 2 by 2 pixels
    column, row = (SIDE * (seen[order, :2].T / 1.5 + 0.5)).astype(int).clip(0, SIDE - 2)
    picture = np.ones((SIDE, SIDE))
    down, right = np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1])
    picture[SIDE - 1 - row[:, None] - down, column[:, None] + right] = shade[order, None]
    return picture


def write_contact_sheet(out: Path, things: Mapping[str, TactileObject | None]) -> None:
    """Write a picture of objects by their names; of None, that it cannot be used."""
    down = -(-len(things) // ACROSS)
    figure = Figure(figsize=(ACROSS * 1.6, down * 1.85), dpi=100)
    for place, (name, thing) in enumerate(things.items(), 1):
        axes = figure.add_subplot(down, ACROSS, place)
        axes.axis("off")
        axes.set_title(name[-24:], fontsize=7, color="black" if thing else "firebrick")
        if thing:
            axes.imshow(draw_object(thing), cmap="gray", vmin=0, vmax=1)
        else:
            axes.text(0.5, 0.5, "cannot be used", ha="center", fontsize=7, color="firebrick")
    figure.tight_layout()
    kind = out.suffix[1:] or "png"
    write_whole(out, lambda file: figure.savefig(file, format=kind))
