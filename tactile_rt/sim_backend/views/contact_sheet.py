"""Contact sheets: many objects in one picture, to check each by eye."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from matplotlib.figure import Figure
from numpy.typing import NDArray

from tactile_rt.core.files import write_whole

ACROSS = 8  # pictures in a row


def write_contact_sheet(
    out: Path,
    things: Mapping[str, Sequence[trimesh.Trimesh] | None],
    whiskers: Sequence[NDArray[np.float64]] = (),
) -> None:
    """Write a picture (.png) that shows each object with its name.

    Args:
        things: the pieces of each object by name; None if it cannot be used.
        whiskers: (point, 3) from base to tip, mm, in the world, drawn with every object, which
            moves along -y; the pieces are then in the world, too.
    """
    across, wide = (min(3, len(things)), 4.0) if whiskers else (ACROSS, 1.6)
    down = -(-len(things) // across)
    figure = Figure(figsize=(across * wide, down * 1.15 * wide), dpi=100)
    figure.suptitle("dots: bases of whiskers; arrow: how the object moves" if whiskers else "")
    for place, (name, pieces) in enumerate(things.items(), 1):
        axes: Any = figure.add_subplot(down, across, place, projection="3d" if pieces else None)
        axes.set_title(name[-24:], fontsize=5 + wide, color="black" if pieces else "firebrick")
        if not whiskers:
            axes.axis("off")
        if not pieces:
            axes.text(0.5, 0.5, "cannot be used", ha="center", fontsize=7, color="firebrick")
            continue
        solid: Any = trimesh.util.concatenate(list(pieces))
        axes.plot_trisurf(
            *solid.vertices.T, triangles=solid.faces, color="0.8", alpha=0.6 if whiskers else 1
        )
        for line in whiskers:
            axes.plot(*line.T, color="black", marker="o", markersize=4, markevery=[0])
        if whiskers:
            axes.computed_zorder = False  # whiskers show through objects that hide them
            axes.view_init(elev=24, azim=-154)
            axes.quiver(*solid.bounds[1], 0, -solid.extents[1] / 2, 0, color="tab:red")
            axes.set(xlabel="x, mm", ylabel="y, mm", zlabel="z, mm")
            axes.locator_params(nbins=4)
        axes.set(aspect="equal")
    write_whole(out, lambda file: figure.savefig(file, format="png"))
