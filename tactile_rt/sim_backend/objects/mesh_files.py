"""Mesh files: read into triangles, or refused with one line that says why.

A file may come from elsewhere. Formats of plain numbers are as long as what they hold, and their
parsers notice if not. The others can say in a few bytes what takes gigabytes: archives that unpack
to them, scenes that hold a thing that holds a thing ten times, meshes that Draco compressed. Of
these the sizes are looked up before a library builds them.
"""

import base64
import json
import struct
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from graphlib import CycleError, TopologicalSorter
from io import BytesIO
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
import trimesh

from tactile_rt.core.errors import ConfigError

__all__ = ["MESH_SUFFIXES", "check_mesh_file", "mesh_content", "read_parts", "read_triangles"]

MOST_UNPACKED: Final = 256 << 20  # bytes of an archive ...
MOST_RATIO: Final = 100  # ... and times its own size; XML of numbers has 10
SMALL: Final = 16 << 20  # bytes that an archive may unpack to at any ratio
MOST_NODES: Final = 10_000  # of a scene, with every time that one is used
MOST_OBJECTS: Final = 100_000  # of glTF's JSON
MOST_POINTS: Final = 6_000_000  # of a mesh that Draco compressed

GLB_JSON: Final = struct.Struct("<4sIIII")  # head of the file and of its first chunk
DRACO: Final = b"DRACO"
Y_UP = (".glb", ".gltf")  # by their standard; COLLADA files say it, and the reader turns them
MAX_FACES = 2_000_000  # a minute
POINT = 1e-9  # of all extents: smaller is none
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def _check_archive(name: str, content: bytes) -> None:
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > min(MOST_UNPACKED, max(SMALL, MOST_RATIO * len(content))):
                raise ConfigError(
                    f"{name}: {len(content)} bytes that unpack to {size >> 20} MiB are no mesh; "
                    "export it again"
                )
            models = [archive.read(m) for m in members if m.filename.endswith(".model")]
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError, OSError):
        return  # the mesh library says what is wrong with it
    _check_nodes(name, _xml_nodes(name, models, "object", "component", "objectid"))


def _xml_nodes(
    name: str, texts: Sequence[bytes], node: str, use: str, reference: str
) -> dict[str, list[str]]:
    """Return the nodes that the elements `use` within each node refer to."""
    from lxml import etree

    used: dict[str, list[str]] = {}
    number = 0
    for text in texts:
        if use.encode() not in text and use.encode("utf-16-le") not in text:
            continue
        inside: list[str] = []
        try:
            for event, element in etree.iterparse(BytesIO(text), events=("start", "end")):
                kind = etree.QName(element).localname
                if kind == node and event == "start":
                    number += 1
                    inside.append(element.get("id") or f" {number}")
                    used.setdefault(inside[-1], [])
                    if len(inside) > 1:  # a node within a node is used by it
                        used[inside[-2]].append(inside[-1])
                elif kind == node:
                    inside.pop()
                elif kind == use and event == "start" and inside:
                    used[inside[-1]].append(str(element.get(reference)).removeprefix("#"))
                if event == "end":
                    element.clear()
                if number > MOST_NODES:
                    raise ConfigError(f"{name}: a scene of more than {MOST_NODES} nodes; join them")
        except (etree.XMLSyntaxError, ValueError):
            pass  # the mesh library says what is wrong with it
    return used


def _check_nodes(name: str, used: Mapping[str, Sequence[str]]) -> None:
    """Refuse scenes that use nodes more often than can be built, or in a circle."""
    times: dict[str, int] = {}  # nodes that a node is, with all that it uses
    try:
        for node in TopologicalSorter(used).static_order():
            times[node] = 1 + sum(times[below] for below in used.get(node, ()))
            if times[node] > MOST_NODES:
                raise ConfigError(
                    f"{name}: a scene of more than {MOST_NODES} nodes, as often as they are "
                    "used; join them"
                )
    except CycleError:
        raise ConfigError(f"{name}: a node of its scene holds itself; export it again") from None


def _check_collada(name: str, content: bytes) -> None:
    _check_nodes(name, _xml_nodes(name, [content], "node", "instance_node", "url"))


def _check_gltf(name: str, content: bytes) -> None:
    text, binary = content, b""
    if content[:4] == b"glTF" and len(content) >= GLB_JSON.size:
        *_, length, _ = GLB_JSON.unpack_from(content)
        text = content[GLB_JSON.size : GLB_JSON.size + length]
        binary = content[GLB_JSON.size + length + 8 :]
    if text.count(b"{") > MOST_OBJECTS:
        raise ConfigError(f"{name}: more than {MOST_OBJECTS} objects in its JSON; join them")
    try:
        scene = json.loads(text)
        nodes = {
            str(i): [str(x) for x in n.get("children", ())]
            for i, n in enumerate(scene.get("nodes", ()))
        }
        primitives = [p for mesh in scene.get("meshes", ()) for p in mesh.get("primitives", ())]
        draco = [d for p in primitives if (d := _draco_of(scene, p, binary))]
    except RecursionError:
        raise ConfigError(f"{name}: its JSON is nested too deep; export it again") from None
    except (ValueError, KeyError, TypeError, AttributeError, IndexError):
        return  # the mesh library says what is wrong with it
    if len(nodes) > MOST_NODES:
        raise ConfigError(f"{name}: a scene of more than {MOST_NODES} nodes; join them")
    _check_nodes(name, nodes)
    for data in draco:
        if max(_draco_sizes(data)) > MOST_POINTS:
            raise ConfigError(
                f"{name}: Draco's data tells of more than {MOST_POINTS} points; export it again"
            )


