"""Mesh files: read into triangles, or refused with one line that says why.

A file may come from elsewhere. Formats of plain numbers are as long as what they hold, and their
parsers notice if not. The others can say in a few bytes what takes gigabytes: archives that unpack
to them, scenes that hold a thing that holds a thing ten times, meshes that Draco compressed. Of
these the sizes are looked up before a library builds them.
"""

import base64
import json
import logging
import re
import struct
import zipfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from graphlib import CycleError, TopologicalSorter
from io import BytesIO
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
import trimesh

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.files import check_no_pointer
from tactile_rt.sim_backend.objects.mesh_formats import READERS, Found

__all__ = ["MESH_SUFFIXES", "check_mesh_file", "mesh_content", "read_parts", "read_triangles"]

MOST_UNPACKED: Final = 256 << 20  # bytes of an archive ...
MOST_RATIO: Final = 100  # ... and times its own size; XML of numbers has 10
SMALL: Final = 16 << 20  # bytes that an archive may unpack to at any ratio
MOST_NODES: Final = 10_000  # of a scene, with every time that one is used
MOST_OBJECTS: Final = 100_000  # of glTF's JSON
MOST_POINTS: Final = 6_000_000  # of a mesh that Draco compressed

# Extensions of glTF that may be required: they do not change where a triangle is, or are read.
HARMLESS: Final = re.compile(
    "[A-Z]+_(draco_mesh_compression|mesh_quantization|materials|texture|lights|xmp|animation)"
)
GLB_JSON: Final = struct.Struct("<4sIIII")  # head of the file and of its first chunk
DRACO: Final = b"DRACO"
MAX_FACES = 2_000_000  # a minute
POINT = 1e-9  # of all extents: smaller is none
Y_UP = (".glb", ".gltf")  # by their standard; COLLADA files say it, the others are z-up
TO_Z_UP: Final = {  # from the axis that points up
    "x": np.array([[0, -1.0, 0], [0, 0, -1.0], [1.0, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]),
}


def _check_archive(name: str, content: bytes) -> int:
    try:
        with zipfile.ZipFile(BytesIO(content)) as archive:
            members = archive.infolist()
            size = sum(member.file_size for member in members)
            if size > min(MOST_UNPACKED, max(SMALL, MOST_RATIO * len(content))):
                raise ConfigError(
                    f"{name}: {len(content)} bytes that unpack to {size >> 20} MiB are no mesh; "
                    "export it again"
                )
            named = {m.filename: archive.read(m) for m in members if m.filename.endswith(".model")}
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, EOFError,
            ValueError, OSError):  # fmt: skip
        return -1  # the mesh library says what is wrong with it
    models = list(named.values())
    _check_nodes(name, _xml_nodes(name, models, "object", "component", "objectid"))
    if any(b"beamlattice>" in model for model in models):
        raise ConfigError(f"{name}: it holds a beam lattice; export it as a mesh of triangles")
    parts = [m for n, m in named.items() if "3d/3dmodel.model" not in n.lower()]
    if any(part.count(b"<mesh>") > 1 for part in parts):  # the library takes all for each
        raise ConfigError(f"{name}: several parts share a file within it; export it as one mesh")
    return -1


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


def _check_collada(name: str, content: bytes) -> int:
    _check_nodes(name, _xml_nodes(name, [content], "node", "instance_node", "url"))
    return -1


