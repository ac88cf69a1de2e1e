"""Cutting a solid into convex pieces that stay within a stated distance of its surface.

The part that is worst is cut in two, by that plane of some dozens which leaves the smallest convex
hulls, until the hull of every part is near enough; then hulls that fit in one are joined. A hull is
near enough when no point of the solid's surface lies deeper inside it than the tolerance, and no
point of its own lies farther outside the solid. Concave corners are cut along their own faces (an L
becomes two boxes exactly); a smooth hollow becomes facets as wide as the tolerance allows. At last
the union is measured: two hulls that bulge into a narrow cleft from either side may fill it, and
are cut further.

CoACD (Wei et al. 2022) bounds the volume that hulls add and a sampled distance instead. It is good
for few, coarse pieces; see docs/objects.md for the same meshes in both ways.
"""

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from tactile_rt.sim_backend.objects.deviation import (
    FACES,
    TOUCHING,
    Deviation,
    TriangleSurface,
    deviation,
    shuffled,
    tiles,
)
from tactile_rt.sim_backend.objects.manifolds import faces_of, surface_of

__all__ = ["cut_solid"]

Floats = NDArray[np.float64]
Plane = tuple[Floats, float]  # unit normal, distance from the origin along it

CORNER_DIGITS = 7  # of a largest extent: 4e-6 mm at 40 mm
THIN = 5e-6  # volume over area, in largest extents; a thinner hull is rounding
NO_GAIN = 1e-12  # volumes differ by rounding if by less than this
SLIVER = 1e-5  # a cut that leaves a smaller share of a part's volume is none
AXIS_CUTS = 5  # planes tried across each axis
TURNS = 4  # planes tried through the worst point, along the surface's normal there
EDGES = 5  # concave edges tried: the heaviest, and the nearest to the worst point
CONCAVE = 0.02  # rad; edges flatter than this are part of a smooth surface
FEW = 500  # points of the surface looked at first
COARSE = 1 / 60  # tiles of a hull's faces outside the solid
PARTS = 4  # parts cut for every piece allowed: joining leaves a third of them
WORK = 20_000_000  # triangles cut in trying planes: a minute; then hulls stay as they are
MARGIN = 0.85  # of the tolerance: the rest is for what falls between the points
ROUGH = 0.2  # of a hull's excess and of the part's thickness: details smaller choose no plane
FINER = (0.5, 0.25)  # of the tolerance: for hulls that are beyond it together
WIDER = 1.15  # tolerances tried where the pieces allowed are too few


def cut_solid(
    solid: Manifold, tolerance: float, max_pieces: int
) -> tuple[list[trimesh.Trimesh], Deviation]:
    """Convex pieces whose union is the solid to within the tolerance, or as near as they come.

    Args:
        solid: of largest extent 1.
        tolerance: largest distance between the surfaces, in largest extents.
        max_pieces: the tolerance is widened until this many do.

    Returns:
        The pieces, and how far they are from the solid.
    """
    cutter = _Cutter(solid, tolerance)
    near = MARGIN * tolerance
    hulls = cutter.join(cutter.cut(solid, near, PARTS * max_pieces), near)
    while len(hulls) > max_pieces:
        near *= WIDER
        hulls = cutter.join(hulls, near)
    found = deviation(cutter.surface, [hull.mesh for hull in hulls])
    for share in FINER:
        if found.largest <= tolerance or near > tolerance:
            break
        finer = cutter.cut_where(hulls, found, share * tolerance)
        if len(finer) > max_pieces:
            break
        hulls, found = finer, deviation(cutter.surface, [hull.mesh for hull in finer])
    return [hull.mesh for hull in hulls], found


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

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        # corners that rounding doubled would leave faces without area
        corners = np.unique(np.round(self.vertices, CORNER_DIGITS), axis=0)
        solid: trimesh.Trimesh = trimesh.convex.convex_hull(corners)
        return solid


def _hull(points: Floats) -> _Hull:
    # not Manifold's: it may leave out corners where slivers meet
    qhull = ConvexHull(points)
    return _Hull(points[qhull.vertices], shuffled(qhull.equations), qhull.volume, qhull.area)


