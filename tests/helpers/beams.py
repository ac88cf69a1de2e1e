"""Beam theory, worked out independently of the simulator: what a whisker must do.

Euler-Bernoulli for stiffness, resonance and sag, the planar elastica for large bends over a peg,
with numpy and scipy alone. In mm, N and s (so mass in tonnes); the whisker lies in the x-y plane,
leaves its clamp at the origin along +x and curves towards +y. It touches with its surface, which
is a radius off the centreline and leans towards it by the taper.
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial
from numpy.typing import NDArray
from scipy.integrate import quad, solve_bvp, solve_ivp
from scipy.linalg import eigh
from scipy.optimize import brentq, fsolve

Floats = NDArray[np.float64]


def about(axis: Any, angle: float) -> Floats:
    """(3, 3) Rodrigues' rotation about a unit axis."""
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k)


class Cone(Protocol):
    """What theory needs to know of a whisker, see `whiskers.Whisker`."""

    length: float
    curvature: float
    base_radius: float
    tip_radius: float
    young_modulus: float
    density_base: float
    density_tip: float


def radius(cone: Cone, s: Floats | float) -> Floats:
    """Radius (mm) at arc length s (mm)."""
    taper = (cone.tip_radius - cone.base_radius) / cone.length
    return np.asarray(cone.base_radius + taper * np.asarray(s))


def taper(cone: Cone) -> float:
    """How far the surface leans from the centreline towards the tip, rad."""
    return math.atan((cone.base_radius - cone.tip_radius) / cone.length)


def bending(cone: Cone, s: Floats | float) -> Floats:
    """E I (N mm^2)."""
    return cone.young_modulus * 1e-6 * np.pi / 4 * radius(cone, s) ** 4


def line_mass(cone: Cone, s: Floats | float) -> Floats:
    """Mass per length (t/mm)."""
    gradient = (cone.density_tip - cone.density_base) / cone.length
    return (cone.density_base + gradient * np.asarray(s)) * 1e-12 * np.pi * radius(cone, s) ** 2


def abscissa(cone: Cone, s: float) -> float:
    """x (mm) of the resting parabola y = a x^2 at arc length s (mm)."""
    k = 2 * abs(cone.curvature)
    if k * s < 1e-7:
        return s

    def arc(x: float) -> float:
        return x * math.sqrt(1 + (k * x) ** 2) / 2 + math.asinh(k * x) / (2 * k) - s

    return float(brentq(arc, 0.0, s, xtol=1e-14))


def compliance(cone: Cone, axis: int) -> float:
    """Deflection of the tip (mm) per force on it (N) along y (1) or z (2), by unit load."""
    a, end = cone.curvature, abscissa(cone, cone.length)

    def energy(s: float) -> float:
        x = abscissa(cone, s)
        if axis == 1:
            lever = end - x
        else:  # out of its plane only bending gives way: the chain of hinges does not twist
            t = math.atan(2 * a * x)
            lever = (end - x) * math.cos(t) + a * (end**2 - x**2) * math.sin(t)
        return lever**2 / float(bending(cone, s))

    return float(quad(energy, 0, cone.length, epsrel=1e-9)[0])


def sag(cone: Cone, gravity: float) -> float:
    """Deflection of the tip (mm) along y under gravity (mm/s^2) along y, by unit load."""
    points, weights = np.polynomial.legendre.leggauss(40)
    length, end = cone.length, abscissa(cone, cone.length)

    def energy(s: float) -> float:
        x = abscissa(cone, s)
        rest = s + (points + 1) / 2 * (length - s)
        levers = np.array([abscissa(cone, r) for r in rest]) - x
        moment = gravity * float(weights @ (line_mass(cone, rest) * levers)) * (length - s) / 2
        return moment * (end - x) / float(bending(cone, s))

    u, w = np.polynomial.legendre.leggauss(60)
    s = (u + 1) / 2 * length
    return float(w @ np.array([energy(at) for at in s]) * length / 2)


