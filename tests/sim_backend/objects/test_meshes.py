import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.objects import mesh_formats
from tactile_rt.sim_backend.objects.catalogue import TactileObject, load_object, make_object
from tactile_rt.sim_backend.objects.mesh_detail import MeshDetail
from tactile_rt.sim_backend.objects.mesh_files import MESH_SUFFIXES
from tactile_rt.sim_backend.objects.meshes import load_mesh, read_pieces, write_pieces
from tactile_rt.sim_backend.objects.solids import box
from tests.helpers import mesh_truth
from tests.helpers.hostile_files import MESHES
from tests.helpers.measured import Measured
from tests.helpers.mesh_truth import inside

Z_UP_TO_Y_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])


def save(mesh: trimesh.Trimesh, path: Path) -> Path:
    """Write the z-up mesh as its format would have it: glTF is y-up, and trimesh's COLLADA."""
    mesh = mesh.copy()
    if path.suffix in (".glb", ".gltf", ".dae"):
        mesh.apply_transform(Z_UP_TO_Y_UP)
    if path.suffix == ".gltf":
        for name, content in trimesh.exchange.gltf.export_gltf(trimesh.Scene(mesh)).items():
            (path if name == "model.gltf" else path.parent / name).write_bytes(content)
    else:
        mesh.export(path)
    return path


def refuse(path: Path, said: str) -> None:
    """The file is refused with this message, on one line that names it."""
    with pytest.raises(ConfigError, match=said) as caught:
        load_mesh(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
def test_a_hollow_solid_survives_each_format(tmp_path: Path, suffix: str) -> None:
    thing = load_object(str(save(mesh_truth.channel(), tmp_path / f"gutter{suffix}")))
    assert (thing.name, thing.category) == ("gutter", "gutter")
    bounds = np.array([p.bounds for p in thing.pieces])
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    np.testing.assert_allclose(high, [0.5, 0.25, 0.2], atol=0.01)
    np.testing.assert_allclose(low, [-0.5, -0.25, -0.2], atol=0.01)
    assert len(thing.pieces) == 3  # two walls and the floor, exactly
    assert thing.surface_error < 1e-6 and thing.made_by == "pieces"
    for piece in thing.pieces:
        assert piece.is_convex and piece.is_watertight and piece.volume > 0
    assert not inside(thing, (0, 0, 0.05)), "the channel was filled"
    assert inside(thing, (0, 0, -0.15)) and inside(thing, (0, 0.2, 0.1))


def test_a_hollow_solid_survives_draco(tmp_path: Path) -> None:
    draco = pytest.importorskip("DracoPy")
    mesh = mesh_truth.channel()
    name = "KHR_draco_mesh_compression"
    packed = draco.encode(
        mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32), quantization_bits=16
    )
    attributes = {"attributes": {"POSITION": 0}}
    ends = dict(zip(("min", "max"), mesh.bounds.tolist(), strict=True))
    told = {
        "extensionsUsed": [name],
        "extensionsRequired": [name],
        "bufferViews": [{"buffer": 0, "byteLength": len(packed)}],
        "accessors": [
            {"componentType": 5126, "count": len(mesh.vertices), "type": "VEC3", **ends},
            {"componentType": 5125, "count": mesh.faces.size, "type": "SCALAR"},
        ],
    }
    extended = {**attributes, "indices": 1, "extensions": {name: {"bufferView": 0, **attributes}}}
    path = tmp_path / "packed.glb"
    mesh_truth.write_glb(path, extended, packed, **told)
    packed_one = load_mesh(path, MeshDetail(up="z"))
    plain = load_mesh(save(mesh, tmp_path / "plain.stl"))
    assert packed_one.made_by == plain.made_by
    volumes = [sum(piece.volume for piece in one.pieces) for one in (packed_one, plain)]
    assert volumes[0] == pytest.approx(volumes[1], rel=1e-3)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb"])
def test_a_mug_of_convex_bodies_comes_back_as_they_are(tmp_path: Path, suffix: str) -> None:
    mug = make_object("mug", 2)
    back = load_mesh(save(trimesh.util.concatenate(mug.pieces), tmp_path / f"mug{suffix}"))
    assert len(back.pieces) == len(mug.pieces)
    first = sorted(p.centroid.round(5).tolist() for p in mug.pieces)
    again = sorted(p.centroid.round(5).tolist() for p in back.pieces)
    np.testing.assert_allclose(first, again, atol=1e-4)


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


def within(thing: TactileObject, mesh: trimesh.Trimesh, mm: float) -> None:
    """No point of the mesh is farther from the pieces than that, at a size of 40 mm."""
    mesh = mesh.copy()
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    points, _ = trimesh.sample.sample_surface(mesh, 300, seed=1)
    triangles = np.concatenate([p.triangles for p in thing.pieces])
    assert 40 * mesh_truth.to_triangles(points, triangles).max() <= mm