def _check_gltf(name: str, content: bytes) -> int:
    """Refuse what is not supported; return how many triangles the scene tells of."""
    text, binary = content, b""
    if content[:4] == b"glTF" and len(content) >= GLB_JSON.size:
        _, _, whole, length, _ = GLB_JSON.unpack_from(content)
        if whole > len(content):
            raise ConfigError(f"{name}: cut short, {len(content)} of {whole} bytes; copy it again")
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
        unsupported = _find_unsupported(scene, primitives, Path(name))
    except RecursionError:
        raise ConfigError(f"{name}: its JSON is nested too deep; export it again") from None
    except (ValueError, KeyError, TypeError, AttributeError, IndexError):
        return -1  # the mesh library says what is wrong with it
    if unsupported:
        raise ConfigError(f"{name}: {unsupported}")
    if len(nodes) > MOST_NODES:
        raise ConfigError(f"{name}: a scene of more than {MOST_NODES} nodes; join them")
    _check_nodes(name, nodes)
    for data in draco:
        if max(_draco_sizes(data)) > MOST_POINTS:
            raise ConfigError(
                f"{name}: Draco's data tells of more than {MOST_POINTS} points; export it again"
            )
    with suppress(ValueError, KeyError, TypeError, AttributeError, IndexError):
        return _count_drawn(scene)
    return -1


def _find_unsupported(scene: Any, primitives: Sequence[Any], path: Path) -> str:
    """Say what of a glTF the mesh library would leave out or misread; empty: nothing."""
    for required in scene.get("extensionsRequired", ()):
        if not HARMLESS.match(required):
            how = "`gltfpack -noq -i IN -o OUT` writes it without" if "meshopt" in required else ""
            return f"it needs {required}, which is not supported; {how or 'export it without'}"
    if any("EXT_mesh_gpu_instancing" in n.get("extensions", ()) for n in scene.get("nodes", ())):
        return "its nodes have copies by EXT_mesh_gpu_instancing; export it without"
    for buffer in scene.get("buffers", ()):
        beside = path.parent / unquote(uri := buffer.get("uri", ""))
        if uri and not uri.startswith("data:"):
            if not beside.is_file():
                return f"{uri}, which it names, is not beside it; copy both, or export a .glb"
            check_no_pointer(beside)
            if beside.stat().st_size < buffer["byteLength"]:
                return f"{uri}, which it names, is cut short; copy it again"
    for primitive in (p for p in primitives if p.get("mode", 4) > 3):
        if primitive.get("mode", 4) > 5:
            return "it holds fans of triangles (mode 6); export plain triangles"
        used = [
            primitive["attributes"]["POSITION"],
            *([primitive.get("indices")] * ("indices" in primitive)),
        ]
        places, *_ = read = [scene["accessors"][i] for i in used]
        if any("sparse" in accessor for accessor in read):
            return "its vertices are a sparse accessor; export it without"
        if places.get("normalized"):
            return "its vertices are normalized integers; `gltf-transform dequantize IN OUT`"
    return ""


