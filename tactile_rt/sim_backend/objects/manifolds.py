"""Closed meshes as solids: their bodies, the outside of their union, and back."""

from collections.abc import Sequence

import manifold3d
import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray

__all__ = ["bodies_of", "faces_of", "in_unit_box", "outer_solid", "surface_of"]


def bodies_of(mesh: trimesh.Trimesh) -> list[Manifold]:
    """The connected parts of a closed mesh, all wound outward; none if its faces do not match.

    Turning one that is wound inward fills it if it is a void, which nothing can touch, and puts it
    right if it is a body.
    """
    arrays = manifold3d.Mesh64(np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.uint64))
    return [b if b.volume() > 0 else _turned(b) for b in Manifold(arrays).decompose()]


def outer_solid(bodies: Sequence[Manifold]) -> Manifold:
    """The union of bodies, without the voids between them."""
    union = Manifold.batch_boolean(list(bodies), manifold3d.OpType.Add)
    shells = [shell for shell in union.decompose() if shell.volume() > 0]
    return Manifold.batch_boolean(shells, manifold3d.OpType.Add)


def in_unit_box(solid: Manifold) -> Manifold:
    """The solid moved and scaled: centred at the origin, of largest extent 1."""
    low, high = np.split(np.array(solid.bounding_box()), 2)
    return solid.translate(list(-(low + high) / 2)).scale([1 / float((high - low).max())] * 3)


def surface_of(solid: Manifold) -> trimesh.Trimesh:
    """The solid's surface."""
    arrays = solid.to_mesh64()
    return trimesh.Trimesh(
        arrays.vert_properties[:, :3].copy(), arrays.tri_verts.astype(np.int64), process=False
    )


def faces_of(solid: Manifold, original: int) -> NDArray[np.float64]:
    """(n, 3, 3) those faces of a solid that came from one of those it was made of."""
    arrays = solid.to_mesh64()
    faces = np.zeros(len(arrays.tri_verts), bool)
    for k, run in enumerate(arrays.run_original_id):
        faces[arrays.run_index[k] // 3 : arrays.run_index[k + 1] // 3] = run == original
    triangles: NDArray[np.float64] = arrays.vert_properties[:, :3][
        arrays.tri_verts[faces].astype(np.int64)
    ]
    return triangles


def _turned(body: Manifold) -> Manifold:
    arrays = body.to_mesh64()
    corners, faces = arrays.vert_properties[:, :3], arrays.tri_verts[:, ::-1]
    return Manifold(manifold3d.Mesh64(corners.copy(), faces.copy()))
