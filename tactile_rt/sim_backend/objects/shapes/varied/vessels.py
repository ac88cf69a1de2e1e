"""Vessels of any plan: round, square or cut, with or without a handle."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import (
    ROUND,
    hull,
    lathe,
    ring,
    shift_points,
    slab,
    tube,
    wall,
)


def bottle(rng: Generator) -> list[Trimesh]:
    """Build any body that narrows to a neck, perhaps with cork, lip or grip."""
    u = rng.uniform
    kind, wide, neck = rng.integers(4), u(0.1, 0.36), u(0.035, 0.11)
    neck = min(neck, 0.8 * wide)
    start, top = u(0.35, 0.85), u(0.86, 1.0)
    pieces = []
    if kind == 0:  # square, as for oil or medicine
        flat, cut, shoulder = u(0.35, 1.0), 0.2 * wide, u(0.02, 0.2)
        body = slab(2 * wide, 2 * wide * flat, 0, cut * flat)
        pieces.append(hull(body, shift_points(body, z=start)))
        pieces.append(hull(shift_points(body, z=start), ring(neck, min(start + shoulder, top), 12)))
        pieces += lathe([(neck, min(start + shoulder, top) - 0.01), (neck, top + 0.01)], 16)
    else:
        sides = ROUND if rng.random() < 0.75 else int(rng.choice([5, 6, 8]))  # round mostly
        foot, belly = u(0.5, 1.0), u(0.1, 0.8) * start
        if kind == 1:  # a flask: round below
            outline = [
                (max(foot, 0.5) * wide * np.sin(np.pi / 2 * t) + 0.02, t * belly)
                for t in (0.25, 0.5, 0.75)
            ]
            outline = [(0.4 * wide, 0.0), *outline, (wide, belly), (0.8 * wide, start)]
        else:  # straight, waisted or bulging
            waist = u(0.8, 1.1) if kind == 2 else u(0.95, 1.0)
            outline = [(foot * wide, 0.0), (wide, 0.04), (waist * wide, belly + 0.05)]
            outline.append((wide, max(start, belly + 0.08)))
        z = outline[-1][1]
        reach, power = max(u(0.03, 0.4), 0.02) * (top - z), u(0.5, 1.6)
        r0 = outline[-1][0]
        for t in (1 / 3, 2 / 3, 1.0):
            fall = ((1 - np.cos(np.pi * t)) / 2) ** power
            outline.append((r0 + (neck - r0) * fall, z + reach * t))
        outline.append((u(0.9, 1.1) * neck, top))
        pieces += lathe(outline, sides)
    if rng.random() < 0.6:  # a lip, a cap or a cork
        lid, high = u(0.7, 1.7) * neck, u(0.02, 0.1)
        pieces += lathe([(lid, top), (u(0.8, 1.1) * lid, top + high)], 16)
    if rng.random() < 0.12:  # a grip
        path = [(neck, 0, top - 0.05), (wide + 0.08, 0, 0.8 * top), (wide + 0.05, 0, 0.5 * top)]
        pieces += tube([*path, (0.8 * wide, 0, 0.42 * top)], 0.025)
    return pieces


def bowl(rng: Generator) -> list[Trimesh]:
    """Build a wide open bowl, shallow to deep, with or without foot and rim."""
    u = rng.uniform
    foot, high, thick = u(0.1, 0.4), u(0.14, 0.6), u(0.03, 0.09)
    straight, lip = u(0.0, 1.0), u(-0.03, 0.05)
    t = np.linspace(0, 1, 5)
    r = foot + (0.5 - foot) * ((1 - straight) * np.sin(t * np.pi / 2) + straight * t)
    z = high * ((1 - straight) * (1 - np.cos(t * np.pi / 2)) + straight * t)
    r[-1] += min(lip, 0.0)
    profile = [(float(a), float(b)) for a, b in zip(r, z, strict=True)]
    pieces = lathe([(foot, -0.005), (1.02 * foot, thick)])
    if rng.random() < 0.6:  # a foot
        pieces += lathe([(u(0.5, 1.0) * foot, -u(0.02, 0.12)), (0.9 * foot, 0.01)])
    pieces += [*wall(profile[:3], thick), *wall(profile[2:], thick)]
    if lip > 0.02:
        pieces += wall([(0.5 + lip, high - 0.02), (0.5 + lip, high + 0.02)], thick + lip)
    if rng.random() < 0.15:  # something in it
        fill = u(0.4, 0.9) * high
        pieces += lathe([(foot, 0.0), (float(np.interp(fill, z, r)) - 0.4 * thick, fill)])
    return pieces


def mug(rng: Generator) -> list[Trimesh]:
    """Build a tumbler, cup or stein, most with a handle of any outline."""
    u = rng.uniform
    low, thick, high = u(0.22, 0.5), u(0.03, 0.09), u(0.6, 1.1)
    rim, belly = low * u(0.8, 1.4), u(0.95, 1.15)
    outline = [(low, 0.0), (max(low, rim) * belly, u(0.4, 0.7) * high), (rim, high)]
    if belly < 1.03:
        outline[1] = ((low + rim) / 2, 0.5 * high)
    pieces = lathe([(low - 0.5 * thick, 0), (low - 0.5 * thick, u(0.04, 0.12))])
    pieces += wall(outline[:2], thick) + wall(outline[1:], thick)
    if rng.random() < 0.25:  # a band, or a thick foot
        z = u(0.0, 0.85) * high
        r = float(np.interp(z, [p[1] for p in outline], [p[0] for p in outline])) + 0.03
        pieces += wall([(r, z), (r, z + u(0.04, 0.12))], 0.06)
    if rng.random() < 0.2:  # something in it
        pieces += lathe([(low - thick, 0.03), (0.8 * min(low, rim), u(0.5, 0.92) * high)])
    if rng.random() < 0.75:
        out, square = u(0.12, 0.4), u(0.15, 1.0)
        half = u(0.18, 0.42) * high
        centre = u(half + 0.04, max(high - half - 0.04, half + 0.06))
        path = []
        for a in np.linspace(0, np.pi, 7):
            z = centre + half * np.sign(np.cos(a)) * abs(np.cos(a)) ** square
            side = float(np.interp(z, [p[1] for p in outline], [p[0] for p in outline]))
            path.append((side - thick / 2 + out * np.sin(a) ** square, 0, z))
        pieces += tube(path, u(0.025, 0.07))
    return pieces
