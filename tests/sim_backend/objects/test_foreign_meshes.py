"""Meshes as other programs write them: the right size, the right way round, whole.

The solid is a box of 40 x 20 x 10 mm with a smaller one on one corner, so that a mirrored or a
turned one is told from it: only one of its eight octants is filled higher than the others.
"""

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold

from tactile_rt.sim_backend.objects.meshes import load_mesh
from tests.helpers.mesh_truth import one_mesh, write_glb

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
    ends = {"min": points.min(axis=0).tolist(), "max": points.max(axis=0).tolist()}
    corners = {"componentType": 5126, "count": len(points), "type": "VEC3", **ends}
    told = {
        "nodes": [{"mesh": 0, **(node or {})}],
        "bufferViews": [
            {"buffer": 0, "byteLength": points.nbytes},
            {"buffer": 0, "byteOffset": points.nbytes, "byteLength": order.nbytes},
        ],
        "accessors": [
            {"bufferView": 0, **corners},
            {"bufferView": 1, "componentType": 5125, "count": len(order), "type": "SCALAR"},
        ],
    }
    primitive = {"attributes": {"POSITION": 0}, "indices": 1, "mode": mode}
    write_glb(path, primitive, points.tobytes() + order.tobytes(), **told)


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
