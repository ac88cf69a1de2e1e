"""Readers of mesh formats that check the counts in a file's header against its content.

A mesh library leaves out what it does not know, and cuts every polygon as a fan. A reader raises a
`ValueError` that says what is wrong with the file.
"""

import re
from collections.abc import Iterator
from contextlib import suppress
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
import trimesh
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.objects.polygons import cut_polygons

Array = NDArray[Any]
Meshes = list[trimesh.Trimesh]
PLY_TYPES: Final = {  # other names are the same as in NumPy
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8",
}  # fmt: skip
MOST_NODES: Final = 10_000  # of a scene; a node counts every time that it is used
SAME: Final = 1e-9  # relative difference in area within which two readings are the same
MAX_FACES = 2_000_000  # which take a minute


def check_number(path: Path, faces: int) -> None:
    """Raise a `ConfigError` for more than `MAX_FACES` triangles."""
    if faces > MAX_FACES:
        raise ConfigError(
            f"{path}: has {faces} triangles, more than {MAX_FACES}; simplify it in a mesh tool"
        )


class _UrlFiles(trimesh.resolvers.FilePathResolver):
    """A resolver of the files that a .gltf names in percent-encoded URLs."""

    def get(self, name: str) -> Any:
        return super().get(unquote(name))


def load_meshes(path: Path, content: bytes, expected: int = -1) -> Meshes:
    """Read the bodies of a file with the mesh library.

    Args:
        expected: number of triangles that they must have; -1 if unknown.
    """
    kind = path.suffix.lower()[1:]
    # materials are not needed, and the library would complain of missing pictures
    materials: dict[str, Any] = {} if kind in ("stl", "3mf") else {"skip_materials": True}
    scene = trimesh.load_scene(
        BytesIO(content), file_type=kind, process=False, resolver=_UrlFiles(str(path)), **materials
    )
    names = [scene.graph[node][1] for node in scene.graph.nodes_geometry]
    # checked before a mesh that is used a thousand times is copied
    check_number(path, sum(len(getattr(scene.geometry[name], "faces", ())) for name in names))
    meshes = [m for m in scene.dump() if isinstance(m, trimesh.Trimesh)]
    number = sum(len(mesh.faces) for mesh in meshes)
    if expected not in (-1, number):
        raise ValueError(f"it declares {expected} triangles, {number} of them can be read")
    for mesh in meshes:
        _check_corners(mesh.vertices, mesh.faces)
    return meshes


def _check_corners(vertices: Array, corners: Array, base: int = 0) -> None:
    if len(vertices) and vertices.shape[1:] != (3,):
        raise ValueError("a vertex has fewer than 3 coordinates; is it cut short?")
    outside = corners[(corners < 0) | (corners >= len(vertices))]
    if len(outside):
        raise ValueError(
            f"a face names vertex {int(outside[0]) + base}, of {len(vertices)} counted from {base}"
        )


def _make_mesh(vertices: Array, corners: Array, sizes: Array, base: int = 0) -> trimesh.Trimesh:
    """Make a mesh from polygons; `base` is the file's first vertex number, for messages."""
    if len(sizes) and sizes.min() < 3:
        raise ValueError(f"face {sizes.argmin() + 1} has {sizes.min()} corners; is it cut short?")
    if len(corners) != sizes.sum():
        raise ValueError("cut short: a face has fewer corners than it declares")
    _check_corners(vertices, corners, base)
    faces = cut_polygons(vertices, corners.astype(np.int64), sizes.astype(np.int64))
    return trimesh.Trimesh(vertices, faces, process=False)


