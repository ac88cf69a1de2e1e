"""A closed surface drawn round faces that enclose nothing: sheets, gaps, crossing walls.

It is where the distance to the nearest face is `LEVEL`, so that sheets become plates of twice that.
Hollows behind gaps narrower than twice `SEAL` are filled: else the inside of a teapot with an open
seam would be cut into hundreds of pieces that no whisker can get to. The distances are those at the
points of a body-centred grid; with a lesser `LEVEL` there would be holes between its points.
"""

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tactile_rt.sim_backend.objects.deviation import gap, tiles
from tactile_rt.sim_backend.objects.manifolds import outer_solid, surface_of

__all__ = ["LEVEL", "closed_round"]

Floats = NDArray[np.float64]

GRID = 1 / 64  # edge of a cell, in largest extents: 0.6 mm at 40 mm
LEVEL = 0.6 * GRID
SEAL = 2 * LEVEL
FAR = 4 * GRID  # what is farther than this from any face needs no exact distance
SMOOTH = 0.15 * LEVEL  # the steps of the grid are no shape
BATCH = 50_000


def closed_round(mesh: trimesh.Trimesh) -> Manifold:
    """The solid within `LEVEL` of the mesh's faces, without the voids in it.

    Args:
        mesh: of largest extent 1.
    """
    low, high = mesh.bounds
    box = [*(low - FAR), *(high + FAR)]
    grid: list[tuple[float, float, float]] = []

    def note(x: float, y: float, z: float) -> float:
        grid.append((x, y, z))
        return -1.0

    # asked for where first, so that all distances are found together
    Manifold.level_set(note, box, GRID)
    points = np.array(grid)

    def solid(inside: Floats) -> Manifold:
        values = dict(zip(grid, inside.tolist(), strict=True))
        return Manifold.level_set(lambda *at: values[at], box, GRID)

    away = _distance(mesh.triangles, points)
    shells = solid(SEAL - away).decompose()
    hollows = [surface_of(shell).triangles for shell in shells if shell.volume() < 0]
    inside = LEVEL - away
    if hollows:  # what is deep in them becomes a void, and so is filled too
        inside = np.maximum(inside, SEAL - _distance(np.concatenate(hollows), points))
    return outer_solid(solid(inside).decompose()).simplify(SMOOTH)


def _distance(triangles: Floats, points: Floats) -> Floats:
    """(n,) distance of points (n, 3) to the face whose middle is nearest, `FAR` at most."""
    parts = tiles(triangles, GRID / 2)
    away, tile = cKDTree(parts.mean(axis=1)).query(points, distance_upper_bound=FAR)
    near = np.flatnonzero(away < FAR)
    for some in np.array_split(near, 1 + len(near) // BATCH):
        away[some] = gap(parts[tile[some]], points[some])
    capped: Floats = np.minimum(away, FAR)
    return capped
