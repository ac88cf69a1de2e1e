"""The distance between the surface of convex pieces and that of the mesh they stand for.

Both surfaces are cut into tiles; the distance from each tile's middle, and from each vertex, to the
other surface is exact (point to triangle). So the largest distance is missed only where it lies
between the points, which are TILE apart, or farther on a surface of more than `MOST_POINTS` tiles.
"""

from collections.abc import Sequence

import manifold3d
import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]
TILE = 1 / 80  # longest edge of a tile, in largest extents: 0.5 mm at 40 mm
NEAR = 4  # tiles checked for each point; for the farthest points, all that could be nearer
BATCH = 64
FACES = 24  # of a piece, checked at a time
NEEDLE = 1e-6  # triangles of less height, in largest extents, have no reliable normal
INSIDE = 1e-5  # points within this distance of the surface count, inside or outside
RAY = np.array([2.1, 0.13, 0.37])  # out of the unit box, along no axis
MOST_POINTS = 20_000  # checked on either surface


def bodies_of(mesh: trimesh.Trimesh) -> list[Manifold]:
    """Return the connected bodies of a closed mesh, all wound outward.

    Reversing a part that is wound inward fills an untouchable void, or corrects a body.
    """
    bodies = _make_solid(mesh.vertices, mesh.faces).decompose()
    turned = ((b, surface_of(b)) for b in bodies)
    return [b if b.volume() > 0 else _make_solid(s.vertices, s.faces[:, ::-1]) for b, s in turned]


def outer_solid(bodies: Sequence[Manifold]) -> Manifold:
    """Return the union of bodies, with the enclosed voids filled."""
    union = Manifold.batch_boolean(list(bodies), manifold3d.OpType.Add)
    shells = [shell for shell in union.decompose() if shell.volume() > 0]
    return Manifold.batch_boolean(shells, manifold3d.OpType.Add)


def surface_of(solid: Manifold) -> trimesh.Trimesh:
    """Return the surface of a solid as a triangle mesh."""
    arrays = solid.to_mesh64()
    return trimesh.Trimesh(
        arrays.vert_properties[:, :3].copy(), arrays.tri_verts.astype(np.int64), process=False
    )


def _make_solid(corners: Floats, faces: NDArray[np.int64]) -> Manifold:
    return Manifold(manifold3d.Mesh64(np.array(corners, np.float64), np.array(faces, np.uint64)))


def tiles(triangles: Floats, size: float = TILE) -> Floats:
    """Halve triangles (n, 3, 3) until no edge is longer than `size`."""
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
    """A triangle surface, cut into tiles, that measures the distances of points to it.

    Attributes:
        tiles: The (n, 3, 3) corners of the tiles that the surface is cut into.
        middles: The (n, 3) centroids of the tiles.
        points: The (m, 3) middles, and the corners of the original triangles.
        reach: The largest distance between a tile's middle and a point of the tile.
    """

    def __init__(self, triangles: Floats) -> None:
        self.tiles = tiles(triangles)
        self.middles = self.tiles.mean(axis=1)
        corners = np.unique(triangles.reshape(-1, 3), axis=0)
        self.points = np.concatenate([self.middles, corners])
        self.reach = float(np.linalg.norm(self.tiles - self.middles[:, None], axis=2).max())
        self._tree = cKDTree(self.middles)

    def about(self, points: Floats) -> Floats:
        """Estimate distances (n,) of points (n, 3): never too small, at most `reach` too large."""
        _, near = self._tree.query(points, k=np.arange(1, min(NEAR, len(self.tiles)) + 1))
        best: Floats = np.min([_find_gaps(self.tiles[tile], points) for tile in near.T], axis=0)
        return best

    def distance(self, points: Floats) -> Floats:
        """Return the distances (n,) of points (n, 3) to the surface.

        Distances are exact for the farthest points, and estimated by `about` for others.
        """
        best = self.about(points)
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
            gaps = _find_gaps(self.tiles[tile], points[some].repeat(counts, axis=0))
            best[some] = np.minimum.reduceat(gaps, np.cumsum([0, *counts[:-1]]))
            exact[some] = True
            floor = max(floor, float(best[some].max()))


def deviation(
    drawn: TriangleSurface, pieces: Sequence[trimesh.Trimesh], solids: Sequence[Manifold] = ()
) -> float:
    """Measure the Hausdorff distance between a surface and the outside of convex pieces.

    Args:
        solids: bodies that the surface encloses; parts of pieces inside them do not count.
    """
    triangles = np.concatenate([piece.triangles for piece in pieces])
    edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2).max(axis=1)
    made = TriangleSurface(triangles[2 * trimesh.triangles.area(triangles) > NEEDLE * edges])
    missed = made.distance(some(drawn.points))
    points = some(made.middles)
    away = drawn.about(points)
    far = points[away > INSIDE]
    beyond = drawn.distance(far[~_find_inside(far, solids)])
    return float(np.concatenate([missed, away[away <= INSIDE], beyond]).max())


def some(points: Floats) -> Floats:
    """Return every k-th point, so that at most `MOST_POINTS` remain."""
    return points[:: 1 + len(points) // MOST_POINTS]


def _find_inside(points: Floats, solids: Sequence[Manifold]) -> NDArray[np.bool_]:
    """Return (n,) flags: the point (n, 3) is inside a solid, by a ray's crossings."""
    inside = np.zeros(len(points), bool)
    for solid in solids:
        low, high = np.split(np.array(solid.bounding_box()), 2)
        for k in np.flatnonzero(~inside & ((points > low) & (points < high)).all(axis=1)):
            hits = solid.ray_cast(points[k].tolist(), (points[k] + RAY).tolist())
            inside[k] = len(hits) % 2
    return inside


def interleave_directions(planes: Floats) -> Floats:
    """Reorder planes by the golden ratio, so that consecutive planes cover all directions."""
    ordered: Floats = planes[np.argsort(np.arange(len(planes)) * 0.6180339887 % 1)]
    return ordered


def _find_gaps(triangles: Floats, points: Floats) -> Floats:
    """Return distances (n,) of points (n, 3), each to its triangle (n, 3, 3)."""
    nearest = trimesh.triangles.closest_point(triangles, points)
    away: Floats = np.linalg.norm(points - nearest, axis=1)
    return away
