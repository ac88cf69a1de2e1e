"""Cutting a solid into convex pieces that stay within a stated distance of its surface.

The part that is worst is cut in two, by that plane of some dozens which leaves the smallest convex
hulls, until the hull of every part is near enough; then hulls that fit in one are joined. A hull is
near enough when no point of the solid's surface lies deeper inside it than the tolerance, and no
point of its own lies farther outside the solid. Concave corners are cut along their own faces (an L
becomes two boxes exactly); a smooth hollow becomes facets as wide as the tolerance allows.

CoACD (Wei et al. 2022) bounds the volume that hulls add and a sampled distance instead. It is good
for few, coarse pieces; a torus to 0.1 mm of 40 takes it 513 pieces and 60 s, and this 41 and 4 s.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count

import manifold3d
import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from tactile_rt.sim_backend.objects.deviation import FACES, Surface, shuffled, tiles

__all__ = ["cut_solid", "outer_solid", "surface_of"]

Floats = NDArray[np.float64]
Plane = tuple[Floats, float]  # unit normal, distance from the origin along it

DUST = 1e-13  # a part of less volume than this (largest extent cubed) is rounding
SLIVER = 1e-5  # a cut that leaves a smaller share of a part's volume is none
AXIS_CUTS = 5  # planes tried across each axis
TURNS = 4  # planes tried through the worst point, along the surface's normal there
EDGES = 5  # concave edges tried: the heaviest, and the nearest to the worst point
CONCAVE = 0.02  # rad; edges flatter than this are part of a smooth surface
FEW = 500  # points of the surface looked at first
COARSE = 1 / 60  # tiles of a hull's faces outside the solid
PARTS = 4  # parts cut for every piece allowed: joining leaves a third of them
MARGIN = 0.85  # of the tolerance: the rest is for what falls between the points
WIDER = 1.3  # tolerances tried where the pieces allowed are too few


def outer_solid(bodies: Sequence[trimesh.Trimesh]) -> Manifold | None:
    """The union of closed bodies without their inner voids; None if their faces do not match."""
    solids = [_solid(body) for body in bodies]
    if any(s.status() != manifold3d.Error.NoError for s in solids):
        return None
    union = Manifold.batch_boolean(solids, manifold3d.OpType.Add)
    # a void's shell is wound inward: nothing can touch it
    shells = [_solid(s) for s in surface_of(union).split(only_watertight=False, repair=False)]
    return Manifold.batch_boolean([s for s in shells if s.volume() > 0], manifold3d.OpType.Add)


def surface_of(solid: Manifold) -> trimesh.Trimesh:
    """The solid's surface."""
    arrays = solid.to_mesh64()
    return trimesh.Trimesh(
        arrays.vert_properties[:, :3].copy(), arrays.tri_verts.astype(np.int64), process=False
    )


def cut_solid(solid: Manifold, tolerance: float, max_pieces: int) -> list[trimesh.Trimesh]:
    """Convex pieces whose union is the solid to within the tolerance, or as near as pieces allow.

    Args:
        solid: of largest extent 1.
        tolerance: largest distance between the surfaces, in largest extents.
        max_pieces: the tolerance is widened until this many do.
    """
    cutter = _Cutter(solid, MARGIN * tolerance)
    hulls, reached = cutter.cut(PARTS * max_pieces)
    hulls = cutter.join(hulls, reached)
    while len(hulls) > max_pieces:
        reached *= WIDER
        hulls = cutter.join(hulls, reached)
    return [trimesh.convex.convex_hull(hull.vertices) for hull in hulls]


@dataclass(frozen=True)
class _Hull:
    """Convex hull: x is inside if planes @ (x, 1) <= 0 for all of its (n, 4) planes."""

    vertices: Floats
    planes: Floats
    volume: float
    area: float

    @cached_property
    def box(self) -> tuple[Floats, Floats]:
        return self.vertices.min(axis=0), self.vertices.max(axis=0)

    @cached_property
    def solid(self) -> Manifold:
        return Manifold.hull_points(self.vertices).as_original()