def _count_drawn(scene: Any) -> int:
    """Count the triangles of all nodes of the scene that is shown."""
    drawn, todo = 0, list(scene["scenes"][scene.get("scene", 0)].get("nodes", ()))
    while todo:
        node = scene["nodes"][todo.pop()]
        todo += node.get("children", ())
        for p in scene["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            number = scene["accessors"][p.get("indices", p["attributes"]["POSITION"])]["count"]
            drawn += {4: number // 3, 5: number - 2}.get(p.get("mode", 4), 0)
    return drawn


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
FORMATS: Final[dict[str, Callable[[str, bytes], int] | None]] = {
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
logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # what matters of a file is told here


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
    content, _ = _read_checked(path)
    if path.suffix.lower() == ".gltf":
        with suppress(ValueError, KeyError, TypeError, AttributeError, OSError):
            for buffer in json.loads(content)["buffers"]:
                if not buffer["uri"].startswith("data:"):
                    content += (path.parent / unquote(buffer["uri"])).read_bytes()
    return content


def _read_checked(path: Path) -> tuple[bytes, int]:
    """Read a file and the number of triangles it tells; refuse archive bombs."""
    check_no_pointer(path)
    content, check = path.read_bytes(), FORMATS[path.suffix.lower()]
    return content, check(str(path), content) if check else -1


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
    found = _read_meshes(path)
    # joined by hand: what colours and textures the bodies have is dropped
    joined = trimesh.util.append_faces(
        [m.vertices for m in found.meshes], [m.faces for m in found.meshes]
    )
    mesh = trimesh.Trimesh(*joined, process=False)
    mesh.remove_unreferenced_vertices()
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise ConfigError(f"{path}: {bad} vertices are not finite numbers; export it again")
    if (up or found.up) in TO_Z_UP:
        mesh.vertices = mesh.vertices @ TO_Z_UP[up or found.up].T
    return mesh


def _read_meshes(path: Path) -> Found:
    """Read the bodies of a file in their places; refuse it if some are missing."""
    content, told = _read_checked(path)
    suffix = path.suffix.lower()
    axis = "y" if suffix in Y_UP else "z"
    try:
        found = READERS[suffix](content) if suffix in READERS else Found(told=told, up=axis)
        if found.same or not found.meshes:
            try:
                found = _choose(found, _load_meshes(path, content))
            except ConfigError:
                raise
            except Exception:
                if not found.again and not found.meshes:
                    raise
                found = found.again(content) if found.again else found
        number = sum(len(mesh.faces) for mesh in found.meshes)
        _check_number(path, number)
        for vertices, faces in (
            (np.asarray(m.vertices), m.faces) for m in found.meshes if len(m.faces)
        ):
            if vertices.shape[1:] != (3,):
                raise ValueError("a vertex has fewer than 3 coordinates; is it cut short?")
            if outside := [i for i in (faces.min(), faces.max()) if not 0 <= i < len(vertices)]:
                raise ValueError(f"a face names vertex {outside[0]}, of {len(vertices)}")
            if suffix in Y_UP and not np.ptp(vertices, axis=0).any() and DRACO in content:
                raise ValueError("what Draco compressed cannot be unpacked")
    except ConfigError:
        raise
    except Exception as error:  # the parsers raise whatever their format trips over
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ImportError):  # what guesses at encodings is not installed
            reason = "cut short, or neither binary as it should be nor UTF-8 text"
        raise ConfigError(
            f"{path}: cannot be read as {suffix} ({reason[:120]}); export it again"
        ) from error
    if not number:
        raise ConfigError(f"{path}: holds no triangles; export a surface mesh, not points or lines")
    return found


def _choose(found: Found, theirs: list[trimesh.Trimesh]) -> Found:
    """Take what the library read, if it is as many triangles as the file tells."""
    told = sum(len(mesh.faces) for mesh in found.meshes) if found.meshes else found.told
    number = sum(len(mesh.faces) for mesh in theirs)
    if told not in (-1, number):
        raise ValueError(f"it tells {told} triangles, {number} of them can be read")
    return replace(found, meshes=theirs)


def _check_number(path: Path, faces: int) -> None:
    if faces > MAX_FACES:
        raise ConfigError(
            f"{path}: has {faces} triangles, more than {MAX_FACES}; simplify it in a mesh tool"
        )


class _Beside(trimesh.resolvers.FilePathResolver):
    """Files that a .gltf names, as URLs write them."""

    def get(self, name: str) -> Any:
        return super().get(unquote(name))


def _load_meshes(path: Path, content: bytes) -> list[trimesh.Trimesh]:
    """Let the library read the bodies of a file."""
    kind = path.suffix.lower()[1:]
    # materials would be dropped, and pictures that are missing be complained of
    materials: dict[str, Any] = {} if kind in ("stl", "3mf") else {"skip_materials": True}
    scene = trimesh.load_scene(
        BytesIO(content), file_type=kind, process=False, resolver=_Beside(str(path)), **materials
    )
    names = [scene.graph[node][1] for node in scene.graph.nodes_geometry]
    # told before a mesh that is used a thousand times is copied
    _check_number(path, sum(len(getattr(scene.geometry[name], "faces", ())) for name in names))
    return [m for m in scene.dump() if isinstance(m, trimesh.Trimesh)]
