"""Mesh files as people have them: read as they are meant, or refused in one line that says why."""

import json
import re
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from tactile_rt.sim_backend.objects.mesh_files import read_parts
from tactile_rt.sim_backend.objects.polygons import cut_polygons
from tests.helpers.refusals import refusal
from tests.sim_backend.objects.test_foreign_meshes import gltf

BOX = np.array([(x, y, z) for x in (0, 1) for y in (0, 2) for z in (0, 3)], float)
QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
# an arrow head and a U: outlines of which a fan from the first corner leaves the polygon
ARROW = [(0, 0), (2, 1), (0, 2), (0.5, 1)]
YOU = [(1, 1), (1, 3), (0, 3), (0, 0), (3, 0), (3, 3), (2, 3), (2, 1)]


def prism(outline: list[tuple[float, float]]) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices and polygons of an upright prism of height 1, its lids whole polygons."""
    n = len(outline)
    lids = [list(range(n))[::-1], list(range(n, 2 * n))]
    sides = [[i, (i + 1) % n, n + (i + 1) % n, n + i] for i in range(n)]
    return np.array([(*p, h) for h in (0, 1) for p in outline], float), lids + sides


def rows(table) -> str:
    return "".join(" ".join(f"{x:g}" for x in row) + "\n" for row in table)


def write(folder: Path, suffix: str, points: np.ndarray, polygons, **told: int) -> Path:
    """Write polygons as text; `vertices` and `faces` are told instead of what is there."""
    path = folder / f"a{suffix}"
    number, count = told.get("vertices", len(points)), told.get("faces", len(polygons))
    lists = rows([len(p), *p] for p in polygons)
    if suffix == ".obj":
        faces = rows([i + 1 for i in p] for p in polygons)
        keyed = [f"v {r}" for r in rows(points).splitlines()]
        path.write_text("\n".join([*keyed, *(f"f {r}" for r in faces.splitlines()), ""]))
    elif suffix == ".off":
        path.write_text(f"OFF\n{number} {count} 0\n" + rows(points) + lists)
    elif suffix == ".dae":
        sizes = " ".join(str(len(p)) for p in polygons)
        path.write_text(dae(
            f'<polylist count="{count}"><input semantic="VERTEX" source="#v" offset="0"/><vcount>'
            f"{sizes}</vcount><p>{' '.join(str(i) for p in polygons for i in p)}</p></polylist>",
            points,
        ))  # fmt: skip
    else:
        kind = told.get("kind", "ascii")
        head = f"ply\nformat {kind} 1.0\nelement vertex {number}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz")
        head += f"element face {count}\nproperty list uchar int vertex_indices\nend_header\n"
        body = (rows(points) + lists).encode()
        if kind != "ascii":
            order = "<>"["big" in kind]
            body = points.astype(order + "f4").tobytes() + b"".join(
                struct.pack(f"{order}B{len(p)}i", len(p), *p) for p in polygons
            )
        path.write_bytes(head.encode() + body)
    return path


def dae(primitive: str, points: np.ndarray, up: str = "<up_axis>Z_UP</up_axis>", node: str = ""):
    text = (
        f'<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>{up}'
    )
    text += (
        '</asset><library_geometries><geometry id="g"><mesh><source id="p"><float_array id="pa" '
    )
    text += f'count="{points.size}">{rows(points)}</float_array><technique_common><accessor '
    text += f'source="#pa" count="{len(points)}" stride="3">'
    text += "".join(f'<param name="{axis}" type="float"/>' for axis in "XYZ")
    text += '</accessor></technique_common></source><vertices id="v"><input semantic="POSITION" '
    text += f'source="#p"/></vertices>{primitive}</mesh></geometry></library_geometries>'
    text += f'<library_visual_scenes><visual_scene id="s"><node id="n">{node}'
    text += '<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>'
    return text + '<scene><instance_visual_scene url="#s"/></scene></COLLADA>'


def triangles(**changes: str) -> str:
    index = " ".join(str(i) for a, b, c, d in QUADS for i in (a, b, c, c, d, a))
    return (
        f'<triangles count="{changes.get("count", 12)}"><input semantic="VERTEX" source="#v" '
        f'offset="0"/><p>{changes.get("index", index)}</p></triangles>'
    )


def indexed(text: str) -> str:
    """Give every corner of the faces of an OBJ file a texture and a normal, too."""
    return re.sub(r"(?m)^f .*", lambda row: re.sub(r"\d+", r"\g<0>/1/1", row[0]), text)


def refuse(path: Path, *said: str) -> None:
    told = refusal(read_parts, [path]).removeprefix(str(path))
    assert len(told) < 170 and all(word in told for word in said), told


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.1, 1), min_size=4, max_size=24), st.integers(0, 1000))
def test_polygons_are_cut_into_triangles_that_cover_them(radii, seed):
    random = np.random.default_rng(seed)
    n, turn = len(radii), np.linalg.qr(random.normal(size=(3, 3)))[0]
    angle = 2 * np.pi * (np.arange(n) + random.uniform(0, 0.4, n)) / n
    x, y = np.array(radii) * (np.cos(angle), np.sin(angle))
    points = np.stack([x, y, 0 * x], axis=1) @ turn * 10.0 ** random.uniform(-3, 3)
    faces = cut_polygons(points, np.arange(n), np.array([n]))
    a, b, c = points[faces].swapaxes(0, 1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    whole = np.linalg.norm(np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0))
    assert area == pytest.approx(whole, rel=1e-4) and len(faces) == n - 2
    edges = {edge for f in faces.tolist() for edge in zip(f, f[1:] + f[:1], strict=True)}
    border = {(i, j) for i, j in edges if (j, i) not in edges}
    assert border == {(i, (i + 1) % n) for i in range(n)}


@pytest.mark.parametrize("suffix", [".obj", ".off", ".ply", ".dae"])
@pytest.mark.parametrize(("outline", "area"), [(ARROW, 1.5), (YOU, 7)])
def test_concave_and_mixed_polygons_are_solid(tmp_path, suffix, outline, area):
    mesh = read_parts([write(tmp_path, suffix, *prism(outline))])
    mesh.merge_vertices()
    assert mesh.is_watertight and mesh.volume == pytest.approx(area)


@pytest.mark.parametrize("kind", ["binary_little_endian", "binary_big_endian"])
def test_binary_ply_of_mixed_polygons_is_read(tmp_path, kind):
    points, polygons = prism(YOU)
    mesh = read_parts([write(tmp_path, ".ply", points, polygons, kind=kind)])
    assert mesh.is_watertight and mesh.volume == pytest.approx(7)


@pytest.mark.parametrize(
    ("turned", "said"),
    [
        (lambda t: t.replace("f ", "  f\t").replace("v ", "\tv  "), ""),
        (lambda t: t.replace("\n", "\r"), ""),
        (lambda t: "\ufeff" + t, ""),
        (lambda t: t.replace("\n", " # a comment\n"), ""),
        (lambda t: t.replace(" 0 0\n", " 0 \\\n0\n"), ""),
        (lambda t: t.replace("\n", " 1\n", 8), ""),  # weights
        (lambda t: "\n".join(f"vn 0 0 1\n{r}" for r in t.splitlines()) + "\n", ""),
        (lambda t: t + "f 1//1 2//1 3//1 4//1\nf 1 2 3\n", ""),
        (lambda t: "o slab\nvn 0 0 1\nvt 0 0\ng all\nusemtl none\ns off\n" + indexed(t), ""),
        (lambda t: t + "f 0 1 2\n", "names vertex 0"),
        (lambda t: t + "f 7 8 9\n", "names vertex 9"),
        (lambda t: t + "f -9 -1 -2\n", "names vertex 0"),
        (lambda t: t[: t.rindex(" ")][: t[: t.rindex(" ")].rindex(" ")], "2 corners; is it cut"),
        (lambda t: t + "cstype bspline\nsurf 0 1 0 1 1 2 3\n", "free-form surfaces"),
    ],
)
def test_obj_is_read_however_its_rows_look(tmp_path, turned, said):
    path = write(tmp_path, ".obj", BOX, QUADS)
    path.write_text(turned(path.read_text()), newline="")
    if said:
        refuse(path, said)
    else:
        mesh = read_parts([path])
        assert mesh.extents == pytest.approx([1, 2, 3]) and abs(mesh.volume) == pytest.approx(6)


def test_relative_numbers_of_obj_count_back_from_their_row(tmp_path):
    text = ""
    for k in range(3):
        corners = rows(BOX + np.array([2 * k, 0, 0])).splitlines()
        text += "".join(f"v {r}\nvt 0 0\n" for r in corners)
        text += "".join("f " + " ".join(f"{i - 8}/-1" for i in q) + "\n" for q in QUADS)
    (tmp_path / "a.obj").write_text(text)
    mesh = read_parts([tmp_path / "a.obj"])
    assert mesh.extents == pytest.approx([5, 2, 3]) and abs(mesh.volume) == pytest.approx(18)


@pytest.mark.parametrize("suffix", [".off", ".ply"])
def test_counts_of_the_header_hold(tmp_path, suffix):
    there = "6" if suffix == ".ply" else "14"
    refuse(write(tmp_path, suffix, BOX, QUADS, faces=8), "cut short", "8", there)
    refuse(write(tmp_path, suffix, BOX, QUADS, faces=4), "its header declares")
    refuse(write(tmp_path, suffix, BOX, [*QUADS, (0, 1, 9)]), "vertex 9, of 8")
    refuse(write(tmp_path, suffix, BOX, [*QUADS, (0, 1, -1)]), "vertex -1, of 8")
    whole = write(tmp_path, suffix, BOX, QUADS).read_bytes()
    for cut in range(1, len(whole), 7):
        (tmp_path / f"b{suffix}").write_bytes(whole[:cut])
        refuse(tmp_path / f"b{suffix}")


def test_stl_of_another_length_than_it_tells_is_refused(tmp_path):
    path, mesh = tmp_path / "a.stl", trimesh.creation.box()
    whole = mesh.export(file_type="stl")
    for content, said in (
        (whole + bytes(33), "declares 12 triangles of 50 bytes, 633 bytes"),
        (whole[:-20], "cut short"),
        (whole[:70], "cut short"),
        (mesh.export(file_type="stl_ascii")[:-300].encode(), "cut short"),
    ):
        path.write_bytes(content)
        refuse(path, said)
    text = mesh.export(file_type="stl_ascii")
    path.write_text(text.replace("vertex", "vertx", 3) + text)
    refuse(path, "declares 24 triangles, 23")


@pytest.mark.parametrize(
    ("axis", "extents"),
    [("Y_UP", [1, 3, 2]), ("X_UP", [2, 3, 1]), ("Z_UP", [1, 2, 3]), ("", [1, 3, 2])],
)
def test_the_axis_that_collada_says_is_up(tmp_path, axis, extents):
    up = f"<up_axis>{axis}</up_axis>" if axis else ""
    (tmp_path / "a.dae").write_text(dae(triangles(), BOX, up))
    mesh = read_parts([tmp_path / "a.dae"])
    assert mesh.extents == pytest.approx(extents)
    assert read_parts([tmp_path / "a.dae"], "z").extents == pytest.approx([1, 2, 3])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (dae(triangles(count="20"), BOX), "declares 20 faces where 12"),
        (dae(triangles(index="0 1 9"), BOX), "mesh or its scene"),
        (dae(triangles() + "<linestrips/>", BOX), "linestrips"),
        (dae("<polygons><ph/></polygons>".replace("/>", "></ph>"), BOX), "holes"),
        (dae(triangles(), BOX, node='<instance_geometry url="#h"/>'), "#h not found"),
    ],
)
def test_collada_that_is_not_all_read_is_refused(tmp_path, text, said):
    (tmp_path / "a.dae").write_text(text)
    refuse(tmp_path / "a.dae", said)


def change(path: Path, **changes: object) -> dict:
    """Write a box as glTF with changes to its JSON, beside its numbers."""
    gltf(path, BOX, [q for a, b, c, d in QUADS for q in (a, b, c, c, d, a)])
    content = path.read_bytes()
    length = struct.unpack_from("<I", content, 12)[0]
    told = json.loads(content[20 : 20 + length])
    told["buffers"][0]["uri"] = "the%20part.bin"
    (path.parent / "the part.bin").write_bytes(content[28 + length :])
    for at, value in changes.items():
        *keys, last = (int(k) if k.isdigit() else k for k in at.split("__"))
        place = told
        for key in keys:
            place = place[key]
        place[last] = value
    path.with_suffix(".gltf").write_text(json.dumps(told))
    return told


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"extensionsRequired": ["KHR_materials_unlit", "KHR_texture_basisu"]}, ""),
        ({"extensionsRequired": ["EXT_meshopt_compression"]}, "EXT_meshopt_compression"),
        ({"extensionsRequired": ["ACME_fur"]}, "needs ACME_fur"),
        ({"nodes__0__extensions": {"EXT_mesh_gpu_instancing": {}}}, "EXT_mesh_gpu_instancing"),
        ({"accessors__0__sparse": {"count": 1}}, "sparse accessor"),
        ({"accessors__0__normalized": True}, "normalized"),
        ({"meshes__0__primitives__0__mode": 6}, "fans"),
        ({"buffers__0__uri": "other.bin"}, "other.bin, which it names, is not beside it"),
        ({"buffers__0__byteLength": 1000}, "cut short"),
        ({"nodes__0__camera": 0, "cameras": [{"type": "perspective", "perspective": {
            "yfov": 1, "znear": 1, "aspectRatio": 1}}]}, "declares 12 triangles, 0"),
    ],
)  # fmt: skip
def test_gltf_says_what_is_not_supported(tmp_path, changes, said):
    change(tmp_path / "a.glb", **changes)
    if said:
        refuse(tmp_path / "a.gltf", said)
    else:
        assert read_parts([tmp_path / "a.gltf"]).extents == pytest.approx([1, 3, 2])


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off", ".dae", ".3mf", ".glb"])
def test_a_pointer_is_called_one(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_text(f"version https://git-lfs.github.com/spec/v1\noid sha256:{'0' * 64}\nsize 9\n")
    refuse(path, "is a Git LFS pointer")


@pytest.mark.parametrize(("shared", "lattice"), [(False, False), (True, False), (False, True)])
def test_parts_of_a_3mf_in_a_file_of_their_own(tmp_path, shared, lattice):
    vertices = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in BOX)
    faces = [t for a, b, c, d in QUADS for t in ((a, b, c), (c, d, a))]
    faces = "".join(f'<triangle v1="{a}" v2="{b}" v3="{c}"/>' for a, b, c in faces)
    mesh = f"<mesh><vertices>{vertices}</vertices><triangles>{faces}</triangles>"
    mesh += f"{'<b:beamlattice></b:beamlattice>' * lattice}</mesh>"
    space = "http://schemas.microsoft.com/3dmanufacturing"
    head = f'<model xmlns="{space}/core/2015/02" xmlns:p="{space}/production/2015/06" xmlns:b="b">'
    thing = "".join(f'<object id="{i}" type="model">{mesh}</object>' for i in range(1, 2 + shared))
    used = '<object id="9"><components><component p:path="/3D/a.model" objectid="1"/></components>'
    with zipfile.ZipFile(tmp_path / "a.3mf", "w") as file:
        file.writestr("3D/a.model", f"{head}<resources>{thing}</resources></model>")
        root = f'<resources>{used}</object></resources><build><item objectid="9"/></build></model>'
        file.writestr("3D/3dmodel.model", head + root)
    if shared or lattice:
        refuse(tmp_path / "a.3mf", "several parts share" if shared else "beam lattice")
    else:
        assert read_parts([tmp_path / "a.3mf"]).extents == pytest.approx([1, 2, 3])


@pytest.mark.parametrize("plot", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_check_goes_on_past_what_cannot_be_read_and_draws_the_others(tmp_path, call, plot):
    folder = tmp_path / "things" / "kind"
    folder.mkdir(parents=True)
    write(folder, ".ply", BOX, [*QUADS, (0, 1, 9)])
    write(folder, ".off", *prism(ARROW)).rename(folder / "arrow.off")
    out = tmp_path / "sheet.png"
    code, said, err = call("objects", "check", folder.parent, *(["--plot", out] if plot else []))
    assert code == 1 and "names vertex 9" in err and said.split()[-1] == "kind/arrow"
    assert out.exists() == plot and (not plot or out.read_bytes().startswith(b"\x89PNG"))
    assert "must be a .png" in call("objects", "check", folder.parent, "--plot", "sheet.pdf")[2]