def _draco_of(scene: Any, primitive: Any, binary: bytes) -> bytes:
    """The beginning of a primitive's data as Draco compressed it; empty if it did not."""
    found = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
    if found is None:
        return b""
    view = scene["bufferViews"][found["bufferView"]]
    uri = scene["buffers"][view["buffer"]].get("uri", "")
    if uri.startswith("data:"):
        binary = base64.b64decode(uri.partition(",")[2])
    elif uri:
        return b""
    at = view.get("byteOffset", 0)
    return binary[at : at + 64]


def _draco_sizes(data: bytes) -> tuple[int, ...]:
    """Read the two numbers of faces, points or vertices that Draco's data begins with."""
    if data[:5] != DRACO or len(data) < 13:
        return (0,)
    found, at = [0, 0], 11 if data[8] == 0 else 12
    for i in range(2):
        for shift in range(0, 70, 7):
            byte = data[at] if at < len(data) else 0
            at += 1
            found[i] |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
    return tuple(found)


# Every format that can be read, with the check of what it says of itself.
FORMATS: Final[dict[str, Callable[[str, bytes], None] | None]] = {
    ".obj": None,
    ".stl": None,
    ".ply": None,
    ".glb": _check_gltf,
    ".gltf": _check_gltf,
    ".off": None,
    ".dae": _check_collada,
    ".3mf": _check_archive,
}
MESH_SUFFIXES = tuple(FORMATS)


def check_mesh_file(path: Path) -> None:
    """Look whether there is such a file, of a format that can be read."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise ConfigError(
            f"{path}: unknown mesh format {path.suffix or '(none)'!r}; use one of "
            f"{', '.join(MESH_SUFFIXES)}"
        )
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise ConfigError(f"{path}: the file is empty; export it again")


def mesh_content(path: Path) -> bytes:
    """Return the bytes of a mesh file and of the files of numbers that a .gltf names.

    Raises:
        ConfigError: it unpacks to more than it can be expected to hold.
    """
    content = _read_checked(path)
    if path.suffix.lower() == ".gltf":
        with suppress(ValueError, KeyError, TypeError, AttributeError, OSError):
            for buffer in json.loads(content)["buffers"]:
                if not buffer["uri"].startswith("data:"):
                    content += (path.parent / unquote(buffer["uri"])).read_bytes()
    return content


def _read_checked(path: Path) -> bytes:
    """Read a file; refuse one that unpacks to more than it may."""
    content, check = path.read_bytes(), FORMATS[path.suffix.lower()]
    if check is not None:
        check(str(path), content)
    return content


def read_triangles(path: Path, up: str = "") -> trimesh.Trimesh:
    """All triangles of a file in one mesh, z up, moved and scaled into the unit box.

    Args:
        path: the file; a scene is taken as one rigid object, its unit does not matter.
        up: the axis that points up in it, "y" or "z"; empty: as its format has it, else z.
    """
    mesh = read_parts([path], up)
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    return mesh


def read_parts(paths: Sequence[Path], up: str = "") -> trimesh.Trimesh:
    """All triangles of the files of one object in one mesh, z up, in the unit of the files."""
    parts = [_part(path, up) for path in paths]
    joined = trimesh.util.append_faces([m.vertices for m in parts], [m.faces for m in parts])
    mesh = trimesh.Trimesh(*joined, process=False)
    largest = max(mesh.extents.max(), np.abs(mesh.bounds).max())
    if np.sort(mesh.extents)[1] <= POINT * largest:
        raise ConfigError(f"{paths[0]}: all its triangles lie on one line; export it again")
    return mesh


def _part(path: Path, up: str) -> trimesh.Trimesh:
    check_mesh_file(path)
    suffix = path.suffix.lower()
    _read_checked(path)
    meshes = _parsed(path, suffix)
    if not any(len(m.faces) for m in meshes):
        raise ConfigError(f"{path}: holds no triangles; export a surface mesh, not points or lines")
    # joined by hand: what colours and textures the bodies have is dropped
    joined = trimesh.util.append_faces([m.vertices for m in meshes], [m.faces for m in meshes])
    mesh = trimesh.Trimesh(*joined, process=False)
    mesh.remove_unreferenced_vertices()
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise ConfigError(f"{path}: {bad} vertices are not finite numbers; export it again")
    if up == "y" or (not up and suffix in Y_UP):
        mesh.vertices = mesh.vertices @ _Y_UP_TO_Z_UP.T
    return mesh


def _parsed(path: Path, suffix: str) -> list[trimesh.Trimesh]:
    try:
        # materials would be dropped, and pictures that are missing be complained of
        kinds = (".obj", ".ply")
        materials: dict[str, Any] = {"skip_materials": True} if suffix in kinds else {}
        scene = trimesh.load_scene(path, process=False, **materials)
        names = [scene.graph[node][1] for node in scene.graph.nodes_geometry]
        faces = sum(len(getattr(scene.geometry[name], "faces", ())) for name in names)
        if faces > MAX_FACES:  # told before a mesh that is used a thousand times is copied
            raise ConfigError(
                f"{path}: has {faces} triangles, more than {MAX_FACES}; simplify it in a mesh tool"
            )
        return [m for m in scene.dump() if isinstance(m, trimesh.Trimesh)]
    except ConfigError:
        raise
    except Exception as error:  # the parsers raise whatever their format trips over
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ImportError):  # what guesses at encodings is not installed
            reason = "cut short, or neither binary as it should be nor UTF-8 text"
        raise ConfigError(
            f"{path}: cannot be read as {suffix} ({reason[:120]}); export it again"
        ) from error
