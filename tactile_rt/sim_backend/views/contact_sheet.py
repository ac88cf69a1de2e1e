"""Contact sheets: many objects in one picture, to see that each is what it should be."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import trimesh
from matplotlib.figure import Figure

from tactile_rt.core.files import write_whole
from tactile_rt.sim_backend.objects.solids import TactileObject

__all__ = ["write_contact_sheet"]

ACROSS = 8  # pictures in a row


def write_contact_sheet(out: Path, things: Mapping[str, TactileObject | None]) -> None:
    """Write a picture (.png) of named objects; None: one that cannot be used."""
    down = -(-len(things) // ACROSS)
    figure = Figure(figsize=(ACROSS * 1.6, down * 1.85), dpi=100)
    for place, (name, thing) in enumerate(things.items(), 1):
        axes: Any = figure.add_subplot(down, ACROSS, place, projection="3d" if thing else None)
        axes.axis("off")
        axes.set_title(name[-24:], fontsize=7, color="black" if thing else "firebrick")
        if thing:
            solid: Any = trimesh.util.concatenate(list(thing.pieces))
            axes.plot_trisurf(*solid.vertices.T, triangles=solid.faces, color="0.8")
            axes.set(xlim=(-0.4, 0.4), ylim=(-0.4, 0.4), zlim=(-0.4, 0.4), box_aspect=(1, 1, 1))
        else:
            axes.text(0.5, 0.5, "cannot be used", ha="center", fontsize=7, color="firebrick")
    write_whole(out, lambda file: figure.savefig(file, format="png"))
