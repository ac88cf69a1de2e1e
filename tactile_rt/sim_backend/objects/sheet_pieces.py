"""A surface that encloses nothing, as thin convex plates.

The faces of a sheet are joined with their neighbours to flat patches of convex outline, the
smallest first, as long as they stay within the tolerance of being flat and convex. Each patch
becomes a plate that reaches equally far to both sides of the sheet. Plates of neighbours share
their corners, so that nothing gapes where the sheet bends.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from tactile_rt.sim_backend.objects.joining import Joining

__all__ = ["SheetPieces"]

Floats = NDArray[np.float64]

FOLDED = 0.5  # cosine of the angle by which a patch's parts may be turned against it
ALONG = np.linspace(0, 1, 4, endpoint=False)[:, None, None]  # where an outline is looked at


@dataclass(frozen=True)
class _Patch:
    area: Floats  # (3,) normal, as long as the area
    corners: frozenset[int]
    outline: frozenset[tuple[int, int]]


class SheetPieces:
    """The plates of a sheet: `join` them, then ask for their `corners`.

    Args:
        sheet: any surface, in the unit box.
        half: how far a plate reaches to either side, in largest extents.
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
        """Join plates as far as a tolerance allows, in largest extents; each time a larger one."""
        self._tolerance = tolerance
        self._joining.join(self._joined)

    def corners(self) -> list[Floats]:
        """The (n, 3) corners of each plate."""
        mesh, plates = self._mesh, []
        for patch in self._joining.patches:
            size = float(np.linalg.norm(patch.area))
            if size == 0:  # a needle; what is beside it reaches to its corners
                continue
            normal = patch.area / size
            index = np.array(sorted(patch.corners))
            points = mesh.vertices[index]
            hull = _outline(points, normal)
            if hull is None:
                continue
            index, points = index[hull.vertices], points[hull.vertices]
            # towards the common normal of all that meet in a corner, as far as is needed for the
            # plate to be as thick as it should
            ways = mesh.vertex_normals[index]
            along = ways @ normal
            ways = np.where(
                np.abs(along)[:, None] > FOLDED,
                ways / np.where(along == 0, 1, along)[:, None],
                normal,
            )
            plates.append(np.concatenate([points - self._half * ways, points + self._half * ways]))
        return plates

    def _joined(self, one: _Patch, two: _Patch) -> _Patch | None:
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
        hull = _outline(points, normal)
        if hull is None:
            return None
        begin, end = vertices[np.array(list(patch.outline))].transpose(1, 0, 2)
        along = _flat((begin + ALONG * (end - begin)).reshape(-1, 3), normal)
        depth = -(along @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1)
        return patch if depth.max() <= self._tolerance else None


def _flat(points: Floats, normal: Floats) -> Floats:
    """(n, 2) points seen along a normal."""
    one = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    one /= np.linalg.norm(one)
    seen: Floats = points @ np.stack([one, np.cross(normal, one)], axis=1)
    return seen


def _outline(points: Floats, normal: Floats) -> ConvexHull | None:
    """The convex outline of points seen along a normal; None of those on a line."""
    try:
        return ConvexHull(_flat(points, normal))
    except QhullError:
        return None
