"""Mesh files, read into triangles or refused with a reason of one line.

A file may be untrusted. A format of plain numbers is as long as its content, and its reader checks
that (see `mesh_formats`). Other formats can expand from a few bytes to gigabytes: archives, scenes
of nested copies, meshes compressed by Draco. Their sizes are checked before a library builds them.
"""

import base64
import json
import logging
import re
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from graphlib import CycleError, TopologicalSorter
from io import BytesIO
from pathlib import Path
from typing import Any, Final
from urllib.parse import unquote

import numpy as np
import trimesh

from tactile_rt.core.errors import ConfigError, explain_errors
from tactile_rt.core.files import refuse_lfs_pointer
from tactile_rt.sim_backend.objects import mesh_formats
from tactile_rt.sim_backend.objects.mesh_formats import MOST_NODES, check_number, load_meshes

MOST_UNPACKED: Final = 256 << 20  # bytes that an archive may unpack to ...
MOST_RATIO: Final = 100  # ... and their ratio to its own size; XML of numbers has 10
SMALL: Final = 16 << 20  # bytes that an archive may unpack to at any ratio
MOST_OBJECTS: Final = 100_000  # in the JSON of a glTF
MOST_POINTS: Final = 6_000_000  # of a mesh compressed by Draco

# Required glTF extensions that are accepted: they move no triangle, or the library reads them.
HARMLESS: Final = re.compile(
    "[A-Z]+_(draco_mesh_compression|mesh_quantization|materials|texture|lights|xmp|animation)"
)
GLB_JSON: Final = struct.Struct("<4sIIII")  # headers of the file and of its first chunk
DRACO: Final = b"DRACO"
NO_GLTF: Final = (ValueError, KeyError, TypeError, AttributeError, IndexError)
POINT = 1e-9  # of the largest extent or coordinate: a smaller extent counts as zero
STRAY, AWAY = 5e-3, 3.0  # share of area at either end, stray if it makes a mesh this much longer
TO_Z_UP: Final = {  # from the axis that points up
    "x": np.array([[0, -1.0, 0], [0, 0, -1.0], [1.0, 0, 0]]),
    "y": np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]),
}
logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # this module reports what matters


def _read_3mf(path: Path, content: bytes) -> list[trimesh.Trimesh]:
    from lxml import etree

    with zipfile.ZipFile(BytesIO(content)) as archive:
        size = sum(member.file_size for member in archive.infolist())
        if size > min(MOST_UNPACKED, max(SMALL, MOST_RATIO * len(content))):
            raise ValueError(f"{len(content)} bytes that unpack to {size >> 20} MiB are no mesh")
        models = {n: archive.read(n) for n in archive.namelist() if n.endswith(".model")}
    used: dict[str, list[str]] = {}
    for name, text in models.items():
        if b"beamlattice>" in text:
            raise ValueError("it holds a beam lattice; export it as a mesh of triangles")
        # the library reads all parts of an inner file for each part
        if "3d/3dmodel.model" not in name.lower() and text.count(b"<mesh>") > 1:
            raise ValueError("several parts share a file within it; export it as one mesh")
        for _, thing in etree.iterparse(BytesIO(text), tag="{*}object"):
            parts = thing.iter("{*}component")
            used[str(thing.get("id"))] = [str(part.get("objectid")) for part in parts]
            thing.clear()
    _check_nodes(used)
    return load_meshes(path, content)


def _check_nodes(used: Mapping[str, Sequence[str]]) -> None:
    """Raise a `ValueError` if nodes expand to too many copies, or contain themselves."""
    times: dict[str, int] = {}  # number of nodes that each node expands to
    try:
        for node in TopologicalSorter(used).static_order():
            times[node] = 1 + sum(times[below] for below in used.get(node, ()))
            if max(times[node], len(used)) > MOST_NODES:
                raise ValueError(f"a scene of more than {MOST_NODES} nodes; join them")
    except CycleError:
        raise ValueError("a node of its scene holds itself") from None


