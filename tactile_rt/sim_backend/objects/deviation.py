"""How far the surface of convex pieces is from the surface of the mesh they stand for.

Both surfaces are cut into tiles; the distance from each tile's middle, and from each vertex, to the
other surface is exact (point to triangle). So the largest distance is missed only where it falls
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
NEAR = 4  # tiles looked at for each point; all that could be nearer, for the farthest points
BATCH = 64
FACES = 24  # of a piece looked at together
NEEDLE = 1e-6  # triangles lower than this, in largest extents, have no normal to speak of
INSIDE = 1e-5  # what is nearer to the surface than this counts wherever it lies
RAY = np.array([2.1, 0.13, 0.37])  # out of the unit box, along no axis
MOST_POINTS = 20_000  # looked at, of either surface


def bodies_of(mesh: trimesh.Trimesh) -> list[Manifold]:
    """Return the connected parts of a closed mesh, all wound outward, if its faces match.

    Turning one that is wound inward fills it if it is a void, which nothing can touch, and puts it
    right if it is a body.
    """
    bodies = _solid(mesh.vertices, mesh.faces).decompose()
    turned = ((b, surface_of(b)) for b in bodies)
    return [b if b.volume() > 0 else _solid(s.vertices, s.faces[:, ::-1]) for b, s in turned]


def outer_solid(bodies: Sequence[Manifold]) -> Manifold:
    """The union of bodies, without the voids between them."""
    union = Manifold.batch_boolean(list(bodies), manifold3d.OpType.Add)
    shells = [shell for shell in union.decompose() if shell.volume() > 0]
    return Manifold.batch_boolean(shells, manifold3d.OpType.Add)


def surface_of(solid: Manifold) -> trimesh.Trimesh:
    """The solid's surface."""
    arrays = solid.to_mesh64()
    return trimesh.Trimesh(
        arrays.vert_properties[:, :3].copy(), arrays.tri_verts.astype(np.int64), process=False
    )


def _solid(corners: Floats, faces: NDArray[np.int64]) -> Manifold:
    return Manifold(manifold3d.Mesh64(np.array(corners, np.float64), np.array(faces, np.uint64)))


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

    def __init__(self, triangles: Floats) -> None:
        self.tiles = tiles(triangles)
        self.middles = self.tiles.mean(axis=1)
        corners = np.unique(triangles.reshape(-1, 3), axis=0)
        self.points = np.concatenate([self.middles, corners])
        self.reach = float(np.linalg.norm(self.tiles - self.middles[:, None], axis=2).max())
        self._tree = cKDTree(self.middles)

    def about(self, points: Floats) -> Floats:
        """(n,) distance of points (n, 3) to the surface, at most `reach` too large, and rarely."""
        _, near = self._tree.query(points, k=np.arange(1, min(NEAR, len(self.tiles)) + 1))
        best: Floats = np.min([_gap(self.tiles[tile], points) for tile in near.T], axis=0)
        return best

    def distance(self, points: Floats) -> Floats:
        """(n,) distance of points (n, 3) to the surface.

        Exact for the farthest points; for others as `about`.
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
            gaps = _gap(self.tiles[tile], points[some].repeat(counts, axis=0))
            best[some] = np.minimum.reduceat(gaps, np.cumsum([0, *counts[:-1]]))
            exact[some] = True
            floor = max(floor, float(best[some].max()))


def deviation(
    drawn: TriangleSurface, pieces: Sequence[trimesh.Trimesh], solids: Sequence[Manifold] = ()
) -> float:
    """Measure the Hausdorff distance between a surface and the outside of convex pieces.

    Args:
        solids: what the surface encloses. What of a piece lies inside them is not its outside.
    """
    triangles = np.concatenate([piece.triangles for piece in pieces])
    edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2).max(axis=1)
    made = TriangleSurface(triangles[2 * trimesh.triangles.area(triangles) > NEEDLE * edges])
    missed = made.distance(some(drawn.points))
    points = some(made.middles)
    away = drawn.about(points)
    far = points[away > INSIDE]
    beyond = drawn.distance(far[~_inside(far, solids)])
    return float(np.concatenate([missed, away[away <= INSIDE], beyond]).max())


def some(points: Floats) -> Floats:
    """Not too many of them, of all parts."""
    return points[:: 1 + len(points) // MOST_POINTS]


def _inside(points: Floats, solids: Sequence[Manifold]) -> NDArray[np.bool_]:
    """Return (n,) whether a ray out of each point (n, 3) leaves a solid, net."""
    inside = np.zeros(len(points), bool)
    for solid in solids:
        low, high = np.split(np.array(solid.bounding_box()), 2)
        for k in np.flatnonzero(~inside & ((points > low) & (points < high)).all(axis=1)):
            hits = solid.ray_cast(points[k].tolist(), (points[k] + RAY).tolist())
            inside[k] = len(hits) % 2
    return inside


def shuffled(planes: Floats) -> Floats:
    """The planes in an order in which any few look all round (golden-ratio sequence)."""
    ordered: Floats = planes[np.argsort(np.arange(len(planes)) * 0.6180339887 % 1)]
    return ordered


def _gap(triangles: Floats, points: Floats) -> Floats:
    """(n,) distance of points (n, 3), each to its own of the triangles (n, 3, 3)."""
    nearest = trimesh.triangles.closest_point(triangles, points)
    away: Floats = np.linalg.norm(points - nearest, axis=1)
    return away
