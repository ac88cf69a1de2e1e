"""Furniture of any plan, from one leg to five, from bars to blocks."""

from itertools import pairwise

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import (
    Points,
    ball,
    bar,
    box,
    hull,
    lathe,
    ring,
    rod,
    slab,
    wall,
)


def _build_plate(rng: Generator, x: float, y: float, low: float, high: float) -> Trimesh:
    """Build a horizontal plate: a rectangle with more or less cut corners, or an oval."""
    if rng.random() < 0.3:
        return hull(ring(x / 2, low, squash=y / x), ring(x / 2, high, squash=y / x))
    cut = rng.uniform(0.005, 0.3) * min(x, y) / 2
    return hull(slab(x, y, low, cut), slab(x, y, high, cut))


def _build_supports(rng: Generator, x: float, y: float, high: float, solid: float) -> list[Trimesh]:
    """Build supports of an x by y plate: legs, foot, runners, panels or block."""
    u = rng.uniform
    if rng.random() < solid:
        inset = u(0.8, 1.0)
        kind = rng.integers(4)
        if kind == 0:  # a block
            return [box((0, 0, high / 2), (x * inset, y * inset, high))]
        thick = u(0.04, 0.3) * y
        sides = [
            box((0, side * (y * inset - thick) / 2, high / 2), (x * inset, thick, high))
            for side in (-1, 1)
        ]
        if kind == 1:  # two panels
            return sides
        if kind == 2:  # two panels and one across behind them
            return [*sides, box((-0.4 * x * inset, 0, high / 2), (0.06, y * inset, high))]
        rail = box((0, 0, high * u(0.3, 0.9)), (0.06, y * inset, 0.08))
        return [*sides, rail]
    legs = int(rng.integers(1, 6))
    thick, end = u(0.025, 0.09), u(0.5, 1.3)
    round_ = rng.random() < 0.5

    def leg(top: tuple[float, float], foot: tuple[float, float]) -> Trimesh:
        if round_:
            return rod((*top, high + 0.005), (*foot, 0), thick / 2, end * thick / 2)
        return bar((*top, high + 0.005), (*foot, 0), thick, thick, end)

    if legs == 1:  # a column on a disc, a cross or a cone
        column = u(0.03, 0.12)
        reach = u(0.3, 0.55) * min(x, y)
        pieces = [rod((0, 0, 0), (0, 0, high), column, u(0.6, 1.4) * column)]
        kind = rng.integers(3)
        if kind == 0:
            return [*pieces, *lathe([(reach, 0), (u(0.3, 1) * reach, u(0.03, 0.08))])]
        if kind == 1:
            turns = 2 * np.pi * np.arange(n := int(rng.integers(3, 6))) / n
            tips = [(reach * np.cos(a), reach * np.sin(a), 0.02) for a in turns]
            return pieces + [bar((0, 0, u(0.03, 0.12)), tip, 0.05, 0.05, 0.7) for tip in tips]
        return [*pieces, *lathe([(reach, 0), (column, u(0.15, 0.5) * high)])]
    splay, inset = u(-0.05, 0.25), u(0.75, 0.98)
    a, b = (x - thick) / 2 * inset, (y - thick) / 2 * inset
    if legs == 2:  # two posts on feet
        feet = []
        for side in (-1, 1):
            feet.append(leg((0, side * b), (0, side * b)))
            feet.append(box((0, side * b, 0.02), (x * inset, thick, 0.04)))
        return feet
    if legs == 4:
        spots = np.array([(i * a, j * b) for i in (-1, 1) for j in (-1, 1)])
    else:
        angle = u(0, 2 * np.pi) + 2 * np.pi * np.arange(legs) / legs
        spots = 0.85 * np.column_stack([a * np.cos(angle), b * np.sin(angle)])
    pieces = [leg((p, q), (p * (1 + splay), q * (1 + splay))) for p, q in spots]
    if legs == 4 and rng.random() < 0.4:  # rails between them
        z = u(0.1, 0.9) * high
        for side in (-1, 1):
            pieces.append(bar((-a, side * b, z), (a, side * b, z), 0.03, u(0.03, 0.12)))
            if rng.random() < 0.5:
                pieces.append(bar((side * a, -b, z), (side * a, b, z), 0.03, u(0.03, 0.12)))
    return pieces


