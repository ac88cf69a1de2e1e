"""Readers of mesh formats: what a file tells of itself is held against what it has.

A mesh library leaves out what it does not know, and cuts every polygon as a fan. Each reader here
gives either the mesh, or how many triangles the library must find. A `ValueError` says what is
wrong with the file.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from itertools import chain
from typing import Any, Final

import numpy as np
import trimesh
from numpy.typing import NDArray

from tactile_rt.sim_backend.objects.polygons import cut_polygons, group_by_corners

__all__ = ["READERS", "Found"]

Array = NDArray[Any]
PLY_TYPES: Final = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "int64": "i8", "uint64": "u8", "float": "f4", "float16": "f2", "float32": "f4",
    "float64": "f8", "double": "f8",
}  # fmt: skip
ENDS: Final = 1 << 14  # bytes of an OBJ file at which it says that it holds surfaces
TEXTURED: Final = {"texcoord", "texture_u", "texture_v", "u", "v", "s", "t"}


@dataclass(frozen=True)
class Found:
    """What a reader found.

    Attributes:
        meshes: Whole, or empty where the library is to read them.
        told: How many triangles the library must find; negative: not known.
        up: The axis that points up.
        same: The library's meshes are taken, if they are as many triangles.
        again: The reader to ask where the library finds another number.
    """

    meshes: Sequence[trimesh.Trimesh] = ()
    told: int = -1
    up: str = "z"
    same: bool = False
    again: Callable[[bytes], "Found"] | None = None


def _plain(content: bytes) -> bytes:
    """Return text as UTF-8 without a byte order mark, its lines ended by line feeds."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = content.decode("utf-16").encode()
    text = content.removeprefix(b"\xef\xbb\xbf")
    return text if b"\n" in text else text.replace(b"\r", b"\n")


def _mesh(
    vertices: Array, corners: Array, sizes: Array, base: int = 0, same: bool = False
) -> Found:
    """Make a mesh of polygons, without those of two corners.

    Args:
        same: the library's is to be taken, unless it must have cut a polygon wrongly.
    """
    outside = corners[(corners < 0) | (corners >= len(vertices))]
    if len(outside):
        raise ValueError(
            f"a face names vertex {int(outside[0]) + base}, of {len(vertices)} counted from {base}"
        )
    kept = sizes > 2
    corners, sizes = corners[np.repeat(kept, sizes)].astype(np.int64), sizes[kept]
    faces, ears = cut_polygons(vertices, corners, sizes)
    if not base:  # in the order of the library
        faces = group_by_corners(faces, sizes)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return Found([mesh], same=same and not ears.any())


def _numbers(rows: Sequence[bytes], kind: type) -> Array:
    return np.fromstring(b" ".join(rows).decode("latin-1"), sep=" ", dtype=kind)


def _read_obj(content: bytes) -> Found:
    if re.search(rb"^[ \t]*surf[ \t]", content[:ENDS] + b"\n" + content[-ENDS:], re.MULTILINE):
        raise ValueError("it holds free-form surfaces, `surf`; export it as polygons")
    text = b"\n" + content if content.startswith(b"v ") else content
    faces = re.findall(rb"\nf (.*)", text)
    joined = b" ".join(faces)
    odd = b"\\" in text or any(sign in joined for sign in (b"-", b"#", b"\t", b" 0"))
    if faces and not odd:
        if joined.count(b" ") + 1 == 3 * len(faces):
            return Found(told=len(faces), again=_parse_obj)
        with suppress(ValueError):
            return _make_obj(re.findall(rb"\nv (.*)", text), faces)
    return _parse_obj(content)


def _parse_obj(content: bytes) -> Found:
    """Read an OBJ file however its rows are indented, continued, commented and numbered."""
    text = _plain(content).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    row = re.compile(rb"^[ \t]*([vf])[ \t]+([^#\n]*)", re.MULTILINE)
    kinds = np.array([kind == b"v" for kind, _ in row.findall(text)], bool)
    faces = [values for kind, values in row.findall(text) if kind == b"f"]
    places = [values for kind, values in row.findall(text) if kind == b"v"]
    return _make_obj(places, faces, np.cumsum(kinds)[~kinds])


def _make_obj(
    places: list[bytes], faces: list[bytes], before: NDArray[np.int64] | None = None
) -> Found:
    """Make a mesh of rows of vertices and of faces.

    Args:
        before: how many vertices stand before each face, if their numbers may be relative.
    """
    sizes = np.array([len(face.split()) for face in faces], np.int64)
    if len(sizes) and sizes.min() < 3:
        raise ValueError(f"face {sizes.argmin() + 1} has {sizes.min()} corners; is it cut short?")
    vertices = _numbers(places, float)
    if len(vertices) != 3 * len(places):  # weights, or colours
        vertices = np.array([row.split()[:3] for row in places], float)
    corners = _numbers([re.sub(rb"/\S*", b"", b" ".join(faces))], np.int64)
    if before is not None:  # relative numbers count back from there
        back = corners + np.repeat(before, sizes) + 1
        corners = np.where(corners < 0, np.maximum(back, 0), corners)
    return _mesh(vertices.reshape(-1, 3), corners - 1, sizes, 1, before is None)


