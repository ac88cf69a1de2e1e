"""Fewer triangles, where nothing that a whisker feels is lost."""

import numpy as np
import trimesh
from fast_simplification import simplify

from tactile_rt.sim_backend.objects.deviation import TriangleSurface, some

__all__ = ["simplified"]

SHARES = (0.25, 0.5, 1.0)  # of the most triangles, that are tried
HASTE = (3.0, 7.0, 10.0)  # how fast the cost of an edge that goes may grow, until few are left


def simplified(mesh: trimesh.Trimesh, tolerance: float, most: int) -> trimesh.Trimesh:
    """The mesh with as few triangles as stay within a tolerance, about `most` of them at most.

    Edges go in the order of quadric error metrics (Garland and Heckbert 1997); how far the surface
    has moved is measured, both ways. A mesh with more triangles than can be dealt with is
    simplified farther than the tolerance.

    Args:
        mesh: in the unit box.
        tolerance: how far the surface may move, in largest extents.
        most: the number of triangles that can be dealt with.
    """
    if len(mesh.faces) <= SHARES[0] * most:
        return mesh
    before, fewer = TriangleSurface(mesh.triangles), mesh
    points = some(before.points)
    for number in (round(share * most) for share in SHARES):
        if len(mesh.faces) <= number:
            return mesh
        fewer = _with_faces(mesh, number)
        after = TriangleSurface(fewer.triangles)
        moved = max(after.distance(points).max(), before.distance(some(after.points)).max())
        if moved <= tolerance:
            break
    return fewer


def _with_faces(mesh: trimesh.Trimesh, number: int) -> trimesh.Trimesh:
    fewer = mesh
    for haste in HASTE:
        corners, faces = simplify(
            np.asarray(mesh.vertices, np.float64),
            np.asarray(mesh.faces, np.int32),
            target_count=number,
            agg=haste,
        )
        fewer = trimesh.Trimesh(corners, faces, process=False)
        if len(faces) <= 1.2 * number:
            break
    return fewer
