"""Mesh files as convex pieces, which a simulator can collide.

A simulator fills the hollows of a mesh that is not cut into convex pieces. The object's `made_by`
says what a file became:

    bodies      its bodies as they are, since all are convex
    pieces      solid bodies in convex pieces (see `convex_parts`), to 0.1 mm at 40 mm if possible
    plates      the same, with surfaces that enclose nothing as thin plates (see `convex_parts`)
    hull        its convex hull, if requested

The distance between the outside of the pieces and the mesh is measured every time, in both
directions, and stored as the object's `surface_error`.

Cutting a mesh takes seconds, so the pieces are cached in $TACTILE_RT_CACHE, else
$XDG_CACHE_HOME/tactile_rt/pieces, else ~/.cache/tactile_rt/pieces: one .npz per object, named by a
hash of everything that the pieces depend on. A damaged file counts as missing; a folder that cannot
be written to is no error.
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

SHARES = (0.25, 0.5, 1.0)  # of the most triangles, tried in turn
HASTE = (3.0, 7.0, 10.0)  # aggressiveness of `simplify`, raised until few enough triangles are left
Floats = NDArray[np.float64]
log = logging.getLogger("tactile_rt.sim_backend.objects")
RECIPE = 6  # version of the pieces; raised when the same file gives different ones
DIGITS = 7  # decimals, in largest extents: corners within 4e-6 mm at 40 mm are merged
MERGE_DIGITS = 6  # decimals: vertices within 1e-6 of the largest extent are merged
SPECK = 1e-6  # least volume of a solid body (largest extent cubed)
FOIL = 1e-5  # least volume over area of a solid body, in largest extents; a thinner one is a sheet
# Shares of the tolerance for dropping triangles and for joining pieces; the rest covers deviations
# between the points that are measured.
SIMPLER, JOINED = 0.4, 0.55
WIDER, WIDEST = 1.25, 0.2  # growth and limit of the tolerance where `max_pieces` does not suffice
MOST_FACES = 6000  # of all bodies and the sheet together, after simplification
LEAST_FACES = 400  # that each body or sheet may keep
GONE = 5e-3  # a face this far from the simplified sheet was lost, and is restored: 0.2 mm at 40 mm
FLAPS = 1e-4  # most area (largest extent squared) of flaps without volume on a solid
SMALL_HOLE = 0.05  # perimeter, in largest extents, below which a hole is damage, not an opening
LONGEST_LOOP = 64  # most edges round a hole that may be closed
FLUSH = 0.999  # least cosine between the normals of a lost face and a neighbour
MANY = 2000  # triangles; more take some seconds, which is logged


def read_pieces(key: str) -> TactileObject | None:
    """Read the cached pieces under a key; None if they are missing or damaged."""
    path = _find_cache_file(key)
    if path is None:
        return None
    try:
        with open(path, "rb") as raw, np.load(raw, allow_pickle=False) as file:
            corners = np.split(file["vertices"], np.cumsum(file["corners"])[:-1])
            faces = np.split(file["faces"].astype(np.int64), np.cumsum(file["sides"])[:-1])
            error, made_by = float(file["surface_error"]), str(file["made_by"])
    except Exception:  # damage raises many kinds of error
        return None
    meshes = tuple(
        trimesh.Trimesh(v, f, process=False) for v, f in zip(corners, faces, strict=True)
    )
    return TactileObject("", "", meshes, error, made_by)


def write_pieces(key: str, thing: TactileObject) -> None:
    """Write pieces into the cache under a key, if the cache can be written to."""
    path = _find_cache_file(key)
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


def _find_cache_file(key: str) -> Path | None:
    """Return the cache file of a key; None if the user has no home."""
    own = os.environ.get("TACTILE_RT_CACHE")
    if own:
        return Path(own) / f"{key}.npz"
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):  # the XDG specification ignores relative paths
        base = os.path.expanduser("~/.cache")
    return Path(base) / "tactile_rt" / "pieces" / f"{key}.npz" if os.path.isabs(base) else None


def simplify_mesh(mesh: trimesh.Trimesh, tolerance: float, most: int) -> trimesh.Trimesh:
    """Simplify a mesh within a tolerance, to at most about `most` triangles.

    Edges collapse in the order of quadric error metrics (Garland and Heckbert 1997); the movement
    of the surface is measured in both directions. Where even `most` triangles are too few for the
    tolerance, it is exceeded.

    Args:
        tolerance: largest allowed movement of the surface, in units of the largest extent.
    """
    if len(mesh.faces) <= SHARES[0] * most:
        return mesh
    before, fewer = TriangleSurface(mesh.triangles), mesh
    points = some(before.points)
    for number in (round(share * most) for share in SHARES):
        if len(mesh.faces) <= number:
            return mesh
        fewer = _reduce_faces(mesh, number)
        after = TriangleSurface(fewer.triangles)
        moved = max(after.distance(points).max(), before.distance(some(after.points)).max())
        if moved <= tolerance:
            break
    return fewer


def _reduce_faces(mesh: trimesh.Trimesh, number: int) -> trimesh.Trimesh:
    arrays, fewer = (np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32)), mesh
    for haste in HASTE:
        corners, faces = simplify(*arrays, target_count=number, agg=haste)
        fewer = trimesh.Trimesh(corners, faces, process=False)
        if len(faces) <= 1.2 * number:
            break
    return fewer


def load_mesh(path: Path, detail: MeshDetail = STANDARD) -> TactileObject:
    """Load a mesh file as convex pieces in the unit box.

    A scene counts as one rigid object. The unit of the file does not matter.
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
            thing = _cut_into_pieces(mesh, detail)
        write_pieces(key, thing)
        if slow:
            error, took = SIZE_MM * thing.surface_error, time.monotonic() - began
            message = "%s: %d pieces within %.2f mm at 40 mm, %.1f s"
            log.info(message, path, len(thing.pieces), error, took)
    return replace(thing, name=path.stem, category=path.stem)


