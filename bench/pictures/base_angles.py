"""Draw docs/pictures/base-angles.png: how a whisker stands, what passes it, and its load axes.

Drawn from the frames of the package, of a whisker with all three angles.
Run: python -m bench.pictures.base_angles [--out FILE]
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon
from PIL import Image

from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tests.helpers.source_tree import ROOT

OUT = ROOT / "docs" / "pictures" / "base-angles.png"
INK, QUIET, BLUE, RED, PLATE = "#222222", "#6b6b6b", "#1f6fb2", "#c0392b", "#d5dde1"
THETA, PHI, ZETA = 1.0, 0.5, 0.6  # rad, as base_theta_rad, base_phi_rad and base_zeta_rad
LONG = 24.0  # mm


def standing(theta: float = np.pi / 2, phi: float = 0.0, zeta: float = 0.0) -> Whisker:
    """The first whisker of docs/arrays/robot.toml at the origin, curved, at these angles."""
    whisker = load_array(str(ROOT / "docs" / "arrays" / "robot.toml")).whiskers[0]
    return replace(
        whisker, base=(0.0, 0.0, 0.0), angles=(theta, phi, zeta), curvature=0.012, length=LONG
    )


def draw_arrow(axes: Axes, start, end, text: str = "", colour: str = INK, width: float = 1.6):
    style = {"arrowstyle": "-|>", "lw": width, "color": colour, "shrinkA": 0, "shrinkB": 0}
    axes.annotate("", end, start, arrowprops=style)
    beyond = np.array(end) + 2.2 * (np.array(end) - start) / np.linalg.norm(np.array(end) - start)
    axes.text(*beyond, text, color=colour, ha="center", va="center", fontsize=10)


def draw_angle(axes: Axes, radius: float, start: float, end: float, text: str) -> None:
    """Draw an arc with a tip from one direction to another, rad, about the origin."""
    at = np.linspace(start, end, 40)
    arc = radius * np.stack([np.cos(at), np.sin(at)], axis=1)
    axes.plot(*arc.T, color=BLUE, lw=1.4)
    draw_arrow(axes, arc[-2], arc[-1], colour=BLUE, width=1.4)
    middle = (radius + 2.4) * np.array([np.cos(at[20]), np.sin(at[20])])
    axes.text(*middle, text, color=BLUE, fontsize=12, ha="center", va="center")


def draw_plan(axes: Axes, whisker: Whisker, across: int, up: int, names: str) -> None:
    """Draw a plate on the left, a whisker on it, and the array's axes, projected on two."""
    axes.add_patch(Polygon([(-3, -17), (0, -17), (0, 17), (-3, 17)], color=PLATE))
    line = whisker.centreline(np.linspace(0, LONG, 60)) @ whisker.orientation.T
    axes.plot(line[:, across], line[:, up], color=INK, lw=2.4, solid_capstyle="round")
    axes.plot(0, 0, "o", color=INK, ms=5)
    draw_arrow(axes, (-2, 19), (5, 19), names[0], QUIET)
    draw_arrow(axes, (-2, 19), (-2, 26), names[1], QUIET)


def draw(out: Path) -> None:
    figure = Figure(figsize=(10.6, 3.9), dpi=100)
    above, beside, along = figure.subplots(1, 3)
    figure.subplots_adjust(0.01, 0.01, 0.99, 0.87, 0.02)
    titles = ("from above: base_theta_rad", "from −y: base_phi_rad", "from the tip: base_zeta_rad")
    for axes, title in zip((above, beside, along), titles, strict=True):
        axes.set(xlim=(-6, 32), ylim=(-20, 31), aspect="equal", title=title)
        axes.axis("off")

    draw_plan(above, replace(standing(THETA), curvature=0.0), 0, 1, "xy")
    above.plot((0, 0), (0, -14), ":", color=BLUE)
    draw_angle(above, 10, -np.pi / 2, THETA - np.pi / 2, "θ")
    above.add_patch(Circle((20, 16), 6, color="#cfe6dc"))
    above.text(20, 16, "object", ha="center", va="center", fontsize=9)
    draw_arrow(above, (20, 9.5), (20, -2), "moves along −y", RED, 2.4)

    draw_plan(beside, replace(standing(phi=PHI), curvature=0.0), 0, 2, "xz")
    beside.plot((0, 16), (0, 0), ":", color=BLUE)
    draw_angle(beside, 13, 0, PHI, "φ")

    along.set(xlim=(-19, 19), ylim=(-20, 31))
    whisker = standing(zeta=ZETA)
    y, z = whisker.orientation[1:, 1], whisker.orientation[1:, 2]  # seen from the tip: right is y
    up = standing().orientation[1:, 1]
    along.plot((0, 14 * up[0]), (0, 14 * up[1]), ":", color=BLUE)
    turn = np.arctan2(*up[::-1])
    draw_angle(along, 11, turn, turn + ZETA, "ζ")
    line = whisker.centreline(np.linspace(0, LONG, 60)) @ whisker.orientation.T
    along.plot(line[:, 1], line[:, 2], color=INK, lw=4, solid_capstyle="round")
    for axis, name in ((y, "y: fy, my"), (z, "z: fz, mz")):
        draw_arrow(along, (0, 0), 17 * axis, colour=RED)
        along.text(*(20 * axis), name, color=RED, ha="center", va="center", fontsize=10)
    along.add_patch(Circle((0, 0), 1.2, facecolor="white", edgecolor=RED, lw=1.6))
    along.plot(0, 0, ".", color=RED)
    said = "x: fx, mx\nalong the whisker,\nout of the picture"
    along.text(2.5, 0, said, color=RED, va="center", fontsize=10)
    note = "a curved whisker bends towards its y;\nloads are read in these axes"
    along.text(0, 28, note, ha="center", va="center", fontsize=9, color=QUIET)
    figure.savefig(out)
    Image.open(out).convert("RGB").quantize(64).save(out, optimize=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=OUT)
    draw(parser.parse_args().out)