def resonance(cone: Cone, axis: int = 1, cells: int = 2000) -> float:
    """First resonance (Hz) of the clamped cone along y (1) or z (2), by Rayleigh-Ritz.

    An inextensible curved beam: every point turns by what is bent between it and the clamp. Along
    z the beam bends about its own normal and does not twist, as chains of two hinges do.
    """
    u = (np.arange(cells) + 0.5) / cells
    s, ds = u * cone.length, cone.length / cells
    slope = np.arctan(2 * cone.curvature * np.array([abscissa(cone, at) for at in s]))
    cos, sin = np.cos(slope), np.sin(slope)

    def along(rate: Floats) -> Floats:  # the integral from the clamp to every midpoint
        return (np.cumsum(rate) - rate / 2) * ds

    shapes = [
        Polynomial([0, 1]) * Chebyshev.basis(k, domain=[0, 1]).convert(kind=Polynomial)
        for k in range(12)
    ]
    bent = np.array([p.deriv()(u) / cone.length for p in shapes])
    if axis == 1:
        turned = [p(u) for p in shapes]
        moved = np.array([[along(-t * sin), along(t * cos)] for t in turned])
    else:
        normal = [(along(-b * sin), along(b * cos)) for b in bent]
        moved = np.array([[along(x * sin - y * cos)] for x, y in normal])
    stiffness = (bent * bending(cone, s)) @ bent.T * ds
    inertia = np.einsum("ias,s,jas->ij", moved, line_mass(cone, s) * ds, moved)
    return float(np.sqrt(eigh(stiffness, inertia, eigvals_only=True)[0]) / (2 * np.pi))


@dataclass(frozen=True)
class Peg:
    """A rigid peg along z pressed on a whisker, sliding along it so slowly that all is balanced."""

    side: int  # +1: from above, on the concave side of a curved whisker; -1: from below
    x: float  # of its centre, mm
    depth: float  # how far along y it has moved past first touch, mm
    # coulomb coefficient, with a sign: positive when the peg slides distally, so that it drags the
    # whisker along its length, negative when proximally
    friction: float = 0.0
    radius: float = 1.0  # mm


@dataclass(frozen=True)
class Bent:
    """An elastica on a peg."""

    centre: Floats  # (2,) of the peg, mm
    s: float  # arc length at the contact, mm
    direction: float  # of the whisker there, rad
    normal: float  # normal force, N
    force: Floats  # (2,) on the whisker, N
    moment: float  # that it exerts on the clamp, N mm
    contact: Floats  # (2,) point where the surfaces touch, mm


def touching(cone: Cone, peg: Peg) -> tuple[float, float]:
    """Arc length of first touch of the resting whisker (mm), and the peg's y there (mm)."""
    a = cone.curvature

    def place(s: float) -> tuple[float, float]:
        x = abscissa(cone, s)
        t = math.atan(2 * a * x)
        lean = t - peg.side * taper(cone)  # of the surface
        thick = float(radius(cone, s))
        return (
            x - peg.side * (thick * math.sin(t) + peg.radius * math.sin(lean)),
            a * x * x + peg.side * (thick * math.cos(t) + peg.radius * math.cos(lean)),
        )

    s = float(brentq(lambda s: place(s)[0] - peg.x, 0.0, cone.length, xtol=1e-13))
    return s, place(s)[1]


class _Ends:
    """What the peg does to the whisker, given where it touches, the direction and the force."""

    def __init__(self, cone: Cone, peg: Peg, centre: Floats, unknown: Floats) -> None:
        self.s, self.direction, self.push = (float(u) for u in unknown)
        lean = self.direction - peg.side * taper(cone)  # of the surface
        normal = np.array([-math.sin(lean), math.cos(lean)])
        tangent = np.array([math.cos(lean), math.sin(lean)])
        across = np.array([-math.sin(self.direction), math.cos(self.direction)])
        arm = peg.side * float(radius(cone, self.s)) * across  # from the centreline to the surface
        self.force = self.push * (-peg.side * normal + peg.friction * tangent)
        self.moment = float(arm[0] * self.force[1] - arm[1] * self.force[0])
        self.contact = centre - peg.side * peg.radius * normal
        self.point = self.contact - arm


def _rates(cone: Cone, s: float, state: Floats, force: Floats) -> list[float]:
    """d/ds of x, y, direction, moment, and the abscissa of the resting whisker."""
    _, _, direction, moment, rest = state
    a2 = 2 * cone.curvature
    slope2 = 1 + (a2 * rest) ** 2
    cos, sin = math.cos(direction), math.sin(direction)
    return [
        cos,
        sin,
        a2 / slope2**1.5 + moment / float(bending(cone, s)),
        force[0] * sin - force[1] * cos,
        1 / math.sqrt(slope2),
    ]


def _shoot(cone: Cone, ends: _Ends, tolerance: float = 1e-11) -> Floats:
    """x, y, direction, moment at the clamp, integrating back from the contact."""
    start = [*ends.point, ends.direction, ends.moment, abscissa(cone, ends.s)]
    path = solve_ivp(
        lambda s, y: _rates(cone, s, y, ends.force),
        (ends.s, 0.0),
        start,
        method="DOP853",
        rtol=tolerance,
        atol=1e-13,
    )
    return np.asarray(path.y[:4, -1])


