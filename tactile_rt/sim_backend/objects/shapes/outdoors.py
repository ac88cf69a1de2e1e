"""Outdoor objects: buildings, and what grows or stands in a garden, a wood or a desert."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import ROUND, ball, box, hull, lathe, ring, rod


def _build_column(
    base: tuple[float, float, float], height: float, radius: float, ribs: int
) -> list[Trimesh]:
    """Build a domed column of star section from crossed blades, two ribs per blade."""
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


def beehive(rng: Generator) -> list[Trimesh]:
    """Build a straw skep: stacked coils narrowing to a closed top, perhaps on a stand.

    By touch: round ridges, level and close, each a little behind the one below.
    """
    u = rng.uniform
    coils, wide, tall = int(rng.integers(6, 9)), u(0.36, 0.46), u(0.8, 0.9)
    high, waist, blunt = tall / coils, u(0.8, 0.87), u(2.2, 3.2)
    pieces = lathe([(1.12 * wide, -0.09), (1.12 * wide, 0.01)]) if rng.random() < 0.5 else []
    for k in range(coils):
        r = wide * (1 - ((k + 0.2) / coils) ** blunt * 0.8)
        z = k * high
        rounds = [(waist, 0.0), (1.0, 0.3), (1.0, 0.7), (waist, 1.0)]
        pieces.append(hull(*(ring(r * q, z + t * high, 12) for q, t in rounds)))
    pieces.append(ball((0, 0, tall), 0.09))
    return pieces


def cactus(rng: Generator) -> list[Trimesh]:
    """Build a ribbed column with one to three ribbed arms bent upward."""
    u = rng.uniform
    radius, arms = u(0.11, 0.16), int(rng.integers(1, 4))
    pieces = _build_column((0, 0, 0), 1.0, radius, int(rng.choice([8, 10])))
    first = u(0, 2 * np.pi)
    for a in range(arms):
        turn = first + 2 * np.pi * a / max(arms, 2) + u(-0.3, 0.3)
        thin, reach, z = radius * u(0.55, 0.75), radius + u(0.12, 0.2), u(0.3, 0.5)
        out = np.array([np.cos(turn), np.sin(turn)])
        elbow = (*(reach * out), z)
        pieces.append(rod((0, 0, z), elbow, 0.85 * thin))
        base = (elbow[0], elbow[1], z - 0.85 * thin)
        pieces += _build_column(base, u(0.25, 0.85 - z + 0.1), thin, 6)
    return pieces


def castle(rng: Generator) -> list[Trimesh]:
    """Build curtain walls between four round towers under pointed or flat tops.

    By touch: a round column at each corner of a flat wall that stands back between them.
    """
    u = rng.uniform
    tower, aspect, high, curtain = u(0.1, 0.15), u(0.7, 1.0), u(0.55, 0.75), u(0.6, 0.8)
    x, y = 0.5 - tower, aspect * (0.5 - tower)
    thick, pointed, roof = u(0.06, 0.09), rng.random() < 0.5, u(0.12, 0.22)
    pieces = []
    for i in (-1, 1):
        for j in (-1, 1):
            at = (i * x, j * y)
            pieces.append(rod((*at, 0), (*at, high), tower, u(0.88, 1.0) * tower, sides=ROUND))
            if pointed:
                pieces.append(rod((*at, high), (*at, high + roof), 1.15 * tower, 0.02, sides=16))
            else:
                pieces.append(rod((*at, high - 0.02), (*at, high + 0.08), 1.2 * tower, sides=16))
        pieces.append(box((i * x, 0, curtain * high / 2), (thick, 2 * y, curtain * high)))
        pieces.append(box((0, i * y, curtain * high / 2), (2 * x, thick, curtain * high)))
    if rng.random() < 0.5:  # a keep
        side = y * u(0.7, 1.0)
        pieces.append(box((0, 0, 0.55 * high), (side, side, 1.1 * high)))
        pieces.append(box((0, 0, 0.03), (2 * x, 2 * y, 0.06)))
    return pieces


def grapes(rng: Generator) -> list[Trimesh]:
    """Build a bunch on a stalk: layers of berries, fewer in each lower layer.

    By touch: small round bumps on all sides, above and beside one another, no flat between.
    """
    u = rng.uniform
    berry, wide, taper = u(0.115, 0.145), u(0.23, 0.29), u(0.55, 0.8)
    rounds, turn = 4, u(0, 2 * np.pi)
    step, z, pieces = berry * u(1.35, 1.5), 0.0, []
    for k, count in enumerate((6, 5, 4, 3) if rng.random() < 0.5 else (5, 5, 4, 3)):
        r = wide * (1 - (1 - taper) * k / (rounds - 1)) - 0.06 * (k == rounds - 1)
        turn += np.pi / count
        for a in turn + 2 * np.pi * np.arange(count) / count:
            size = berry * u(0.9, 1.1)
            berry_at = np.array([r * np.cos(a), r * np.sin(a), z]) + u(-0.015, 0.015, 3)
            pieces.append(ball(berry_at, size))
        z -= step
    pieces.append(ball((0, 0, z + 0.3 * step), berry))
    top = u(0.2, 0.3)
    pieces.append(rod((0, 0, z + 0.3 * step), (0, 0, 0.02), 0.8 * wide * taper, 0.9 * wide))
    pieces.append(rod((0, 0, 0), (u(-0.05, 0.05), 0, top), 0.04, 0.03, sides=8))
    return pieces


def house(rng: Generator) -> list[Trimesh]:
    """Build walls under a gabled roof with eaves and a chimney, perhaps a wing.

    By touch: a flat wall, an edge that juts out over it, a slope that recedes above.
    """
    u = rng.uniform
    wide, wall, ridge = u(0.6, 0.8), u(0.34, 0.46), u(0.24, 0.36)
    eave, gable, thick = u(0.08, 0.12), u(0.06, 0.1), 0.035
    long = 1 - 2 * gable

    def roof(x: float, y: float, length: float, width: float, rise: float) -> Trimesh:
        """Build a solid gable along x with its eaves at the top of the walls."""
        a, b = length / 2, width / 2
        low = [
            (x + i * a, y + j * b, wall - k) for i in (-1, 1) for j in (-1, 1) for k in (0, thick)
        ]
        return hull(low, [(x + i * a, y, wall + rise) for i in (-1, 1)])

    pieces = [box((0, 0, wall / 2), (long, wide, wall)), roof(0, 0, 1.0, wide + 2 * eave, ridge)]
    x, y = u(-0.3, 0.3), wide * u(0.1, 0.25)
    pieces.append(box((x, y, wall + ridge / 2), (0.1, 0.09, ridge + u(0.08, 0.18))))
    if rng.random() < 0.5:  # a wing at right angles, as a smaller gable
        x, out, half = u(-0.25, 0.25), wide / 2 + u(0.08, 0.14), u(0.12, 0.18)
        pieces.append(box((x, -out / 2, wall / 2), (2 * half, out, wall)))
        low = [
            (x + i * (half + eave), -y, wall - k)
            for i in (-1, 1)
            for y in (0.0, out + gable)
            for k in (0, thick)
        ]
        pieces.append(hull(low, [(x, -y, wall + 0.7 * ridge) for y in (0.0, out + gable)]))
    return pieces


def mushroom(rng: Generator) -> list[Trimesh]:
    """Build a wide round cap on a thick stem.

    By touch: a broad rim with nothing below it but a stem far behind, and a dome above.
    """
    u = rng.uniform
    stem, foot, low, dome = u(0.12, 0.19), u(1.1, 1.5), u(0.26, 0.38), u(0.3, 0.42)
    point = u(0.8, 1.3)
    cap = [
        (0.5 * np.cos(a), low + 0.05 + dome * np.sin(a) ** point)
        for a in np.radians([0, 20, 40, 60, 78])
    ]
    return [
        *lathe([(foot * stem, 0), (stem, 0.4 * low), (0.95 * stem, low + 0.04)]),
        *lathe([(0.4, low), *cap]),
    ]


def pagoda(rng: Generator) -> list[Trimesh]:
    """Build a tower of storeys under wide roofs with thin eaves, and a spire.

    By touch: square shelves that jut far out one above the other, drawing in upward.
    """
    u = rng.uniform
    storeys, sides = int(rng.integers(4, 6)), int(rng.choice([4, 4, 6]))
    wide, shrink, jut = u(0.27, 0.36), u(0.9, 0.97), u(1.4, 1.7)
    room = u(0.4, 0.55)  # share of a storey that is wall
    pieces, z, high = [], 0.0, 0.88 / sum(shrink**k for k in range(storeys))
    for k in range(storeys):
        r, h = wide * shrink**k, high * shrink**k
        turn = np.pi / sides
        body = [ring(0.85 * r, z - 0.02 * (k > 0), sides, turn=turn)]
        pieces.append(hull(*body, ring(0.85 * r, z + room * h + 0.01, sides, turn=turn)))
        z += room * h
        eave = [ring(jut * r, z, sides, turn=turn), ring(jut * r, z + 0.025, sides, turn=turn)]
        pieces.append(hull(*eave, ring(0.8 * r, z + (1 - room) * h, sides, turn=turn)))
        z += (1 - room) * h
    pieces.append(rod((0, 0, z - 0.03), (0, 0, 1.0), 0.035, 0.02, sides=8))
    return pieces


def pumpkin(rng: Generator) -> list[Trimesh]:
    """Build six to eight fat lobes round a core, with a stalk.

    By touch: broad smooth bulges side by side, a crease running up between each two.
    """
    u = rng.uniform
    lobes, out, squash = int(rng.integers(6, 9)), u(0.24, 0.29), u(0.75, 1.05)
    radius, lean = 0.5 - out, u(-0.06, 0.06)
    wide = out * np.tan(np.pi / lobes) * u(1.25, 1.5)  # half a lobe's width, with an overlap
    pieces = []
    for turn in 2 * np.pi * np.arange(lobes) / lobes:
        c, s = np.cos(turn), np.sin(turn)
        egg = ball((0, 0, 0), 1.0).vertices * (radius, 1.3 * wide, squash * 0.44)
        egg = egg + np.array([out, 0, 0])
        egg[:, 0] += lean * egg[:, 2]
        pieces.append(hull(egg @ np.array([(c, s, 0), (-s, c, 0), (0, 0, 1)])))
    top = 0.4 * squash
    pieces += lathe([(0.8 * out, -0.8 * top), (0.8 * out, 0.8 * top)], sides=16)
    bend = u(-0.06, 0.06)
    pieces.append(rod((0, 0, 0.7 * top), (bend, 0, top + u(0.08, 0.16)), 0.06, 0.04, sides=8))
    return pieces


def snowman(rng: Generator) -> list[Trimesh]:
    """Build three balls, smaller upward, with a hat, a nose and stick arms.

    By touch: round bulges with a deep crease between them, and a twig at either side.
    """
    u = rng.uniform
    radii = np.cumprod([u(0.24, 0.29), u(0.8, 0.9), u(0.72, 0.82)])
    sink = u(0.78, 0.88)
    pieces, z = [], 0.8 * radii[0]
    middles = []
    for k, r in enumerate(radii):
        z += sink * (radii[k - 1] + r) if k else 0.0
        middles.append(float(z))
        pieces.append(ball((0, 0, z), r))
    head, r = middles[2], float(radii[2])
    brim = head + 0.72 * r
    pieces += lathe([(1.15 * r, brim), (1.15 * r, brim + 0.033)], sides=16)
    pieces += lathe([(0.72 * r, brim), (u(0.65, 0.8) * r, brim + u(0.1, 0.18))], sides=16)
    pieces.append(rod((0.8 * r, 0, head), (r + u(0.06, 0.12), 0, head - 0.01), 0.035, 0.02, 8))
    for side in (-1, 1):
        shoulder = (0, side * 0.7 * radii[1], middles[1] + 0.2 * radii[1])
        hand = (u(-0.05, 0.08), side * (radii[1] + u(0.12, 0.2)), middles[1] + u(0.05, 0.2))
        pieces.append(rod(shoulder, hand, 0.024, 0.018, sides=8))
    return pieces
