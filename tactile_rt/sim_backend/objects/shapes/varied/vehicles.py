"""Vehicles of any plan, from a box with wheels to a bare shell; each heads along +x."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import ROUND, ball, box, hull, rod, shift_points, slab


def car(rng: Generator) -> list[Trimesh]:
    """Build any car, with hidden or visible wheels: racer, saloon, van, bus, rover, open."""
    u = rng.uniform
    wide, wheel = u(0.3, 0.65), u(0.06, 0.17)
    low, belt = u(0.3, 1.1) * wheel, wheel + u(0.06, 0.24)
    cut, nose = u(0.01, 0.12), u(0.75, 1.0)
    body = [
        slab(u(0.9, 1.0), 0.95 * wide, low, cut),
        slab(1.0, wide, (low + belt) / 2, cut),
        slab(u(0.85, 1.0), nose * wide, belt, cut),
    ]
    pieces = [hull(*body)]
    kind = rng.integers(6)
    if kind < 4:  # a cabin: in the middle, far back, far forward, or all along
        rear, front = [(-0.4, 0.25), (-0.5, 0.15), (-0.1, 0.45), (-0.49, 0.47)][kind]
        rear, front = rear + u(-0.01, 0.08), front - u(-0.02, 0.08)
        roof, rake = belt + u(0.08, 0.35), u(0.0, 0.16)
        middle, long = (rear + front) / 2, front - rear
        pieces.append(
            hull(
                slab(long, u(0.8, 1.0) * wide, belt - 0.01, 0.02, middle),
                slab(max(long - 2 * rake, 0.1), u(0.65, 0.95) * wide, roof, 0.02, middle),
            )
        )
    elif kind == 4:  # rounded over, like a beetle
        a, r = u(0.3, 0.45), u(0.1, 0.28)
        dome = shift_points(
            ball((0, 0, 0), 1.0).vertices * (a, 0.45 * wide, r), u(-0.1, 0.05), 0, belt
        )
        pieces.append(hull(dome))
    else:  # open: seats or a load
        for x in (-0.25, 0.05)[: int(rng.integers(1, 3))]:
            high = u(0.08, 0.2)
            pieces.append(box((x, 0, belt + high / 2 - 0.01), (0.08, 0.7 * wide, high)))
    base, tyre, out = u(0.22, 0.38), u(0.05, 0.14), u(-0.03, 0.05)
    sides = ROUND if rng.random() < 0.7 else 8
    axles = (-base, base) if rng.random() < 0.85 else (-base, 0.0, base)
    for x in axles if rng.random() < 0.85 else ():
        for side in (-1, 1):
            y = side * (wide / 2 + out)
            pieces.append(rod((x, y - side * tyre, wheel), (x, y, wheel), wheel, sides=sides))
    if rng.random() < 0.3:  # a wing, a spare wheel, a rack
        z = belt + u(0.03, 0.15)
        pieces.append(box((-0.46, 0, z), (0.08, 0.9 * wide, 0.03)))
        pieces.append(box((-0.46, 0, (belt + z) / 2), (0.04, 0.1 * wide, z - belt)))
    return pieces


def plane(rng: Generator) -> list[Trimesh]:
    """Build a slim or fat body, swept or straight wings in one or two decks."""
    u = rng.uniform
    r, nose, tail = u(0.045, 0.15), u(0.1, 0.25), u(0.2, 0.5)
    flat = u(0.8, 1.3)
    pieces = [
        rod((0.5, 0, 0), (0.5 - nose, 0, 0), u(0.1, 0.7) * r, r, sides=16),
        rod((0.5 - nose, 0, 0), (0.5 - nose - 0.2, 0, 0), r, sides=16),
        rod((0.3 - nose, 0, 0), (-0.5, 0, u(0.0, 0.6) * r), r, u(0.15, 0.6) * r, sides=16),
    ]
    sweep, taper, chord, span = u(-0.05, 0.3), u(0.3, 1.0), u(0.12, 0.3), u(0.3, 0.55)
    thick, rise, root = u(0.012, 0.035), u(-0.05, 0.1), u(0.02, 0.22)

    def wing(x: float, z: float, half: float, long: float, lift: float) -> list[Trimesh]:
        found = []
        for side in (-1, 1):
            inner = np.array([(x, 0, z), (x - long, 0, z)])
            end = (x - sweep * half / 0.45, side * half, z + lift)
            outer = np.array([end, (end[0] - taper * long, *end[1:])])
            shift = np.array([0, 0, thick / 2])
            found.append(hull(inner - shift, inner + shift, outer - shift, outer + shift))
        return found

    decks = (0.0,) if rng.random() < 0.8 else (-0.9 / max(flat, 1.0), 1.4)  # two: a biplane
    low = u(-0.8, 0.9) * r if len(decks) == 1 else 0.0
    for deck in decks:
        pieces += wing(root, flat * deck * r + low, span, chord, rise)
    if len(decks) == 2:  # struts
        x, half = root - 0.4 * chord - 0.6 * sweep * span / 0.45, 0.6 * span
        lower, upper = (flat * deck * r + 0.6 * rise for deck in decks)
        pieces += [rod((x, y, lower), (x, y, upper), 0.015, sides=8) for y in (-half, half)]
    fin, back = u(0.1, 0.26), -0.5 + u(0.12, 0.2)
    high = fin if rng.random() < 0.3 else u(0.0, 0.5) * r
    # on top of the fin or at its foot
    pieces += wing(-0.4 if high == fin else back, high, u(0.4, 0.5) * tail, u(0.07, 0.15), 0.0)
    side = np.array([0, thick / 2, 0])
    blade = np.array([(back, 0, 0), (-0.5, 0, 0), (-0.5, 0, fin), (-0.42, 0, fin)])
    pieces.append(hull(blade - side, blade + side))
    for k in range(int(rng.integers(0, 3))):
        for y in (-1, 1):
            share, wide = 0.35 + 0.25 * k, u(0.025, 0.05)
            at, x = y * span * share, root - 0.06 - sweep * share * span / 0.45
            z = flat * decks[0] * r + low + share * rise - 0.8 * wide
            pieces.append(rod((x + 0.06, at, z), (x - 0.1, at, z), wide))
    if rng.random() < 0.3:  # a propeller, stopped
        pieces.append(box((0.5, 0, 0), (0.02, 0.04, u(0.2, 0.4))))
    if rng.random() < 0.3:  # wheels
        for leg in (-0.08, 0.08):
            pieces.append(rod((0.1, 0.3 * leg, 0), (0.1, leg, -r - 0.08), 0.012, sides=8))
            pieces.append(rod((0.1, leg - 0.015, -r - 0.09), (0.1, leg + 0.015, -r - 0.09), 0.04))
    return pieces