def test_an_open_dome_stays_open(tmp_path: Path) -> None:
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.update_faces(mesh.triangles_center[:, 2] > 0.1)
    half = trimesh.Trimesh(mesh.vertices, mesh.faces)
    thing = load_mesh(save(half, tmp_path / "dome.stl"))
    assert thing.made_by == "plates" and 40 * thing.surface_error <= 0.25
    within(thing, half, 0.2)
    assert not inside(thing, (0, 0, -0.2)) and not inside(thing, (0, 0, 0.1))


def test_a_crate_without_a_lid_stays_open(tmp_path: Path) -> None:
    """The hole has four edges; a missing triangle is damage, a missing side is none."""
    crate = box((0, 0, 0), (1, 1, 0.6))
    crate.update_faces(crate.face_normals[:, 2] < 0.5)
    thing = load_mesh(save(crate, tmp_path / "crate.obj"))
    assert len(thing.pieces) == 5 and thing.made_by == "plates"
    assert not inside(thing, (0, 0, 0.1)) and not inside(thing, (0, 0, 0.29))
    within(thing, crate, 0.11)


def test_a_wall_inside_a_solid_and_a_flag_on_it_are_plates(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 1, 1))
    corners = mesh.vertices
    ends = [int(np.argmin(np.abs(corners - p).sum(axis=1))) for p in ((-0.5,) * 3, (0.5,) * 3)]
    edge = next(e for e in mesh.edges_unique.tolist() if ends[0] in e)
    faces = np.vstack([mesh.faces, [*edge, ends[1]], [*edge, len(corners)]])
    mast = corners[edge[0]] * 1.2
    path = tmp_path / "crate.obj"
    crate = trimesh.Trimesh([*corners, mast], faces, process=False)
    crate.export(path)
    thing = load_mesh(path)
    assert thing.made_by == "plates"
    within(thing, crate, 0.2)


def test_bodies_that_share_a_side_stay_two_solids(tmp_path: Path) -> None:
    stack = trimesh.util.concatenate([box((0, 0, 0), (1, 1, 1)), box((0, 0, 1), (1, 1, 1))])
    thing = load_mesh(save(stack, tmp_path / "stack.stl"))
    assert thing.made_by == "bodies" and len(thing.pieces) == 2


def test_a_sheet_is_a_plate_of_two_tenths(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 1, 1e-6))
    mesh.update_faces(mesh.face_normals[:, 2] > 0.5)
    (plate,) = load_mesh(save(mesh, tmp_path / "sheet.obj")).pieces
    np.testing.assert_allclose(40 * plate.extents, (40, 40, 0.2), atol=0.01)


def test_triangles_on_a_line_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "needle.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    refuse(path, "all its triangles lie on one line")


def test_a_crumb_far_from_the_object_is_refused(tmp_path: Path) -> None:
    both = [box((0, 0, 0), (1, 0.5, 0.5)), box((99, 0, 0), (0.01, 0.01, 0.01))]
    path = save(trimesh.util.concatenate(both), tmp_path / "crumb.stl")
    refuse(path, "99.5 long, but nearly all of it within 1; delete what lies far from the rest")


def test_which_way_is_up_can_be_said(tmp_path: Path) -> None:
    mesh = box((0, 0, 0), (1, 0.5, 0.25))
    path = save(mesh, tmp_path / "brick.stl")
    for up, extents in (("", (1, 0.5, 0.25)), ("z", (1, 0.5, 0.25)), ("y", (1, 0.25, 0.5))):
        (piece,) = load_mesh(path, MeshDetail(up=up)).pieces
        np.testing.assert_allclose(piece.extents, extents, atol=1e-6)
    (piece,) = load_mesh(save(mesh, tmp_path / "brick.glb"), MeshDetail(up="z")).pieces
    np.testing.assert_allclose(piece.extents, (1, 0.25, 0.5), atol=1e-6)  # as it lies in the file


def test_a_texture_seam_is_no_gap(tmp_path: Path) -> None:
    """glTF and OBJ files give a vertex once for every normal and texture coordinate."""
    split = mesh_truth.channel()
    split.unmerge_vertices()
    thing = load_mesh(save(split, tmp_path / "seams.glb"))
    assert thing.made_by == "pieces" and len(thing.pieces) == 3


@pytest.mark.parametrize("suffix", MESH_SUFFIXES)
@pytest.mark.parametrize("content", [b"", b"not a mesh at all\n", bytes(range(256)) * 4])
def test_garbage_is_refused(tmp_path: Path, suffix: str, content: bytes) -> None:
    path = tmp_path / f"garbage{suffix}"
    path.write_bytes(content)
    refuse(path, "cannot be read as|holds no triangles|file is empty")


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


