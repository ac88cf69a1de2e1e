"""How an object meets whiskers at rest: where it first touches, and which it will pass by.

Worked out on the whiskers' true centrelines and the convex pieces' planes, so that the same sweep
starts at the same place at every simulation profile.
"""

from collections.abc import Sequence

import numpy as np
import trimesh
from numpy.typing import NDArray

from tactile_rt.sim_backend.arrays.whisker_array import Mount, WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Whisker

__all__ = ["centrelines", "faces_right", "lateral_reach", "way_to_contact", "within_reach"]

SPACING_MM = 0.25
TOUCH_MM = 0.15  # counts as contact: both soft layers, and a link's chord off the centreline
PASSED_BY_MM = 0.5  # a miss by less is simulated

Floats = NDArray[np.float64]


def centrelines(whiskers: Sequence[Whisker], mount: Mount) -> list[Floats]:
    """Points (point, 3) along every whisker at rest, base to tip, in the world, mm."""
    turn, origin = mount.rotation, np.array(mount.position)
    lines = []
    for whisker in whiskers:
        s = np.linspace(0.0, whisker.length, max(2, round(whisker.length / SPACING_MM) + 1))
        inside = whisker.centreline(s) @ whisker.orientation.T + np.array(whisker.base)
        lines.append(inside @ turn.T + origin)
    return lines


def faces_right(animals: Sequence[WhiskerArray], lines: Sequence[Floats]) -> NDArray[np.bool_]:
    """(whisker,) whether the side of the head that each whisker is on faces world +x.

    Whole sides do: on a turned head some whiskers of the far side point across.
    """
    out = np.array([line[-1, 0] - line[0, 0] for line in lines])
    sides = np.array([2 * k + _to_left(w) for k, a in enumerate(animals) for w in a.whiskers])
    right = np.zeros(len(out), dtype=np.bool_)
    for side in np.unique(sides):
        right[sides == side] = out[sides == side].mean() > 0
    return right


def _to_left(whisker: Whisker) -> bool:
    """Whether a whisker points to the left in the frame of its head."""
    tip = whisker.orientation @ whisker.centreline(np.array([whisker.length]))[0]
    return bool(tip[0] < 0)


def lateral_reach(animals: Sequence[WhiskerArray]) -> float:
    """How far whiskers reach out from their bases along world x: the median over them, mm.

    Where they reach to both sides, of those on the side on which objects pass.
    """
    lines = [line for animal in animals for line in centrelines(animal.whiskers, animal.mount)]
    right = faces_right(animals, lines)
    seen = right == (2 * right.sum() >= len(right))
    out = np.array([line[-1, 0] - line[0, 0] for line in lines])
    return float(np.median(abs(out[seen])))


def way_to_contact(
    whiskers: Sequence[Whisker], lines: Sequence[Floats], pieces: Sequence[trimesh.Trimesh]
) -> tuple[float, NDArray[np.bool_]]:
    """How far pieces can move along -y before they meet a whisker at rest.

    Args:
        pieces: convex, in the world, mm.

    Returns:
        The way, mm, infinite when none is met; and which whiskers (whisker,) come so near to the
        swept volume that they may be touched.
    """
    points = np.concatenate(lines)
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    fractions = [np.linspace(0, w.length, len(n)) for w, n in zip(whiskers, lines, strict=True)]
    radii = np.concatenate([w.radius(s) for w, s in zip(whiskers, fractions, strict=True)])
    touching = _entry(points, radii + TOUCH_MM, pieces)
    near = _entry(points, radii + PASSED_BY_MM, pieces)
    met = np.zeros(len(lines), dtype=np.bool_)
    met[owner[np.isfinite(near)]] = True
    return float(touching.min()), met


def _entry(points: Floats, radii: Floats, pieces: Sequence[trimesh.Trimesh]) -> Floats:
    """(point,) way along +y from a ball round each point to the nearest piece, mm, or infinity."""
    nearest = np.full(len(points), np.inf)
    widest = radii.max()
    for piece in pieces:
        low, high = piece.bounds
        at = np.flatnonzero(
            ((points[:, [0, 2]] >= low[[0, 2]] - widest).all(axis=1))
            & ((points[:, [0, 2]] <= high[[0, 2]] + widest).all(axis=1))
        )
        if not len(at):
            continue
        normals = piece.face_normals
        offsets = np.einsum("ij,ij->i", normals, piece.triangles[:, 0])
        # Ahead of a plane by `gap`, and nearing it by normals . y per mm of way.
        gap = points[at] @ normals.T - offsets - radii[at, None]  # (point, face)
        rate = -normals[:, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = gap / rate
        enter = np.where(rate > 0, cross, -np.inf).max(axis=1)
        leave = np.where(rate < 0, cross, np.inf).min(axis=1)
        beside = ((rate == 0) & (gap > 0)).any(axis=1)
        hit = (enter <= leave) & (leave >= 0) & ~beside
        nearest[at[hit]] = np.minimum(nearest[at[hit]], enter[hit])
    return nearest


def within_reach(
    lines: Sequence[Floats], lengths: Sequence[float], pieces: Sequence[trimesh.Trimesh]
) -> list[int]:
    """Which pieces any whisker could touch at all, however it bends, while they move along y.

    Args:
        lengths: of the whiskers, mm.
        pieces: convex, in the world, mm.
    """
    bases = np.array([line[0, [0, 2]] for line in lines]).reshape(-1, 2)
    reach = np.array(lengths) + PASSED_BY_MM
    kept = []
    for i, piece in enumerate(pieces):
        low, high = piece.bounds[:, [0, 2]]
        away = np.linalg.norm(bases - np.clip(bases, low, high), axis=1)
        if (away <= reach).any():
            kept.append(i)
    return kept