def _read_gltf(path: Path, content: bytes) -> list[trimesh.Trimesh]:
    text, binary = content, b""
    if content[:4] == b"glTF" and len(content) >= GLB_JSON.size:
        _, _, whole, length, _ = GLB_JSON.unpack_from(content)
        if whole > len(content):
            raise ValueError(f"cut short, {len(content)} of {whole} bytes; copy it again")
        text = content[GLB_JSON.size : GLB_JSON.size + length]
        binary = content[GLB_JSON.size + length + 8 :]
    if text.count(b"{") > MOST_OBJECTS:
        raise ValueError(f"more than {MOST_OBJECTS} objects in its JSON; join them")
    scene = json.loads(text)
    nodes = enumerate(scene.get("nodes", ()))
    _check_nodes({str(i): [str(x) for x in node.get("children", ())] for i, node in nodes})
    _check_supported(scene)
    for buffer in (binary, *_read_buffers(path, scene)):
        for match in re.finditer(DRACO, buffer):
            if max(_read_draco_sizes(buffer[match.start() : match.start() + 64])) > MOST_POINTS:
                raise ValueError(f"Draco's data declares more than {MOST_POINTS} points")
    expected = -1
    with suppress(*NO_GLTF):
        expected = _count_triangles(scene)
    meshes = load_meshes(path, content, expected)
    for mesh in meshes:
        if DRACO in content and len(mesh.vertices) and not np.ptp(mesh.vertices, axis=0).any():
            raise ValueError("what Draco compressed cannot be unpacked")
        mesh.metadata["up"] = "y"  # by its standard
    return meshes


def _read_buffers(path: Path, scene: Any) -> Iterator[bytes]:
    """Yield the buffers of a glTF that are outside its binary part."""
    for buffer in scene.get("buffers", ()):
        uri = buffer.get("uri", "")
        if uri.startswith("data:"):
            yield base64.b64decode(uri.partition(",")[2])
        elif uri:
            beside = path.parent / unquote(uri)
            if not beside.is_file():
                raise ConfigError(f"{path}: {uri}, which it names, is not beside it; copy both")
            refuse_lfs_pointer(beside)
            if beside.stat().st_size < buffer["byteLength"]:
                raise ConfigError(f"{path}: {uri}, which it names, is cut short; copy it again")
            yield beside.read_bytes()


def _check_supported(scene: Any) -> None:
    """Raise a `ValueError` for glTF features that the mesh library would omit or misread."""
    for required in scene.get("extensionsRequired", ()):
        if not HARMLESS.match(required):
            how = "; `gltfpack -noq -i IN -o OUT` writes it without" * ("meshopt" in required)
            raise ValueError(f"it needs {required}, which is not supported{how}")
    if any("EXT_mesh_gpu_instancing" in n.get("extensions", ()) for n in scene.get("nodes", ())):
        raise ValueError("its nodes have copies by EXT_mesh_gpu_instancing")
    for primitive in (p for mesh in scene.get("meshes", ()) for p in mesh["primitives"]):
        if primitive.get("mode", 4) > 5:
            raise ValueError("it holds fans of triangles (mode 6); export plain triangles")
        used = (primitive["attributes"].get("POSITION"), primitive.get("indices"))
        read = [scene["accessors"][i] for i in used if i is not None]
        if any("sparse" in accessor for accessor in read):
            raise ValueError("its vertices are a sparse accessor")
        if any(accessor.get("normalized") for accessor in read):
            raise ValueError("its vertices are normalized; `gltf-transform dequantize IN OUT`")