def _read_off(content: bytes) -> Found:
    text = re.sub(rb"#[^\n]*", b"", _plain(content))
    head = re.match(rb"\s*(?:ST)?C?N?OFF(\s+BINARY)?\s", text)
    if not head or head[1]:
        raise ValueError("binary OFF; save it as text" if head else "it does not begin with OFF")
    rows = [row for line in text[head.end() :].splitlines() if (row := line.split())]
    points, faces = int(rows[0][0]), int(rows[0][1])
    if len(rows) - 1 != points + faces:
        raise ValueError(
            f"{'cut short: ' * (len(rows) <= points + faces)}its header tells {points} vertices "
            f"and {faces} faces, {len(rows) - 1} rows follow"
        )
    vertices = np.array([row[:3] for row in rows[1 : points + 1]], float).reshape(points, 3)
    sizes = np.array([int(row[0]) for row in rows[points + 1 :]], np.int64)
    polygons = [row[1 : size + 1] for row, size in zip(rows[points + 1 :], sizes, strict=True)]
    corners = np.array(list(map(int, chain.from_iterable(polygons))), np.int64)
    if len(corners) != sizes.sum():
        raise ValueError("cut short: a face has fewer corners than it tells")
    return _mesh(vertices, corners, sizes)


def _read_ply(content: bytes) -> Found:
    head, end, body = content.removeprefix(b"\xef\xbb\xbf").partition(b"end_header")
    lines = [line.split() for line in head.decode("latin-1").splitlines() if line.strip()]
    if not end or lines[0] != ["ply"] or lines[1][0] != "format":
        raise ValueError("it does not begin with the header of a PLY file, or that is cut short")
    text, order = lines[1][1] == "ascii", "<>"["big" in lines[1][1]]
    body = body[re.match(rb"[^\n\r]*\r?\n?", body).end() :]  # type: ignore[union-attr]
    data = _numbers([body], float).tobytes() if text else body
    elements: dict[str, tuple[int, dict[str, list[str]]]] = {}
    for line in lines:
        if line[0] == "element":
            elements[line[1]] = int(line[2]), {}
        elif line[0] == "property":
            kinds = [order + PLY_TYPES[kind] for kind in line[1:-1] if kind != "list"]
            list(elements.values())[-1][1][line[-1]] = kinds
    at, found = 0, {}
    for name, (count, properties) in elements.items():
        read = {key: ["<f8"] * len(kinds) for key, kinds in properties.items()}
        found[name], at = _read_rows(name, data, at, count, read if text else properties)
    if at != len(data):
        raise ValueError(f"its header tells of {at} bytes, {len(data)} are there")
    points = elements.get("vertex", (0, {}))[1]
    if missing := [axis for axis in "xyz" if axis not in points]:
        raise ValueError(f"its vertices have no {missing[0]}")
    vertices = np.column_stack([found["vertex"][k][1].astype(points[k][0]) for k in "xyz"])
    lists = [key for key, kinds in elements.get("face", (0, {}))[1].items() if len(kinds) > 1]
    names = [key for key in ("vertex_index", "vertex_indices", *lists) if key in lists]
    sizes, corners = found["face"][names[0]] if names else (np.zeros(0, int), np.zeros(0, int))
    if "tristrips" in elements:
        raise ValueError("it holds strips of triangles, `tristrips`; save it as faces")
    return _mesh(vertices, corners, sizes, same=bool(TEXTURED & {*points, *lists}))


def _read_rows(
    element: str, data: bytes, at: int, count: int, kinds: dict[str, list[str]]
) -> tuple[dict[str, tuple[Array, Array]], int]:
    """Read an element: sizes of lists and all values of each property."""
    none, fields = np.zeros(0, int), list[Any]()
    if not count or not kinds:
        return dict.fromkeys(kinds, (none, none)), at
    with suppress(ValueError):  # most have lists of one size
        for key, kind in kinds.items():
            if len(kind) > 1:
                size = np.frombuffer(data, kind[0], 1, at + np.dtype(fields).itemsize)[0]
                fields += [(f"{key} ", kind[0]), (key, kind[1], (int(size),))]
            else:
                fields.append((key, kind[0]))
        rows = np.frombuffer(data, fields, count, at)
        sizes = {k: rows[f"{k} "].astype(int) for k, kind in kinds.items() if len(kind) > 1}
        if all((n == n[0]).all() for n in sizes.values()):
            return {k: (sizes.get(k, none), rows[k].ravel()) for k in kinds}, at + rows.nbytes
    values: dict[str, list[Array]] = {key: [] for key in kinds}
    for row in range(count):
        try:
            for key, kind in kinds.items():
                many = 1
                if len(kind) > 1:
                    many = max(int(np.frombuffer(data, kind[0], 1, at)[0]), 0)
                    at += np.dtype(kind[0]).itemsize
                values[key].append(np.frombuffer(data, kind[-1], many, at) if many else none)
                at += values[key][-1].nbytes
        except ValueError:
            raise ValueError(
                f"cut short: its header tells {count} rows of {element!r}, {row} are there"
            ) from None
    return {k: (np.array([len(v) for v in vs]), np.concatenate(vs)) for k, vs in values.items()}, at


