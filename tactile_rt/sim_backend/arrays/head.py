"""The head that whiskers stand on: a mesh drawn, and collided where asked, in a MuJoCo world."""

from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.sim_backend.arrays.whisker_array import HEAD_FILES

__all__ = ["HEAD_BIT", "add_head"]

HEAD_BIT, WHISKER_BIT = 4, 1  # collision groups, as in `world`
HEAD_GROUP = 0  # of geoms that viewers draw and no ray of a sweep looks for
MAX_FACES = 200_000  # MuJoCo's own limit for STL files
LEAST_MM = 1.0  # a smaller head is one whose file is in m


def add_head(world: mujoco.MjSpec, body: mujoco.MjsBody, path: Path, collide: bool = False) -> None:
    """Draw a mesh file on a head's body: in the body's frame, mm, without mass.

    Args:
        world: to which the mesh is added.
        body: the head's.
        path: .stl, .obj or .ply file, in mm and in the head's frame.
        collide: whether whiskers meet it, too: its convex hull, as MuJoCo collides no other.
            Whiskers whose bases are inside the hull are pushed out of it: exclude them.

    Raises:
        ConfigError: the file cannot be used; the message names it and says what to do.
    """
    vertices, faces = _read(path)
    mesh = world.add_mesh(
        name=f"{body.name} mesh",
        uservert=vertices.astype(np.float32).ravel(),
        userface=faces.astype(np.int32).ravel(),
    )
    # A scanned head is seldom closed: a surface always has an inertia, a volume may not.
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=mesh.name,
        contype=HEAD_BIT if collide else 0,
        conaffinity=WHISKER_BIT if collide else 0,
        group=HEAD_GROUP,
        mass=0.0,
        rgba=(0.6, 0.6, 0.65, 1.0),
    )


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """(vertex, 3) mm and (face, 3) of all triangles in the file."""
    import trimesh  # only a world with a head waits for it

    if path.suffix.lower() not in HEAD_FILES:
        raise ConfigError(f"{path}: a head is one of {', '.join(HEAD_FILES)}, in mm")
    if not path.is_file():
        raise ConfigError(f"{path}: no such file")
    try:
        mesh = trimesh.load_scene(path, process=False).to_mesh()
    except Exception as error:  # the parsers raise whatever their format trips over
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise ConfigError(f"{path}: cannot be read ({reason}); export it again") from error
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    if len(faces) == 0:
        raise ConfigError(f"{path}: holds no triangles; export a surface mesh")
    if len(faces) > MAX_FACES:
        raise ConfigError(f"{path}: has {len(faces)} triangles, more than {MAX_FACES}; simplify it")
    if not np.isfinite(vertices).all():
        raise ConfigError(f"{path}: has vertices that are not finite; export it again")
    extent = float(np.ptp(vertices, axis=0).max())
    if extent < LEAST_MM:
        raise ConfigError(f"{path}: is {extent:g} mm large; export it in mm")
    return vertices, faces