class _Cutter:
    def __init__(self, solid: Manifold, tolerance: float) -> None:
        self.tolerance = tolerance
        self.solid = solid
        self.surface = TriangleSurface(surface_of(solid).triangles)
        self.normals = np.cross(*np.diff(self.surface.tiles, axis=1).transpose(1, 0, 2))
        self.columns = self.surface.points.T.copy()
        self.work = 0

    def cut(self, solid: Manifold, tolerance: float, parts: int) -> list[_Hull]:
        """Hulls of the parts that a solid is cut into.

        Args:
            solid: this one, or a part of it.
            tolerance: hulls are near enough when no farther out than this.
            parts: at most so many, and some that fall off with the last.
        """
        done: list[_Hull] = []
        queue: list[tuple[float, int, Manifold, _Hull, Floats]] = []
        number = count()

        def add(part: Manifold) -> None:
            for body in part.decompose():
                try:
                    hull = _hull(surface_of(body).vertices)
                except QhullError:  # flat
                    continue
                if hull.volume < THIN * hull.area:
                    continue
                depth, worst = self.excess(hull, tolerance)
                if depth <= tolerance:
                    done.append(hull)
                else:
                    heapq.heappush(queue, (-depth, next(number), body, hull, worst))

        add(solid)
        while queue and len(done) + len(queue) < parts and self.work < WORK:
            depth, _, body, hull, worst = heapq.heappop(queue)
            halves = self.halve(body, -depth, worst)
            if halves:
                add(halves[0])
                add(halves[1])
            else:
                done.append(hull)
        return done + [hull for _, _, _, hull, _ in queue]

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
        bare = tiles(faces_of(hull.solid - self.solid, hull.solid.original_id()), COARSE)
        if len(bare):
            points = np.concatenate([bare.mean(axis=1), bare[:, 0]])
            away, _ = self.surface.bound(points)
            if away.max() <= enough + self.surface.reach:
                points = points[away > enough]
                away = self.surface.distance(points) if len(points) else np.zeros(1)
            if away.max() > enough:
                return float(away.max()), points[away.argmax()]
        return 0.0, (low + high) / 2

    def halve(
        self, part: Manifold, depth: float, worst: Floats
    ) -> tuple[Manifold, Manifold] | None:
        """The part cut by the plane that leaves the smallest hulls."""
        thickness = 2 * part.volume() / part.surface_area()
        plane = self.best_plane(part.simplify(ROUGH * min(depth, thickness)), worst)
        if plane is None:
            return None
        one, two = part.split_by_plane(plane[0].tolist(), plane[1])
        return (one, two) if min(one.volume(), two.volume()) > 0 else None

    def best_plane(self, part: Manifold, worst: Floats) -> Plane | None:
        """The plane that leaves the smallest hulls."""
        best, least = None, np.inf
        scale = SLIVER * part.volume()
        for normal, offset in self.planes(surface_of(part), worst):
            self.work += part.num_tri()
            halves = part.split_by_plane(normal.tolist(), offset)
            if min(half.volume() for half in halves) < scale:
                continue
            volume = sum(b.hull().volume() for half in halves for b in half.decompose())
            if volume < least - NO_GAIN:
                best, least = (normal, offset), volume
        return best

    def planes(self, mesh: trimesh.Trimesh, worst: Floats) -> Iterator[Plane]:
        """Where a part may be cut."""
        low, high = mesh.bounds
        shares = np.arange(1, AXIS_CUTS + 1) / (AXIS_CUTS + 1)
        # of cuts that are as good as each other the first is made: it must not leave ever thinner
        # slices
        for axis in np.argsort(low - high):
            normal = np.eye(3)[axis]
            for share in shares[np.argsort(np.abs(shares - 0.5), kind="stable")]:
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

    def cut_where(self, hulls: Sequence[_Hull], found: Deviation, finer: float) -> list[_Hull]:
        """The hulls, those of them cut further that are beyond the tolerance somewhere."""
        far = found.points[found.gaps > self.tolerance]
        done = []
        for hull in hulls:
            depth = hull.planes[:, :3] @ far.T + hull.planes[:, 3:]
            if (depth.max(axis=0) < TOUCHING).any():
                parts = self.cut(hull.solid ^ self.solid, finer, PARTS * len(hulls))
                done += self.join(parts, finer)
            else:
                done.append(hull)
        return done

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
