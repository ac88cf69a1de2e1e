"""Twelve kinds of thing, each drawn from a random stream.

A builder takes a generator and returns convex pieces whose union is the object, in its own unit
(about 1 for the largest extent; the caller normalises), z up, in its natural pose. The kinds are
chosen to be told apart by what passes in the middle half of their height, from any side: smooth
columns of three widths, ribs, teeth, posts, seats, rungs, an overhang, wings.
"""

from itertools import pairwise

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.solids import (
    ROUND,
    bar,
    box,
    hull,
    lathe,
    ring,
    rod,
    slab,
    tube,
    wall,
)


def bottle(rng: Generator) -> list[Trimesh]:
    """A slender body, a shoulder, a neck with a lip."""
    u = rng.uniform
    r, body, shoulder = u(0.13, 0.2), u(0.48, 0.64), u(0.1, 0.24)
    neck, waist, lip = r * u(0.3, 0.42), u(0.82, 1.0), u(0.035, 0.06)
    roundness = u(0.6, 1.4)  # below 1 a sloping wine shoulder, above it a square one
    profile = [(0.9 * r, 0.0), (r, 0.03), (waist * r, 0.5 * body), (r, body)]
    for t in (1 / 3, 2 / 3, 1.0):
        fall = (1 - np.cos(np.pi * t)) / 2
        profile.append((r + (neck - r) * fall**roundness, body + shoulder * t))
    top = max(body + shoulder + 0.08, u(0.9, 1.0))
    return [
        *lathe([*profile, (0.95 * neck, top)]),
        *lathe([(1.3 * neck, top), (1.3 * neck, top + lip)]),
    ]


def bowl(rng: Generator) -> list[Trimesh]:
    """A wide open cup on a small foot."""
    u = rng.uniform
    foot, height, thick = u(0.17, 0.25), u(0.3, 0.46), u(0.05, 0.075)
    straight = u(0.0, 0.6)  # between a quarter ellipse and a cone
    t = np.linspace(0, 1, 5)
    r = foot + (0.5 - foot) * ((1 - straight) * np.sin(t * np.pi / 2) + straight * t)
    z = height * ((1 - straight) * (1 - np.cos(t * np.pi / 2)) + straight * t)
    profile = [(float(a), float(b)) for a, b in zip(r, z, strict=True)]
    floor = lathe([(0.9 * foot, -u(0.025, 0.06)), (foot, thick)])
    return [*floor, *wall(profile[:3], thick), *wall(profile[2:], thick)]


def _ribbed(
    base: tuple[float, float, float], height: float, radius: float, ribs: int
) -> list[Trimesh]:
    """A column of star section with a domed top: blades crossed on one axis, two ribs a blade."""
    blades, pieces = ribs // 2, []
    half = 0.55 * radius * np.sin(np.pi / ribs)
    dome = [(1.0, 0.0), (1.0, height - 0.8 * radius), (0.75, height - 0.25 * radius), (0.3, height)]
    for b in range(blades):
        c, s = np.cos(np.pi * b / blades), np.sin(np.pi * b / blades)
        points = [
            (base[0] + x * c - y * s, base[1] + x * s + y * c, base[2] + z)
            for k, z in dome
            for x in (-k * radius, k * radius)
            for y in (-half, half)
        ]
        pieces.append(hull(points))
    return pieces


def cactus(rng: Generator) -> list[Trimesh]:
    """A ribbed column with one to three ribbed arms bent upward."""
    u = rng.uniform
    radius, arms = u(0.11, 0.16), int(rng.integers(1, 4))
    pieces = _ribbed((0, 0, 0), 1.0, radius, int(rng.choice([8, 10])))
    first = u(0, 2 * np.pi)
    for a in range(arms):
        turn = first + 2 * np.pi * a / max(arms, 2) + u(-0.3, 0.3)
        thin, reach, z = radius * u(0.55, 0.75), radius + u(0.12, 0.2), u(0.3, 0.5)
        out = np.array([np.cos(turn), np.sin(turn)])
        elbow = (*(reach * out), z)
        pieces.append(rod((0, 0, z), elbow, 0.85 * thin))
        base = (elbow[0], elbow[1], z - 0.85 * thin)
        pieces += _ribbed(base, u(0.25, 0.85 - z + 0.1), thin, 6)
    return pieces


def car(rng: Generator) -> list[Trimesh]:
    """A low body with a cabin, on four wheels: saloon, estate, van or pickup."""
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


def chair(rng: Generator) -> list[Trimesh]:
    """Four legs, a seat at half height, an open or closed back."""
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
        """x of the leaning back at height z."""
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


def dumbbell(rng: Generator) -> list[Trimesh]:
    """A bar lying flat with a weight at either end: a cut prism, plates or a ball."""
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
    """A thick toothed ring lying flat."""
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


def ladder(rng: Generator) -> list[Trimesh]:
    """A stepladder: treads between leaning front rails, two back legs, a cap."""
    u = rng.uniform
    bottom, reach, rail = u(0.4, 0.52), u(0.2, 0.3), u(0.03, 0.04)
    top, depth, back = bottom * u(0.6, 0.8), u(0.07, 0.11), u(0.16, 0.26)

    def front(side: float, z: float) -> tuple[float, float, float]:
        """A point of the front rails at height z; side -1 to 1 across."""
        return (-0.04 - reach * (1 - z), side * (bottom + (top - bottom) * z) / 2, z)

    def rear(side: float, z: float) -> tuple[float, float, float]:
        """The same on the back legs."""
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
    """A flat base, a thin pole, a wide open shade."""
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


def mug(rng: Generator) -> list[Trimesh]:
    """A thick hollow cylinder with a handle at one side."""
    u = rng.uniform
    low, high, thick = u(0.32, 0.42), u(0.35, 0.43), u(0.05, 0.075)
    middle = max(low, high) * u(1.0, 1.06) if rng.random() < 0.4 else (low + high) / 2
    pieces = lathe([(low - thick, 0), (low - thick, u(0.06, 0.1))])
    pieces += wall([(low, 0), (middle, 0.5), (high, 1)], thick)
    radius, out, square = u(0.04, 0.06), u(0.22, 0.32), u(0.5, 1.0)
    centre, half = u(0.48, 0.56), u(0.22, 0.32)
    path = []
    for a in np.linspace(0, np.pi, 7):
        z = centre + half * np.sign(np.cos(a)) * abs(np.cos(a)) ** square
        side = low + (high - low) * z if a in (0.0, np.pi) else low
        path.append((side - thick / 2 + out * np.sin(a) ** square, 0, z))
    return [*pieces, *tube(path, radius)]


def plane(rng: Generator) -> list[Trimesh]:
    """An airliner in level flight: fuselage, swept wings, tail, engines under the wings."""
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
        """A tapered plate from the middle line to its tip, the leading edges at x and tip."""
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
    """A circle of the fuselage at x, its middle at height z."""
    circle = ring(radius, 0.0, 16)
    return np.column_stack([np.full(16, x), circle[:, 0], z + circle[:, 1]])


def table(rng: Generator) -> list[Trimesh]:
    """A wide top on three to six legs."""
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
