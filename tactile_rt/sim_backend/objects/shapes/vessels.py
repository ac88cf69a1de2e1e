"""Vessels of revolution, with or without a spout or a handle."""

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import lathe, rod, tube, wall


def bottle(rng: Generator) -> list[Trimesh]:
    """Build a slender body, a shoulder and a neck with a lip."""
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
    """Build a wide open cup on a small foot."""
    u = rng.uniform
    foot, height, thick = u(0.17, 0.25), u(0.3, 0.46), u(0.05, 0.075)
    straight = u(0.0, 0.6)  # between a quarter ellipse and a cone
    t = np.linspace(0, 1, 5)
    r = foot + (0.5 - foot) * ((1 - straight) * np.sin(t * np.pi / 2) + straight * t)
    z = height * ((1 - straight) * (1 - np.cos(t * np.pi / 2)) + straight * t)
    profile = [(float(a), float(b)) for a, b in zip(r, z, strict=True)]
    floor = lathe([(0.9 * foot, -u(0.025, 0.06)), (foot, thick)])
    return [*floor, *wall(profile[:3], thick), *wall(profile[2:], thick)]


def goblet(rng: Generator) -> list[Trimesh]:
    """Build a round foot, a stem with a knob and a deep cup.

    By touch: a thin stem below a round cup that overhangs it and grows wider upward.
    """
    u = rng.uniform
    foot, stem, rim = u(0.19, 0.27), u(0.03, 0.045), u(0.27, 0.36)
    low, thick, swell = u(0.36, 0.5), u(0.045, 0.06), u(0.85, 1.05)
    pieces = lathe([(foot, 0), (0.96 * foot, 0.035), (stem, u(0.08, 0.13))])
    pieces.append(rod((0, 0, 0.05), (0, 0, low + 0.02), stem, sides=16))
    knob, z = stem * u(1.6, 2.4), low * u(0.45, 0.75)
    pieces += lathe([(stem, z - knob), (knob, z), (stem, z + knob)])
    belly = low + 0.3 * (1 - low)
    pieces += lathe([(1.2 * stem, low), (0.62 * rim, low + 0.07)])
    profile = [(0.62 * rim, low + 0.06), (swell * 0.95 * rim, belly), (rim, 1.0)]
    return [*pieces, *wall(profile[:2], thick), *wall(profile[1:], thick)]


def mug(rng: Generator) -> list[Trimesh]:
    """Build a thick hollow cylinder with a handle at one side."""
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


def teapot(rng: Generator) -> list[Trimesh]:
    """Build a round belly with a spout, a handle opposite and a lid.

    By touch: a ball with a rising spout on one side and an open loop on the other.
    """
    u = rng.uniform
    radius, tall, base = u(0.27, 0.33), u(0.46, 0.6), u(0.55, 0.75)
    angles = np.radians([-90 * base, -30, 0, 30, 62])
    belly = [(radius * np.cos(a), 0.5 * tall * np.sin(a)) for a in angles]
    top = belly[-1][1]
    pieces = lathe(belly)
    pieces += lathe([(0.9 * belly[-1][0], top), (0.3 * radius, top + u(0.03, 0.07))])
    pieces += lathe([(0.16 * radius, top + 0.02), (0.2 * radius, top + u(0.1, 0.14))], sides=12)
    thick, tip, rise = u(0.075, 0.1), u(0.03, 0.045), u(0.75, 1.15)
    elbow = (radius + u(0.03, 0.06), 0, u(-0.05, 0.02))
    mouth = (elbow[0] + u(0.06, 0.11), 0, rise * top)
    pieces += [
        rod((0.7 * radius, 0, -0.12), elbow, thick, 0.7 * thick),
        rod(elbow, mouth, 0.7 * thick, tip),
    ]
    out, half, round_ = u(0.15, 0.21), 0.5 * tall * u(0.55, 0.75), u(0.6, 1.0)
    path = []
    for a in np.linspace(0, np.pi, 7):
        z = 0.04 + half * np.cos(a)
        side = radius * 0.82 if a in (0.0, np.pi) else radius * 0.9
        path.append((-side - out * np.sin(a) ** round_, 0, z))
    return [*pieces, *tube(path, u(0.03, 0.042))]
