from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("trimesh")

import trimesh

from tactile_rt.sim_backend.objects import meshes
from tactile_rt.sim_backend.objects.catalogue import TactileObject, load_object, make_object
from tactile_rt.sim_backend.objects.meshes import MESH_SUFFIXES, load_mesh
from tactile_rt.sim_backend.objects.solids import box
from tactile_rt.stream import ConfigError

Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])


def save(mesh: trimesh.Trimesh, path: Path) -> Path:
    """Write the z-up mesh as its format would have it: glTF is y-up."""
    mesh = mesh.copy()
    if path.suffix == ".glb":
        mesh.apply_transform(Z_UP_TO_Y_UP)
    mesh.export(path)
    return path


def channel() -> trimesh.Trimesh:
    """A U-shaped channel 2 long (x), 1 wide (y), 0.8 high (z), walls and floor 0.2 thick."""
    section = [(-0.5, 0), (0.5, 0), (0.5, 0.8), (0.3, 0.8), (0.3, 0.2)]
    section += [(-0.3, 0.2), (-0.3, 0.8), (-0.5, 0.8)]
    n = len(section)
    corners = [(x, y, z) for x in (-1, 1) for y, z in section]
    caps = [(0, 1, 4), (1, 2, 3), (1, 3, 4), (0, 4, 5), (0, 5, 6), (0, 6, 7)]
    faces = [(c, b, a) for a, b, c in caps] + [(a + n, b + n, c + n) for a, b, c in caps]
    for k in range(n):
        m = (k + 1) % n
        faces += [(k, m, m + n), (k, m + n, k + n)]
    mesh = trimesh.Trimesh(corners, faces, process=False)
    assert mesh.is_watertight and mesh.volume == pytest.approx(2 * (0.2 + 2 * 0.2 * 0.6))
    return mesh


def inside(thing: TactileObject, point: tuple[float, float, float]) -> bool:
    """Whether the point is in any of the convex pieces: behind all faces of one."""
    return any(
        bool((((point - p.triangles[:, 0]) * p.face_normals).sum(axis=1) <= 1e-9).all())
        for p in thing.pieces
    )


def refuse(path: Path, said: str) -> None:
    """The file is refused with this message, on one line that names it."""
    with pytest.raises(ConfigError, match=said) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_a_hollow_solid_survives_each_format(tmp_path: Path, suffix: str) -> None:
    thing = load_object(str(save(channel(), tmp_path / f"gutter{suffix}")))
    assert (thing.name, thing.category) == ("gutter", "gutter")
    bounds = np.array([p.bounds for p in thing.pieces])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    np.testing.assert_allclose(high, [0.5, 0.25, 0.2], atol=0.01)
    np.testing.assert_allclose(low, [-0.5, -0.25, -0.2], atol=0.01)
    assert len(thing.pieces) == 3  # two walls and the floor, exactly
    assert thing.surface_error < 1e-6 and thing.made_by == "cut"
    for piece in thing.pieces:
        assert piece.is_convex and piece.is_watertight and piece.volume > 0
    assert not inside(thing, (0, 0, 0.05)), "the channel was filled"
    assert inside(thing, (0, 0, -0.15)) and inside(thing, (0, 0.2, 0.1))


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_a_mug_of_convex_bodies_comes_back_as_they_are(tmp_path: Path, suffix: str) -> None:
    mug = make_object("mug", 2)
    back = load_mesh(save(trimesh.util.concatenate(mug.pieces), tmp_path / f"mug{suffix}"))
    assert len(back.pieces) == len(mug.pieces)
    first = sorted(p.centroid.round(5).tolist() for p in mug.pieces)
    again = sorted(p.centroid.round(5).tolist() for p in back.pieces)
    np.testing.assert_allclose(first, again, atol=1e-4)


def test_the_same_file_gives_the_same_pieces(tmp_path: Path) -> None:
    path = save(channel(), tmp_path / "gutter.stl")
    one, two = load_mesh(path), load_mesh(path)
    assert len(one.pieces) == len(two.pieces)
    for a, b in zip(one.pieces, two.pieces, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)


