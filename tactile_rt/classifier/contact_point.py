"""Contact position along a whisker from the loads at its base: classical mechanical estimates.

A contact at r from the base that pushes with F loads the base with F and M = r x F. So the contact
lies on a known line, and the shape of the whisker determines where on it:

- straight: where a straight whisker crosses the line (Birdwell et al. 2007, J. Neurophysiol. 98:
  2439; Solomon & Hartmann 2006, Nature 443: 525): transverse moment over transverse force;
- resting: the point of the undeflected, curved whisker that comes nearest to the line;
- bent: the whisker as these loads bend it, integrated from the base to where its bending moment
  has fallen to zero (Scholz & Rahn 2004, IEEE Trans. Robot. Autom. 20: 124; in three dimensions
  as Huet et al. 2017, IEEE Trans. Robot. 33: 1031). It needs the stiffness as well.

All use the whole force, friction included, and neglect inertia.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError

Floats = NDArray[np.float64]

POINTS = 64  # segments of a whisker
TWICE = 0.02  # of the moment: a second minimum along the whisker must be deeper by more than this
AT_ONCE = 20_000  # loads per batch, to bound memory
SHARPEST = 0.3  # rad that a segment may bend: beyond it, noise would coil up a thin tip


@dataclass(frozen=True)
class WhiskerShapes:
    """Shapes and stiffnesses of an array's whiskers: (element,) arrays in SI units.

    The whisker leaves its base along x of its frame and follows y = curvature x^2.

    Attributes:
        length: (element,) Arc length from base to tip, m.
        curvature: (element,) Curvature a of the resting parabola y = a x^2, 1/m.
        base_radius, tip_radius: (element,) Radii of the cone at its base and at its tip, m.
        young_modulus: (element,) Young's modulus of the whisker's material, Pa.

    Raises:
        ConfigError: A field does not have one finite value for each whisker.
    """

    length: Floats
    curvature: Floats
    base_radius: Floats
    tip_radius: Floats
    young_modulus: Floats

    def __post_init__(self) -> None:
        for name in ("length", "curvature", "base_radius", "tip_radius", "young_modulus"):
            values = np.asarray(getattr(self, name), dtype=np.float64)
            object.__setattr__(self, name, values)
            if values.shape != np.shape(self.length) or not np.isfinite(values).all():
                raise ConfigError(f"whisker shapes: {name} needs a finite value for each whisker")

    def __len__(self) -> int:
        return len(self.length)

    def abscissae(self, points: int = POINTS) -> Floats:
        """Compute x (element, points + 1) of the resting whiskers at equal arc-length steps, m."""
        share = np.linspace(0.0, 1.0, points + 1)
        fine = np.linspace(0.0, 1.0, 1001) * self.length[:, None]
        slope = 2 * self.curvature[:, None] * fine
        pieces = np.sqrt(1 + ((slope[:, 1:] + slope[:, :-1]) / 2) ** 2) * np.diff(fine)
        arc = np.concatenate([np.zeros((len(self), 1)), np.cumsum(pieces, axis=1)], axis=1)
        return np.stack(
            [np.interp(share * s, a, x) for s, a, x in zip(self.length, arc, fine, strict=True)]
        )


def straight(loads: Floats, element: NDArray[np.int64], shapes: WhiskerShapes) -> Floats:
    """Estimate the contact's distance (n,) from a straight whisker's base, m, within its length.

    Args:
        loads: (n, 6) The force (N) and moment (N m) at the base, in the whisker's frame.
        element: (n,) The index of the whisker.
    """
    force, moment = loads[:, 1:3], loads[:, 4:6]
    squared = (force**2).sum(axis=1)
    across = moment[:, 1] * force[:, 0] - moment[:, 0] * force[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(squared > 0, across / squared, 0.0)
    distance: Floats = np.clip(ratio, 0.0, shapes.length[element])
    return distance


def resting(loads: Floats, element: NDArray[np.int64], shapes: WhiskerShapes) -> Floats:
    """Estimate the arc length (n,), m, where the resting whisker is nearest the force's line.

    Args:
        loads, element, shapes: See `straight`.
    """
    x = shapes.abscissae()
    nodes = np.stack([x, shapes.curvature[:, None] * x**2, np.zeros_like(x)], axis=2)
    found = []
    for start in range(0, len(loads), AT_ONCE):
        some, who = loads[start : start + AT_ONCE], element[start : start + AT_ONCE]
        best, where = np.full(len(some), np.inf), np.zeros(len(some))
        for k in range(POINTS):
            left, at = _find_nearest(some, nodes[who, k], nodes[who, k + 1])
            where = np.where(left < best, k + at, where)
            best = np.minimum(best, left)
        found.append(where / POINTS * shapes.length[who])
    return np.concatenate(found) if found else np.zeros(0)


def bent(loads: Floats, element: NDArray[np.int64], shapes: WhiskerShapes) -> Floats:
    """Estimate the arc length (n,), m, where the bent whisker meets the force's line.

    Args:
        loads, element, shapes: See `straight`; the loads also bend the whisker.
    """
    x = shapes.abscissae()
    headings = np.arctan(2 * shapes.curvature[:, None] * x)
    found = []
    for start in range(0, len(loads), AT_ONCE):
        some, who = loads[start : start + AT_ONCE], element[start : start + AT_ONCE]
        force, moment = some[:, :3], some[:, 3:]
        step = shapes.length[who] / POINTS
        place, frame = np.zeros((len(some), 3)), np.tile(np.eye(3), (len(some), 1, 1))
        best, where = np.full(len(some), np.inf), np.zeros(len(some))
        nearing = np.ones(len(some), dtype=np.bool_)
        met = TWICE**2 * (moment**2).sum(axis=1)
        for k in range(POINTS):
            share = (k + 0.5) / POINTS
            radius = (shapes.base_radius + share * (shapes.tip_radius - shapes.base_radius))[who]
            stiffness = shapes.young_modulus[who] * np.pi * radius**4 / 4
            halfway = place + frame[:, :, 0] * step[:, None] / 2
            inside = np.einsum("nij,ni->nj", frame, moment - np.cross(halfway, force))
            turn = inside * (step / stiffness)[:, None]
            turn[:, 0] = 0.0  # the sensors' whiskers do not twist
            size = np.linalg.norm(turn, axis=1, keepdims=True)
            turn *= np.minimum(1.0, SHARPEST / np.maximum(size, SHARPEST))
            turn[:, 2] += headings[who, k + 1] - headings[who, k]
            middle = frame @ _make_rotations(turn / 2)
            further = place + middle[:, :, 0] * step[:, None]
            left, at = _find_nearest(some, place, further)
            # Beyond the contact the integrated curve is not real, and may cross the line again.
            nearing = (left < best) & (nearing | (left + met < best))
            where = np.where(nearing, k + at, where)
            best = np.where(nearing, left, best)
            place, frame = further, frame @ _make_rotations(turn)
        found.append(where / POINTS * shapes.length[who])
    return np.concatenate(found) if found else np.zeros(0)


ESTIMATES = {"straight": straight, "resting": resting, "bent": bent}


def _find_nearest(loads: Floats, near: Floats, far: Floats) -> tuple[Floats, Floats]:
    """Return the least |M - r x F|^2 (n,) on segments, and its relative position."""
    force, moment = loads[:, :3], loads[:, 3:]
    missing, gained = moment - np.cross(near, force), np.cross(far - near, force)
    squared = np.maximum((gained**2).sum(axis=1), np.finfo(float).tiny)
    at = np.clip((missing * gained).sum(axis=1) / squared, 0.0, 1.0)
    return ((missing - at[:, None] * gained) ** 2).sum(axis=1), at


def _make_rotations(turn: Floats) -> Floats:
    """Return the matrices (n, 3, 3) of rotation vectors (n, 3), rad (Rodrigues)."""
    angle = np.linalg.norm(turn, axis=1)[:, None, None]
    x, y, z = turn.T
    none = np.zeros_like(x)
    cross = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=1).reshape(-1, 3, 3)
    with np.errstate(invalid="ignore"):
        once = np.where(angle > 0, np.sin(angle) / angle, 1.0)
        twice = np.where(angle > 0, (1 - np.cos(angle)) / angle**2, 0.5)
    rotations: Floats = np.eye(3) + once * cross + twice * (cross @ cross)
    return rotations
