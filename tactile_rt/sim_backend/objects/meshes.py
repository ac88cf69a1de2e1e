"""Mesh files as convex pieces, which is what can be collided.

A simulator fills every hollow of a mesh given to it whole. What a file becomes is written into the
object's `made_by`:

    bodies      its bodies as they are: all are convex
    pieces      its solid bodies in convex pieces (see `solid_pieces`), to 0.1 mm of 40 mm if it can
    plates      the same, and what encloses nothing as thin plates (see `sheet_pieces`)
    hull        its convex hull, as asked for

How far the outside of the pieces is from the mesh, and the mesh from them, is measured every time
and kept as the object's `surface_error`. Results are cached.
"""

import logging
import time
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from manifold3d import Manifold
from numpy.typing import NDArray

from tactile_rt.sim_backend.objects.deviation import TriangleSurface, deviation
from tactile_rt.sim_backend.objects.manifolds import bodies_of, outer_solid, surface_of
from tactile_rt.sim_backend.objects.mesh_detail import SIZE_MM, STANDARD, MeshDetail
from tactile_rt.sim_backend.objects.mesh_files import (
    check_mesh_file,
    mesh_content,
    read_triangles,
)
from tactile_rt.sim_backend.objects.piece_cache import Pieces, cache_key, read_pieces, write_pieces
from tactile_rt.sim_backend.objects.sheet_pieces import SheetPieces
from tactile_rt.sim_backend.objects.simplification import simplified
from tactile_rt.sim_backend.objects.solid_pieces import SolidPieces
from tactile_rt.sim_backend.objects.solids import TactileObject

__all__ = ["load_mesh"]

Floats = NDArray[np.float64]

log = logging.getLogger("tactile_rt.sim_backend.objects")

RECIPE = 4  # of the pieces; raised when the same file would become others
DIGITS = 7  # of a largest extent: corners nearer than 4e-6 mm at 40 mm are one
MERGE_DIGITS = 6  # vertices closer than 1e-6 of the largest extent are one
SPECK = 1e-6  # a body of less volume than this (largest extent cubed) touches nothing
FOIL = 1e-5  # a body of which this is volume over area, in largest extents, is a sheet
# What is allowed of the distance for fewer triangles, and for joining pieces; the rest is for what
# falls between the points looked at.
SIMPLER, JOINED = 0.4, 0.55
WIDER, WIDEST = 1.25, 0.2  # distances that are tried where the pieces allowed are too few
MOST_FACES = 6000  # of all bodies and the sheet together, where there are more
LEAST_FACES = 400  # that each of them may keep
GONE = 5e-3  # so far from what is left is a face that simplification took away: 0.2 mm at 40 mm
FLAPS = 1e-4  # of area (largest extent squared) of what hangs on a solid without having volume
SMALL_HOLE = 0.05  # of which this is the length round it is damage, not an opening
LONGEST_LOOP = 64  # of edges round a hole that is looked at
FLUSH = 0.999  # so parallel (cosine) to a neighbour is a face that got lost
MANY = 2000  # triangles that take some seconds


def load_mesh(path: Path, detail: MeshDetail = STANDARD) -> TactileObject:
    """What a mesh file holds, as convex pieces in the unit box.

    A scene is taken as one rigid object. The unit of the file does not matter.

    Args:
        path: the file.
        detail: how finely it is told apart into pieces, and which way is up.

    Raises:
        ConfigError: it cannot be used: what file, what is wrong, what to do, in one line.
    """
    check_mesh_file(path)
    asked = (detail.surface_error_mm, detail.max_pieces, detail.hull, detail.up)
    makers = [version(p) for p in ("manifold3d", "trimesh", "scipy", "fast-simplification")]
    key = cache_key(mesh_content(path), path.suffix.lower(), *asked, RECIPE, makers)
    pieces = read_pieces(key)
    if pieces is None:
        began = time.monotonic()
        mesh = read_triangles(path, detail.up)
        faces = len(mesh.faces)
        if faces > MANY:
            log.info("%s: %d triangles to pieces; this takes some seconds, once", path, faces)
        with np.errstate(all="ignore"):  # parts without a volume have no centre
            pieces = _pieces(mesh, detail)
        write_pieces(key, pieces)
        if faces > MANY:
            error, took = SIZE_MM * pieces.surface_error, time.monotonic() - began
            log.info(
                "%s: %d pieces within %.2f mm at 40 mm, %.1f s",
                path,
                len(pieces.meshes),
                error,
                took,
            )
    return TactileObject(path.stem, path.stem, pieces.meshes, pieces.surface_error, pieces.made_by)