def test_too_many_triangles_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mesh_formats, "MAX_FACES", 10)
    refuse(save(box((0, 0, 0), (1, 1, 1)), tmp_path / "c.ply"), "12 triangles, more than 10")


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    refuse(tmp_path / "cup.stl", "no such file")
    (tmp_path / "folder.stl").mkdir()
    refuse(tmp_path / "folder.stl", "no such file")


def test_cutting_says_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    load_mesh(save(mesh_truth.channel(), tmp_path / "gutter.ply"))
    assert capfd.readouterr() == ("", "")


def test_a_dense_mesh_loses_triangles_and_no_shape_and_says_that_it_takes_seconds(
    tmp_path: Path, cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lump = mesh_truth.blob(4)
    path = save(lump, tmp_path / "lump.ply")
    with caplog.at_level("INFO", "tactile_rt.sim_backend.objects"):
        thing = load_mesh(path)
        before, after = (record.getMessage() for record in caplog.records)
        assert before == f"{path}: 5120 triangles to pieces; this takes some seconds, once"
        assert after.startswith(f"{path}: ") and " pieces within 0." in after
        caplog.clear()
        load_mesh(path)
    assert not caplog.records
    assert 40 * thing.surface_error <= 0.13
    within(thing, lump, 0.13)


def test_no_large_face_is_lost_where_small_ones_go(tmp_path: Path) -> None:
    """A cloth of 9,800 triangles, rippled, and a sail of two at its border."""
    x, y = np.meshgrid(np.linspace(0, 1, 71), np.linspace(0, 1, 71))
    z = 0.02 * np.sin(9 * x) * np.sin(7 * y)
    at = np.arange(71 * 71).reshape(71, 71)
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]))
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    corners = np.stack([x.ravel(), y.ravel(), z.ravel()], 1)
    n = len(corners)
    sail = [[0, 1, n], [70 * 71, n + 1, n + 2]]
    corners = np.vstack([corners, [-1, -1, 0.5], [-1, 2, 0.5], [0, 1.01, 1]])
    cloth = trimesh.Trimesh(corners, np.vstack([faces, sail]), process=False)
    thing = load_mesh(save(cloth, tmp_path / "cloth.ply"))
    assert len(thing.pieces) < 1024
    within(thing, cloth, 0.4)


@pytest.fixture
def pieces():
    return TactileObject("box", "box", (trimesh.creation.box(),), 0.0, "by hand")


@pytest.mark.parametrize("relative", ["", "some/cache"])
def test_a_relative_folder_is_the_home_s(pieces, tmp_path, monkeypatch, relative):
    monkeypatch.delenv("TACTILE_RT_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", relative)
    monkeypatch.setenv("HOME", str(tmp_path))
    write_pieces("key", pieces)
    assert (tmp_path / ".cache" / "tactile_rt" / "pieces" / "key.npz").is_file()
    assert read_pieces("key") is not None


@pytest.mark.parametrize("home", ["~", "relative"])
def test_without_a_home_nothing_is_kept(pieces, tmp_path, monkeypatch, home):
    monkeypatch.delenv("TACTILE_RT_CACHE", raising=False)
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(os.path, "expanduser", lambda path: path.replace("~", home))
    monkeypatch.chdir(tmp_path)
    write_pieces("key", pieces)
    assert read_pieces("key") is None
    assert os.listdir(tmp_path) == []


# The simulator is imported once: every command runs in a child that has it already.
FORKS = """
import json, os, sys
import tactile_rt.sim_backend.objects.catalogue
import tactile_rt.sim_backend.stimulus_simulation
from tactile_rt.cli import main

found, (out, *paths) = [], sys.argv[1:]
for path in paths:
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        os.dup2(writing, 2)
        sys.argv[1:] = ["whisk", out, "--object", path]
        try:
            main()
        except SystemExit as left:
            sys.stderr.flush()
            os._exit(left.code)
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as told:
        err = told.read()
    _, status, used = os.wait4(child, 0)
    cpu_s = used.ru_utime + used.ru_stime
    found.append([os.waitstatus_to_exitcode(status), "", err, cpu_s, used.ru_maxrss / 1024])
print(json.dumps(found))
"""


@pytest.fixture(scope="module")
def refused(tmp_path_factory) -> dict[str, Measured]:
    """Return how reading each mesh ended."""
    folder = tmp_path_factory.mktemp("hostile")
    paths = []
    for number, make in enumerate(MESHES.values()):
        suffix, content = make()
        paths.append(folder / f"hostile{number}{suffix}")
        paths[-1].write_bytes(content)
    out = folder / "out.npz"
    run = subprocess.run(
        [sys.executable, "-c", FORKS, str(out), *map(str, paths)],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    return {
        name: Measured(*told, ("whisk", out, "--object", path))
        for name, path, told in zip(MESHES, paths, json.loads(run.stdout), strict=True)
    }


@pytest.mark.parametrize("name", MESHES)
def test_a_hostile_mesh_is_refused(name, refused):
    refused[name].assert_refused("hostile", cpu_s=1.0)
