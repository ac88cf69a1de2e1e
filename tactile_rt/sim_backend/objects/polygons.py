"""Polygons cut into triangles: as fans where these are right, at their ears where they are not."""

import numpy as np
from manifold3d import triangulate
from numpy.typing import NDArray

__all__ = ["cut_polygons", "group_by_corners"]

FOLD = 1e-6  # of a polygon's area: a triangle of a fan that lies so far outside folds back over it
Ints = NDArray[np.int64]


def cut_polygons(vertices: NDArray[np.floating], corners: Ints, sizes: Ints) -> Ints:
    """Cut polygons into triangles that cover them, in their order.

    Args:
        vertices: (n, 3) places.
        corners: the vertices of all polygons, one after the other.
        sizes: how many corners each has, 3 at least.

    Returns:
        (m, 3) vertices of triangles, `size - 2` for each polygon.
    """
    counts = sizes - 2
    first, owner = np.cumsum(counts) - counts, np.repeat(np.arange(len(sizes)), counts)
    start = (np.cumsum(sizes) - sizes)[owner]
    step = start + np.arange(len(owner)) - first[owner]
    faces: Ints = np.stack([corners[start], corners[step + 1], corners[step + 2]], axis=1)
    if not len(sizes) or sizes.max() == 3:
        return faces
    a, b, c = np.asarray(vertices, float)[faces].swapaxes(0, 1)
    areas = np.cross(b - a, c - a)
    whole = np.add.reduceat(areas, first, axis=0)[owner]
    outside = (areas * whole).sum(axis=1) < -FOLD * (whole**2).sum(axis=1)
    for polygon in np.unique(owner[outside]):
        own = slice(first[polygon], first[polygon] + counts[polygon])
        ring = np.append(faces[own][0, :2], faces[own, 2])
        faces[own] = _cut_ears(np.asarray(vertices[ring], float), whole[first[polygon]], ring)
    return faces


def _cut_ears(places: NDArray[np.floating], normal: NDArray[np.floating], ring: Ints) -> Ints:
    across = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    across /= np.linalg.norm(across)
    plane = np.stack([across, np.cross(normal / np.linalg.norm(normal), across)], axis=1)
    return ring[np.asarray(triangulate([(places - places[0]) @ plane]), np.int64)]


def group_by_corners(faces: Ints, sizes: Ints) -> Ints:
    """Sort triangles of polygons: of triangles first, of quads by halves, then of the others."""
    corners, owner = (np.repeat(a, sizes - 2) for a in (sizes, np.arange(len(sizes))))
    second = (corners == 4) & (owner == np.roll(owner, 1))
    faces = np.where(second[:, None], faces[:, [1, 2, 0]], faces)
    return faces[np.lexsort((second, np.minimum(corners, 5)))]
