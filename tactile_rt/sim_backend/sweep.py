"""The parameters of a sweep of an object past an array, and their random draw.

World frame: z up, x away from the head, y rostral; its origin is that of the published sweeps
(see `whisker_array.MOUNT`). The object moves along -y, as it would past a head that moves forward.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from types import MappingProxyType

import numpy as np
import trimesh
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.arrays.whisker_array import Mount, WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Floats, Whisker, rotation

SPACING_MM = 0.25
TOUCH_MM = 0.15  # a contact below it: both soft layers, and a link's chord off the centreline
PASSED_BY_MM = 0.5  # a whisker that is missed by less is simulated
SIDES = 500  # a piece of more corners keeps the furthest in each of so many directions

EARTH = 9.80665  # m/s^2
NOTHING: Mapping[str, float] = MappingProxyType({})
LIMITS = {
    "size_mm": (1e-3, 1e4),
    "speed_mm_s": (1e-3, 3e3),  # a faster object moves too far in a time step
    "gap_mm": (0.0, 1e4),
    "heading_deg": (-60.0, 60.0),  # beyond, the object would hit the head itself
    "climb_deg": (-60.0, 60.0),
    "ramp_ms": (0.0, 1e4),
    "head_moves": (0.0, 1.0),
    "surface_friction": (0.0, 10.0),
    "shake_g": (0.0, 5.0),
    "shake_hz": (0.1, 200.0),  # samples are a millisecond apart
    **dict.fromkeys(("gravity_x_g", "gravity_y_g", "gravity_z_g"), (-5.0, 5.0)),
    "tilt_deg": (-180.0, 180.0),
    "tilt_axis_deg": (-180.0, 180.0),
    "tilt_ms": (0.0, 1e5),
}


def centrelines(whiskers: Sequence[Whisker], mount: Mount) -> list[Floats]:
    """Return points (point, 3) along every whisker at rest, base to tip, world, mm."""
    turn, origin = mount.rotation, np.array(mount.position)
    lines = []
    for whisker in whiskers:
        s = np.linspace(0.0, whisker.length, max(2, round(whisker.length / SPACING_MM) + 1))
        inside = whisker.centreline(s) @ whisker.orientation.T + np.array(whisker.base)
        lines.append(inside @ turn.T + origin)
    return lines


def faces_right(animals: Sequence[WhiskerArray], lines: Sequence[Floats]) -> NDArray[np.bool_]:
    """Return (whisker,) flags: true if the whisker's side of the head faces world +x.

    Sides are judged as a whole: on a rotated head some whiskers of the far side point across.
    """
    out = np.array([line[-1, 0] - line[0, 0] for line in lines])
    sides = np.array([2 * k + _points_left(w) for k, a in enumerate(animals) for w in a.whiskers])
    right = np.zeros(len(out), dtype=np.bool_)
    for side in np.unique(sides):
        right[sides == side] = out[sides == side].mean() > 0
    return right


def _points_left(whisker: Whisker) -> bool:
    """Return whether a whisker points to the left in the frame of its head."""
    tip = whisker.orientation @ whisker.centreline(np.array([whisker.length]))[0]
    return bool(tip[0] < 0)


def lateral_reach(animals: Sequence[WhiskerArray]) -> float:
    """Return the median reach of whiskers from their bases along world x, mm.

    If whiskers reach to both sides, only those on the side where objects pass count.
    """
    lines = [line for animal in animals for line in centrelines(animal.whiskers, animal.mount)]
    right = faces_right(animals, lines)
    seen = right == (2 * right.sum() >= len(right))
    out = np.array([line[-1, 0] - line[0, 0] for line in lines])
    return float(np.median(abs(out[seen])))


def way_to_contact(
    whiskers: Sequence[Whisker], lines: Sequence[Floats], pieces: Sequence[trimesh.Trimesh]
) -> tuple[float, NDArray[np.bool_]]:
    """Find how far pieces move along -y until first contact, and which whiskers they reach.

    Args:
        pieces: convex, in the world, mm.

    Returns:
        The distance, mm, infinite without contact; and (whisker,) flags of the whiskers so near to
        the swept volume that they may be touched.
    """
    points = np.concatenate(lines)
    owner = np.repeat(np.arange(len(lines)), [len(line) for line in lines])
    fractions = [np.linspace(0, w.length, len(n)) for w, n in zip(whiskers, lines, strict=True)]
    radii = np.concatenate([w.radius(s) for w, s in zip(whiskers, fractions, strict=True)])
    pieces = [_reduce_corners(piece) for piece in pieces]
    touching = _find_distances(points, radii + TOUCH_MM, pieces)
    near = _find_distances(points, radii + PASSED_BY_MM, pieces)
    met = np.zeros(len(lines), dtype=np.bool_)
    met[owner[np.isfinite(near)]] = True
    return float(touching.min()), met


def _reduce_corners(piece: trimesh.Trimesh) -> trimesh.Trimesh:
    """Reduce a piece to at most `SIDES` corners, within 0.3 % of its size."""
    if len(piece.vertices) <= SIDES:
        return piece
    z, turn = np.linspace(-1, 1, SIDES), np.pi * (3 - np.sqrt(5)) * np.arange(SIDES)
    sides = np.stack([*(np.sqrt(1 - z**2) * (np.cos(turn), np.sin(turn))), z], axis=1)
    furthest = np.unique(np.argmax(sides @ piece.vertices.T, axis=1))
    hull: trimesh.Trimesh = trimesh.Trimesh(piece.vertices[furthest]).convex_hull
    return hull


def _find_distances(points: Floats, radii: Floats, pieces: Sequence[trimesh.Trimesh]) -> Floats:
    """Find (point,) distances along +y from balls to the nearest piece, mm."""
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
        # Each ball is `gap` in front of a plane, and approaches it by `rate` per mm along +y.
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
    """Select the pieces that any whisker could touch while they move along y.

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