def _count_triangles(scene: Any) -> int:
    """Count the triangles of all nodes of the default scene."""
    drawn, todo = 0, list(scene["scenes"][scene.get("scene", 0)].get("nodes", ()))
    while todo:
        node = scene["nodes"][todo.pop()]
        todo += node.get("children", ())
        for p in scene["meshes"][node["mesh"]]["primitives"] if "mesh" in node else ():
            number = scene["accessors"][p.get("indices", p["attributes"]["POSITION"])]["count"]
            drawn += {4: number // 3, 5: number - 2}.get(p.get("mode", 4), 0)
    return drawn


def _read_draco_sizes(data: bytes) -> tuple[int, ...]:
    """Read the two counts (faces, points or vertices) at the start of Draco data."""
    found, at = [0, 0], 11 if data[8:9] == b"\0" else 12
    for i in range(2):
        for shift in range(0, 70, 7):
            byte = data[at] if at < len(data) else 0
            at += 1
            found[i] |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
    return tuple(found)


READERS: Final[dict[str, Callable[[Path, bytes], list[trimesh.Trimesh]]]] = {
    ".obj": mesh_formats.read_obj,
    ".stl": mesh_formats.read_stl,
    ".ply": mesh_formats.read_ply,
    ".glb": _read_gltf,
    ".gltf": _read_gltf,
    ".off": mesh_formats.read_off,
    ".dae": mesh_formats.read_dae,
    ".3mf": _read_3mf,
}
MESH_SUFFIXES = tuple(READERS)
UNREAD_SUFFIXES = (".step", ".stp", ".iges", ".igs", ".fbx", ".3ds", ".wrl", ".usdz", ".blend")


def check_mesh_file(path: Path) -> None:
    """Raise a `ConfigError` for a missing or empty file, Git LFS pointer or unknown format."""
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
    refuse_lfs_pointer(path)


def mesh_content(path: Path) -> bytes:
    """Return the bytes of a mesh file, and of the buffers that a .gltf names."""
    content = path.read_bytes()
    if path.suffix.lower() == ".gltf" and content.count(b"{") <= MOST_OBJECTS:
        with suppress(*NO_GLTF, RecursionError, ConfigError):
            content += b"".join(_read_buffers(path, json.loads(content)))
    return content


def read_triangles(path: Path, up: str = "") -> trimesh.Trimesh:
    """Read all triangles of a file into one mesh in the unit box, z up.

    Args:
        path: the file; a scene counts as one rigid object, its unit does not matter.
        up: the axis of the file that points up, "y" or "z"; if empty, that of its format, else z.
    """
    mesh = read_parts([path], up)
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    return mesh


def read_parts(paths: Sequence[Path], up: str = "") -> trimesh.Trimesh:
    """Read the files of one object into one mesh, z up, in their unit."""
    mesh = _join([_read_part(path, up) for path in paths])
    largest = max(mesh.extents.max(), np.abs(mesh.bounds).max())
    if np.sort(mesh.extents)[1] <= POINT * largest:
        raise ConfigError(f"{paths[0]}: all its triangles lie on one line; export it again")
    axis = mesh.extents.argmax()
    order = mesh.triangles_center[:, axis].argsort()
    area = mesh.area_faces[order].cumsum()
    first, last = np.searchsorted(area, [STRAY * area[-1], (1 - STRAY) * area[-1]])
    most = np.ptp(mesh.triangles[order[first : last + 1], :, axis])
    if mesh.extents[axis] > AWAY * most:
        long = f"{mesh.extents[axis]:.3g} long, but nearly all of it within {most:.3g}"
        raise ConfigError(f"{paths[0]}: {long}; delete what lies far from the rest")
    return mesh


def _join(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    # by hand, which drops the colours and textures of the bodies
    joined = trimesh.util.append_faces([m.vertices for m in meshes], [m.faces for m in meshes])
    return trimesh.Trimesh(*joined, process=False)


def _read_part(path: Path, up: str) -> trimesh.Trimesh:
    check_mesh_file(path)
    suffix = path.suffix.lower()
    before, after = f"{path}: cannot be read as {suffix} (", "); export it again"
    with explain_errors(ConfigError, before, after, most=120):
        try:
            meshes = READERS[suffix](path, path.read_bytes())
        except ImportError:  # the library that guesses encodings is not installed
            raise ValueError(
                "cut short, or neither binary as it should be nor UTF-8 text"
            ) from None
    number = sum(len(mesh.faces) for mesh in meshes)
    check_number(path, number)
    if not number:
        raise ConfigError(f"{path}: holds no triangles; export a surface mesh, not points or lines")
    mesh = _join(meshes)
    mesh.remove_unreferenced_vertices()
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise ConfigError(f"{path}: {bad} vertices are not finite numbers; export it again")
    axis = up or meshes[0].metadata.get("up", "z")
    if axis in TO_Z_UP:
        mesh.vertices = mesh.vertices @ TO_Z_UP[axis].T
    return mesh
