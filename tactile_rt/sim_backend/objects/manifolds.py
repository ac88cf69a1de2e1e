"""Closed meshes as solids: their bodies, the outside of their union, and back."""

from collections.abc import Sequence

import manifold3d
import numpy as np
import trimesh
from manifold3d import Manifold

__all__ = ["bodies_of", "outer_solid", "surface_of"]


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


def surface_of(solid: Manifold) -> trimesh.Trimesh:
    """The solid's surface."""
    arrays = solid.to_mesh64()
    return trimesh.Trimesh(
        arrays.vert_properties[:, :3].copy(), arrays.tri_verts.astype(np.int64), process=False
    )


def _turned(body: Manifold) -> Manifold:
    arrays = body.to_mesh64()
    corners, faces = arrays.vert_properties[:, :3], arrays.tri_verts[:, ::-1]
    return Manifold(manifold3d.Mesh64(corners.copy(), faces.copy()))