@dataclass(frozen=True)
class Sweep:
    """A sweep of an object in any pose past the array (Chung et al. 2025, appendix A1).

    Attributes:
        size_mm: The largest extent of the object, mm.
        speed_mm_s: The speed of the object relative to the head, mm/s.
        yaw_deg: The rotation of the object about z, degrees.
        height_mm: The z of the object's centre in the world frame, mm.
        distance_mm: The distance from the mean of the whiskers' base points to the object's nearest
            face, across its path (along world x if it moves along -y), mm; below 5.5 the stiff
            rostral whiskers of a mouse jam.
        gap_mm: The distance that the object moves from its start to first contact, mm.
        roll_deg: The rotation of the object about its own x, degrees; first of the three.
        pitch_deg: The rotation of the object about its own y, degrees; after the roll, before the
            yaw.
        heading_deg: The direction in which the object moves, rotated about z from -y, degrees. At 0
            it comes from the front; negative, for whiskers on the right, it comes from the front
            and the whiskers' side.
        climb_deg: The rise of the object's path above the horizontal, degrees.
        ramp_ms: The time from the start to full speed, ms; the acceleration begins and ends at 0.
        head_moves: 1 if the head moves past an object that stands still, and its whiskers feel its
            acceleration; 0 if the object moves.
        surface_friction: The friction of the object's surface, as a multiple of that in the
            whiskers' description.
        shake_g: The amplitude of the acceleration that shakes the head along (1, 1, 1), as on a
            robot that walks or flies, in multiples of the Earth's (9.80665 m/s^2).
        shake_hz: The frequency of the shaking, Hz.
        gravity_x_g, gravity_y_g, gravity_z_g: The gravity added to that of the array's
            description, in the world, in multiples of the Earth's.
        tilt_deg: The angle by which the head, with the object and the world's axes, is tilted
            after the tare, degrees. Loads are relative to the tare, so that the weight of the
            whiskers shows.
        tilt_axis_deg: The direction of the axis of that tilt in the x-y plane, from x, degrees.
        tilt_ms: The duration of the tilt from the start of the sweep; 0 if it is tilted before.
    """

    size_mm: float = 40.0
    speed_mm_s: float = 34.0
    yaw_deg: float = 0.0
    height_mm: float = -2.0
    distance_mm: float = 6.5
    gap_mm: float = 2.0
    roll_deg: float = 0.0
    pitch_deg: float = 0.0
    heading_deg: float = 0.0
    climb_deg: float = 0.0
    ramp_ms: float = 0.0
    head_moves: float = 0.0
    surface_friction: float = 1.0
    shake_g: float = 0.0
    shake_hz: float = 30.0
    gravity_x_g: float = 0.0
    gravity_y_g: float = 0.0
    gravity_z_g: float = 0.0
    tilt_deg: float = 0.0
    tilt_axis_deg: float = 0.0
    tilt_ms: float = 0.0

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            low, high = LIMITS.get(name, (-1e4, 1e4))
            if not low <= getattr(self, name) <= high:
                raise ConfigError(
                    f"{name} must be {low:g} to {high:g}, not {getattr(self, name):g}"
                )

    @property
    def turn(self) -> Floats:
        """The (3, 3) rotation of the object: roll, then pitch, then yaw."""
        roll, pitch, yaw = np.radians((self.roll_deg, self.pitch_deg, self.yaw_deg))
        return rotation("z", yaw) @ rotation("y", pitch) @ rotation("x", roll)

    @property
    def across(self) -> Floats:
        """The (3, 3) rotation into a frame in which the object moves along -y."""
        heading, climb = np.radians((self.heading_deg, self.climb_deg))
        return rotation("x", climb) @ rotation("z", -heading)

    def gravity(self, described: Sequence[float], tilt: float = 0.0) -> Floats:
        """Compute (3,) gravity in the world, m/s^2, after a share (0 to 1) of tilt.

        Args:
            described: (3,) gravity in the array's description, m/s^2.
        """
        added = np.array([self.gravity_x_g, self.gravity_y_g, self.gravity_z_g]) * EARTH
        axis = rotation("z", np.radians(self.tilt_axis_deg))
        # The world frame rotates with the head, so gravity rotates the other way.
        back = axis @ rotation("x", -np.radians(self.tilt_deg) * tilt) @ axis.T
        return np.asarray(back @ (described + added))


