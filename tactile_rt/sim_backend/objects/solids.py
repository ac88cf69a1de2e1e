"""A tactile object, and the convex building blocks that objects are made of.

Lengths are in the caller's own unit; z is up. A block that is not convex (a tube, a hollow wall)
is returned as a list of convex pieces.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import trimesh

Points = npt.NDArray[np.float64]
Profile = Sequence[tuple[float, float]]  # (radius, z) from the bottom up

# A 24-sided polygon of 40 mm departs from its circle by 0.17 mm, less than a whisker resolves.
ROUND = 24


@dataclass(frozen=True)
class TactileObject:
    """A rigid object of convex pieces, centred at the origin, largest extent 1, z up."""

    name: str  # "mug-17", or the file's stem
    category: str  # "mug", or the file's stem for a mesh file
    pieces: tuple[trimesh.Trimesh, ...]  # convex, watertight, wound outward; union = the object
    surface_error: float = 0.0  # largest distance of the pieces from the mesh, in largest extents
    made_by: str = "drawn"  # origin of the pieces: drawn as such, or as in `meshes`


def fit_unit_box(pieces: Sequence[trimesh.Trimesh]) -> tuple[trimesh.Trimesh, ...]:
    """Return the pieces, centred at the origin and scaled together to largest extent 1."""
    corners = np.vstack([piece.bounds for piece in pieces])
    low, high = corners.min(axis=0), corners.max(axis=0)
    centre, scale = (low + high) / 2, 1 / (high - low).max()
    return tuple(
        trimesh.Trimesh((piece.vertices - centre) * scale, piece.faces, process=False)
        for piece in pieces
    )


def shift_points(points: Points, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Points:
    """Return points (n, 3) shifted by (x, y, z)."""
    shifted: Points = points + np.array([x, y, z])
    return shifted


def stretch_pieces(
    pieces: Sequence[trimesh.Trimesh], factors: npt.ArrayLike
) -> list[trimesh.Trimesh]:
    """Return the pieces scaled along x, y and z by positive factors."""
    return [
        trimesh.Trimesh(piece.vertices * np.asarray(factors), piece.faces, process=False)
        for piece in pieces
    ]


def hull(*points: npt.ArrayLike) -> trimesh.Trimesh:
    """Return the convex hull of one or more groups of points (n, 3)."""
    solid: trimesh.Trimesh = trimesh.convex.convex_hull(np.vstack(points))
    return solid


def ring(
    radius: float, z: float, sides: int = ROUND, squash: float = 1.0, turn: float = 0.0
) -> Points:
    """Return points (sides, 3) of a horizontal circle at height z, y scaled by `squash`."""
    angle = turn + np.arange(sides) * (2 * np.pi / sides)
    return np.column_stack(
        [radius * np.cos(angle), squash * radius * np.sin(angle), np.full(sides, z)]
    )


def slab(x: float, y: float, z: float, cut: float = 0.0, centre: float = 0.0) -> Points:
    """Return corners (8, 3) of an x by y rectangle at z, chamfered by `cut`."""
    a, b = x / 2, y / 2
    corners = [(a - cut, b), (a, b - cut), (a, cut - b), (a - cut, -b)]
    quarter = corners + [(-u, -v) for u, v in corners]
    return np.array([(centre + u, v, z) for u, v in quarter])


def box(centre: Sequence[float], size: Sequence[float]) -> trimesh.Trimesh:
    """Return an axis-aligned box from its centre and its sizes along x, y and z."""
    signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return hull(np.asarray(centre) + signs * np.asarray(size) / 2)


def ball(centre: npt.ArrayLike, radius: float) -> trimesh.Trimesh:
    """Return a ball of 48 corners, its flats at most 0.05 radii inside the sphere."""
    rings = [
        ring(np.cos(a), np.sin(a), 12, turn=(k % 2) * np.pi / 12)
        for k, a in enumerate(np.radians([-67.5, -22.5, 22.5, 67.5]))
    ]
    return hull(np.asarray(centre) + radius * np.vstack(rings))


def _find_section_axes(start: Points, end: Points) -> Points:
    """Return unit vectors (2, 3) across the line from start to end.

    For a steep line they are along x and y, for a flat line horizontal and upward, so that a
    rectangular section never rolls about its own axis.
    """
    along = (end - start) / np.linalg.norm(end - start)
    steep = abs(along[2]) > 0.8
    first = np.array([1.0, 0.0, 0.0]) if steep else np.cross([0.0, 0.0, 1.0], along)
    first = first - along * (first @ along)
    first /= np.linalg.norm(first)
    return np.array([first, np.cross(along, first)])


def _loft(start: npt.ArrayLike, end: npt.ArrayLike, one: Points, two: Points) -> trimesh.Trimesh:
    """Return the hull of cross-sections `one` and `two` (n, 2) at a line's ends."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    across = _find_section_axes(a, b)
    return hull(a + one @ across, b + two @ across)


def rod(
    start: npt.ArrayLike,
    end: npt.ArrayLike,
    radius: float,
    end_radius: float | None = None,
    sides: int = 12,
) -> trimesh.Trimesh:
    """Return a round bar from start to end, tapered if `end_radius` is given."""
    circle = ring(1.0, 0.0, sides)[:, :2]
    return _loft(start, end, radius * circle, (end_radius or radius) * circle)


def bar(
    start: npt.ArrayLike, end: npt.ArrayLike, width: float, height: float, taper: float = 1.0
) -> trimesh.Trimesh:
    """Return a rectangular bar, width by height, scaled by `taper` towards its end.

    `width` is the x side of a steep bar and the horizontal side of a flat one.
    """
    corners = np.array([(-1, -1), (-1, 1), (1, 1), (1, -1)]) * (width / 2, height / 2)
    return _loft(start, end, corners, taper * corners)


def tube(path: Sequence[npt.ArrayLike], radius: float, sides: int = 10) -> list[trimesh.Trimesh]:
    """Return round bars along a path, one per segment, overlapping at the bends."""
    points = np.asarray(path, float)
    steps = np.diff(points, axis=0)
    extra = 0.4 * radius * steps / np.linalg.norm(steps, axis=1, keepdims=True)
    return [
        rod(a - e, b + e, radius, sides=sides)
        for a, b, e in zip(points[:-1], points[1:], extra, strict=True)
    ]


def lathe(profile: Profile, sides: int = ROUND) -> list[trimesh.Trimesh]:
    """Return a solid of revolution: one frustum for each step of the profile."""
    return [
        hull(ring(r0, z0, sides), ring(r1, z1, sides)) for (r0, z0), (r1, z1) in pairwise(profile)
    ]


def wall(profile: Profile, thickness: float, segments: int = 8) -> list[trimesh.Trimesh]:
    """Return a hollow solid of revolution: `segments` staves around an empty middle.

    The outside follows the profile (which must bulge outward) with ROUND sides; each stave is
    flat on the inside.
    """
    facets = ROUND // segments
    staves = []
    for s in range(segments):
        outer = (s * facets + np.arange(facets + 1)) * (2 * np.pi / ROUND)
        points = [(r * np.cos(a), r * np.sin(a), z) for r, z in profile for a in outer]
        for r, z in (profile[0], profile[-1]):
            inner = r - thickness
            points += [(inner * np.cos(a), inner * np.sin(a), z) for a in outer[[0, -1]]]
        staves.append(hull(points))
    return staves