def _hull(points: Floats) -> _Hull:
    # not Manifold's: it may leave out corners where slivers meet
    qhull = ConvexHull(points)
    return _Hull(points[qhull.vertices], shuffled(qhull.equations), qhull.volume, qhull.area)


class _Cutter:
    def __init__(self, solid: Manifold, tolerance: float) -> None:
        self.tolerance = tolerance
        self.solid = solid
        mesh = surface_of(solid)
        self.surface = Surface(mesh.triangles)
        self.normals = np.cross(*np.diff(self.surface.tiles, axis=1).transpose(1, 0, 2))
        self.columns = np.concatenate([mesh.vertices, self.surface.middles]).T.copy()

    def cut(self, max_parts: int) -> tuple[list[_Hull], float]:
        """Hulls of the parts, and the farthest out that one is (the tolerance at least)."""
        done: list[_Hull] = []
        queue: list[tuple[float, int, Manifold, _Hull, Floats]] = []
        number = count()

        def add(part: Manifold) -> None:
            for body in part.decompose():
                if body.volume() < DUST:
                    continue
                try:
                    hull = _hull(surface_of(body).vertices)
                except QhullError:  # flat
                    continue
                depth, worst = self.excess(hull, self.tolerance)
                if depth <= self.tolerance:
                    done.append(hull)
                else:
                    heapq.heappush(queue, (-depth, next(number), body, hull, worst))

        add(self.solid)
        reached = self.tolerance
        while queue and len(done) + len(queue) < max_parts:
            depth, _, body, hull, worst = heapq.heappop(queue)
            halves = self.halve(body, worst)
            if halves:
                add(halves[0])
                add(halves[1])
            else:
                done.append(hull)
                reached = max(reached, -depth)
        left = [hull for _, _, _, hull, _ in queue]
        return done + left, max([reached, *(-item[0] for item in queue)])

    def excess(self, hull: _Hull, enough: float) -> tuple[float, Floats]:
        """How far a hull is from the solid, and where; 0 if no farther than `enough`."""
        low, high = hull.box
        near = np.logical_and.reduce(
            [(self.columns[k] > low[k]) & (self.columns[k] < high[k]) for k in range(3)]
        )
        points = self.columns[:, near]
        for some in (points[:, :: 1 + points.shape[1] // FEW], points):
            depth = np.full(some.shape[1], np.inf)
            for k in range(0, len(hull.planes), FACES):  # few points stay deeper for long
                planes = hull.planes[k : k + FACES]
                depth = np.minimum(depth, -(planes[:, :3] @ some + planes[:, 3:]).max(axis=0))
                some, depth = some[:, depth > enough], depth[depth > enough]
            if len(depth):
                return float(depth.max()), some[:, depth.argmax()]
        bare = tiles(_faces_of(hull.solid - self.solid, hull.solid.original_id()), COARSE)
        if len(bare):
            points = np.concatenate([bare.mean(axis=1), bare[:, 0]])
            away, _ = self.surface.bound(points)
            if away.max() <= enough + self.surface.reach:
                points = points[away > enough]
                away = self.surface.distance(points) if len(points) else np.zeros(1)
            if away.max() > enough:
                return float(away.max()), points[away.argmax()]
        return 0.0, (low + high) / 2

    def halve(self, part: Manifold, worst: Floats) -> tuple[Manifold, Manifold] | None:
        """The part cut by the plane that leaves the smallest hulls."""
        best, least = None, np.inf
        scale = SLIVER * part.volume()
        for normal, offset in self.planes(part, worst):
            one, two = part.split_by_plane(normal.tolist(), offset)
            if min(one.volume(), two.volume()) < scale:
                continue
            volume = sum(b.hull().volume() for half in (one, two) for b in half.decompose())
            if volume < least - 1e-12:
                best, least = (one, two), volume
        return best

    def planes(self, part: Manifold, worst: Floats) -> Iterator[Plane]:
        """Where a part may be cut."""
        mesh = surface_of(part)
        low, high = mesh.bounds
        for axis in range(3):
            normal = np.eye(3)[axis]
            for share in np.arange(1, AXIS_CUTS + 1) / (AXIS_CUTS + 1):
                yield normal, float(low[axis] + share * (high[axis] - low[axis]))
            yield normal, float(worst[axis])
        angles = np.where(mesh.face_adjacency_convex, 0.0, mesh.face_adjacency_angles)
        ends = mesh.vertices[mesh.face_adjacency_edges]
        weight = angles * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        near = np.linalg.norm(ends.mean(axis=1) - worst, axis=1) + np.where(angles > CONCAVE, 0, 9)
        for edge in {*np.argsort(-weight)[:EDGES].tolist(), *np.argsort(near)[:EDGES].tolist()}:
            if angles[edge] <= CONCAVE:
                continue
            a, b = mesh.face_normals[mesh.face_adjacency[edge]]
            for normal in (a, b, (a - b) / np.linalg.norm(a - b)):
                yield normal, float(normal @ ends[edge, 0])
        _, tile = self.surface.bound(worst[None])
        up = self.normals[tile[0]] / max(np.linalg.norm(self.normals[tile[0]]), 1e-30)
        one = np.cross(up, np.eye(3)[np.abs(up).argmin()])
        one /= max(np.linalg.norm(one), 1e-30)
        for angle in np.arange(TURNS) * np.pi / TURNS:
            normal = np.cos(angle) * one + np.sin(angle) * np.cross(up, one)
            yield normal, float(normal @ worst)

    def join(self, hulls: Sequence[_Hull], tolerance: float) -> list[_Hull]:
        """Neighbours replaced by their common hull where that is within the tolerance."""
        alive = dict(enumerate(hulls))
        queue: list[tuple[float, int, int]] = []

        def propose(k: int, others: Sequence[int]) -> None:
            low, high = alive[k].box
            lows = np.array([alive[i].box[0] for i in others])
            highs = np.array([alive[i].box[1] for i in others])
            for i in np.flatnonzero(((lows <= high) & (highs >= low)).all(axis=1)).tolist():
                one, two = alive[k], alive[others[i]]
                both = Manifold.batch_hull([one.solid, two.solid])
                added = both.volume() - one.volume - two.volume
                if added < tolerance * both.surface_area():  # else deeper somewhere
                    heapq.heappush(queue, (added, others[i], k))

        for k in range(1, len(hulls)):
            propose(k, range(k))
        new = count(len(hulls))
        while queue:
            _, i, j = heapq.heappop(queue)
            if i not in alive or j not in alive:
                continue
            both = _hull(np.concatenate([alive[i].vertices, alive[j].vertices]))
            if self.excess(both, tolerance)[0] > tolerance:
                continue
            del alive[i], alive[j]
            k = next(new)
            others = list(alive)
            alive[k] = both
            if others:
                propose(k, others)
        return list(alive.values())


def _solid(mesh: trimesh.Trimesh) -> Manifold:
    return Manifold(
        manifold3d.Mesh64(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.uint64))
    )


def _faces_of(solid: Manifold, original: int) -> Floats:
    """(n, 3, 3) those faces of a solid that came from one of those it was made of."""
    arrays = solid.to_mesh64()
    faces = np.zeros(len(arrays.tri_verts), bool)
    for k, run in enumerate(arrays.run_original_id):
        faces[arrays.run_index[k] // 3 : arrays.run_index[k + 1] // 3] = run == original
    triangles: Floats = arrays.vert_properties[:, :3][arrays.tri_verts[faces].astype(np.int64)]
    return triangles
