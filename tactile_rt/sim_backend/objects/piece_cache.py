"""Convex pieces kept on disk, because cutting a mesh takes seconds and reading them does not.

They lie in $TACTILE_RT_CACHE, else $XDG_CACHE_HOME/tactile_rt/pieces, else
~/.cache/tactile_rt/pieces: one .npz each, named by a hash of all that they depend on. A file that
is damaged counts as missing; a folder that cannot be written to is no error.
"""

import contextlib
import hashlib
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

__all__ = ["Pieces", "cache_key", "read_pieces", "write_pieces"]


@dataclass(frozen=True)
class Pieces:
    """Convex pieces of a mesh, in the unit box, and how they came about.

    Attributes:
        meshes: The convex pieces themselves, closed and wound outward.
        surface_error: The farthest that their surface is from the mesh's, in fractions of the
            largest extent.
        made_by: The way in which the mesh became pieces, one of those that `meshes` lists.
    """

    meshes: tuple[trimesh.Trimesh, ...]
    surface_error: float
    made_by: str


def cache_key(content: bytes, *settings: object) -> str:
    """Name for what is made of a file's content with these settings."""
    return hashlib.sha256(hashlib.sha256(content).digest() + repr(settings).encode()).hexdigest()


def read_pieces(key: str) -> Pieces | None:
    """What was written under this key; None if nothing was, or it cannot be read any more."""
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
    return Pieces(meshes, error, made_by)


def write_pieces(key: str, pieces: Pieces) -> None:
    """Keep the pieces under this key, if there is a place to keep them."""
    path = _path(key)
    if path is None:
        return
    with contextlib.suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(
                    file,
                    vertices=np.concatenate([m.vertices for m in pieces.meshes]),
                    faces=np.concatenate([m.faces for m in pieces.meshes]).astype(np.int32),
                    corners=[len(m.vertices) for m in pieces.meshes],
                    sides=[len(m.faces) for m in pieces.meshes],
                    surface_error=pieces.surface_error,
                    made_by=pieces.made_by,
                )
            os.replace(name, path)  # another process may have written the same meanwhile
        except BaseException:
            os.unlink(name)
            raise


def _path(key: str) -> Path | None:
    """Where it is kept; None where a user has no home."""
    own = os.environ.get("TACTILE_RT_CACHE")
    if own:
        return Path(own) / f"{key}.npz"
    base = os.environ.get("XDG_CACHE_HOME", "")
    if not os.path.isabs(base):  # the specification has relative paths ignored
        base = os.path.expanduser("~/.cache")
    return Path(base) / "tactile_rt" / "pieces" / f"{key}.npz" if os.path.isabs(base) else None
