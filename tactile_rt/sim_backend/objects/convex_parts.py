"""Convex pieces of a surface: of a closed solid, and of a sheet that encloses nothing.

Patches of the surface are joined with their neighbours, the smallest first, as long as the result
stays near enough to the surface.

Every face of a solid begins as a piece of its own, some tenths of a millimetre or more deep, and
neighbours are joined as long as no point of the surface lies deeper in their common convex hull
than the tolerance. So a convex solid becomes one piece, an L two boxes, and a smooth hollow facets
as wide as the tolerance allows. Space left empty in the middle is filled last; no whisker gets
there. Decompositions that cut a whole in two (CoACD, Wei et al. 2022) cost more; see
docs/decisions/0023.

The faces of a sheet are joined to flat patches of convex outline. Each becomes a plate that reaches
equally far to both sides of the sheet; neighbouring plates share corners, so that no gap opens
where the sheet bends.
"""

import heapq
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import count
from typing import Generic, TypeVar

import numpy as np
import trimesh
from manifold3d import Manifold, OpType
from scipy.spatial import ConvexHull, QhullError

from tactile_rt.sim_backend.objects.deviation import (
    FACES,
    TILE,
    interleave_directions,
    surface_of,
    tiles,
)
from tactile_rt.sim_backend.objects.polygons import Floats, flat

P = TypeVar("P")
FOLDED = 0.5  # least cosine between the normals of a patch and of the parts joined to it
ALONG = np.linspace(0, 1, 4, endpoint=False)[:, None, None]  # points checked on an outline's edge
DEEP = 0.05  # largest depth of a face's piece, in largest extents: 2 mm at 40 mm
SHALLOW = 2e-4  # least depth of a face's piece
SHARE = 0.6  # largest depth as a share of the thickness: the pieces of opposite walls overlap
ASIDE = 1e-5  # distance from a corner at which the ray that measures thickness begins
APART = TILE / 2  # spacing to which points on the surface are thinned out
OUT = 2.0  # a distance that leads out of the unit box from anywhere in it
VOID, VOID_DEPTH = 1e-7, 5e-5  # volume, and volume over area, below which a void stays empty
MOST_VOIDS = 2000  # checked


class Joining(Generic[P]):
    """A set of patches that are merged with their neighbours, the smallest pair first.

    A refused pair stays refused until the next `join`, even if a patch has grown since.
    """

    def __init__(
        self, patches: Sequence[P], sizes: Iterable[float], neighbours: Iterable[tuple[int, int]]
    ) -> None:
        self._alive = dict(enumerate(patches))
        self._sizes = dict(enumerate(sizes))
        self._near: dict[int, set[int]] = {k: set() for k in self._alive}
        for a, b in neighbours:
            if a != b:
                self._near[a].add(b)
                self._near[b].add(a)
        self._new = count(len(patches))

    def __len__(self) -> int:
        return len(self._alive)

    @property
    def patches(self) -> list[P]:
        """The patches that remain after merging."""
        return list(self._alive.values())

    def join(self, joined: Callable[[P, P], P | None]) -> None:
        """Merge neighbouring patches until no more can be merged.

        Args:
            joined: merges two patches and returns the result, or None to refuse the pair.
        """
        refused: dict[int, set[int]] = {k: set() for k in self._alive}
        queue = [
            (self._sizes[a] + self._sizes[b], a, b)
            for a, others in self._near.items()
            for b in others
            if a < b
        ]
        heapq.heapify(queue)
        while queue:
            _, a, b = heapq.heappop(queue)
            if a not in self._alive or b not in self._alive or b in refused[a]:
                continue
            patch = joined(self._alive[a], self._alive[b])
            if patch is None:
                refused[a].add(b)
                refused[b].add(a)
                continue
            c = next(self._new)
            self._alive[c], self._sizes[c] = patch, self._sizes.pop(a) + self._sizes.pop(b)
            self._near[c] = (self._near.pop(a) | self._near.pop(b)) - {a, b}
            refused[c] = refused.pop(a) | refused.pop(b)
            del self._alive[a], self._alive[b]
            for k in self._near[c]:
                self._near[k] -= {a, b}
                self._near[k].add(c)
                if k in refused[c]:
                    refused[k].add(c)
                else:
                    heapq.heappush(queue, (self._sizes[c] + self._sizes[k], c, k))


@dataclass(frozen=True)
class _Patch:
    area: Floats  # (3,) normal whose length is the area
    corners: frozenset[int]
    outline: frozenset[tuple[int, int]]