def _read_stl(content: bytes) -> Found:
    told = int.from_bytes(content[80:84], "little")
    there = len(content) - 84
    if 0 <= there == 50 * told:
        return Found(told=told)
    facets = len(re.findall(rb"\bfacet[ \t]+normal\b", content, re.IGNORECASE))
    if content.lstrip()[:5].lower() == b"solid" and facets:
        if not content.lower().rstrip().rpartition(b"\n")[2].lstrip().startswith(b"endsolid"):
            raise ValueError(f"cut short: no `endsolid` after {facets} facets")
        return Found(told=facets)
    if there < 0:
        raise ValueError("cut short, or no STL: neither text nor a header")
    raise ValueError(
        f"{'cut short: ' * (there < 50 * told)}its header tells {told} triangles of 50 bytes, "
        f"{there} bytes are there"
    )


def _read_dae(content: bytes) -> Found:
    import collada

    if b"<ph>" in content:
        raise ValueError("it holds polygons with holes, `<ph>`; triangulate it")
    file = collada.Collada(BytesIO(content), ignore=[collada.common.DaeError])
    tag, geometries = file.tag, list(file.xmlnode.getroot().iter(file.tag("geometry")))
    curves = {f"#{g.get('id')}" for g in geometries if g.find(tag("mesh")) is None}
    if file.scene is None or len(geometries) > len(file.geometries) + len(curves):
        why = re.sub(r"{.*?}", "", str(file.errors[0])) if file.errors else "there is none"
        raise ValueError(f"a mesh or its scene: {why}")
    parts = {tag(k) for k in ("node", "instance_node", "instance_geometry", "instance_controller")}
    meshes: list[trimesh.Trimesh] = []

    def visit(node: Any, matrix: Array) -> None:
        if isinstance(node, collada.scene.ControllerNode):
            raise ValueError("a mesh on a skeleton, `instance_controller`; apply the pose")
        if isinstance(node, collada.scene.GeometryNode):
            meshes.extend(_place(node.geometry, matrix))
        elif isinstance(node, collada.scene.Node):
            element = getattr(node, "node", node).xmlnode
            told = [e for e in element if e.tag in parts and e.get("url") not in curves]
            known = (collada.scene.GeometryNode, collada.scene.ControllerNode, collada.scene.Node)
            if len(told) > sum(isinstance(child, known) for child in node.children):
                raise ValueError(f"a part of its scene: {file.errors[0]}")
            for child in node.children:
                visit(child, np.dot(matrix, node.matrix))

    for node in file.scene.nodes:
        visit(node, np.eye(4))
    return Found(meshes, up=(file.assetInfo.upaxis or "Y_UP")[0].lower())


def _place(geometry: Any, matrix: Array) -> Iterator[trimesh.Trimesh]:
    """Make the meshes of a COLLADA geometry, every triangle with corners of its own."""
    for primitive in geometry.primitives:
        index, sizes = primitive.vertex_index, getattr(primitive, "vcounts", None)
        if index is None or not hasattr(primitive, "normal"):  # lines
            continue
        told, node = len(primitive), primitive.xmlnode
        if node.tag.endswith(("triangles", "polylist")):
            told = int(node.get("count", told))
        whole = len(index) if sizes is None else len(primitive)
        if told != whole or (sizes is not None and sizes.sum() != len(index)):
            raise ValueError(
                f"it tells {told} faces where {whole} are, or fewer corners; cut short?"
            )
        if sizes is not None:
            index = index[np.repeat(sizes > 2, sizes)]
            index, _ = cut_polygons(primitive.vertex, index, sizes[sizes > 2].astype(np.int64))
        if index.size and index.min() < 0:
            raise ValueError(f"a face names vertex {index.min()}")
        corners = primitive.vertex[index].reshape(-1, 3)
        faces = np.arange(len(corners)).reshape(-1, 3)
        yield trimesh.Trimesh(corners, faces, process=False).apply_transform(matrix)


READERS: Final[dict[str, Callable[[bytes], Found]]] = {
    ".obj": _read_obj,
    ".stl": _read_stl,
    ".ply": _read_ply,
    ".off": _read_off,
    ".dae": _read_dae,
}
