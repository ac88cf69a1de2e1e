"""Closed meshes to cut, and another measure of how far pieces are from them.

The package tiles both surfaces and looks from the middles of the tiles; here both are sampled at
random, and what of a piece lies in another is told by the planes of its triangles.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import manifold3d
import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Floats = NDArray[np.float64]

NEAREST = 24  # samples whose triangles are asked for their distance
ON = 1e-7  # so near to a face's plane, in largest extents, is on it
OFF = 5e-5  # so far off its face a sample is looked for in another piece


def as_mesh(solid: Manifold) -> trimesh.Trimesh:
    """Its surface, in the unit box."""
    arrays = solid.to_mesh64()
    vertices = arrays.vert_properties[:, :3]
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    vertices = (vertices - (low + high) / 2) / (high - low).max()
    return trimesh.Trimesh(vertices, arrays.tri_verts.astype(int), process=False)


def one_mesh(pieces: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """The union of closed meshes as one closed mesh."""
    solids = [
        Manifold(manifold3d.Mesh64(np.array(p.vertices), np.array(p.faces, np.uint64)))
        for p in pieces
    ]
    return as_mesh(Manifold.batch_boolean(solids, manifold3d.OpType.Add))


def box(x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> Manifold:
    """Between these coordinates."""
    low, high = np.array([x, y, z]).T
    return Manifold.cube(list(high - low)).translate(list(low))


def torus(radius: float, tube: float, around: int = 32, across: int = 16) -> trimesh.Trimesh:
    """About the z axis, its vertices on the true torus; lengths in the caller's unit."""
    return trimesh.creation.torus(radius, tube, major_sections=around, minor_sections=across)


def bracket() -> trimesh.Trimesh:
    """An L of 40 x 30 mm, 6 mm thick, 20 mm wide."""
    return as_mesh(box((0, 40), (0, 20), (0, 6)) + box((0, 6), (0, 20), (0, 30)))


def channel() -> trimesh.Trimesh:
    """A gutter 40 mm long, walls and floor 4 mm thick."""
    return as_mesh(box((0, 40), (0, 20), (0, 16)) - box((-1, 41), (4, 16), (4, 17)))


def gear(teeth: int = 8) -> trimesh.Trimesh:
    """A spur gear 40 mm across and 8 mm thick with a bore."""
    profile = []
    for k in range(teeth):
        for share, radius in ((-0.3, 15), (-0.15, 20), (0.15, 20), (0.3, 15)):
            angle = 2 * np.pi * (k + share) / teeth
            profile.append((radius * np.cos(angle), radius * np.sin(angle)))
    hole = [(5 * np.cos(a), 5 * np.sin(a)) for a in np.arange(8) * np.pi / 4]
    section = CrossSection([profile]) - CrossSection([hole])
    return as_mesh(Manifold.extrude(section, 8.0))


def bowl(sides: int = 24) -> trimesh.Trimesh:
    """A round bowl 40 mm across, 15 mm deep, its wall 3 mm thick."""
    angle = np.radians(np.linspace(-90, 0, 7))
    outer = [(20 * np.cos(a), 15 * np.sin(a)) for a in angle]
    inner = [(17 * np.cos(a), 12 * np.sin(a)) for a in angle[::-1]]
    return as_mesh(Manifold.revolve(CrossSection([outer + inner]), sides))


def mug(sides: int = 24) -> trimesh.Trimesh:
    """A cup 40 mm high with a handle."""
    cup = Manifold.cylinder(40, 14, 14, sides) - Manifold.cylinder(40, 11.5, 11.5, sides).translate(
        [0, 0, 3]
    )
    turns = np.arange(8) * np.pi / 4
    ring = CrossSection([[(9 + 2.5 * np.cos(a), 2.5 * np.sin(a)) for a in turns]])
    handle = Manifold.revolve(ring, 16).rotate([90, 0, 0]).translate([15, 0, 20])
    return as_mesh(cup + (handle - Manifold.cylinder(40, 12.5, 12.5, sides)))


