"""Mesh files: read into triangles, or refused with one line that says why."""

import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh

from tactile_rt.errors import ConfigError
from tactile_rt.sim_backend.objects.mesh_limits import check_mesh_content

__all__ = ["MESH_SUFFIXES", "check_mesh_file", "mesh_content", "read_parts", "read_triangles"]

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb", ".gltf", ".off", ".dae", ".3mf")
Y_UP = (".glb", ".gltf")  # by their standard; COLLADA files say it, and the reader turns them
MAX_FACES = 2_000_000  # a minute
POINT = 1e-9  # of all extents: smaller is none

_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def check_mesh_file(path: Path) -> None:
    """Look whether there is such a file, of a format that can be read.

    Raises:
        ConfigError: there is not: what file, what is wrong, what to do, in one line.
    """
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
    """What a mesh file holds, with the files of numbers that one in glTF's text form names.

    Raises:
        ConfigError: it unpacks to more than it can be expected to hold.
    """
    content, suffix = path.read_bytes(), path.suffix.lower()
    check_mesh_content(str(path), suffix, content)
    if suffix == ".gltf":
        with suppress(ValueError, KeyError, TypeError, AttributeError, OSError):
            for buffer in json.loads(content)["buffers"]:
                if not buffer["uri"].startswith("data:"):
                    content += (path.parent / unquote(buffer["uri"])).read_bytes()
    return content


def read_triangles(path: Path, up: str = "") -> trimesh.Trimesh:
    """All triangles of a file in one mesh, z up, moved and scaled into the unit box.

    Args:
        path: the file; a scene is taken as one rigid object, its unit does not matter.
        up: the axis that points up in it, "y" or "z"; empty: as its format has it, else z.

    Raises:
        ConfigError: it cannot be read: what file, what is wrong, what to do, in one line.
    """
    mesh = read_parts([path], up)
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / mesh.extents.max()
    return mesh


def read_parts(paths: Sequence[Path], up: str = "") -> trimesh.Trimesh:
    """All triangles of the files of one object in one mesh, z up, in the unit of the files.

    Args:
        paths: the files, each a part of the object in its place.
        up: see `read_triangles`.

    Raises:
        ConfigError: one of them cannot be read: what file, what is wrong, what to do, in one line.
    """
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
    check_mesh_content(str(path), suffix, path.read_bytes())
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
