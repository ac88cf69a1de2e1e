"""Mesh files as convex pieces, which is what can be collided.

A simulator fills every hollow of a mesh given to it whole. What a file becomes is written into the
object's `made_by`:

    bodies      its bodies as they are: all are convex
    pieces      its solid bodies in convex pieces (see `convex_parts`), to 0.1 mm of 40 mm if it can
    plates      the same, and what encloses nothing as thin plates (see `convex_parts`)
    hull        its convex hull, as asked for

How far the outside of the pieces is from the mesh, and the mesh from them, is measured every time
and kept as the object's `surface_error`.

Cutting a mesh takes seconds and reading pieces does not, so they are kept in $TACTILE_RT_CACHE,
else $XDG_CACHE_HOME/tactile_rt/pieces, else ~/.cache/tactile_rt/pieces: one .npz each, named by a
hash of all that they depend on. A file that is damaged counts as missing; a folder that cannot be
written to is no error.
"""

import contextlib
import hashlib
import logging
import os
import time
from dataclasses import replace
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from fast_simplification import simplify
from manifold3d import Manifold
from numpy.typing import NDArray

from tactile_rt.core.files import write_whole
from tactile_rt.sim_backend.objects.convex_parts import SheetPieces, SolidPieces
from tactile_rt.sim_backend.objects.deviation import (
    TriangleSurface,
    bodies_of,
    deviation,
    outer_solid,
    some,
    surface_of,
)
from tactile_rt.sim_backend.objects.mesh_detail import SIZE_MM, STANDARD, MeshDetail
from tactile_rt.sim_backend.objects.mesh_files import check_mesh_file, mesh_content, read_triangles
from tactile_rt.sim_backend.objects.solids import TactileObject

SHARES = (0.25, 0.5, 1.0)  # of the most triangles, that are tried
HASTE = (3.0, 7.0, 10.0)  # how fast the cost of an edge that goes may grow, until few are left
Floats = NDArray[np.float64]
log = logging.getLogger("tactile_rt.sim_backend.objects")
RECIPE = 6  # of the pieces; raised when the same file would become others
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


def read_pieces(key: str) -> TactileObject | None:
    """Read the pieces under this key; None if there are none, or they are damaged."""
    path = _path(key)
    if path is None:
        return None
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            corners = np.split(file["vertices"], np.cumsum(file["corners"])[:-1])
            faces = np.split(file["faces"].astype(np.int64), np.cumsum(file["sides"])[:-1])
            error, made_by = float(file["surface_error"]), str(file["made_by"])
    except Exception:  # damage shows itself in a dozen ways
        return None
    meshes = tuple(
        trimesh.Trimesh(v, f, process=False) for v, f in zip(corners, faces, strict=True)
    )
    return TactileObject("", "", meshes, error, made_by)


def write_pieces(key: str, thing: TactileObject) -> None:
    """Keep the pieces under this key, if there is a place to keep them."""
    path = _path(key)
    if path is None:
        return
    arrays: dict[str, Any] = {
        "vertices": np.concatenate([m.vertices for m in thing.pieces]),
        "faces": np.concatenate([m.faces for m in thing.pieces]).astype(np.int32),
        "corners": [len(m.vertices) for m in thing.pieces],
        "sides": [len(m.faces) for m in thing.pieces],
        "surface_error": thing.surface_error,
        "made_by": thing.made_by,
    }
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, lambda file: np.savez(file, **arrays))


def _path(key: str) -> Path | None:
    """Return the file of a key; None where a user has no home."""
    own = os.environ.get("TACTILE_RT_CACHE")
    if own:
        return Path(own) / f"{key}.npz"
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):  # the specification has relative paths ignored
        base = os.path.expanduser("~/.cache")
    return Path(base) / "tactile_rt" / "pieces" / f"{key}.npz" if os.path.isabs(base) else None