def press(cone: Cone, peg: Peg) -> Bent:
    """Solve the elastica over a peg by shooting, from first touch to the depth.

    Three unknowns at the contact (arc length, direction, normal force) carry the whisker back to
    its clamp; the force leans from the normal by the angle of friction. ArithmeticError if no
    solution is found.
    """
    s, y = touching(cone, peg)
    scale = float(bending(cone, s / 2)) / s**2  # of the force, N
    unknown = np.array([s, math.atan(2 * cone.curvature * abscissa(cone, s)), 0.0])
    step = np.zeros(3)
    for share in np.linspace(0, 1, 6)[1:]:
        centre = np.array([peg.x, y - peg.side * share * peg.depth])

        def missed(u: Floats, centre: Floats = centre) -> Floats:
            return _shoot(cone, _Ends(cone, peg, centre, u * (1, 1, scale)))[:3] / (s, s, 1)

        found, info, _, why = fsolve(missed, unknown + step, xtol=1e-12, full_output=True)
        if abs(info["fvec"]).max() > 1e-9:
            raise ArithmeticError(f"no elastica for {peg} at {share:.2f} of its depth: {why}")
        unknown, step = found, found - unknown
    ends = _Ends(cone, peg, centre, unknown * (1, 1, scale))
    moment = float(_shoot(cone, ends)[3])
    return Bent(centre, ends.s, ends.direction, ends.push, ends.force, moment, ends.contact)


def outline(cone: Cone, peg: Peg, bent: Bent) -> Floats:
    """(200, 2) points of the bent centreline from clamp to tip, mm."""
    ends = _Ends(cone, peg, bent.centre, np.array([bent.s, bent.direction, bent.normal]))
    rest = abscissa(cone, bent.s)
    start = [*ends.point, ends.direction, ends.moment, rest]
    inner = np.linspace(bent.s, 0, 150)
    path = solve_ivp(
        lambda s, y: _rates(cone, s, y, ends.force), (bent.s, 0), start, "DOP853", inner, rtol=1e-9
    )
    turn = ends.direction - math.atan(2 * cone.curvature * rest)  # the rest is free: it only turns
    x = np.array([abscissa(cone, s) for s in np.linspace(bent.s, cone.length, 51)[1:]])
    away = np.array([x - rest, cone.curvature * (x**2 - rest**2)])
    cos, sin = math.cos(turn), math.sin(turn)
    outer = ends.point[:, None] + np.array([[cos, -sin], [sin, cos]]) @ away
    return np.concatenate([path.y[:2, ::-1].T, outer.T])


def slides(peg: Peg, before: Bent, after: Bent) -> float:
    """How far the peg's surface slides distally along the whisker's (mm) between two places."""
    # where the contact goes on the whisker, less where it goes on the peg
    return (after.s - before.s) - peg.side * peg.radius * (after.direction - before.direction)


def collocate(cone: Cone, peg: Peg, guess: Bent) -> tuple[float, float, float]:
    """The same elastica as a boundary-value problem, by collocation (scipy's `solve_bvp`).

    Args:
        guess: where to start from; spoilt by a per cent first.

    Returns:
        Arc length at the contact (mm), normal force (N), moment on the clamp (N mm).
    """
    unit = abs(guess.moment)

    def ends(p: Floats) -> _Ends:
        unknown = np.array([p[0], p[2], p[1] * guess.normal])
        return _Ends(cone, peg, guess.centre, unknown)

    def rates(u: Floats, y: Floats, p: Floats) -> Floats:
        force, a2 = ends(p).force / unit, 2 * cone.curvature
        slope2 = 1 + (a2 * y[4]) ** 2
        cos, sin = np.cos(y[2]), np.sin(y[2])
        bend = a2 / slope2**1.5 + y[3] * unit / bending(cone, p[0] * u)
        return p[0] * np.array([cos, sin, bend, force[0] * sin - force[1] * cos, slope2**-0.5])

    def bounds(start: Floats, end: Floats, p: Floats) -> Floats:
        there = ends(p)
        held = np.array([*start[:3], start[4]])
        met = np.array([*(end[:2] - there.point), end[2] - p[2], end[3] - there.moment / unit])
        return np.concatenate([held, met])

    u = np.linspace(0, 1, 41)
    x, y = guess.contact[0] * u, guess.contact[1] * u**2
    moment = np.sign(guess.moment) * (1 - u)
    start = np.array([x, y, guess.direction * u, moment, x])
    unknown = [1.01 * guess.s, 1.01, 0.99 * guess.direction]
    found = solve_bvp(rates, bounds, u, start, p=unknown, tol=1e-9, max_nodes=50_000)
    if not found.success:
        raise ArithmeticError(found.message)
    return float(found.p[0]), float(found.p[1] * guess.normal), float(found.y[3, 0] * unit)


def straight(cone: Any) -> Any:
    """The same whisker without its curve."""
    return replace(cone, curvature=0.0)