def _pieces(mesh: trimesh.Trimesh, detail: MeshDetail) -> Pieces:
    drawn = TriangleSurface(mesh.triangles)
    if detail.hull:
        hull = (mesh.convex_hull,)
        return Pieces(hull, deviation(drawn, hull).largest, "hull")
    tolerance = detail.surface_error_mm / SIZE_MM
    bodies, sheet = _simplified(*_bodies_and_sheet(_mended(mesh)), SIMPLER * tolerance)
    if len(bodies) > detail.max_pieces:
        bodies = [outer_solid(bodies)]
    solids = [SolidPieces(body) for body in bodies]
    sheets = [SheetPieces(sheet, half=tolerance)] if len(sheet.faces) else []
    parts: list[SolidPieces | SheetPieces] = [*solids, *sheets]
    allowed = JOINED * tolerance
    for part in parts:
        part.join(allowed)
    while sum(map(len, parts)) > detail.max_pieces and allowed < WIDEST:
        allowed *= WIDER
        for part in parts:
            part.join(allowed)
    corners = [piece for plates in sheets for piece in plates.corners()]
    left = sum(map(len, solids))
    for solid in solids:
        left -= len(solid)
        corners += solid.corners(spare=max(0, detail.max_pieces - len(corners) - left - len(solid)))
    pieces = tuple(_piece(c) for c in corners)
    error = deviation(drawn, pieces, bodies).largest
    made_by = "plates" if sheets else "bodies" if len(pieces) == len(bodies) else "pieces"
    return Pieces(pieces, error, made_by)


def _piece(corners: Floats) -> trimesh.Trimesh:
    # corners that rounding doubled would leave faces without area
    piece: trimesh.Trimesh = trimesh.convex.convex_hull(np.unique(corners.round(DIGITS), axis=0))
    return piece


