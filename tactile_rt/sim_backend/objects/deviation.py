"""How far the surface of convex pieces is from the surface of the mesh they stand for.

Both surfaces are cut into tiles; the distance from each tile's middle, and from each vertex, to the
other surface is exact (point to triangle). So the largest distance is missed only where it falls
between the points: by about TILE^2 / (8 r) where a surface has radius of curvature r (0.006 mm for
r = 5 mm at 40 mm), and never by more than a tile.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, cKDTree

__all__ = ["Deviation", "TriangleSurface", "deviation", "gap", "shuffled", "tiles"]

Floats = NDArray[np.float64]

TILE = 1 / 80  # longest edge of a tile, in largest extents: 0.5 mm at 40 mm
NEAR = 4  # tiles looked at for each point; all that could be nearer, for the farthest points
BATCH = 64
FACES = 24  # of a piece looked at together
NEEDLE = 1e-6  # triangles lower than this, in largest extents, have no normal to speak of
TOUCHING = 1e-7  # pieces nearer to each other than this leave no gap
OUTWARD = 1e-4  # how far outside its face a point is tested for lying in another piece


@dataclass(frozen=True)
class Deviation:
    """Distances between a mesh and the outside of pieces, in fractions of the largest extent.

    Attributes:
        points: The (n, 3) points measured at: the mesh's, then those of the outside of the pieces.
        gaps: The (n,) distance of each point to the other surface; large where the mesh has faces
            buried in its own inside, too.
        missed: The farthest that the mesh is from the outside of the pieces.
        beyond: The farthest that the outside of the pieces is from the mesh.
    """

    points: Floats
    gaps: Floats
    missed: float
    beyond: float

    @property
    def largest(self) -> float:
        """The Hausdorff distance."""
        return max(self.beyond, self.missed)


def tiles(triangles: Floats, size: float = TILE) -> Floats:
    """(n, 3, 3) triangles, those of the input halved until no edge is longer than `size`."""
    done = []
    while len(triangles):
        edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2)
        large = edges.max(axis=1) > size
        done.append(triangles[~large])
        triangles, edges = triangles[large], edges[large]
        row, first = np.arange(len(triangles)), edges.argmax(axis=1)
        a, b, c = (triangles[row, (first + k) % 3] for k in range(3))
        middle = (a + b) / 2
        triangles = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate(done) if done else triangles


class TriangleSurface:
    """A surface to measure distances from.

    Attributes:
        tiles: The (n, 3, 3) corners of the tiles that the surface is cut into.
        middles: The (n, 3) centroids of the tiles.
        points: The (m, 3) middles, and the corners that the surface came with.
        reach: The farthest that a point of a tile is from its tile's middle.
    """

    def __init__(self, triangles: Floats, size: float = TILE) -> None:
        self.tiles = tiles(triangles, size)
        self.middles = self.tiles.mean(axis=1)
        corners = np.unique(triangles.reshape(-1, 3), axis=0)
        self.points = np.concatenate([self.middles, corners])
        self.reach = float(np.linalg.norm(self.tiles - self.middles[:, None], axis=2).max())
        self._tree = cKDTree(self.middles)

    def bound(self, points: Floats) -> tuple[Floats, NDArray[np.intp]]:
        """(n,) distances to the nearest middle, at most `reach` too large, and whose it is."""
        away, tile = self._tree.query(points)
        return away, tile

    def distance(self, points: Floats) -> Floats:
        """(n,) distance of points (n, 3) to the surface.

        Exact for the farthest points; for others at most `reach` too large, and rarely that.
        """
        _, near = self._tree.query(points, k=np.arange(1, min(NEAR, len(self.tiles)) + 1))
        best: Floats = np.min([gap(self.tiles[tile], points) for tile in near.T], axis=0)
        floor, exact = 0.0, np.zeros(len(points), bool)
        while True:
            unsure = np.flatnonzero(~exact & (best > floor))
            if not len(unsure):
                return best
            some = unsure[np.argsort(-best[unsure])[:BATCH]]
            # a nearer tile has its middle no farther than this
            found = self._tree.query_ball_point(points[some], best[some] + self.reach)
            counts = [len(ball) for ball in found]
            tile = np.concatenate(found).astype(int)
            gaps = gap(self.tiles[tile], points[some].repeat(counts, axis=0))
            best[some] = np.minimum.reduceat(gaps, np.cumsum([0, *counts[:-1]]))
            exact[some] = True
            floor = max(floor, float(best[some].max()))


def deviation(drawn: TriangleSurface, pieces: Sequence[trimesh.Trimesh]) -> Deviation:
    """Distance between a surface and the outside of the union of convex pieces.

    Args:
        drawn: of largest extent 1.
        pieces: convex, in the same frame. What of a piece lies inside another is not outside.
    """
    parts = [_broad(tiles(piece.triangles)) for piece in pieces]
    owner = np.repeat(np.arange(len(pieces)), [len(part) for part in parts])
    every = np.concatenate(parts)
    across = np.cross(every[:, 1] - every[:, 0], every[:, 2] - every[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    made = TriangleSurface(every[~_inside(every.mean(axis=1) + OUTWARD * across, pieces, owner)])
    missed, beyond = made.distance(drawn.points), drawn.distance(made.middles)
    # a tile is outside if its middle is; a point that lies in no piece may be nearest to any tile
    far = np.flatnonzero(missed > missed.max() / 2)
    far = far[~_inside(drawn.points[far], pieces)]
    if len(far):
        missed[far] = np.minimum(missed[far], TriangleSurface(every).distance(drawn.points[far]))
    points = np.concatenate([drawn.points, made.middles])
    gaps = np.concatenate([missed, beyond])
    return Deviation(points, gaps, float(missed.max()), float(beyond.max()))


def _inside(
    points: Floats, pieces: Sequence[trimesh.Trimesh], owner: NDArray[np.intp] | None = None
) -> NDArray[np.bool_]:
    """(n,) whether points (n, 3) lie in a piece, other than their owner (n,) if they have one."""
    columns = np.ascontiguousarray(points.T)
    inside = np.zeros(len(points), bool)
    for j, piece in enumerate(pieces):
        near = ~inside if owner is None else ~inside & (owner != j)
        for column, low, high in zip(columns, *piece.bounds, strict=True):
            near &= (column >= low) & (column <= high)
        index = np.flatnonzero(near)
        planes = shuffled(ConvexHull(piece.vertices).equations)
        for k in range(0, len(planes), FACES):  # few points are inside many of them
            some = planes[k : k + FACES]
            out = some[:, :3] @ columns[:, index] > TOUCHING - some[:, 3:]
            index = index[~out.any(axis=0)]
        inside[index] = True
    return inside


def shuffled(planes: Floats) -> Floats:
    """The planes in an order in which any few look all round (golden-ratio sequence)."""
    ordered: Floats = planes[np.argsort(np.arange(len(planes)) * 0.6180339887 % 1)]
    return ordered


def _broad(triangles: Floats) -> Floats:
    edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2).max(axis=1)
    broad: Floats = triangles[2 * trimesh.triangles.area(triangles) > NEEDLE * edges]
    return broad


def gap(triangles: Floats, points: Floats) -> Floats:
    """(n,) distance of points (n, 3), each to its own of the triangles (n, 3, 3)."""
    nearest = trimesh.triangles.closest_point(triangles, points)
    away: Floats = np.linalg.norm(points - nearest, axis=1)
    return away
