"""Mesh files: read, checked, repaired where that is safe, cut into convex pieces.

A simulator collides convex pieces only, and fills every hollow of a mesh given to it whole. So a
file becomes pieces here: its bodies as they are when all are convex, otherwise CoACD's
decomposition of the whole, the same on every run.

CoACD's threshold is the concavity a piece may keep, in fractions of the largest extent. With
THRESHOLD = 0.05 a mug keeps its mouth and the gap behind its handle (0.2 and more) in 28 pieces
that add 8 % to its volume; 0.1 takes half the pieces but adds 20 %, thickening the wall by half.
The search is cut short of CoACD's defaults: half the time (5 s for that mug, 15 s for 25 000
triangles) for 3 % more volume.
"""

from pathlib import Path

import numpy as np
import trimesh

from tactile_rt.sim_backend.solids import TactileObject, normalised
from tactile_rt.stream import ConfigError

MESH_SUFFIXES = (".obj", ".stl", ".ply", ".glb")
THRESHOLD = 0.05
MAX_PIECES = 32
MAX_CORNERS = 48  # vertices of a piece
SEARCH = {"mcts_iterations": 60, "mcts_nodes": 10, "mcts_max_depth": 2}
SEED = 0
MAX_FACES = 50_000  # half a minute of cutting
MERGE_DIGITS = 6  # vertices closer than 1e-6 of the largest extent are one
FLAT = 1e-3  # thinner than this fraction of the largest extent is a sheet, not a solid
SPECK = 1e-6  # a piece of less volume than this (largest extent cubed) touches nothing

# glTF is y-up by its standard; the other formats say nothing and are taken as z-up
_Y_UP_TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


def load_mesh(path: Path) -> TactileObject:
    """The solid in a .obj, .stl, .ply or .glb file, as convex pieces in the unit box.

    A scene is taken as one rigid object. A .glb is turned from y-up to z-up; other files must be
    z-up already. The unit of the file does not matter. ConfigError, one line, for anything that
    cannot be used: what file, what is wrong, what to do.
    """
    if path.suffix.lower() not in MESH_SUFFIXES:
        raise ConfigError(
            f"{path}: unknown mesh format {path.suffix or '(none)'!r}; use one of "
            f"{', '.join(MESH_SUFFIXES)}"
        )
    solid = _closed(_read(path), path)
    return TactileObject(path.stem, path.stem, normalised(_decompose(solid, path)))


def _read(path: Path) -> trimesh.Trimesh:
    """All triangles of the file in world coordinates, z-up, scaled into the unit box."""
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    if path.stat().st_size == 0:
        raise ConfigError(f"{path}: the file is empty; export it again")
    try:
        scene = trimesh.load_scene(path, process=False)
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
    if path.suffix.lower() == ".glb":
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
        raise ConfigError(
            f"{path}: not watertight ({', '.join(wrong)}); close it in a mesh tool "
            "(in Blender: Mesh > Clean Up > Fill Holes) and export it again"
        )
    if not _balanced(mesh) or mesh.volume < 0:
        trimesh.repair.fix_normals(mesh, multibody=mesh.body_count > 1)
    if not _balanced(mesh) or mesh.volume < SPECK:
        raise ConfigError(
            f"{path}: encloses no volume, or its faces look both ways; recalculate its normals "
            "outward in a mesh tool (in Blender: Mesh > Normals > Recalculate Outside)"
        )
    return mesh


def _balanced(mesh: trimesh.Trimesh) -> bool:
    """Whether every edge is run through as often one way as the other."""
    edge = np.unique(mesh.edges_sorted, axis=0, return_inverse=True)[1].ravel()
    way = np.where(mesh.edges[:, 0] < mesh.edges[:, 1], 1, -1)
    return not np.bincount(edge, weights=way).any()


def _decompose(mesh: trimesh.Trimesh, path: Path) -> list[trimesh.Trimesh]:
    """Convex pieces whose union is the mesh, to within THRESHOLD."""
    bodies = mesh.split(only_watertight=False, repair=False)
    if len(bodies) <= MAX_PIECES and all(b.is_convex and b.volume > SPECK for b in bodies):
        return list(bodies)
    try:
        import coacd
    except ImportError as error:
        raise ConfigError(
            f"{path}: not convex, and cutting it into convex pieces needs CoACD: "
            "pip install 'tactile-rt[sim]'"
        ) from error
    coacd.set_log_level("error")
    parts = coacd.run_coacd(
        coacd.Mesh(mesh.vertices, mesh.faces),
        threshold=THRESHOLD,
        max_convex_hull=MAX_PIECES,
        decimate=True,
        max_ch_vertex=MAX_CORNERS,
        seed=SEED,
        **SEARCH,
    )
    hulls = [trimesh.convex.convex_hull(vertices) for vertices, _ in parts]
    return [piece for piece in hulls if piece.volume > SPECK]
