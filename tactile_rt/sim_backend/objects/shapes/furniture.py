"""Furniture to sit on, sit at, climb and light a room: legs, seats, treads, a shade."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import bar, box, hull, lathe, ring, rod, slab, wall


def chair(rng: Generator) -> list[Trimesh]:
    """Build four legs, a seat at half height and an open or closed back."""
    u = rng.uniform
    w, d, seat, leg = u(0.4, 0.52), u(0.38, 0.5), u(0.4, 0.5), u(0.035, 0.055)
    thick, lean, splay = u(0.035, 0.07), u(0.0, 0.1), u(0.0, 0.05)
    x, y = d / 2 - leg / 2, w / 2 - leg / 2
    pieces = [hull(slab(d, w, seat, 0.02), slab(d, w, seat + thick, 0.02))]
    for i in (-1, 1):
        for j in (-1, 1):
            foot = (i * (x + splay), j * (y + splay), 0)
            pieces.append(bar((i * x, j * y, seat + 0.01), foot, leg, leg, u(0.7, 1.0)))
    top = 1.0
    tip = -x - lean

    def back(z: float) -> float:
        """Return x of the tilted backrest at height z."""
        return -x + (tip + x) * (z - seat) / (top - seat)

    pieces += [bar((-x, j * y, seat), (tip, j * y, top), leg, leg) for j in (-1, 1)]
    kind = rng.integers(3)
    if kind == 0:  # a closed panel
        low = seat + u(0.06, 0.16)
        pieces.append(bar((back(low), 0, low), (tip, 0, top - 0.01), 0.8 * leg, 2 * y))
    elif kind == 1:  # rails across
        for z in np.linspace(top - 0.06, seat + u(0.12, 0.2), int(rng.integers(2, 4))):
            pieces.append(bar((back(z), -y, z), (back(z), y, z), 0.03, u(0.06, 0.1)))
    else:  # spindles under a top rail
        for s in np.linspace(-y, y, int(rng.integers(3, 6)) + 2)[1:-1]:
            pieces.append(rod((-x, s, seat), (tip, s, top - 0.03), 0.014, sides=8))
        pieces.append(
            bar((tip, -y - leg / 2, top - 0.04), (tip, y + leg / 2, top - 0.04), leg, 0.08)
        )
    if rng.random() < 0.3:  # arms
        z = seat + u(0.17, 0.24)
        for j in (-1, 1):
            pieces.append(bar((back(z), j * y, z), (x, j * y, z), 0.05, 0.035))
            pieces.append(bar((x - 0.03, j * y, seat), (x - 0.03, j * y, z), 0.035, 0.035))
    return pieces


def ladder(rng: Generator) -> list[Trimesh]:
    """Build a stepladder: treads between leaning front rails, two back legs, a cap."""
    u = rng.uniform
    bottom, reach, rail = u(0.4, 0.52), u(0.2, 0.3), u(0.03, 0.04)
    top, depth, back = bottom * u(0.6, 0.8), u(0.07, 0.11), u(0.16, 0.26)

    def front(side: float, z: float) -> tuple[float, float, float]:
        """Return a point of the front rails at height z, side -1 to 1."""
        return (-0.04 - reach * (1 - z), side * (bottom + (top - bottom) * z) / 2, z)

    def rear(side: float, z: float) -> tuple[float, float, float]:
        """Return a point of the back legs at height z, side -1 to 1."""
        return (0.04 + back * (1 - z), 0.9 * side * (bottom + (top - bottom) * z) / 2, z)

    pieces = [box((0, 0, 0.985), (0.16, top + rail, 0.03))]
    for side in (-1, 1):
        pieces.append(bar(front(side, 0), front(side, 0.98), depth * 0.8, rail))
        pieces.append(bar(rear(side, 0), rear(side, 0.98), rail, rail))
    treads = int(rng.integers(3, 7))
    for z in np.arange(1, treads + 1) / (treads + 1):
        pieces.append(bar(front(-1, z), front(1, z), depth, 0.03))
    for z in ((0.3,), (0.25, 0.6))[int(rng.integers(2))]:
        pieces.append(bar(rear(-1, z), rear(1, z), 0.025, 0.03))
    return pieces


def lamp(rng: Generator) -> list[Trimesh]:
    """Build a flat base, a thin pole and a wide open shade."""
    u = rng.uniform
    base, foot, pole = u(0.16, 0.25), u(0.03, 0.05), u(0.02, 0.032)
    low, rim = u(0.47, 0.58), u(0.25, 0.34)
    crown = rim * u(0.35, 0.9)
    pieces = lathe([(base, 0), (base, foot), (base * u(0.2, 0.7), foot + u(0.03, 0.06))])
    pieces.append(rod((0, 0, 0.02), (0, 0, 0.95), pole, sides=16))
    pieces += wall([(rim, low), (crown, 1.0)], 0.04)
    pieces.append(box((0, 0, 0.945), (2 * crown, 0.03, 0.03)))  # holds the shade to the pole
    if rng.random() < 0.5:  # a knob on the pole
        r, z = pole * u(1.8, 2.8), u(0.2, 0.4)
        pieces += lathe([(0.5 * r, z - r), (r, z - 0.4 * r), (r, z + 0.4 * r), (0.5 * r, z + r)])
    return pieces


def stool(rng: Generator) -> list[Trimesh]:
    """Build a small thick seat on three or four splayed legs, joined by rungs.

    By touch: a few round posts that converge upward, bridged half way up.
    """
    u = rng.uniform
    legs, seat, thick, leg = int(rng.integers(3, 5)), u(0.24, 0.32), u(0.06, 0.1), u(0.028, 0.042)
    spread, rung = u(0.3, 0.38), u(0.3, 0.55)
    pieces = lathe([(0.93 * seat, 1 - thick), (seat, 1 - 0.4 * thick), (0.95 * seat, 1.0)])
    turns = 2 * np.pi * (np.arange(legs) + 0.5) / legs

    def on(turn: float, z: float) -> tuple[float, float, float]:
        """Return a point of a leg's axis at height z; `turn` is its azimuth, rad."""
        r = spread + (0.7 * seat - spread) * z
        return (r * np.cos(turn), r * np.sin(turn), z)

    step = u(0.0, 0.12)  # rungs at alternating heights, as joiners do
    for k, turn in enumerate(turns):
        pieces.append(rod(on(turn, 1 - 0.8 * thick), on(turn, 0), leg, 0.75 * leg))
        z = rung + step * (k % 2)
        pieces.append(rod(on(turn, z), on(turns[(k + 1) % legs], z), 0.7 * leg, sides=8))
    return pieces