def blob(subdivisions: int) -> trimesh.Trimesh:
    """A smooth lump with hollows: 20 * 4^subdivisions triangles."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    x, y, z = mesh.vertices.T
    waves = 0.12 * np.sin(5 * x + 1) * np.sin(6 * y) * np.cos(4 * z)
    ripples = 0.05 * np.sin(13 * x) * np.sin(11 * y + 2)
    mesh.vertices = mesh.vertices * (1 + waves + ripples)[:, None]
    return mesh


def sheet_chair() -> trimesh.Trimesh:
    """As ShapeNet's are: y-up, open sheets and thin legs that pass through each other."""
    seat = trimesh.creation.box((1, 0.06, 1))
    back = trimesh.Trimesh(
        [(-0.5, 0, -0.5), (0.5, 0, -0.5), (0.5, 1, -0.6), (-0.5, 1, -0.6)], [(0, 1, 2), (0, 2, 3)]
    )
    legs = []
    for x in (-0.45, 0.45):
        for z in (-0.45, 0.45):
            leg = trimesh.creation.box((0.08, 0.9, 0.08))
            leg.apply_translation((x, -0.42, z))
            leg.update_faces(np.abs(leg.face_normals[:, 1]) < 0.5)  # open at both ends
            legs.append(leg)
    return trimesh.util.concatenate([seat, back, *legs])


@dataclass(frozen=True)
class Sampled:
    """Distances between a mesh and the outside of a union of pieces, both sampled at random.

    Attributes:
        beyond: the farthest that the outside of the pieces is from the mesh.
        missed: (least, most) that the farthest of the mesh can be from the outside: where a point
            is inside, its distance is bounded by its depth in any one piece and by the nearest
            sample of the outside.
    """

    beyond: float
    missed: tuple[float, float]


def sampled(
    mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh], count: int = 12_000
) -> Sampled:
    """Measure with about so many samples of each surface; largest extent 1."""
    points, _ = trimesh.sample.sample_surface(mesh, count, seed=1)
    points = np.concatenate([points, mesh.vertices])
    areas = np.array([piece.area for piece in pieces])
    made, faces, offset = [], [], 0
    for k, piece in enumerate(pieces):
        number = max(20, int(10 * count * areas[k] / areas.sum()))
        some, face = trimesh.sample.sample_surface(piece, number, seed=k)
        off = some + OFF * piece.face_normals[face]
        out = depths(off, [p for p in pieces if p is not piece]) <= 0
        made.append(some[out])
        faces.append(face[out] + offset)
        offset += len(piece.faces)
    outside, face = np.concatenate(made), np.concatenate(faces)
    triangles = np.concatenate([piece.triangles for piece in pieces])
    deep = depths(points, pieces)
    free = deep <= ON
    most = np.where(
        free, to_faces(points, outside, triangles[face]), cKDTree(outside).query(points)[0]
    )
    least = np.where(free, most, deep)
    drawn, owner = trimesh.sample.sample_surface(mesh, 4 * count, seed=2)
    beyond = to_faces(outside[:: max(1, len(outside) // count)], drawn, mesh.triangles[owner])
    return Sampled(float(beyond.max()), (float(least.max()), float(most.max())))


def depths(points: Floats, pieces: Sequence[trimesh.Trimesh]) -> Floats:
    """(n,) how deep points are in that piece in which they are deepest; negative outside."""
    deepest = np.full(len(points), -np.inf)
    for piece in pieces:
        low, high = piece.bounds
        near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
        if len(near):
            normals = piece.face_normals
            planes = np.einsum("ij,ij->i", normals, piece.triangles[:, 0])
            real = normals.any(axis=1)  # a triangle without height has none
            depth = (planes[real, None] - normals[real] @ points[near].T).min(axis=0)
            deepest[near] = np.maximum(deepest[near], depth)
    return deepest


def to_faces(points: Floats, samples: Floats, triangles: Floats) -> Floats:
    """(n,) distance to the nearest of those triangles that the nearest samples were drawn from."""
    _, near = cKDTree(samples).query(points, k=NEAREST)
    best = np.full(len(points), np.inf)
    for k in near.T:
        nearest = trimesh.triangles.closest_point(triangles[k], points)
        best = np.minimum(best, np.linalg.norm(nearest - points, axis=1))
    return best
