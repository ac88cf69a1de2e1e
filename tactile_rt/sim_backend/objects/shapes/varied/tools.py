"""Handheld objects of any plan."""

from itertools import pairwise

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import ROUND, ball, box, hull, lathe, rod, tube, wall


def birdcage(rng: Generator) -> list[Trimesh]:
    """Build wires round a floor, few or many, under a dome, cone or lid."""
    u = rng.uniform
    wires, r, wire = int(rng.integers(5, 15)), u(0.2, 0.48), u(0.012, 0.032)
    eave, top, lean = u(0.4, 0.85), u(0.85, 1.0), u(-0.25, 0.25)
    square, lid, dome = rng.random() < 0.25, rng.random() < 0.3, u(0.3, 0.95)
    floor, high = r + u(0.0, 0.08), u(0.03, 0.14)
    if square:
        pieces = [box((0, 0, high / 2), (1.5 * floor, 1.5 * floor, high))]
    else:
        pieces = lathe([(floor, 0), (floor, high)])
    for turn in 2 * np.pi * (np.arange(wires) + 0.5) / wires:
        c, s = np.cos(turn), np.sin(turn)
        if square:  # onto the sides of a square
            c, s = np.array([c, s]) / max(abs(c), abs(s)) * 0.74
        foot, knee = (r * c, r * s, 0.02), ((1 - lean) * r * c, (1 - lean) * r * s, eave)
        if lid:
            pieces.append(rod(foot, knee, wire, sides=8))
            continue
        bend = (dome * knee[0] * 0.7, dome * knee[1] * 0.7, eave + 0.7 * (top - eave))
        pieces += tube([foot, knee, bend, (0.02 * c, 0.02 * s, top)], wire, sides=6)
    if lid:
        wide = (1 - lean) * r + 0.02
        pieces += lathe([(wide, eave), (wide * u(0.05, 1.0), eave + u(0.03, 0.3))], 16)
    for z in np.linspace(high, eave, int(rng.integers(0, 3)) + 2)[1:-1]:  # hoops
        pieces += [] if square else wall([(r + wire, z), (r + wire, z + 2 * wire)], 2 * wire)
    if rng.random() < 0.6:
        pieces.append(ball((0, 0, (eave if lid else top) + 0.02), u(0.03, 0.08)))
    return pieces


def dumbbell(rng: Generator) -> list[Trimesh]:
    """Build a bar between two weights of any outline and number of sides."""
    u = rng.uniform
    r, grip, inner = u(0.12, 0.34), u(0.02, 0.08), u(0.08, 0.34)
    sides = int(rng.choice([4, 6, 8, ROUND, ROUND]))
    plates = int(rng.integers(1, 4))
    edges = np.linspace(inner, 0.5 if rng.random() < 0.6 else 0.46, plates + 1)
    shrink, cut, domed = u(0.6, 1.15), u(0.0, 0.05), rng.random() < 0.25
    pieces = [rod((-0.5, 0, 0), (0.5, 0, 0), grip, sides=12)]
    if rng.random() < 0.3:  # a swelling grip
        pieces += [rod((0, 0, 0), (s * inner, 0, 0), 1.6 * grip, grip, sides=12) for s in (-1, 1)]
    for side in (-1, 1):
        if domed:
            pieces.append(ball((side * (0.5 - r), 0, 0), r))
            continue
        for k, (a, b) in enumerate(pairwise(edges)):
            here, gap = r * shrink**k, 0.015 * (plates > 1)
            middle = (side * (a + b) / 2, 0, 0)
            for end in (a, b - gap):
                pieces.append(rod(middle, (side * end, 0, 0), here, max(here - cut, grip), sides))
    return pieces


def gear(rng: Generator) -> list[Trimesh]:
    """Build a thin or thick toothed wheel, teeth square or pointed, spoked or whole."""
    u = rng.uniform
    teeth, half, root = int(rng.integers(6, 22)), u(0.06, 0.3), u(0.3, 0.45)
    hole, twist = u(0.05, 0.8) * root, u(-0.2, 0.2)
    pitch = 2 * np.pi / teeth
    foot, tip = pitch * u(0.2, 0.32), pitch * u(0.02, 0.22)
    pieces = wall([(root, -half), (root, half)], max(root - hole, 0.06))
    for k in range(teeth):
        points = [
            (r * np.cos(a), r * np.sin(a), z)
            for z, shift in ((-half, -twist / 2), (half, twist / 2))
            for r, spread in ((0.93 * root, foot), (0.5, tip))
            for a in (k * pitch + shift - spread, k * pitch + shift + spread)
        ]
        pieces.append(hull(points))
    hub = u(0.05, 0.12)
    if hole > 2 * hub:  # a hub on spokes
        pieces += lathe([(hub, -half), (hub, half)], 12)
        for a in 2 * np.pi * np.arange(n := int(rng.integers(3, 7))) / n:
            end = (0.95 * hole * np.cos(a), 0.95 * hole * np.sin(a), 0)
            pieces.append(rod((0, 0, 0), end, 0.04, sides=8))
    elif rng.random() < 0.4:  # an axle
        hub = max(hub, 1.05 * hole)
        pieces += lathe([(hub, -half - u(0.0, 0.3)), (hub, half + u(0.0, 0.3))], 12)
    return pieces


def hourglass(rng: Generator) -> list[Trimesh]:
    """Build two bulbs joined by a neck, between end plates, perhaps with posts."""
    u = rng.uniform
    plate, thick, neck = u(0.18, 0.42), u(0.02, 0.12), u(0.025, 0.12)
    bulb, full, shoulder, curve = plate * u(0.7, 1.0), u(0.4, 0.9), u(0.4, 1.0), u(0.15, 0.7)
    half, sides = 0.5 - thick, int(rng.choice([4, 6, ROUND, ROUND]))
    outline = [(neck, 0.0), (max(curve * bulb, neck), 0.2 * half), (bulb, full * half)]
    outline.append((shoulder * bulb, half))
    pieces = []
    for side in (-1, 1):
        pieces += lathe([(r, side * z) for r, z in outline])
        pieces += lathe([(plate, side * (half - 0.01)), (plate * u(0.8, 1), side * 0.5)], sides)
    if rng.random() < 0.4:
        at = 0.9 * plate
        for a in 2 * np.pi * np.arange(n := int(rng.integers(3, 5))) / n:
            x, y = at * np.cos(a), at * np.sin(a)
            pieces.append(rod((x, y, -half), (x, y, half), u(0.015, 0.035), sides=8))
    return pieces


def spring(rng: Generator) -> list[Trimesh]:
    """Build a coil of few or many turns, thin or thick, straight, conical or waisted."""
    u = rng.uniform
    turns, r, wire = u(2.0, 5.5), u(0.18, 0.48), u(0.025, 0.085)
    turns = min(turns, 0.8 / (2.2 * wire))
    cone, waist, hand = u(-0.25, 0.25), u(-0.4, 0.3), rng.choice([-1, 1])
    t = np.linspace(0, 1, round(6.6 * turns) + 1)
    angle = u(0, 2 * np.pi) + hand * 2 * np.pi * turns * t
    radius = r * (1 + cone * (t - 0.5)) * (1 + waist * (1 - np.abs(2 * t - 1)))
    path = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), u(0.5, 0.95) * t])
    return tube(list(path), wire, sides=8)
