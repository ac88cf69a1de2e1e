"""Triangulation of polygons: as fans where these are valid, by clipping ears where they are not."""

import numpy as np
from manifold3d import triangulate
from numpy.typing import NDArray

MOST_CORNERS = 10_000
SLIVER = 1e-9  # of the largest extent squared: a triangle of less area is ignored
FOLD = 1e-6  # of a polygon's area: a fan's triangle of more negative area folds back over it
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


def cut_polygons(vertices: Floats, corners: Ints, sizes: Ints) -> Ints:
    """Cut polygons into triangles, in the order of the polygons.

    Args:
        vertices: (n, 3) positions.
        corners: the vertex numbers of all polygons, one polygon after the other.
        sizes: number of corners of each polygon, at least 3.

    Returns:
        (m, 3) vertex numbers of triangles, `size - 2` for each polygon.
    """
    if sizes.max(initial=3) > MOST_CORNERS:
        raise ValueError(f"a face has {sizes.max()} corners, more than {MOST_CORNERS}; split it")
    counts = sizes - 2
    first, owner = np.cumsum(counts) - counts, np.repeat(np.arange(len(sizes)), counts)
    start = (first + 2 * np.arange(len(sizes)))[owner]
    step = np.arange(len(owner)) + 2 * owner
    faces: Ints = np.stack([corners[start], corners[step + 1], corners[step + 2]], axis=1)
    if sizes.max(initial=3) == 3:
        return faces
    places: Floats = np.ascontiguousarray(vertices.T, float)
    a, b, c = (places[:, corner] for corner in faces.T)
    areas = _cross(b - a, c - a)
    whole = np.add.reduceat(areas, first, axis=1)
    share = (areas * whole[:, owner]).sum(axis=0)
    area = np.linalg.norm(whole, axis=0)[owner]
    outside = share < -area * np.maximum(FOLD * area, SLIVER * np.ptp(places, axis=1).max() ** 2)
    for polygon in np.unique(owner[outside]):
        own = slice(first[polygon], first[polygon] + counts[polygon])
        ring = np.append(faces[own][0, :2], faces[own, 2])
        seen = flat((places[:, ring] - places[:, ring[:1]]).T, whole[:, polygon] / area[own][0])
        ears = ring[np.asarray(triangulate([seen]), np.int64)]
        a, b, c = (places[:, corner] for corner in ears.T)
        sizes_of = (np.linalg.norm(x, axis=0).sum() for x in (_cross(b - a, c - a), areas[:, own]))
        if np.subtract(*sizes_of) < -FOLD * area[own][0]:  # else the polygon crosses itself
            faces[own] = ears
    return faces


def _cross(a: Floats, b: Floats) -> Floats:
    return np.stack([a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)])


def flat(points: Floats, normal: Floats) -> Floats:
    """Project points (n, 3) along a normal to plane coordinates (n, 2)."""
    one = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    one /= np.linalg.norm(one)
    seen: Floats = points @ np.stack([one, np.cross(normal, one)], axis=1)
    return seen
