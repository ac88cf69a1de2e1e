"""Mesh files: read, checked, repaired where that is safe, cut into convex pieces.

A simulator collides convex pieces only, and fills every hollow of a mesh given to it whole. What a
file becomes is written into the object's `made_by`:

    bodies      its bodies as they are: all are convex
    cut         the solid cut into pieces (see `decomposition`), by default to 0.1 mm of 40 mm
    hull        its convex hull, as asked for or for want of a closed surface
    remeshed    pieces of a closed surface drawn round the faces of a mesh that is not closed

How far the outside of the pieces is from the mesh is measured every time and kept as the object's
`surface_error`; where a mesh was closed, also how far the mesh is from them. Results are cached.

Pieces cost little: a 40 mm bowl in 508 of them (0.1 mm) steps 1.2 times as slowly as in 32 (1 mm).
"""

from dataclasses import astuple, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from tactile_rt.sim_backend.objects.decomposition import cut_solid
from tactile_rt.sim_backend.objects.deviation import TriangleSurface, deviation
from tactile_rt.sim_backend.objects.manifolds import (
    bodies_of,
    in_unit_box,
    outer_solid,
    surface_of,
)
from tactile_rt.sim_backend.objects.piece_cache import Pieces, cache_key, read_pieces, write_pieces
from tactile_rt.sim_backend.objects.remeshing import LEVEL, closed_round
from tactile_rt.sim_backend.objects.solids import TactileObject, normalised
from tactile_rt.stream import ConfigError

__all__ = ["BROKEN", "MESH_SUFFIXES", "MeshDetail", "load_mesh"]

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb")
BROKEN = ("refuse", "remesh", "hull")
RECIPE = 2  # of the pieces; raised when the same file would become others
MAX_FACES = 200_000  # minutes
MERGE_DIGITS = 6  # vertices closer than 1e-6 of the largest extent are one
FLAT = 1e-3  # thinner than this fraction of the largest extent is a sheet, not a solid
SPECK = 1e-6  # a body of less volume than this (largest extent cubed) touches nothing
SHEETS = 1e-3  # of area (largest extent squared) in bodies without volume is part of the object
FOIL = 1e-5  # nor does one of which this is volume over area, in largest extents
REMESH_TOLERANCE = 0.5 * LEVEL  # cutting finer than the surface is drawn would show its grid

# glTF is y-up by its standard; the other formats say nothing and are taken as z-up
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


class _NotClosed(ConfigError):
    """The faces bound no solid: to be refused, remeshed or replaced by their hull."""


@dataclass(frozen=True)
class MeshDetail:
    """How a mesh becomes convex pieces.

    Attributes:
        max_error_mm: The largest distance allowed between pieces and mesh, mm, at the size
            `size_mm`.
        size_mm: The largest extent of the mesh at which `max_error_mm` is meant, mm.
        max_pieces: The largest number of pieces; where it does not suffice, the error is larger
            (and known).
        hull: Whether to take one piece only, the convex hull; its error is measured but not
            bounded.
        broken: What becomes of a mesh that is not closed and cannot be safely: "refuse" it,
            "remesh" it (a closed surface is drawn round its faces, 0.4 mm off at 40 mm, see
            `remeshing`, and cut with an error of about 1 mm), or take its convex "hull".

    Raises:
        ConfigError: a value out of range.
    """

    max_error_mm: float = 0.1
    size_mm: float = 40.0
    max_pieces: int = 512
    hull: bool = False
    broken: str = "refuse"

    def __post_init__(self) -> None:
        if not 0 < self.max_error_mm < self.size_mm:
            raise ConfigError(
                f"max_error_mm must be between 0 and the size of {self.size_mm} mm, "
                f"not {self.max_error_mm}"
            )
        if self.max_pieces < 1:
            raise ConfigError(f"max_pieces must be 1 or more, not {self.max_pieces}")
        if self.broken not in BROKEN:
            raise ConfigError(f"broken must be one of {', '.join(BROKEN)}, not {self.broken!r}")


def load_mesh(
    path: Path, detail: MeshDetail | None = None, *, y_up: bool | None = None
) -> TactileObject:
    """The solid in a .obj, .stl, .ply or .glb file, as convex pieces in the unit box.

    A scene is taken as one rigid object. The unit of the file does not matter.

    Args:
        path: the file.
        detail: how finely to cut it.
        y_up: whether the file is y-up and so is turned; by default, only a .glb is.

    Raises:
        ConfigError: it cannot be used: what file, what is wrong, what to do, in one line.
    """
    detail = detail or MeshDetail()
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise ConfigError(
            f"{path}: unknown mesh format {path.suffix or '(none)'!r}; use one of "
            f"{', '.join(MESH_SUFFIXES)}"
        )
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    turned = suffix == ".glb" if y_up is None else y_up
    makers = [version(package) for package in ("manifold3d", "trimesh", "scipy")]
    key = cache_key(path.read_bytes(), suffix, turned, astuple(detail), RECIPE, makers)
    pieces = read_pieces(key)
    if pieces is None:
        pieces = _make_pieces(path, detail, turned)
        write_pieces(key, pieces)
    return TactileObject(path.stem, path.stem, pieces.meshes, pieces.surface_error, pieces.made_by)