def simplify_mesh(mesh: trimesh.Trimesh, tolerance: float, most: int) -> trimesh.Trimesh:
    """Take triangles away within a tolerance, to about `most` of them.

    Edges go in the order of quadric error metrics (Garland and Heckbert 1997); how far the surface
    has moved is measured, both ways. A mesh with more triangles than can be dealt with is
    simplified farther than the tolerance.

    Args:
        tolerance: how far the surface may move, in largest extents.
    """
    if len(mesh.faces) <= SHARES[0] * most:
        return mesh
    before, fewer = TriangleSurface(mesh.triangles), mesh
    points = some(before.points)
    for number in (round(share * most) for share in SHARES):
        if len(mesh.faces) <= number:
            return mesh
        fewer = _with_faces(mesh, number)
        after = TriangleSurface(fewer.triangles)
        moved = max(after.distance(points).max(), before.distance(some(after.points)).max())
        if moved <= tolerance:
            break
    return fewer


def _with_faces(mesh: trimesh.Trimesh, number: int) -> trimesh.Trimesh:
    arrays, fewer = (np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)), mesh
    for haste in HASTE:
        corners, faces = simplify(*arrays, target_count=number, agg=haste)
        fewer = trimesh.Trimesh(corners, faces, process=False)
        if len(faces) <= 1.2 * number:
            break
    return fewer


def load_mesh(path: Path, detail: MeshDetail = STANDARD) -> TactileObject:
    """What a mesh file holds, as convex pieces in the unit box.

    A scene is taken as one rigid object. The unit of the file does not matter.
    """
    check_mesh_file(path)
    asked = (detail.surface_error_mm, detail.max_pieces, detail.hull, detail.up)
    makers = [version(p) for p in ("manifold3d", "trimesh", "scipy", "fast-simplification")]
    settings = repr((path.suffix.lower(), *asked, RECIPE, makers)).encode()
    key = hashlib.sha256(hashlib.sha256(mesh_content(path)).digest() + settings).hexdigest()
    thing = read_pieces(key)
    if thing is None:
        began = time.monotonic()
        mesh = read_triangles(path, detail.up)
        slow = len(mesh.faces) > MANY
        if slow:
            log.info(
                "%s: %d triangles to pieces; this takes some seconds, once", path, len(mesh.faces)
            )
        with np.errstate(all="ignore"):  # parts without a volume have no centre
            thing = _pieces(mesh, detail)
        write_pieces(key, thing)
        if slow:
            error, took = SIZE_MM * thing.surface_error, time.monotonic() - began
            told = "%s: %d pieces within %.2f mm at 40 mm, %.1f s"
            log.info(told, path, len(thing.pieces), error, took)
    return replace(thing, name=path.stem, category=path.stem)


def _pieces(mesh: trimesh.Trimesh, detail: MeshDetail) -> TactileObject:
    drawn = TriangleSurface(mesh.triangles)
    if detail.hull:
        hull = (mesh.convex_hull,)
        return TactileObject("", "", hull, deviation(drawn, hull), "hull")
    tolerance = detail.surface_error_mm / SIZE_MM
    bodies, sheet = _simplify_parts(*_bodies_and_sheet(_mended(mesh)), SIMPLER * tolerance)
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
    # Corners that rounding doubled would leave faces without area.
    rounded = (np.unique(c.round(DIGITS), axis=0) for c in corners)
    pieces = tuple(map(trimesh.convex.convex_hull, rounded))
    error = deviation(drawn, pieces, bodies)
    made_by = "plates" if sheets else "bodies" if len(pieces) == len(bodies) else "pieces"
    return TactileObject("", "", pieces, error, made_by)


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


def _simplify_parts(
    bodies: list[Manifold], sheet: trimesh.Trimesh, tolerance: float
) -> tuple[list[Manifold], trimesh.Trimesh]:
    """Simplify bodies and sheet, each to its share of the triangles allowed."""
    number = sum(body.num_tri() for body in bodies) + len(sheet.faces)
    share = MOST_FACES / max(number, MOST_FACES)
    simpler = []
    for body in bodies:
        least = max(LEAST_FACES, round(share * body.num_tri()))
        found = _solid(simplify_mesh(surface_of(body), tolerance, least))
        simpler += found or [body]
    fewer = simplify_mesh(sheet, tolerance, max(LEAST_FACES, round(share * len(sheet.faces))))
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
