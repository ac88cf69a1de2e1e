"""Handheld objects from a shelf, a workshop, a gymnasium or a toy box."""

from itertools import pairwise

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import ROUND, ball, hull, lathe, rod, tube, wall


def birdcage(rng: Generator) -> list[Trimesh]:
    """Build upright wires round a floor, bent together over it, with a knob.

    By touch: thin posts at even steps round a circle, air behind them.
    """
    u = rng.uniform
    wires, radius, wire = int(rng.integers(7, 11)), u(0.3, 0.38), u(0.016, 0.022)
    eave, top, bend = u(0.6, 0.72), u(0.88, 0.94), u(0.0, 0.12)
    floor = radius + u(0.02, 0.05)
    pieces = lathe([(floor, 0), (floor, u(0.05, 0.1))])
    for turn in 2 * np.pi * np.arange(wires) / wires:
        c, s = np.cos(turn), np.sin(turn)
        foot, knee = (
            (radius * c, radius * s, 0.03),
            ((1 + bend) * radius * c, (1 + bend) * radius * s, eave),
        )
        pieces += tube([foot, knee, (0.03 * c, 0.03 * s, top)], wire, sides=8)
    pieces.append(ball((0, 0, top + 0.01), 0.06))
    return pieces


def dumbbell(rng: Generator) -> list[Trimesh]:
    """Build a horizontal bar with a weight at either end: prism, plates or ball."""
    u = rng.uniform
    r, grip = u(0.19, 0.26), u(0.03, 0.045)
    kind, sides, inner = rng.integers(3), int(rng.choice([6, 8])), u(0.14, 0.22)
    cut, plates = u(0.04, 0.08), np.cumsum(u(0.08, 0.12, int(rng.integers(2, 4))))
    shrink = u(0.75, 0.9)
    profile: list[tuple[float, float]]  # (radius, distance from the middle) outward
    if kind == 0:
        profile = [(r - cut, inner), (r, inner + cut), (r, 0.5 - cut), (r - cut, 0.5)]
    elif kind == 1:
        scale = (0.46 - inner) / plates[-1]
        edges = inner + scale * np.concatenate([[0.0], plates])
        profile = [
            (r * shrink**k, float(edge))
            for k in range(len(plates))
            for edge in (edges[k], edges[k + 1] - 0.022)
        ]
        profile += [(1.3 * grip, float(edges[-1])), (1.3 * grip, 0.5)]
    else:
        angles = np.radians([18, 42, 66, 90, 114, 138, 162])
        profile = [(r * np.sin(a), 0.5 - r - r * np.cos(a)) for a in angles]
    faces = sides if kind == 0 else ROUND
    pieces = [rod((-0.45, 0, 0), (0.45, 0, 0), grip, sides=16)]
    for side in (-1, 1):
        for (r0, x0), (r1, x1) in pairwise(profile):
            pieces.append(rod((side * x0, 0, 0), (side * x1, 0, 0), r0, r1, sides=faces))
    return pieces


def gear(rng: Generator) -> list[Trimesh]:
    """Build a thick toothed ring lying flat."""
    u = rng.uniform
    teeth, half, root = int(rng.integers(8, 15)), u(0.13, 0.22), u(0.37, 0.42)
    hole, twist = u(0.1, 0.2), u(-0.12, 0.12)  # radians between bottom and top: helical teeth
    pieces = wall([(root, -half), (root, half)], root - hole)
    pitch = 2 * np.pi / teeth
    foot, tip = pitch * u(0.26, 0.3), pitch * u(0.1, 0.16)  # half angles of a tooth
    for k in range(teeth):
        points = [
            (r * np.cos(a), r * np.sin(a), z)
            for z, shift in ((-half, -twist / 2), (half, twist / 2))
            for r, spread in ((0.94 * root, foot), (0.5, tip))
            for a in (k * pitch + shift - spread, k * pitch + shift + spread)
        ]
        pieces.append(hull(points))
    return pieces


def hourglass(rng: Generator) -> list[Trimesh]:
    """Build two bulbs that meet in a narrow neck, with a plate at either end.

    By touch: a round body that narrows to almost nothing half way up and swells again.
    """
    u = rng.uniform
    plate, thick, full = u(0.28, 0.38), u(0.05, 0.09), u(0.5, 0.72)
    bulb, neck, shoulder = plate * u(0.86, 1.0), u(0.035, 0.07), u(0.7, 0.9)
    half, curve = 0.5 - thick, u(0.2, 0.45)
    outline = [(neck, 0.0), (curve * bulb, 0.14 * half), (bulb, full * half)]
    outline.append((shoulder * bulb, half))
    pieces = []
    for side in (-1, 1):
        pieces += lathe([(plate, side * half), (plate, side * 0.5)])
        pieces += lathe([(r, side * z) for r, z in outline])
    return pieces


def jack(rng: Generator) -> list[Trimesh]:
    """Build a toy jack: three crossed bars ending in balls, two perhaps in points.

    By touch: knobs on thin stalks, far apart, nothing between.
    """
    u = rng.uniform
    arm, knob, middle = u(0.045, 0.07), u(0.13, 0.17), u(0.1, 0.16)
    pointed, tilt, turn = int(rng.integers(3)), u(0.0, 0.3), u(0, 2 * np.pi)
    # tilted about a horizontal axis at `turn`
    k = np.array([np.cos(turn), np.sin(turn), 0.0])
    cross = np.array([(0, -k[2], k[1]), (k[2], 0, -k[0]), (-k[1], k[0], 0)])
    tip = np.eye(3) + np.sin(tilt) * cross + (1 - np.cos(tilt)) * cross @ cross
    pieces = [ball((0, 0, 0), middle)]
    for axis in range(3):
        along = tip[:, axis]
        reach = 0.5 * (1 if axis < 2 else u(0.9, 1.1))
        pieces.append(rod(-reach * along, reach * along, arm, sides=8))
        for side in (-1, 1):
            if axis == 2 and pointed == 2:
                pieces.append(rod(side * reach * along, side * 1.2 * reach * along, arm, 0.012))
            else:
                pieces.append(ball(side * reach * along, knob))
    return pieces


def spring(rng: Generator) -> list[Trimesh]:
    """Build a steep coil of thick wire.

    By touch: slanting round ridges one above the other, a gap under each.
    """
    u = rng.uniform
    turns, radius, wire, hand = u(2.8, 3.7), u(0.3, 0.42), u(0.042, 0.065), rng.choice([-1, 1])
    start, taper = u(0, 2 * np.pi), u(-0.08, 0.08)
    t = np.linspace(0, 1, round(6.6 * turns) + 1)
    angle, r = start + hand * 2 * np.pi * turns * t, radius + taper * (t - 0.5)
    path = np.column_stack([r * np.cos(angle), r * np.sin(angle), 0.9 * t])
    return tube(list(path), wire, sides=8)
