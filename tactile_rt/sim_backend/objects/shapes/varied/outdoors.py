"""Buildings and what grows or stands outside, of any plan."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.shapes import outdoors as plain
from tactile_rt.sim_backend.objects.solids import (
    ROUND,
    ball,
    box,
    hull,
    lathe,
    ring,
    rod,
    shift_points,
    slab,
)


def cactus(rng: Generator) -> list[Trimesh]:
    """Build a column or a barrel, ribbed or smooth, with none to four arms."""
    u = rng.uniform
    if rng.random() < 0.3:
        return plain.cactus(rng)
    r, top = u(0.07, 0.2), u(0.6, 1.0)
    pieces = lathe(
        [(0.8 * r, 0), (r, 0.1), (r, top - 0.9 * r), (0.7 * r, top - 0.3 * r), (0.2 * r, top)]
    )
    if rng.random() < 0.5:
        n = int(rng.integers(5, 11))
        for a in 2 * np.pi * np.arange(n) / n:
            at = (0.93 * r * np.cos(a), 0.93 * r * np.sin(a))
            pieces.append(rod((*at, 0), (*at, top - r), u(0.12, 0.25) * r, sides=6))
    for _ in range(int(rng.integers(0, 5))):
        a, out, z, thin = u(0, 2 * np.pi), r + u(0.06, 0.25), u(0.2, 0.65) * top, u(0.4, 0.9) * r
        tip = (out * np.cos(a), out * np.sin(a), z + u(0.0, 0.1))
        pieces.append(rod((0, 0, z), tip, 0.9 * thin))
        pieces.append(rod(tip, (*tip[:2], min(tip[2] + u(0.1, 0.4), 1.0)), thin, 0.7 * thin))
    if rng.random() < 0.3:  # in a pot
        pot = u(1.1, 2.0) * r
        pieces += lathe([(0.7 * pot, -u(0.1, 0.3)), (pot, 0.02)])
    return pieces


def castle(rng: Generator) -> list[Trimesh]:
    """Build round or square towers joined by walls, with or without a keep."""
    u = rng.uniform
    towers, r = int(rng.integers(2, 7)), u(0.07, 0.17)
    high, curtain, aspect = u(0.35, 0.95), u(0.4, 0.95), u(0.6, 1.0)
    angle = u(0, 2 * np.pi) + 2 * np.pi * np.arange(towers) / towers
    reach = 0.5 - r
    spots = [(reach * np.cos(a), aspect * reach * np.sin(a)) for a in angle]
    square, top = rng.random() < 0.4, rng.integers(4)
    pieces, thick = [], u(0.04, 0.12)
    for k, (x, y) in enumerate(spots):
        tall = high * u(0.75, 1.25)
        sides = 4 if square else ROUND
        body = shift_points(ring(r, 0, sides), x, y)
        pieces.append(hull(body, shift_points(body, z=tall)))
        if top == 0:  # a spire
            eave = shift_points(ring(u(1.0, 1.3) * r, tall, sides), x, y)
            pieces.append(hull(eave, [(x, y, tall + u(0.1, 0.35))]))
        elif top == 1:  # a parapet
            edge = shift_points(ring(1.2 * r, tall - 0.02, sides), x, y)
            pieces.append(hull(edge, shift_points(edge, z=u(0.05, 0.12))))
        elif top == 2:  # battlements
            for a in 2 * np.pi * (np.arange(4) + 0.5) / 4:
                at = (x + 0.75 * r * np.cos(a), y + 0.75 * r * np.sin(a), tall + 0.03)
                pieces.append(box(at, (0.4 * r, 0.4 * r, 0.08)))
        p, q = spots[(k + 1) % towers], (x, y)
        along = np.array([p[0] - q[0], p[1] - q[1]])
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along) * thick / 2
        foot = np.array([(*(np.array(e) + s * across), 0.0) for e in (p, q) for s in (-1, 1)])
        pieces.append(hull(foot, shift_points(foot, z=curtain * high)))
    if rng.random() < 0.5:  # a keep
        side, tall = u(0.2, 0.6) * aspect, u(0.6, 1.4) * high
        keep = slab(side, side, 0.0)
        pieces.append(hull(keep, shift_points(keep, z=tall)))
        if rng.random() < 0.4:
            pieces.append(hull(slab(1.2 * side, 1.2 * side, tall), [(0, 0, tall + u(0.1, 0.3))]))
    if rng.random() < 0.4:
        pieces.append(
            hull(ring(0.5, -u(0.02, 0.15), squash=aspect), ring(0.5, 0.01, squash=aspect))
        )
    return pieces


def grapes(rng: Generator) -> list[Trimesh]:
    """Build a slender or broad bunch of few or many, small or large berries."""
    u = rng.uniform
    berry, wide, rounds = u(0.08, 0.18), u(0.15, 0.36), int(rng.integers(3, 7))
    z, turn, pieces = 0.0, u(0, 2 * np.pi), []
    for k in range(rounds):
        r = wide * (1 - (k / rounds) ** u(0.8, 2.0) * 0.85)
        count = max(2, round(2 * np.pi * r / (1.9 * berry)))
        turn += np.pi / count
        for a in turn + 2 * np.pi * np.arange(count) / count:
            at = np.array([r * np.cos(a), r * np.sin(a), z]) + u(-0.02, 0.02, 3)
            pieces.append(ball(at, berry * u(0.85, 1.1)))
        z -= berry * u(1.2, 1.7)
    pieces.append(ball((0, 0, z + 0.4 * berry), berry))
    pieces.append(rod((0, 0, z + berry), (0, 0, 0), 0.5 * wide, 0.85 * wide))
    if rng.random() < 0.8:
        pieces.append(rod((0, 0, 0), (u(-0.1, 0.1), 0, u(0.12, 0.35)), u(0.02, 0.05), sides=8))
    return pieces[:60]


def house(rng: Generator) -> list[Trimesh]:
    """Build one or two blocks of one to five floors: gabled, hipped, sloped or flat."""
    u = rng.uniform

    def block(x: float, y: float, long: float, wide: float, wall: float) -> list[Trimesh]:
        found = [box((x, y, wall / 2), (long, wide, wall))]
        kind, eave = rng.integers(4), u(0.0, 0.1)
        rise, thick = u(0.1, 0.4), u(0.0, 0.05)
        edge = shift_points(slab(long + 2 * eave, wide + 2 * eave, wall - thick), x, y)
        rim = shift_points(edge, z=thick + 0.005)
        if kind == 0:  # a gable, along or across
            ends = [(x + s * (long / 2 + eave), y, wall + rise) for s in (-1, 1)]
            if rng.random() < 0.4:
                ends = [(x, y + s * (wide / 2 + eave), wall + rise) for s in (-1, 1)]
            found.append(hull(edge, rim, ends))
        elif kind == 1:  # a hip, or a pyramid
            half = u(0.0, 0.6) * long / 2
            found.append(hull(edge, rim, [(x + s * half, y, wall + rise) for s in (-1, 1)]))
        elif kind == 2:  # one slope
            high = [
                (x + s * (long / 2 + eave), y + wide / 2 + eave, wall + 0.6 * rise) for s in (-1, 1)
            ]
            found.append(hull(edge, rim, high))
        else:  # flat, with a rim or things on it
            if rng.random() < 0.6:
                found.append(hull(edge, shift_points(edge, z=0.03 + thick)))
            for _ in range(int(rng.integers(0, 3))):
                at = (x + u(-0.3, 0.3) * long, y + u(-0.3, 0.3) * wide)
                size = (u(0.06, 0.3, 3) * (long, wide, 0.5)).tolist()
                found.append(box((*at, wall + size[2] / 2), size))
        return found

    floors = int(rng.choice([1, 1, 2, 2, 3, 5]))
    long, wide = u(0.4, 1.0), u(0.35, 0.8)
    wall = floors * u(0.2, 0.34)
    pieces = block(0, 0, long, wide, wall)
    if rng.random() < 0.4:  # a wing, lower or as high
        w, d = u(0.2, 0.6) * long, u(0.2, 0.6) * wide
        at = u(-0.4, 0.4) * long
        pieces += block(at, -wide / 2 - 0.3 * d, w, d, u(0.4, 1.0) * wall)
    if rng.random() < 0.4:  # a chimney
        x, y, side = u(-0.4, 0.4) * long, u(-0.3, 0.3) * wide, u(0.06, 0.14)
        tall = wall + u(0.2, 0.5)
        pieces.append(box((x, y, tall / 2), (side, side, tall)))
    if rng.random() < 0.25:  # a door that stands proud, a porch, steps
        x, size = u(-0.2, 0.2), (u(0.1, 0.3), u(0.03, 0.15), 0.24)
        pieces.append(box((x, wide / 2 + size[1] / 2 - 0.005, 0.12), size))
    if rng.random() < 0.25:  # the ground that it stands on
        deep = u(0.03, 0.1)
        pieces.append(box((0, 0, 0.005 - deep / 2), (1.25 * long, 1.25 * wide, deep)))
    return pieces


def mushroom(rng: Generator) -> list[Trimesh]:
    """Build one to three mushrooms, each a cap of any slope on a stem."""
    u = rng.uniform
    count = int(rng.choice([1, 1, 1, 2, 3]))
    pieces = lathe([(0.55, -0.05), (0.5, 0.01)]) if count > 1 else []  # the ground
    for k in range(count):
        size = 1.0 if k == 0 else u(0.35, 0.75)
        turn = u(0, 2 * np.pi)
        at = np.array([np.cos(turn), np.sin(turn), 0.0]) * (0.0 if k == 0 else u(0.25, 0.45))
        stem, foot, low, dome = u(0.05, 0.22), u(0.7, 2.0), u(0.2, 0.75), u(0.1, 0.5)
        wide, power, under = u(0.25, 0.5), u(0.6, 1.8), u(0.0, 0.1)
        profile = [(foot * stem, 0.0), (stem, 0.4 * low), (u(0.7, 1.1) * stem, low + 0.04)]
        cap = [
            (wide * np.cos(a), low + under + dome * np.sin(a) ** power)
            for a in np.radians([0, 20, 40, 60, 80])
        ]
        for solid in [*lathe(profile), *lathe([(u(0.3, 0.9) * wide, low), *cap])]:
            pieces.append(hull(solid.vertices * size + at))
    return pieces


def pagoda(rng: Generator) -> list[Trimesh]:
    """Build two to seven storeys, polygonal or round, each under its own roof."""
    u = rng.uniform
    storeys, sides = int(rng.integers(2, 8)), int(rng.choice([4, 4, 6, 8, ROUND]))
    wide, shrink, jut, room = u(0.18, 0.4), u(0.75, 1.0), u(1.15, 1.9), u(0.3, 0.7)
    turn, z, pieces = np.pi / sides, 0.0, []
    high = u(0.8, 1.0) / sum(shrink**k for k in range(storeys))
    for k in range(storeys):
        r, h = wide * shrink**k, high * shrink**k
        wall = [ring(r, z - 0.01, sides, turn=turn), ring(r, z + room * h, sides, turn=turn)]
        pieces.append(hull(*wall))
        z += room * h
        eave = [
            ring(jut * r, z, sides, turn=turn),
            ring(jut * r, z + u(0.01, 0.04), sides, turn=turn),
        ]
        pieces.append(hull(*eave, ring(u(0.5, 0.95) * r, z + (1 - room) * h, sides, turn=turn)))
        z += (1 - room) * h
    if rng.random() < 0.6:
        pieces.append(rod((0, 0, z - 0.05), (0, 0, z + u(0.05, 0.25)), 0.03, 0.015, sides=8))
    if rng.random() < 0.4:
        base = ring(u(1.1, 1.6) * wide, -u(0.02, 0.1), sides, turn=turn)
        pieces.append(hull(base, shift_points(base * (1, 1, 0), z=0.01)))
    return pieces


def pumpkin(rng: Generator) -> list[Trimesh]:
    """Build a smooth, faintly creased or deeply lobed body, perhaps with a stalk."""
    u = rng.uniform
    squash, deep = u(0.5, 1.1), u(0.0, 0.12) if rng.random() < 0.6 else u(0.12, 0.3)
    lobes = int(rng.integers(5, 13))
    levels = np.radians([-80, -50, -20, 10, 40, 70])
    power, dent = u(0.6, 1.0), u(0.0, 0.15)
    pieces = []
    # each lobe is a wedge: its middle stands out, its sides are the creases
    for k in range(lobes):
        points = [(0.0, 0.0, squash * 0.5 * (1 - dent) * s) for s in (-1, 1)]
        for level in levels:
            r, z = 0.5 * np.cos(level) ** power, 0.5 * squash * np.sin(level)
            for t, out in ((-0.5, 1 - deep), (-0.2, 1.0), (0.2, 1.0), (0.5, 1 - deep)):
                a = 2 * np.pi * (k + t) / lobes
                points.append((out * r * np.cos(a), out * r * np.sin(a), z))
        pieces.append(hull(points))
    if rng.random() < 0.75:
        top = 0.45 * squash
        tip = (u(-0.12, 0.12), 0, top + u(0.06, 0.25))
        pieces.append(rod((0, 0, top - 0.1), tip, u(0.03, 0.08), u(0.02, 0.05), sides=8))
    return pieces


def snowman(rng: Generator) -> list[Trimesh]:
    """Build two or three balls of any size, perhaps with hat, scarf and arms."""
    u = rng.uniform
    balls = int(rng.choice([2, 3, 3]))
    radii = u(0.2, 0.34) * np.cumprod([1.0, *u(0.62, 0.95, balls - 1)])
    z, middles, sink = u(0.6, 1.0) * radii[0], [], u(0.65, 0.92)
    for k, r in enumerate(radii):
        z += sink * (radii[k - 1] + r) if k else 0.0
        middles.append(float(z))
    pieces = [ball((0, 0, m), r) for m, r in zip(middles, radii, strict=True)]
    head, r = middles[-1], float(radii[-1])
    if rng.random() < 0.6:
        brim = head + u(0.6, 0.85) * r
        pieces += lathe([(u(0.9, 1.4) * r, brim), (u(0.9, 1.4) * r, brim + 0.03)], 16)
        pieces += lathe([(0.75 * r, brim), (u(0.1, 0.8) * r, brim + u(0.08, 0.25))], 16)
    if rng.random() < 0.3:  # a scarf
        neck = (middles[-1] + middles[-2]) / 2 + 0.2 * r
        pieces += lathe([(0.9 * r, neck), (0.9 * r, neck + u(0.04, 0.1))], 16)
    if rng.random() < 0.6:
        pieces.append(rod((0.8 * r, 0, head), (r + u(0.04, 0.2), 0, head), 0.035, 0.01, 8))
    if rng.random() < 0.7:
        z, body = middles[-2] + 0.2 * radii[-2], radii[-2]
        for side in (-1, 1):
            hand = (u(-0.1, 0.15), side * (body + u(0.06, 0.25)), z + u(-0.15, 0.25))
            pieces.append(rod((0, side * 0.7 * body, z), hand, u(0.015, 0.05), 0.018, sides=8))
    return pieces