def _cut_into_pieces(mesh: trimesh.Trimesh, detail: MeshDetail) -> TactileObject:
    drawn = TriangleSurface(mesh.triangles)
    if detail.hull:
        hull = (mesh.convex_hull,)
        return TactileObject("", "", hull, deviation(drawn, hull), "hull")
    tolerance = detail.surface_error_mm / SIZE_MM
    bodies, sheet = _simplify_parts(*_split_bodies_and_sheet(_repair(mesh)), SIMPLER * tolerance)
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
    # Corners that coincide after rounding would leave faces without area.
    rounded = (np.unique(c.round(DIGITS), axis=0) for c in corners)
    pieces = tuple(map(trimesh.convex.convex_hull, rounded))
    error = deviation(drawn, pieces, bodies)
    made_by = "plates" if sheets else "bodies" if len(pieces) == len(bodies) else "pieces"
    return TactileObject("", "", pieces, error, made_by)


def _repair(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Return the mesh with coincident vertices merged and small or flush holes filled."""
    mesh = mesh.copy()
    if not mesh.is_watertight:  # merged only if necessary: touching bodies would grow together
        mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=MERGE_DIGITS)
        mesh.update_faces(mesh.nondegenerate_faces())
        mesh.remove_unreferenced_vertices()
    if mesh.is_watertight:
        return mesh
    return trimesh.Trimesh(mesh.vertices, [*mesh.faces.tolist(), *_fill_holes(mesh)], process=False)


def _fill_holes(mesh: trimesh.Trimesh) -> list[list[int]]:
    """Return triangles that fill small holes and holes flush with a neighbouring face."""
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


def _split_bodies_and_sheet(mesh: trimesh.Trimesh) -> tuple[list[Manifold], trimesh.Trimesh]:
    """Split a mesh into its solid bodies and the faces that enclose nothing."""
    # connect faces by all shared edges first, then those left open by edges of two faces only
    edges = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)[1].ravel()
    order = np.argsort(edges, kind="stable")
    same = edges[order][1:] == edges[order][:-1]
    pairs = np.stack([order[1:], order[:-1]], axis=1)[same] // 3
    bodies, left = [], np.arange(len(mesh.faces))
    for neighbours in (pairs, mesh.face_adjacency):
        among = neighbours[np.isin(neighbours, left).all(axis=1)]
        open_faces = []
        for part in trimesh.graph.connected_components(among, nodes=left):
            found = _make_solids(mesh.submesh([part], append=True, repair=False))
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
    """Simplify bodies and sheet, each to its share of the allowed triangles."""
    number = sum(body.num_tri() for body in bodies) + len(sheet.faces)
    share = MOST_FACES / max(number, MOST_FACES)
    simpler = []
    for body in bodies:
        least = max(LEAST_FACES, round(share * body.num_tri()))
        found = _make_solids(simplify_mesh(surface_of(body), tolerance, least))
        simpler += found or [body]
    fewer = simplify_mesh(sheet, tolerance, max(LEAST_FACES, round(share * len(sheet.faces))))
    if len(fewer.faces) < len(sheet.faces):  # a large face at a border may be lost
        places = np.concatenate([sheet.triangles, sheet.triangles_center[:, None]], axis=1)
        away = TriangleSurface(fewer.triangles).distance(places.reshape(-1, 3)).reshape(-1, 4)
        gone = sheet.faces[away.max(axis=1) > GONE]
        joined = trimesh.util.append_faces([fewer.vertices, sheet.vertices], [fewer.faces, gone])
        fewer = trimesh.Trimesh(*joined, process=False)
        fewer.remove_unreferenced_vertices()
    return simpler, fewer


def _make_solids(part: Any) -> list[Manifold]:
    """Return the solid bodies that a part of a mesh encloses; none if open."""
    counts = np.unique(part.edges_sorted, axis=0, return_counts=True)[1]
    if (counts % 2).any() or len(part.faces) < 4:
        return []
    if not _has_balanced_edges(part) or part.volume < 0:
        trimesh.repair.fix_normals(part, multibody=part.body_count > 1)
    if not _has_balanced_edges(part):
        return []
    bodies = bodies_of(part)
    thick = all(b.volume() > max(SPECK, FOIL * b.surface_area()) for b in bodies)
    lost = part.area - sum(b.surface_area() for b in bodies)  # area of faces that lie on each other
    return bodies if thick and lost < FLAPS else []


def _has_balanced_edges(mesh: trimesh.Trimesh) -> bool:
    """Return whether the faces traverse every edge equally often in both directions."""
    edge = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)[1].ravel()
    way = np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1)
    return not np.bincount(edge, weights=way).any()
