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

__all__ = ["Deviation", "Surface", "outside", "shuffled", "surface_deviation", "tiles"]

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
    """Distances between the pieces' outside and the mesh, in fractions of the largest extent.

    Attributes:
        beyond: the farthest that the outside of the pieces is from the mesh.
        missed: the farthest that the mesh is from the outside of the pieces; also where narrow
            clefts are filled, and where the mesh has faces buried in its own inside.
        p99: 99 % of the area of both surfaces is nearer than this.
        mean: over the area of both.
    """

    beyond: float
    missed: float
    p99: float
    mean: float

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


class Surface:
    """A surface to measure distances from.

    Attributes:
        tiles: (n, 3, 3) corners.
        middles: (n, 3) their centroids.
        reach: the farthest that a point of a tile is from its middle.
    """

    def __init__(self, triangles: Floats, size: float = TILE) -> None:
        self.tiles = tiles(triangles, size)
        self.middles = self.tiles.mean(axis=1)
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
        best: Floats = np.min([_gap(self.tiles[tile], points) for tile in near.T], axis=0)
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
            gaps = _gap(self.tiles[tile], points[some].repeat(counts, axis=0))
            best[some] = np.minimum.reduceat(gaps, np.cumsum([0, *counts[:-1]]))
            exact[some] = True
            floor = max(floor, float(best[some].max()))


def surface_deviation(mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh]) -> Deviation:
    """Distance between the mesh's surface and the outside of the union of convex pieces.

    Args:
        mesh: of largest extent 1.
        pieces: convex, in the same frame. What of a piece lies inside another is not outside.
    """
    drawn, made = Surface(mesh.triangles), Surface(outside(pieces))
    missed, beyond = made.distance(drawn.middles), drawn.distance(made.middles)
    at_corners = made.distance(mesh.vertices[np.unique(mesh.faces)])
    gaps = np.concatenate([missed, beyond])
    areas = trimesh.triangles.area(np.concatenate([drawn.tiles, made.tiles]))
    order = np.argsort(gaps)
    share = np.cumsum(areas[order]) / areas.sum()
    return Deviation(
        beyond=float(beyond.max()),
        missed=float(max(missed.max(), at_corners.max())),
        p99=float(gaps[order][np.searchsorted(share, 0.99)]),
        mean=float(gaps @ areas / areas.sum()),
    )


def outside(pieces: Sequence[trimesh.Trimesh]) -> Floats:
    """(n, 3, 3) tiles of the pieces' faces, without those inside another piece."""
    parts = [_broad(tiles(piece.triangles)) for piece in pieces]
    owner = np.repeat(np.arange(len(pieces)), [len(part) for part in parts])
    every = np.concatenate(parts)
    across = np.cross(every[:, 1] - every[:, 0], every[:, 2] - every[:, 0])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    columns = np.ascontiguousarray((every.mean(axis=1) + OUTWARD * across).T)
    inside = np.zeros(len(every), bool)
    for j, piece in enumerate(pieces):
        near = ~inside & (owner != j)
        for column, low, high in zip(columns, *piece.bounds, strict=True):
            near &= (column >= low) & (column <= high)
        index = np.flatnonzero(near)
        planes = shuffled(ConvexHull(piece.vertices).equations)
        for k in range(0, len(planes), FACES):  # few points are inside many of them
            some = planes[k : k + FACES]
            out = some[:, :3] @ columns[:, index] > TOUCHING - some[:, 3:]
            index = index[~out.any(axis=0)]
        inside[index] = True
    return every[~inside]


def shuffled(planes: Floats) -> Floats:
    """The planes in an order in which any few look all round (golden-ratio sequence)."""
    ordered: Floats = planes[np.argsort(np.arange(len(planes)) * 0.6180339887 % 1)]
    return ordered


def _broad(triangles: Floats) -> Floats:
    edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2).max(axis=1)
    broad: Floats = triangles[2 * trimesh.triangles.area(triangles) > NEEDLE * edges]
    return broad


def _gap(triangles: Floats, points: Floats) -> Floats:
    nearest = trimesh.triangles.closest_point(triangles, points)
    gap: Floats = np.linalg.norm(points - nearest, axis=1)
    return gap