def _read(path: Path, turned: bool) -> trimesh.Trimesh:
    """All triangles of the file in world coordinates, z-up, scaled into the unit box."""
    if path.stat().st_size == 0:
        raise ConfigError(f"{path}: the file is empty; export it again")
    try:
        # materials would be dropped, and pictures that are missing be complained of
        kinds = (".obj", ".ply")
        materials: dict[str, Any] = {"skip_materials": True} if path.suffix.lower() in kinds else {}
        scene = trimesh.load_scene(path, process=False, **materials)
        meshes = [m for m in scene.dump() if isinstance(m, trimesh.Trimesh)]
    except Exception as error:  # the parsers raise whatever their format trips over
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ImportError):  # what guesses at encodings is not installed
            reason = "cut short, or neither binary as it should be nor UTF-8 text"
        raise ConfigError(
            f"{path}: cannot be read as {path.suffix.lower()} ({reason[:120]}); export it again"
        ) from error
    faces = sum(len(m.faces) for m in meshes)
    if faces == 0:
        raise ConfigError(f"{path}: holds no triangles; export a surface mesh, not points or lines")
    if faces > MAX_FACES:
        raise ConfigError(
            f"{path}: has {faces} triangles, more than {MAX_FACES}; simplify it in a mesh tool"
        )
    # joined by hand: what colours and textures the bodies have is dropped
    joined = trimesh.util.append_faces([m.vertices for m in meshes], [m.faces for m in meshes])
    mesh = trimesh.Trimesh(*joined, process=False)
    mesh.remove_unreferenced_vertices()
    if not np.isfinite(mesh.vertices).all():
        bad = int((~np.isfinite(mesh.vertices)).any(axis=1).sum())
        raise ConfigError(f"{path}: {bad} vertices are not finite numbers; export it again")
    if turned:
        mesh.vertices = mesh.vertices @ _Y_UP_TO_Z_UP.T
    largest = mesh.extents.max()
    if mesh.extents.min() <= FLAT * largest:
        raise ConfigError(f"{path}: flat, so it has no volume; give it thickness in a mesh tool")
    mesh.vertices = (mesh.vertices - mesh.bounds.mean(axis=0)) / largest
    return mesh


def _closed(mesh: trimesh.Trimesh, path: Path) -> trimesh.Trimesh:
    """The mesh closed and wound outward, repaired only as far as cannot change its shape.

    Closed means that every edge joins an even number of faces, half of them running each way: two
    as a rule, four where parts of the solid touch along an edge.
    """
    if not mesh.is_watertight:  # merged only if need be: bodies that touch would grow together
        mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=MERGE_DIGITS)
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh.remove_unreferenced_vertices()
    if not mesh.is_watertight:
        trimesh.repair.fill_holes(mesh)  # of three or four edges, no more
    counts = np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1]
    single, branching = int((counts == 1).sum()), int(((counts > 1) & (counts % 2 == 1)).sum())
    if single or branching:
        wrong = [f"{single} open edges"] if single else []
        wrong += [f"{branching} edges where an odd number of faces meet"] if branching else []
        raise _NotClosed(
            f"{path}: not watertight ({', '.join(wrong)}); close it in a mesh tool "
            "(in Blender: Mesh > Clean Up > Fill Holes) and export it again"
        )
    if not _balanced(mesh) or mesh.volume < 0:
        trimesh.repair.fix_normals(mesh, multibody=mesh.body_count > 1)
    if not _balanced(mesh) or mesh.volume < SPECK:
        raise _NotClosed(
            f"{path}: encloses no volume, or its faces look both ways; recalculate its normals "
            "outward in a mesh tool (in Blender: Mesh > Normals > Recalculate Outside)"
        )
    return mesh


def _balanced(mesh: trimesh.Trimesh) -> bool:
    """Whether every edge is run through as often one way as the other."""
    edge = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)[1].ravel()
    way = np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1)
    return not np.bincount(edge, weights=way).any()


def _make_pieces(path: Path, detail: MeshDetail, turned: bool) -> Pieces:
    mesh = _read(path, turned)
    try:
        return _closed_pieces(mesh.copy(), path, detail)
    except _NotClosed:
        if detail.broken == "refuse":
            raise
    # Faces buried in such a mesh are no fault of the pieces: it counts how far these are from it,
    # and not how far it is from these.
    if detail.hull or detail.broken == "hull":
        pieces = normalised([mesh.convex_hull])
        return Pieces(pieces, deviation(TriangleSurface(mesh.triangles), pieces).beyond, "hull")
    tolerance = max(detail.max_error_mm / detail.size_mm, REMESH_TOLERANCE)
    parts, found = cut_solid(closed_round(mesh), tolerance, detail.max_pieces)
    pieces = normalised(parts)
    error = max(deviation(TriangleSurface(mesh.triangles), pieces).beyond, found.missed)
    return Pieces(pieces, error, "remeshed")


def _closed_pieces(mesh: trimesh.Trimesh, path: Path, detail: MeshDetail) -> Pieces:
    mesh = _closed(mesh, path)
    bodies = [b for b in bodies_of(mesh) if b.volume() > max(SPECK, FOIL * b.surface_area())]
    if mesh.area - sum(b.surface_area() for b in bodies) > SHEETS:
        raise _NotClosed(
            f"{path}: not watertight (parts of it are sheets without thickness); give them some in "
            "a mesh tool (in Blender: the Solidify modifier) and export it again"
        )
    if not bodies:
        raise _NotClosed(
            f"{path}: its faces enclose no solid, though every edge is closed; rebuild its surface "
            "in a mesh tool (in Blender: the Remesh modifier)"
        )
    if detail.hull:
        pieces = normalised([mesh.convex_hull])
        return Pieces(pieces, deviation(TriangleSurface(mesh.triangles), pieces).largest, "hull")
    surfaces = [surface_of(body) for body in bodies]
    if len(bodies) <= detail.max_pieces and all(surface.is_convex for surface in surfaces):
        return Pieces(normalised(surfaces), 0.0, "bodies")
    tolerance = detail.max_error_mm / detail.size_mm
    solid = in_unit_box(outer_solid(bodies))
    parts, off = cut_solid(solid, tolerance, detail.max_pieces)
    return Pieces(normalised(parts), off.largest, "cut")