def chair(rng: Generator) -> list[Trimesh]:
    """Build a seat on any supports, with any kind of back, perhaps with arms."""
    u = rng.uniform
    wide, deep, seat = u(0.36, 0.75), u(0.34, 0.7), u(0.25, 0.5)
    thick, lean, top = u(0.025, 0.2), u(-0.02, 0.2), u(0.65, 1.1)
    pieces = [_build_plate(rng, deep, wide, seat, seat + thick)]
    pieces += _build_supports(rng, deep, wide, seat + 0.01, 0.3)
    back, post = -deep / 2 + 0.03, u(0.03, 0.08)

    def at(side: float, z: float) -> tuple[float, float, float]:
        """Return a point of the tilted backrest at height z; `side` is -1 to 1."""
        x = back - lean * (z - seat) / (top - seat)
        return (x, side * (wide - post) / 2 * 0.95, z)

    kind = rng.integers(5)
    low = seat + thick * u(0.0, 1.0)
    if kind == 0:  # a solid back
        pieces.append(bar(at(0, low), at(0, top), u(0.02, 0.16), wide * u(0.7, 1.0), u(0.7, 1)))
    elif kind == 1:  # a plate on posts
        gap = seat + thick + u(0.05, 0.5) * (top - seat - thick)
        pieces += [bar(at(j, seat), at(j, top), post, post) for j in (-1, 1)]
        pieces.append(bar(at(0, gap), at(0, top), u(0.02, 0.05), wide * 0.9))
    elif kind == 2:  # rails
        pieces += [bar(at(j, seat), at(j, top), post, post) for j in (-1, 1)]
        for z in np.linspace(
            min(seat + thick + 0.1, top - 0.06), top - 0.04, int(rng.integers(1, 5))
        ):
            pieces.append(bar(at(-1, z), at(1, z), 0.03, u(0.03, 0.1)))
    elif kind == 3:  # spindles
        pieces += [
            rod(at(s, seat), at(0.9 * s, top - 0.03), 0.014, sides=8)
            for s in np.linspace(-1, 1, int(rng.integers(3, 8)))
        ]
        pieces.append(bar(at(-1, top - 0.04), at(1, top - 0.04), 0.04, u(0.05, 0.12)))
    else:  # a hoop, or the round back of a tub
        turns = np.linspace(np.pi / 2, 3 * np.pi / 2, 7)
        high = u(0.5, 1.0) * (top - seat)
        rim: list[Points] = [
            np.array([(deep / 2 * np.cos(a), wide / 2 * np.sin(a), z) for z in (low, seat + high)])
            for a in turns
        ]
        inner = u(0.7, 0.92)
        for a, b in pairwise(rim):
            pieces.append(hull(a, b, a * (inner, inner, 1), b * (inner, inner, 1)))
    if rng.random() < 0.35:
        z, width = seat + thick + u(0.08, 0.25), u(0.03, 0.12)
        for side in (-1, 1):
            y = side * (wide - width) / 2
            if rng.random() < 0.4:  # filled
                pieces.append(box((0, y, (seat + z) / 2), (deep * 0.9, width, z - seat)))
            else:
                pieces.append(box((0, y, z), (deep * 0.95, width, 0.035)))
                pieces.append(box((deep * 0.4, y, (seat + z) / 2), (0.035, 0.035, z - seat)))
    return pieces


def table(rng: Generator) -> list[Trimesh]:
    """Build a plate on any supports, perhaps with a shelf, drawers or a frame."""
    u = rng.uniform
    deep, high, thick = u(0.4, 1.0), u(0.25, 0.9), u(0.02, 0.12)
    pieces = [_build_plate(rng, 1.0, deep, high - thick, high)]
    pieces += _build_supports(rng, 0.95, 0.95 * deep, high - thick, 0.3)
    if rng.random() < 0.2:  # a board below
        pieces.append(box((0, 0, u(0.1, 0.6) * high), (0.9, 0.93 * deep, 0.03)))
    if rng.random() < 0.2:  # drawers under one side
        tall = u(0.2, 0.9) * (high - thick)
        pieces.append(box((0.3, 0, high - thick - tall / 2), (0.3, 0.85 * deep, tall)))
    if rng.random() < 0.25:  # a frame
        size = (0.85, 0.85 * deep, u(0.05, 0.15))
        pieces.append(box((0, 0, high - thick - size[2] / 2), size))
    return pieces