@pytest.mark.parametrize("unit", [0.001, 1.0, 1000.0])
def test_the_unit_of_the_file_does_not_matter(tmp_path: Path, unit: float) -> None:
    mesh = box((3 * unit, 0, 0), (unit, 0.5 * unit, 0.25 * unit))
    (piece,) = load_mesh(save(mesh, tmp_path / "brick.STL")).pieces
    np.testing.assert_allclose(piece.extents, [1, 0.5, 0.25], atol=1e-5)
    np.testing.assert_allclose(piece.bounds.sum(axis=0), 0, atol=1e-5)


def test_a_scene_is_one_object_in_its_own_places(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    cube = box((0, 0, 0), (1, 1, 1))
    scene.add_geometry(cube)
    scene.add_geometry(cube, transform=trimesh.transformations.translation_matrix((0, 3, 0)))
    path = tmp_path / "tower.glb"
    scene.export(path)  # the second cube above the first: y is up in glTF
    thing = load_mesh(path)
    heights = sorted(p.centroid[2] for p in thing.pieces)
    assert heights == pytest.approx([-0.375, 0.375])


def test_small_damage_is_repaired(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 2, 3))
    faces = mesh.faces[1:].copy()  # one triangle lost
    faces[3] = faces[3][::-1]  # one turned round
    path = tmp_path / "crate.obj"
    trimesh.Trimesh(mesh.vertices, faces, process=False).export(path)
    (piece,) = load_mesh(path).pieces
    assert piece.is_watertight and piece.volume == pytest.approx(1 * 2 * 3 / 27)


def test_an_inside_out_solid_is_turned(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 1, 1))
    mesh.invert()
    (piece,) = load_mesh(save(mesh, tmp_path / "cube.ply")).pieces
    assert piece.volume == pytest.approx(1)


def test_an_open_mesh_is_refused_with_the_count_of_edges(tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.update_faces(mesh.triangles_center[:, 2] > 0.1)
    half = trimesh.Trimesh(mesh.vertices, mesh.faces)
    count = len(trimesh.grouping.group_rows(half.edges_sorted, require_count=1))
    assert count > 10
    refuse(save(half, tmp_path / "dome.stl"), rf"not watertight \({count} open edges\).*Fill Holes")


def test_a_wall_inside_a_solid_is_refused(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 1, 1))
    corners = mesh.vertices
    ends = [int(np.argmin(np.abs(corners - p).sum(axis=1))) for p in ((-0.5,) * 3, (0.5,) * 3)]
    edge = next(e for e in mesh.edges_unique.tolist() if ends[0] in e)
    faces = np.vstack([mesh.faces, [*edge, ends[1]]])
    path = tmp_path / "crate.obj"
    trimesh.Trimesh(corners, faces, process=False).export(path)
    refuse(path, "not watertight .*odd number of faces")


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"not a mesh at all\n", bytes(range(256)) * 4])
def test_garbage_is_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(content)
    refuse(path, "cannot be read as|holds no triangles|file is empty")


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    path = save(trimesh.creation.icosphere(), tmp_path / "ball.stl")
    path.write_bytes(path.read_bytes()[:-1000])
    refuse(path, "cannot be read|not watertight|holds no triangles")


def test_points_without_faces_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "scan.ply"
    trimesh.PointCloud(np.random.default_rng(0).random((20, 3))).export(path)
    refuse(path, "holds no triangles")


def test_vertices_that_are_not_numbers_are_refused(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 1, 1))
    mesh.vertices[0, 0] = np.nan
    path = tmp_path / "cube.ply"
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
    refuse(path, "1 vertices are not finite")


def test_a_sheet_is_refused(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 1, 1e-5))
    refuse(save(mesh, tmp_path / "sheet.obj"), "flat")


def test_too_many_triangles_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(meshes, "MAX_FACES", 10)
    refuse(save(box((0, 0, 0), (1, 1, 1)), tmp_path / "c.ply"), "12 triangles, more than 10")


@pytest.mark.parametrize("name", ["cup.step", "cup.gltf", "cup"])
def test_another_format_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"x")
    refuse(tmp_path / name, r"unknown mesh format.*\.obj, \.stl, \.ply, \.glb")


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    refuse(tmp_path / "cup.stl", "no such file")
    (tmp_path / "folder.stl").mkdir()
    refuse(tmp_path / "folder.stl", "no such file")


def test_cutting_says_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    load_mesh(save(channel(), tmp_path / "gutter.ply"))
    assert capfd.readouterr() == ("", "")