def _mended(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with vertices that are one joined, and small damage to it repaired."""
    mesh = mesh.copy()
    if not mesh.is_watertight:  # merged only if need be: bodies that touch would grow together
        mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=MERGE_DIGITS)
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh.remove_unreferenced_vertices()
    if mesh.is_watertight:
        return mesh
    return trimesh.Trimesh(mesh.vertices, [*mesh.faces.tolist(), *_lost(mesh)], process=False)


def _lost(mesh: trimesh.Trimesh) -> list[list[int]]:
    """Faces that close holes which are small, or flush with a face beside them."""
    single = trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)
    beside: dict[int, list[int]] = {}
    faces: dict[int, list[Floats]] = {}
    for k in single.tolist():
        a, b = mesh.edges[k].tolist()
        beside.setdefault(a, []).append(b)
        beside.setdefault(b, []).append(a)
        for v in (a, b):
            faces.setdefault(v, []).append(mesh.face_normals[mesh.edges_face[k]])
    found, seen = [], set()
    for first in beside:
        loop = [first]
        while loop[-1] not in seen and len(beside[loop[-1]]) == 2 and len(loop) <= LONGEST_LOOP:
            seen.add(loop[-1])
            onward = [v for v in beside[loop[-1]] if v not in loop[-2:]]
            loop.append(onward[0] if onward else first)
        if len(loop) < 4 or loop[-1] != first:
            continue
        corners = mesh.vertices[loop]
        fan = [[first, b, c] for b, c in pairwise(loop[1:-1])]
        across = np.cross(corners[1:-2] - corners[0], corners[2:-1] - corners[0])
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-30)
        beside_it = np.array([normal for v in loop for normal in faces[v]])
        flush = len(fan) <= 2 and (np.abs(across @ beside_it.T).min(axis=0) > FLUSH).any()
        if flush or np.linalg.norm(np.diff(corners, axis=0), axis=1).sum() < SMALL_HOLE:
            found += fan
    return found


def _bodies_and_sheet(mesh: trimesh.Trimesh) -> tuple[list[Manifold], trimesh.Trimesh]:
    """The solid bodies of a mesh, and the faces that enclose nothing."""
    # first by all edges that faces share, then, of what is not closed, by those of two faces only
    edges = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(edges, kind="stable")
    same = edges[order][1:] == edges[order][:-1]
    pairs = np.stack([order[1:], order[:-1]], axis=1)[same] // 3
    bodies, left = [], np.arange(len(mesh.faces))
    for neighbours in (pairs, mesh.face_adjacency):
        among = neighbours[np.isin(neighbours, left).all(axis=1)]
        open_faces = []
        for part in trimesh.graph.connected_components(among, nodes=left):
            found = _solid(mesh.submesh([part], append=True, repair=False))
            bodies += found
            if not found:
                open_faces.append(part)
        left = np.sort(np.concatenate(open_faces)) if open_faces else left[:0]
    sheet = trimesh.Trimesh(mesh.vertices, mesh.faces[left], process=False)
    sheet.update_faces(sheet.unique_faces())
    sheet.remove_unreferenced_vertices()
    return bodies, sheet


def _simplified(
    bodies: list[Manifold], sheet: trimesh.Trimesh, tolerance: float
) -> tuple[list[Manifold], trimesh.Trimesh]:
    """Bodies and sheet with fewer triangles, each its share of those that can be dealt with."""
    number = sum(body.num_tri() for body in bodies) + len(sheet.faces)
    share = MOST_FACES / max(number, MOST_FACES)
    simpler = []
    for body in bodies:
        least = max(LEAST_FACES, round(share * body.num_tri()))
        found = _solid(simplified(surface_of(body), tolerance, least))
        simpler += found or [body]
    fewer = simplified(sheet, tolerance, max(LEAST_FACES, round(share * len(sheet.faces))))
    if len(fewer.faces) < len(sheet.faces):  # a large face at a border may have gone altogether
        places = np.concatenate([sheet.triangles, sheet.triangles_center[:, None]], axis=1)
        away = TriangleSurface(fewer.triangles).distance(places.reshape(-1, 3)).reshape(-1, 4)
        gone = sheet.faces[away.max(axis=1) > GONE]
        joined = trimesh.util.append_faces([fewer.vertices, sheet.vertices], [fewer.faces, gone])
        fewer = trimesh.Trimesh(*joined, process=False)
        fewer.remove_unreferenced_vertices()
    return simpler, fewer


def _solid(part: Any) -> list[Manifold]:
    """The solid bodies that a part of a mesh encloses; none if it is open."""
    counts = np.unique(part.edges_sorted, axis=0, return_counts=True)[1]
    if (counts % 2).any() or len(part.faces) < 4:
        return []
    if not _balanced(part) or part.volume < 0:
        trimesh.repair.fix_normals(part, multibody=part.body_count > 1)
    if not _balanced(part):
        return []
    bodies = bodies_of(part)
    thick = all(b.volume() > max(SPECK, FOIL * b.surface_area()) for b in bodies)
    lost = part.area - sum(b.surface_area() for b in bodies)  # faces that lie on each other
    return bodies if thick and lost < FLAPS else []


def _balanced(mesh: trimesh.Trimesh) -> bool:
    """Whether every edge is run through as often one way as the other."""
    edge = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)[1].ravel()
    way = np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1)
    return not np.bincount(edge, weights=way).any()
