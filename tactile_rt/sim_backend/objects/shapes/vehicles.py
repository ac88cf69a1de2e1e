"""Vehicles on wheels and in the air. Each heads along +x."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import ROUND, box, hull, ring, rod, slab


def car(rng: Generator) -> list[Trimesh]:
    """Build a low body with a cabin on four wheels: saloon, estate, van or pickup."""
    u = rng.uniform
    width, wheel = u(0.36, 0.44), u(0.095, 0.125)
    belt = wheel + u(0.11, 0.15)
    roof = belt + u(0.1, 0.2)
    # the cabin's foot from `rear` to `front`; the body runs from -0.5 to 0.5
    rear, front = [(-0.4, 0.22), (-0.48, 0.2), (-0.48, 0.36), (-0.12, 0.26)][rng.integers(4)]
    rear, front = rear + u(-0.01, 0.04), front + u(-0.03, 0.04)
    rake_rear, rake_front = u(0.01, 0.1), u(0.07, 0.16)
    long, middle = front - rear, (front + rear) / 2
    top, top_middle = long - rake_front - rake_rear, middle + (rake_rear - rake_front) / 2
    low, waist = 0.6 * wheel, 0.55 * belt + 0.02
    body = hull(
        slab(0.94, 0.94 * width, low, 0.06),
        slab(1.0, width, waist, 0.06),
        slab(0.96, 0.94 * width, belt, 0.06),
    )
    cabin = hull(
        slab(long, 0.9 * width, belt - 0.01, 0.03, middle),
        slab(top, 0.74 * width, roof, 0.03, top_middle),
    )
    pieces = [body, cabin]
    base, tyre = u(0.26, 0.31), u(0.07, 0.1)
    for x in (-base, base):
        for side in (-1, 1):
            y = side * (width / 2 + 0.025)
            pieces.append(rod((x, y - side * tyre, wheel), (x, y, wheel), wheel, sides=ROUND))
    if rng.random() < 0.25:  # a spoiler
        pieces.append(box((-0.455, 0, belt + 0.045), (0.07, 0.85 * width, 0.025)))
        pieces += [box((-0.45, y * width, belt + 0.015), (0.03, 0.03, 0.06)) for y in (-0.3, 0.3)]
    return pieces


def plane(rng: Generator) -> list[Trimesh]:
    """Build an airliner in level flight: fuselage, swept wings, tail, engines under the wings."""
    u = rng.uniform
    r, sweep, taper = u(0.055, 0.08), u(0.05, 0.28), u(0.35, 0.7)
    span, chord, rise = u(0.4, 0.5), u(0.16, 0.24), u(-0.02, 0.08)
    low, root = r * u(-0.6, 0.6), u(0.1, 0.2)
    pieces = [
        hull(_disc(0.5, 0.25 * r), _disc(0.46, 0.65 * r), _disc(0.38, r)),
        rod((0.38, 0, 0), (-0.2, 0, 0), r, sides=ROUND),
        hull(_disc(-0.2, r), _disc(-0.5, 0.3 * r, 0.5 * r)),
    ]

    def blade(x: float, z: float, tip: tuple[float, float, float], long: float) -> Trimesh:
        """Build a tapered plate from the middle line to `tip`, its leading edge at x."""
        n = np.array([0, 0, 0.016]) if tip[1] else np.array([0, 0.016, 0])
        start, end = np.array([x, 0, z]), np.array(tip)
        edges = [(start, 0.0), (start, long), (end, 0.0), (end, taper * long)]
        return hull([p - (back, 0, 0) + s * n for p, back in edges for s in (-1, 1)])

    tail, fin = u(0.14, 0.2), u(0.14, 0.22)
    high = 0.5 * r + (fin if rng.random() < 0.3 else 0.0)  # a T tail or a low one
    engines = int(rng.integers(0, 3))
    for side in (-1, 1):
        pieces.append(blade(root, low, (root - sweep, side * span, low + rise), chord))
        pieces.append(blade(-0.36, high, (-0.36 - sweep * 0.4, side * tail, high), 0.13))
        for e in range(engines):
            t = 0.35 + 0.25 * e
            x, y, z = root - t * sweep, side * t * span, low + t * rise - 0.045
            pieces.append(rod((x + 0.04, y, z), (x - 0.1, y, z), 0.036, 0.028))
    pieces.append(blade(-0.3, 0, (-0.38, 0, 0.5 * r + fin), 0.17))
    return pieces


def _disc(x: float, radius: float, z: float = 0.0) -> np.ndarray:
    """Return points (16, 3) of a fuselage circle at x, its centre at height z."""
    circle = ring(radius, 0.0, 16)
    return np.column_stack([np.full(16, x), circle[:, 0], z + circle[:, 1]])


def truck(rng: Generator) -> list[Trimesh]:
    """Build a cab, a gap, a tall box and three axles.

    By touch: two flat upright walls with a slot between them, over wheels.
    """
    u = rng.uniform
    width, wheel, roof = u(0.27, 0.33), u(0.065, 0.085), u(0.44, 0.54)
    cab, gap, floor = u(0.17, 0.23), u(0.04, 0.08), 1.5 * wheel
    top, rear = roof * u(0.68, 0.9), 0.5 - cab - gap
    nose = u(0.0, 0.07)
    pieces = [
        box((0.0, 0, 1.35 * wheel), (0.96, 0.5 * width, 0.7 * wheel)),
        box(((rear - 0.5) / 2, 0, (roof + floor) / 2), (rear + 0.5, width, roof - floor)),
        hull(
            slab(cab, 0.94 * width, 0.9 * wheel, 0.02, 0.5 - cab / 2),
            slab(cab, 0.94 * width, 0.5 * top, 0.02, 0.5 - cab / 2),
            slab(cab - nose, 0.86 * width, top, 0.02, 0.5 - (cab + nose) / 2),
        ),
    ]
    axles = [0.5 - 0.55 * cab, -0.5 + 0.12]
    axles.append(axles[1] + 2.15 * wheel)
    for x in axles:
        for side in (-1, 1):
            y = side * (width / 2 + 0.015)
            pieces.append(rod((x, y - side * 0.07, wheel), (x, y, wheel), wheel, sides=16))
    return pieces
