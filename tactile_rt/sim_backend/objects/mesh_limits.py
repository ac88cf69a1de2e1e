"""Mesh files held against what they say of themselves, before a library builds it.

A file may come from elsewhere. Formats of plain numbers are as long as what they hold, and their
parsers notice if not. The others can say in a few bytes what takes gigabytes: archives that unpack
to them, scenes that hold a thing that holds a thing ten times, meshes that Draco compressed. Of
these the sizes are looked up.
"""

import base64
import json
import struct
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from io import BytesIO
from typing import Any, Final

from tactile_rt.errors import ConfigError

__all__ = ["check_mesh_content"]

MOST_UNPACKED: Final = 256 << 20  # bytes of an archive ...
MOST_RATIO: Final = 100  # ... and times its own size; XML of numbers has 10
SMALL: Final = 16 << 20  # bytes that an archive may unpack to at any ratio
MOST_NODES: Final = 10_000  # of a scene, with every time that one is used
MOST_OBJECTS: Final = 100_000  # of glTF's JSON
MOST_POINTS: Final = 6_000_000  # of a mesh that Draco compressed

GLB_JSON: Final = struct.Struct("<4sIIII")  # head of the file and of its first chunk
DRACO: Final = b"DRACO"


def check_mesh_content(name: str, suffix: str, content: bytes) -> None:
    """Refuse a file that unpacks to more than it can be expected to hold.

    Args:
        name: the file, for the message.
        suffix: the ending that tells its format, in lower case.
        content: what is in it.

    Raises:
        ConfigError: one line with the file and what is too much.
    """
    if suffix == ".3mf":
        _check_archive(name, content)
    elif suffix == ".dae":
        _check_nodes(name, _xml_nodes(name, [content], "node", "instance_node", "url"))
    elif suffix in (".gltf", ".glb"):
        _check_gltf(name, suffix, content)


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
    """What each node of XML texts uses: the nodes that elements `use` within it refer to."""
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
    for first in used:
        begun: dict[str, Iterator[str]] = {}
        here = first
        while True:
            if here in times or here not in used:
                below = None
            else:
                below = next(begun.setdefault(here, iter(used[here])), None)
            if below is not None:
                if below in begun:
                    raise ConfigError(f"{name}: a node of its scene holds itself; export it again")
                here = below
                continue
            if here not in times:
                times[here] = 1 + sum(times.get(x, 1) for x in used.get(here, ()))
                if times[here] > MOST_NODES:
                    raise ConfigError(
                        f"{name}: a scene of more than {MOST_NODES} nodes, as often as they are "
                        "used; join them"
                    )
            begun.pop(here, None)
            if not begun:
                break
            here = next(reversed(begun))


def _check_gltf(name: str, suffix: str, content: bytes) -> None:
    text, binary = content, b""
    if suffix == ".glb" and len(content) >= GLB_JSON.size:
        *_, length, _ = GLB_JSON.unpack_from(content)
        text = content[GLB_JSON.size : GLB_JSON.size + length]
        binary = content[GLB_JSON.size + length + 8 :]
    if text.count(b"{") > MOST_OBJECTS:
        raise ConfigError(f"{name}: more than {MOST_OBJECTS} objects in its JSON; join them")
    try:
        scene = json.loads(text)
        nodes = {str(i): [str(x) for x in n.get("children", ())] for i, n in _each(scene, "nodes")}
        meshes = _each(scene, "meshes")
        primitives = [p for _, mesh in meshes for p in mesh.get("primitives", ())]
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


def _each(scene: Any, what: str) -> list[tuple[int, Any]]:
    return list(enumerate(scene.get(what, ())))


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
    """The numbers of faces and points, or of vertices and faces, that Draco's data begins with."""
    if data[:5] != DRACO or len(data) < 13:
        return (0,)
    return _varints(data[11:] if data[8] == 0 else data[12:])


def _varints(data: bytes) -> tuple[int, int]:
    found, at = [0, 0], 0
    for i in range(2):
        for shift in range(0, 70, 7):
            byte = data[at] if at < len(data) else 0
            at += 1
            found[i] |= (byte & 0x7F) << shift
            if byte < 0x80:
                break
    return found[0], found[1]