def _normalise_text(content: bytes) -> bytes:
    """Convert text to UTF-8 without a byte order mark, with line feeds as line ends."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        content = content.decode("utf-16").encode()
    text = content.removeprefix(b"\xef\xbb\xbf")
    return text if b"\n" in text else text.replace(b"\r", b"\n")


def _parse_numbers(text: bytes, kind: type) -> Array:
    return np.fromstring(text.decode("latin-1"), sep=" ", dtype=kind)


def read_obj(path: Path, content: bytes) -> Meshes:
    """Read an OBJ file with rows indented, continued, commented and numbered in any way.

    The library's own meshes are preferred if they have the same number of triangles and the same
    area; the library misreads relative vertex numbers.
    """
    text = _normalise_text(content).replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    rows = re.findall(rb"^[ \t]*(v|f|surf)[ \t]+([^#\n]*)", text, re.MULTILINE)
    kinds = np.array([kind for kind, _ in rows], "S4")
    if (kinds == b"surf").any():
        raise ValueError("it holds free-form surfaces, `surf`; export it as polygons")
    places = [values for kind, values in rows if kind == b"v"]
    faces = [values for kind, values in rows if kind == b"f"]
    sizes = np.array([len(face.split()) for face in faces], np.int64)
    vertices = _parse_numbers(b" ".join(places), float)
    if len(vertices) == 3 * len(places):
        vertices = vertices.reshape(-1, 3)
    else:  # weights, or colours
        vertices = np.array([row.split()[:3] for row in places], float)
    corners = _parse_numbers(re.sub(rb"/\S*", b"", b" ".join(faces)), np.int64)
    before = np.cumsum(kinds == b"v")[kinds == b"f"]  # relative numbers count back from it
    back = corners + np.repeat(before, sizes)[: len(corners)] + 1
    relative = corners < 0
    mesh = _make_mesh(vertices, np.where(relative, np.maximum(back, 0), corners) - 1, sizes, 1)
    with suppress(Exception):
        theirs = load_meshes(path, content, len(mesh.faces))
        covered = sum(float(m.area) for m in theirs)
        if not relative.any() and abs(covered - mesh.area) <= SAME * covered:
            return theirs
    return [mesh]


def read_off(path: Path, content: bytes) -> Meshes:
    text = re.sub(rb"#[^\n]*", b"", _normalise_text(content))
    head = re.match(rb"\s*(?:ST)?C?N?OFF(\s+BINARY)?\s", text)
    if not head or head[1]:
        raise ValueError("binary OFF; save it as text" if head else "it does not begin with OFF")
    rows = [row for line in text[head.end() :].splitlines() if (row := line.split())]
    points, faces = int(rows[0][0]), int(rows[0][1])
    if len(rows) - 1 != points + faces:
        raise ValueError(
            f"{'cut short: ' * (len(rows) <= points + faces)}its header declares {points} vertices "
            f"and {faces} faces, {len(rows) - 1} rows follow"
        )
    vertices = np.array([row[:3] for row in rows[1 : points + 1]], float).reshape(points, 3)
    sizes = np.array([int(row[0]) for row in rows[points + 1 :]], np.int64)
    polygons = [row[1 : size + 1] for row, size in zip(rows[points + 1 :], sizes, strict=True)]
    corners = np.array(list(map(int, chain.from_iterable(polygons))), np.int64)
    return [_make_mesh(vertices, corners, sizes)]


def read_ply(path: Path, content: bytes) -> Meshes:
    head, end, body = content.removeprefix(b"\xef\xbb\xbf").partition(b"end_header")
    lines = [line.split() for line in head.decode("latin-1").splitlines() if line.strip()]
    if not end or lines[0] != ["ply"] or lines[1][0] != "format":
        raise ValueError("it does not begin with the header of a PLY file, or that is cut short")
    text, order = lines[1][1] == "ascii", "<>"["big" in lines[1][1]]
    body = body[re.match(rb"[^\n\r]*\r?\n?", body).end() :]  # type: ignore[union-attr]
    data = _parse_numbers(body, float).tobytes() if text else body
    elements: dict[str, tuple[int, dict[str, list[str]]]] = {}
    for line in lines:
        if line[0] == "element":
            elements[line[1]] = int(line[2]), {}
        elif line[0] == "property":
            names = [PLY_TYPES.get(kind, kind) for kind in line[1:-1] if kind != "list"]
            kinds = [order + np.dtype("f8" if text else name).str[1:] for name in names]
            list(elements.values())[-1][1][line[-1]] = kinds
    at, found = 0, {}
    for name, (count, properties) in elements.items():
        found[name], at = _read_rows(name, data, at, count, properties)
    if at != len(data):
        raise ValueError(f"its header declares {at} bytes, {len(data)} are there")
    points = elements.get("vertex", (0, {}))[1]
    if missing := [axis for axis in "xyz" if axis not in points]:
        raise ValueError(f"its vertices have no {missing[0]}")
    vertices = np.column_stack([found["vertex"][k][1] for k in "xyz"])
    lists = [key for key, kinds in elements.get("face", (0, {}))[1].items() if len(kinds) > 1]
    if "tristrips" in elements:
        raise ValueError("it holds strips of triangles, `tristrips`; save it as faces")
    known = [key for key in ("vertex_index", "vertex_indices", *lists) if key in lists]
    return [_make_mesh(vertices, *found["face"][known[0]][::-1])] if known else []


def _read_rows(
    element: str, data: bytes, at: int, count: int, kinds: dict[str, list[str]]
) -> tuple[dict[str, tuple[Array, Array]], int]:
    """Read a PLY element: list sizes and values of each property, and the end offset."""
    sizes: dict[str, list[Array]] = {key: [np.zeros(0, int)] for key in kinds}
    values: dict[str, list[Array]] = {key: [np.zeros(0, int)] for key in kinds}
    left, step = count * bool(kinds), count
    while left:  # at a time, rows whose lists are as long as the first row's
        fields = list[Any]()
        with suppress(ValueError):
            for key, kind in kinds.items():
                size = 1
                if len(kind) > 1:
                    start = at + np.dtype(fields).itemsize
                    size = max(int(np.frombuffer(data, kind[0], 1, start)[0]), 0)
                    fields.append((f"{key} ", kind[0]))
                fields.append((key, kind[-1], (size,)))
        there = (len(data) - at) // np.dtype(fields).itemsize if len(fields) >= len(kinds) else 0
        if not there:
            raise ValueError(
                f"cut short: it declares {count} rows of {element!r}, {count - left} are there"
            )
        rows = np.frombuffer(data, fields, min(step, left, there), at)
        same = np.ones(len(rows), bool)
        for key in (key for key, kind in kinds.items() if len(kind) > 1):
            same &= rows[f"{key} "] == rows[f"{key} "][0]
        step = max(2 * len(rows), 64) if same.all() else 64
        rows = rows[: len(rows) if same.all() else same.argmin()]
        for key in kinds:
            sizes[key].append(np.full(len(rows), rows[key].shape[1]))
            values[key].append(rows[key].ravel())
        at, left = at + rows.nbytes, left - len(rows)
    return {k: (np.concatenate(sizes[k]), np.concatenate(values[k])) for k in kinds}, at


def read_stl(path: Path, content: bytes) -> Meshes:
    count = int.from_bytes(content[80:84], "little")
    size = len(content) - 84
    if 0 <= size == 50 * count:
        return load_meshes(path, content, count)
    facets = len(re.findall(rb"\bfacet[ \t]+normal\b", content, re.IGNORECASE))
    if content.lstrip()[:5].lower() == b"solid" and facets:
        if not content.lower().rstrip().rpartition(b"\n")[2].lstrip().startswith(b"endsolid"):
            raise ValueError(f"cut short: no `endsolid` after {facets} facets")
        return load_meshes(path, content, facets)
    raise ValueError(
        "cut short, or no STL: neither text nor a header"
        if size < 0
        else f"{'cut short: ' * (size < 50 * count)}it declares {count} triangles of 50 bytes,"
        f" {size} bytes are there"
    )


def read_dae(path: Path, content: bytes) -> Meshes:
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
    meshes, visited = Meshes(), list[Any]()

    def visit(node: Any, matrix: Array) -> None:
        visited.append(node)
        if len(visited) > MOST_NODES:
            raise ValueError(f"a scene of more than {MOST_NODES} nodes; join them")
        if isinstance(node, collada.scene.ControllerNode):
            raise ValueError("a mesh on a skeleton, `instance_controller`; apply the pose")
        if isinstance(node, collada.scene.GeometryNode):
            meshes.extend(m.apply_transform(matrix) for m in _make_meshes(node.geometry))
        elif isinstance(node, collada.scene.Node):
            element = getattr(node, "node", node).xmlnode
            listed = [e for e in element if e.tag in parts and e.get("url") not in curves]
            known = (collada.scene.GeometryNode, collada.scene.ControllerNode, collada.scene.Node)
            if len(listed) > sum(isinstance(child, known) for child in node.children):
                raise ValueError(f"a part of its scene: {file.errors[0]}")
            for child in node.children:
                visit(child, np.dot(matrix, node.matrix))

    for node in file.scene.nodes:
        visit(node, np.eye(4))
    for mesh in meshes:
        mesh.metadata["up"] = (file.assetInfo.upaxis or "Y_UP")[0].lower()
    return meshes


def _make_meshes(geometry: Any) -> Iterator[trimesh.Trimesh]:
    inputs = (e for e in geometry.xmlnode.iter("{*}input") if e.get("semantic") == "POSITION")
    places = {e.get("source") for e in inputs}
    for source in geometry.xmlnode.iter("{*}source"):
        if f"#{source.get('id')}" in places and "nan" in "".join(source.itertext()).lower():
            raise ValueError("a vertex is not a number but nan")  # the library would read 0
    for primitive in geometry.primitives:
        index, sizes = primitive.vertex_index, getattr(primitive, "vcounts", None)
        if index is None or not hasattr(primitive, "normal"):  # lines
            continue
        if sizes is None:
            sizes = np.full(len(index), 3)
        count = len(primitive)
        if primitive.xmlnode.tag.endswith(("triangles", "polylist")):
            count = int(primitive.xmlnode.get("count", count))
        if count != len(sizes):
            raise ValueError(f"it declares {count} faces where {len(sizes)} are; cut short?")
        yield _make_mesh(primitive.vertex, index.ravel(), sizes)