def table(rng: Generator) -> list[Trimesh]:
    """Build a wide top on three to six legs."""
    u = rng.uniform
    depth, height, thick, leg = u(0.55, 0.95), u(0.55, 0.75), u(0.035, 0.06), u(0.045, 0.075)
    splay, taper, inset = u(0.0, 0.06), u(0.55, 1.0), u(0.05, 0.1)
    under = height - thick
    if rng.random() < 0.35:  # round or oval
        pieces = [hull(ring(0.5, under, squash=depth), ring(0.5, height, squash=depth))]
        angles = np.pi / 4 + np.arange(n := int(rng.integers(3, 7))) * 2 * np.pi / n
        spots = 0.36 * np.column_stack([np.cos(angles), depth * np.sin(angles)])
    else:
        pieces = [hull(slab(1, depth, under, 0.03), slab(1, depth, height, 0.03))]
        spots = np.array([(i, j) for i in (-1, 1) for j in (-1, 1)], float)
        spots *= (0.5 - inset, depth / 2 - inset)
        if rng.random() < 0.5:  # a frame under the top
            size = (1 - 2 * inset, depth - 2 * inset, 0.09)
            pieces.append(box((0, 0, under - 0.04), size))
        elif rng.random() < 0.5:  # a bar near the floor at either end
            for i in (-1, 1):
                x, y = i * (0.5 - inset), depth / 2 - inset
                pieces.append(box((x, 0, u(0.1, 0.2)), (0.03, 2 * y, 0.04)))
    for x, y in spots:
        foot = (x * (1 + splay), y * (1 + splay), 0)
        pieces.append(bar((x, y, under + 0.005), foot, leg, leg, taper))
    return pieces
