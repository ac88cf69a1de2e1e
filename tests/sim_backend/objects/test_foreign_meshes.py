"""Meshes as other programs write them: the right size, the right way round, whole.

The solid is a box of 40 x 20 x 10 mm with a smaller one on one corner, so that a mirrored or a
turned one is told from it: only one of its eight octants is filled higher than the others.
"""

import json
import struct

import numpy as np
import pytest

pytest.importorskip("manifold3d")

import trimesh
from manifold3d import Manifold

from tactile_rt.sim_backend.objects.meshes import load_mesh
from tests.helpers.mesh_truth import one_mesh

FILLED = np.array([0.75, 0.75, 0.75])  # of the extents: inside
EMPTY = [np.array(share) for share in ([0.25, 0.75, 0.75], [0.75, 0.25, 0.75], [0.25, 0.25, 0.75])]


def corner() -> trimesh.Trimesh:
    """The solid, z up, in mm."""
    solid = Manifold.cube([40, 20, 5]) + Manifold.cube([20, 10, 5.5]).translate([20, 10, 4.5])
    arrays = solid.to_mesh64()
    return trimesh.Trimesh(arrays.vert_properties[:, :3], arrays.tri_verts.astype(int))


def is_right(path) -> None:
    """Check the extents, the volume and the side of what is read."""
    pieces = load_mesh(path).pieces
    mesh = one_mesh(pieces)
    np.testing.assert_allclose(mesh.extents * 40, [40, 20, 10], rtol=1e-5)
    assert mesh.volume * 40**3 == pytest.approx(40 * 20 * 5 + 20 * 10 * 5, rel=1e-5)
    low, high = trimesh.util.concatenate(list(pieces)).bounds

    def holds(share):
        point = low + share * (high - low)
        return any(
            (((point - p.triangles[:, 0]) * p.face_normals).sum(1) < 0).all() for p in pieces
        )

    assert holds(FILLED) and not any(holds(share) for share in EMPTY)


def gltf(path, positions, indices, mode=4, node=None):
    """Write a glTF 2.0 of one mesh, y up: positions of shape (n, 3) in m, indices."""
    points = np.asarray(positions, "<f4")
    order = np.asarray(indices, "<u4").ravel()
    data = points.tobytes() + order.tobytes()
    told = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}]}],
        "buffers": [{"byteLength": len(data)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": order.nbytes},
        ],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": 5126,
                "count": len(points),
                "type": "VEC3",
                "min": points.min(axis=0).tolist(),
                "max": points.max(axis=0).tolist(),
            },
            {"bufferView": 1, "componentType": 5125, "count": len(order), "type": "SCALAR"},
        ],
    }
    text = json.dumps(told).encode()
    text += b" " * (-len(text) % 4)
    data += b"\0" * (-len(data) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(data), 0x004E4942) + data
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


def y_up(points):
    """Turn z-up coordinates into those of glTF."""
    return np.stack([points[:, 0], points[:, 2], -points[:, 1]], axis=1)


def test_a_mirrored_node_shows_its_mesh_the_right_way_round(tmp_path):
    mesh = corner()
    mirror = y_up(mesh.vertices) * [-1, 1, 1]
    gltf(tmp_path / "a.glb", mirror, mesh.faces[:, ::-1], node={"scale": [-1, 1, 1]})
    is_right(tmp_path / "a.glb")


def test_a_turned_and_a_scaled_node_are_placed(tmp_path):
    mesh = corner()
    half = np.sqrt(0.5)
    back = y_up(mesh.vertices) / 1000
    node = {"rotation": [0, half, 0, half], "scale": [1000, 1000, 1000], "translation": [1, 2, 3]}
    turned = np.stack([-back[:, 2], back[:, 1], back[:, 0]], axis=1)  # by -90 degrees about y
    gltf(tmp_path / "a.glb", turned, mesh.faces, node=node)
    is_right(tmp_path / "a.glb")


def test_strips_of_triangles_are_all_drawn(tmp_path):
    mesh = corner()
    # Each face is a strip of its own: repeated corners join them.
    order = []
    for a, b, c in mesh.faces:
        order += [order[-1], a] if order else []
        order += [a] if len(order) % 2 else []
        order += [a, b, c]
    gltf(tmp_path / "a.glb", y_up(mesh.vertices), order, mode=5)
    is_right(tmp_path / "a.glb")


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".off", ".glb", ".3mf", ".dae"])
def test_what_trimesh_writes_has_its_size_and_side(tmp_path, suffix):
    mesh = corner()
    if suffix in (".glb", ".dae"):
        mesh.vertices = y_up(mesh.vertices)
    path = tmp_path / f"a{suffix}"
    mesh.export(path)
    is_right(path)


def test_ascii_stl_of_inches_with_capitals_and_a_name_is_read(tmp_path):
    mesh = corner()
    lines = ["SOLID the corner of a box"]
    for normal, triangle in zip(mesh.face_normals, mesh.triangles / 25.4, strict=True):
        lines += [f"  FACET NORMAL {normal[0]:e} {normal[1]:e} {normal[2]:e}", "    OUTER LOOP"]
        lines += [f"      VERTEX {x:.9e} {y:.9e} {z:.9e}" for x, y, z in triangle]
        lines += ["    ENDLOOP", "  ENDFACET"]
    (tmp_path / "a.stl").write_text("\r\n".join([*lines, "ENDSOLID", ""]))
    is_right(tmp_path / "a.stl")


def test_an_obj_of_quads_with_groups_normals_and_comments_is_read(tmp_path):
    text = "# a slab\no slab\nv 0 0 0\nv 40 0 0\nv 40 20 0\nv 0 20 0\n"
    text += (
        "v 0 0 10\nv 40 0 10\nv 40 20 10\nv 0 20 10\nvn 0 0 1\nvt 0 0\ng all\nusemtl none\ns off\n"
    )
    for face in ("4 3 2 1", "5 6 7 8", "1 2 6 5", "2 3 7 6", "3 4 8 7", "4 1 5 8"):
        text += "f " + " ".join(f"{v}/1/1" for v in face.split()) + "\n"
    (tmp_path / "a.obj").write_text(text)
    thing = load_mesh(tmp_path / "a.obj")
    (piece,) = thing.pieces
    scale = piece.extents[0] / 40
    np.testing.assert_allclose(piece.extents / scale, [40, 20, 10])
    assert piece.is_watertight and piece.volume / scale**3 == pytest.approx(8000)
