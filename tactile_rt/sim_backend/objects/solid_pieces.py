"""A closed solid as convex pieces that stay within a stated distance of its surface.

Every face of the solid begins as a piece of its own, some tenths of a millimetre or more deep.
Neighbours are joined, the smallest first, as long as their common convex hull is near enough: no
point of the solid's surface may lie deeper in it than the tolerance. So a convex solid becomes one
piece, an L two boxes, and a smooth hollow facets as wide as the tolerance allows. What is still
empty in the middle of the solid is filled at last; no whisker gets there.

Decompositions that cut a whole in two, by the best of many planes, again and again (CoACD, Wei et
al. 2022), try what costs more; see docs/decisions/0025.
"""

import numpy as np
from manifold3d import Manifold, OpType
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from tactile_rt.sim_backend.objects.deviation import FACES, TILE, shuffled, tiles
from tactile_rt.sim_backend.objects.joining import Joining
from tactile_rt.sim_backend.objects.manifolds import surface_of

__all__ = ["SolidPieces"]

Floats = NDArray[np.float64]

DEEP = 0.05  # of a face's piece, in largest extents, at most: 2 mm at 40 mm
SHALLOW = 2e-4  # at least
SHARE = 0.6  # of the way through the solid, at most: the pieces of opposite walls overlap
ASIDE = 1e-5  # from a corner begins the ray that looks how far it is through the solid
APART = TILE / 2  # points on the surface that are nearer than this tell the same
OUT = 2.0  # from any place in the unit box, that is out of it
VOID, VOID_DEPTH = 1e-7, 5e-5  # volume, and volume over area, of what is too small to be filled
MOST_VOIDS = 2000  # looked at


class SolidPieces:
    """The pieces of a solid: `join` them, then ask for their `corners`.

    Args:
        solid: in the unit box.
    """

    def __init__(self, solid: Manifold) -> None:
        self._solid = solid
        self._mesh = mesh = surface_of(solid)
        middles = tiles(mesh.triangles).mean(axis=1)
        middles = middles[np.unique(np.rint(middles / APART), axis=0, return_index=True)[1]]
        edges = mesh.vertices[mesh.edges_unique].mean(axis=1)
        points = np.concatenate([middles, mesh.vertices, edges])
        self._surface = points[np.argsort(points[:, 0], kind="stable")]
        self._tolerance = 0.0
        self._joining: Joining[Floats] | None = None  # None: it is convex

    def __len__(self) -> int:
        return len(self._joining) if self._joining else 1

    def join(self, tolerance: float) -> None:
        """Join pieces as far as a tolerance allows, in largest extents; each time a larger one."""
        self._tolerance = tolerance
        if self._joining is None:
            if self._near_enough(_hull(self._mesh.vertices)):
                return
            areas, neighbours = self._mesh.area_faces, self._mesh.face_adjacency.tolist()
            self._joining = Joining(self._faces(), areas, neighbours)
        self._joining.join(self._joined)

    def corners(self, spare: int) -> list[Floats]:
        """The (n, 3) corners of each piece, those of the pieces in the middle at the end.

        Args:
            spare: so many pieces there may be in the middle.
        """
        if self._joining is None:
            return [self._mesh.vertices]
        outer = [p for p in self._joining.patches if _hull(p) is not None]
        return outer + self._middle(outer, spare)

    def _faces(self) -> list[Floats]:
        """The piece behind each face, as deep as it can be."""
        mesh = self._mesh
        ways = -mesh.vertex_normals
        starts, ends = mesh.vertices + ASIDE * ways, mesh.vertices + OUT * ways
        free = np.zeros(len(starts))
        for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            hits = self._solid.ray_cast(start, end)
            if len(hits) % 2:  # else it begins outside, where the surface is folded over
                free[k] = OUT * hits[0].distance
        behind = mesh.vertices + ways * np.clip(SHARE * free, SHALLOW, DEEP)[:, None]
        pieces = []
        for face, normal in zip(mesh.faces, mesh.face_normals, strict=True):
            front = mesh.vertices[face]
            piece = np.concatenate([front, behind[face]])
            if not self._near_enough(_hull(piece)):
                piece = np.concatenate([front, front - SHALLOW * normal])
            pieces.append(piece)
        return pieces

    def _joined(self, one: Floats, two: Floats) -> Floats | None:
        both = np.concatenate([one, two])
        hull = _hull(both)
        if hull is None:
            return both
        return both[hull.vertices] if self._near_enough(hull) else None

    def _near_enough(self, hull: ConvexHull | None) -> bool:
        """Whether no point of the surface lies deeper in a hull than the tolerance."""
        if hull is None:
            return False
        low, high = hull.min_bound, hull.max_bound
        first, last = np.searchsorted(self._surface[:, 0], (low[0], high[0]))
        points = self._surface[first:last]
        y, z = points[:, 1], points[:, 2]
        points = points[(y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2])]
        planes = shuffled(hull.equations)
        for k in range(0, len(planes), FACES):  # few points stay deeper for long
            some = planes[k : k + FACES]
            depth = -(points @ some[:, :3].T + some[:, 3]).max(axis=1, initial=-np.inf)
            points = points[depth > self._tolerance]
        return len(points) == 0

    def _middle(self, outer: list[Floats], spare: int) -> list[Floats]:
        """Pieces that fill what others leave empty."""
        union = Manifold.batch_boolean([Manifold.hull_points(p) for p in outer], OpType.Add)
        voids, pieces = (self._solid - union).decompose(), list[Floats]()
        for _ in range(MOST_VOIDS):
            if not voids or len(pieces) == spare:
                break
            void = voids.pop()
            if void.volume() < max(VOID, VOID_DEPTH * void.surface_area()):
                continue
            corners = surface_of(void).vertices
            hull = _hull(corners)
            if hull is None:
                continue
            if self._near_enough(hull):
                pieces.append(corners[hull.vertices])
            else:
                low, high = corners.min(axis=0), corners.max(axis=0)
                axis = int((high - low).argmax())
                middle = float(low[axis] + high[axis]) / 2
                for half in void.split_by_plane(np.eye(3)[axis].tolist(), middle):
                    voids += half.decompose()
        return pieces


def _hull(points: Floats) -> ConvexHull | None:
    """The convex hull; None of what is flat."""
    try:
        return ConvexHull(points)
    except QhullError:
        return None