def ladder(rng: Generator) -> list[Trimesh]:
    """Build two rails with rungs, upright or leaning, or a pair that stand together."""
    u = rng.uniform
    wide, reach, rail = u(0.2, 0.5), u(0.0, 0.35), u(0.025, 0.06)
    narrow, rungs = u(0.6, 1.0), int(rng.integers(3, 11))
    round_, double = rng.random() < 0.5, rng.random() < 0.5

    def at(side: float, z: float, out: float) -> tuple[float, float, float]:
        return (out * reach * (1 - z), side * wide / 2 * (1 - (1 - narrow) * z), z)

    pieces = []
    for out in (1, -1) if double else (1,):
        for side in (-1, 1):
            pieces.append(bar(at(side, 0, out), at(side, 1, out), rail, u(0.6, 1.6) * rail))
        for z in np.arange(1, rungs + 1) / (rungs + 1):
            ends = at(-1, z, out), at(1, z, out)
            deep = u(0.02, 0.08)
            pieces.append(rod(*ends, 0.4 * rail, sides=8) if round_ else bar(*ends, deep, 0.025))
        if double and out < 0 and rng.random() < 0.5:
            break
    return pieces


def lamp(rng: Generator) -> list[Trimesh]:
    """Build a lamp: shade or ball on a pole, street lamp, desk lamp or lantern."""
    u = rng.uniform
    pole, base = u(0.012, 0.05), u(0.08, 0.28)
    foot = u(0.02, 0.1)
    pieces = (
        [box((0, 0, foot / 2), (1.7 * base, 1.7 * base, foot))]
        if rng.random() < 0.35
        else lathe([(base, 0), (base * u(0.2, 1.0), foot)])
    )
    kind = rng.integers(5)
    if kind == 0:  # a shade: open, of any slope, on a pole or a fat body
        low, rim = u(0.4, 0.75), u(0.14, 0.36)
        body = u(0.06, 0.2) if rng.random() < 0.4 else pole
        waist = u(0.4, 1.2)
        pieces += lathe([(body, 0), (waist * body, 0.5 * low), (0.5 * body, low + 0.02)])
        pieces.append(rod((0, 0, low - 0.02), (0, 0, 0.97), pole))
        crown = rim * u(0.25, 1.1)
        pieces += (
            lathe([(rim, low), (crown, 1.0)])
            if rng.random() < 0.5
            else [
                *wall([(rim, low), (crown, 1.0)], 0.04),
                box((0, 0, 0.95), (2 * crown, 0.04, 0.04)),
            ]
        )
    elif kind == 1:  # a ball
        r = u(0.1, 0.24)
        pieces += [rod((0, 0, 0), (0, 0, 1 - r), pole), ball((0, 0, 1 - r), r)]
    elif kind == 2:  # a street lamp: one arm or two, a head at the end
        arm, drop = u(0.15, 0.45), u(-0.05, 0.12)
        pieces.append(rod((0, 0, 0), (0, 0, 1), 1.4 * pole, pole))
        for side in (1,) if rng.random() < 0.6 else (-1, 1):
            tip = (side * arm, 0, 1 - drop)
            pieces.append(rod((0, 0, 0.97), tip, 0.8 * pole))
            size = (u(0.12, 0.25), u(0.07, 0.14), u(0.04, 0.1))
            pieces.append(box(tip, size))
    elif kind == 3:  # a desk lamp: two arms, a hood
        knee = (-u(0.0, 0.25), 0, u(0.4, 0.7))
        head = (u(0.1, 0.4), 0, u(0.6, 0.95))
        pieces += [rod((0, 0, 0), knee, pole), rod(knee, head, pole)]
        r, out = u(0.09, 0.18), np.array([u(0.0, 0.7), 0, -1.0])
        out *= u(0.12, 0.25) / np.linalg.norm(out)
        pieces.append(rod(head, np.array(head) + out, 0.4 * r, r, sides=16))
    else:  # a lantern, on a post or on its foot
        low = u(0.0, 0.7)
        wide, high = u(0.12, 0.3) * (1 - 0.5 * low), (1 - low) * u(0.6, 0.75)
        pieces.append(rod((0, 0, 0), (0, 0, max(low, 0.05)), 1.3 * pole))
        pieces.append(box((0, 0, low + high / 2), (1.5 * wide, 1.5 * wide, high)))
        if rng.random() < 0.6:  # posts that stand proud of the glass
            for i in (-1, 1):
                for j in (-1, 1):
                    pieces.append(
                        box((i * wide, j * wide, low + high / 2), (0.25 * wide, 0.25 * wide, high))
                    )
        roof = slab(2.4 * wide, 2.4 * wide, low + high)
        pieces.append(hull(roof, slab(0.3 * wide, 0.3 * wide, 1.0)))
    return pieces