def usual_distance(animals: tuple[WhiskerArray, ...]) -> float:
    """Return the usual sweep distance, mm: a mouse's 6.5, scaled by whisker reach.

    So an object meets the same share of whiskers: 20 of a mouse's 30 reach beyond 6.5 mm, 19 of a
    rat's 30 beyond its 8.75 mm.
    """
    return round(Sweep.distance_mm * lateral_reach(animals) / _measure_mouse_reach(), 2)


def usual_size(animals: Sequence[WhiskerArray]) -> float:
    """Return the usual object size, mm: 40, or the extent of whisker tips if larger.

    So an object is at least as large as the region that the whiskers reach.
    """
    tips = [line[-1, 1:] for a in animals for line in centrelines(a.whiskers, a.mount)]
    return max(Sweep.size_mm, round(float(np.ptp(tips, axis=0).max())))


@cache
def _measure_mouse_reach() -> float:
    return lateral_reach(load_animals("mouse"))


def draw_sweep(
    rng: np.random.Generator,
    distance_mm: float = Sweep.distance_mm,
    chosen: Mapping[str, float] = NOTHING,
) -> Sweep:
    """Draw speed, yaw, height, distance and gap of a sweep, unless given in `chosen`."""
    drawn = {
        "speed_mm_s": float(rng.uniform(28, 40)),
        "yaw_deg": float(rng.uniform(0, 360)),
        "height_mm": float(rng.uniform(-8, 4)),
        "distance_mm": float(rng.uniform(5.5, 8)) * distance_mm / Sweep.distance_mm,
        "gap_mm": float(rng.uniform(0.5, 4)),
    }
    return Sweep(**{**drawn, **chosen})
