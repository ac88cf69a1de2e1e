"""Closed meshes to cut, and another measure of how far pieces are from them: by brute force."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import manifold3d
import numpy as np
import trimesh
from manifold3d import CrossSection, Manifold
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from tactile_rt.sim_backend.objects.catalogue import TactileObject

Floats = NDArray[np.float64]

TOGETHER = 64  # triangles


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


def write_glb(path: Path, primitive: dict[str, object], data: bytes, **more: object) -> None:
    """Write a binary glTF 2.0 of one mesh of one primitive; `more` is of its JSON."""
    told = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}], "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(data)}], **more,
    }  # fmt: skip
    text = json.dumps(told).encode()
    chunks = b""
    for kind, content, fill in ((b"JSON", text, b" "), (b"BIN\0", data, b"\0")):
        content += fill * (-len(content) % 4)
        chunks += struct.pack("<I4s", len(content), kind) + content
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


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


def to_triangles(points: Floats, triangles: Floats) -> Floats:
    """(n,) distance of each point to the nearest triangle, all of them tried."""
    best = np.full(len(points), np.inf)
    for some in np.array_split(triangles, 1 + len(triangles) // TOGETHER):
        every, at = np.repeat(some, len(points), axis=0), np.tile(points, (len(some), 1))
        away = np.linalg.norm(at - trimesh.triangles.closest_point(every, at), axis=1)
        best = np.minimum(best, away.reshape(len(some), -1).min(axis=0))
    return best


def depth(points: Floats, piece: trimesh.Trimesh) -> Floats:
    """(n,) how deep inside a convex piece; negative outside."""
    planes = ConvexHull(piece.vertices).equations
    deep: Floats = -(points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    return deep


def sampled(mesh: trimesh.Trimesh, pieces: Sequence[trimesh.Trimesh]) -> tuple[float, ...]:
    """Farthest that the outside of the pieces is from the mesh; that the mesh is from the pieces
    where outside them; and that it lies deep inside one: each by brute force on random points."""
    skin = []
    for k, piece in enumerate(pieces):
        number = max(10, int(2000 * piece.area / sum(p.area for p in pieces)))
        points, _ = trimesh.sample.sample_surface(piece, number, seed=k)
        others = [depth(points, p) for p in pieces if p is not piece]
        skin.append(points[np.max(others, axis=0) < -1e-6] if others else points)
    beyond = to_triangles(np.concatenate(skin), mesh.triangles)
    points, _ = trimesh.sample.sample_surface(mesh, 600, seed=1)
    points = np.concatenate([points, mesh.vertices[:600]])
    depths = np.max([depth(points, p) for p in pieces], axis=0)
    out = points[depths < -1e-7]
    away = np.full(len(out), np.inf)
    for piece in pieces:
        near = ((out > piece.bounds[0] - 0.01) & (out < piece.bounds[1] + 0.01)).all(axis=1)
        if near.any():
            away[near] = np.minimum(away[near], to_triangles(out[near], piece.triangles))
    return float(beyond.max()), float(away.max(initial=0.0)), float(depths.max())


def inside(thing: TactileObject, point: tuple[float, float, float]) -> bool:
    """Whether the point is in any of the convex pieces: behind all faces of one."""
    return any(
        bool((((point - p.triangles[:, 0]) * p.face_normals).sum(axis=1) <= 1e-9).all())
        for p in thing.pieces
    )