class SheetPieces:
    """The convex plates that a sheet is cut into: call `join`, then `corners`.

    Args:
        sheet: any surface, in the unit box.
        half: half the thickness of a plate, in units of the largest extent.
    """

    def __init__(self, sheet: trimesh.Trimesh, half: float) -> None:
        trimesh.repair.fix_winding(sheet)
        self._mesh, self._half, self._tolerance = sheet, half, 0.0
        areas = sheet.face_normals * sheet.area_faces[:, None]
        sides = np.sort(sheet.edges, axis=1).reshape(-1, 3, 2).tolist()
        patches = [
            _Patch(area, frozenset(face), frozenset(map(tuple, side)))
            for area, face, side in zip(areas, sheet.faces.tolist(), sides, strict=True)
        ]
        self._joining = Joining(patches, sheet.area_faces, sheet.face_adjacency.tolist())

    def __len__(self) -> int:
        return len(self._joining)

    def join(self, tolerance: float) -> None:
        """Merge plates as far as a tolerance, in units of the largest extent, allows."""
        self._tolerance = tolerance
        self._joining.join(self._join_pair)

    def corners(self) -> list[Floats]:
        """Return the corners (n, 3) of each plate."""
        mesh, plates = self._mesh, []
        for patch in self._joining.patches:
            size = float(np.linalg.norm(patch.area))
            if size == 0:  # a needle; its neighbours reach to its corners
                continue
            normal = patch.area / size
            index = np.array(sorted(patch.corners))
            points = mesh.vertices[index]
            hull = _hull(flat(points, normal))
            if hull is None:
                continue
            index, points = index[hull.vertices], points[hull.vertices]
            # along the common normal of the faces that meet in a corner, scaled so that the plate
            # has its full thickness
            ways = mesh.vertex_normals[index]
            along = ways @ normal
            ways = np.where(
                np.abs(along)[:, None] > FOLDED,
                ways / np.where(along == 0, 1, along)[:, None],
                normal,
            )
            plates.append(np.concatenate([points - self._half * ways, points + self._half * ways]))
        return plates

    def _join_pair(self, one: _Patch, two: _Patch) -> _Patch | None:
        area = one.area + two.area
        size = float(np.linalg.norm(area))
        if size == 0:
            return None
        for part in (one, two):
            if part.area @ area < FOLDED * np.linalg.norm(part.area) * size:
                return None
        patch = _Patch(area, one.corners | two.corners, one.outline ^ two.outline)
        vertices, normal = self._mesh.vertices, area / size
        points = vertices[list(patch.corners)]
        if np.ptp(points @ normal) > 2 * self._tolerance:
            return None
        hull = _hull(flat(points, normal))
        if hull is None:
            return None
        begin, end = vertices[np.array(list(patch.outline))].transpose(1, 0, 2)
        along = flat((begin + ALONG * (end - begin)).reshape(-1, 3), normal)
        depth = -(along @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1)
        return patch if depth.max() <= self._tolerance else None


class SolidPieces:
    """The convex pieces that a solid is cut into: call `join`, then `corners`."""

    def __init__(self, solid: Manifold) -> None:
        self._solid = solid
        self._mesh = mesh = surface_of(solid)
        middles = tiles(mesh.triangles).mean(axis=1)
        middles = middles[np.unique(np.rint(middles / APART), axis=0, return_index=True)[1]]
        edges = mesh.vertices[mesh.edges_unique].mean(axis=1)
        points = np.concatenate([middles, mesh.vertices, edges])
        self._surface = points[np.argsort(points[:, 0], kind="stable")]
        self._tolerance = 0.0
        self._joining: Joining[Floats] | None = None  # None: the solid is convex

    def __len__(self) -> int:
        return len(self._joining) if self._joining else 1

    def join(self, tolerance: float) -> None:
        """Merge pieces within a tolerance, in largest extents, that grows from call to call."""
        self._tolerance = tolerance
        if self._joining is None:
            if self._near_enough(_hull(self._mesh.vertices)):
                return
            areas, neighbours = self._mesh.area_faces, self._mesh.face_adjacency.tolist()
            self._joining = Joining(self._make_pieces(), areas, neighbours)
        self._joining.join(self._join_pair)

    def corners(self, spare: int) -> list[Floats]:
        """Return corners (n, 3) of all pieces; up to `spare` further pieces fill the middle."""
        if self._joining is None:
            return [self._mesh.vertices]
        outer = [p for p in self._joining.patches if _hull(p) is not None]
        return outer + self._fill_middle(outer, spare)

    def _make_pieces(self) -> list[Floats]:
        """Return a convex piece behind each face, deep where thickness and tolerance allow."""
        mesh = self._mesh
        ways = -mesh.vertex_normals
        starts, ends = mesh.vertices + ASIDE * ways, mesh.vertices + OUT * ways
        free = np.zeros(len(starts))
        for k, (start, end) in enumerate(zip(starts.tolist(), ends.tolist(), strict=True)):
            hits = self._solid.ray_cast(start, end)
            if len(hits) % 2:  # else it begins outside, where the surface folds over
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

    def _join_pair(self, one: Floats, two: Floats) -> Floats | None:
        both = np.concatenate([one, two])
        hull = _hull(both)
        if hull is None:
            return both
        return both[hull.vertices] if self._near_enough(hull) else None

    def _near_enough(self, hull: ConvexHull | None) -> bool:
        """Return whether a hull covers the surface nowhere deeper than the tolerance."""
        if hull is None:
            return False
        low, high = hull.min_bound, hull.max_bound
        first, last = np.searchsorted(self._surface[:, 0], (low[0], high[0]))
        points = self._surface[first:last]
        y, z = points[:, 1], points[:, 2]
        points = points[(y > low[1]) & (y < high[1]) & (z > low[2]) & (z < high[2])]
        planes = interleave_directions(hull.equations)
        for k in range(0, len(planes), FACES):  # few points remain after some planes
            some = planes[k : k + FACES]
            depth = -(points @ some[:, :3].T + some[:, 3]).max(axis=1, initial=-np.inf)
            points = points[depth > self._tolerance]
        return len(points) == 0

    def _fill_middle(self, outer: list[Floats], spare: int) -> list[Floats]:
        """Return at most `spare` pieces that fill the space left by the outer ones."""
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
    """Return the convex hull; None if the points are flat."""
    try:
        return ConvexHull(points)
    except QhullError:
        return None
