"""How an object is swept past an array, and how that is drawn.

World frame: z up, x away from the head, y rostral; its origin is where the published sweeps have
it (see `whisker_array.MOUNT`). The object moves along -y, as things do past a head that moves
forward.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError
from tactile_rt.sim_backend.approach import lateral_reach
from tactile_rt.sim_backend.arrays.files import load_animals
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import rotation

__all__ = ["NOTHING", "Sweep", "draw_sweep", "usual_distance", "usual_size"]

NOTHING: Mapping[str, float] = MappingProxyType({})

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Sweep:
    """How an object is swept past the array (Chung et al. 2025, appendix A1), in any pose.

    Attributes:
        size_mm: The largest extent of the object, mm.
        speed_mm_s: The speed of the object relative to the head, mm/s.
        yaw_deg: The rotation of the object about z, degrees.
        height_mm: The z of the object's centre in the world frame, mm.
        distance_mm: The distance from the mean of the whiskers' base points to the object's nearest
            face, to the side of its way (along world x where it goes along -y), mm; below 5.5 the
            stiff rostral whiskers of a mouse jam.
        gap_mm: The way before first contact at which the object starts, mm.
        roll_deg: The rotation of the object about its own x, degrees; first of the three.
        pitch_deg: The rotation of the object about its own y, degrees; after the roll, before the
            yaw.
        heading_deg: The direction in which the object goes, turned about z from -y, degrees: from
            the front where it is 0, from the front and the side on which the whiskers are where it
            is negative on the right.
        climb_deg: The rise of the object's way above the horizontal, degrees.
        ramp_ms: The time in which the speed grows to its whole from the start on, ms; its
            acceleration begins and ends at nothing.
        head_moves: 1: the head moves past an object that stands still, and its whiskers feel its
            acceleration; 0: the object moves.
        surface_friction: The friction of the object's surface, as a multiple of what the whiskers'
            description says.
        shake_g: The amplitude of the acceleration with which the head is shaken along (1, 1, 1), as
            a robot's that walks or flies, in multiples of the Earth's (9.80665 m/s^2).
        shake_hz: The frequency of that, Hz.
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

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self)):
            low, high = LIMITS.get(name, (-1e4, 1e4))
            if not low <= getattr(self, name) <= high:
                raise ConfigError(
                    f"{name} must be {low:g} to {high:g}, not {getattr(self, name):g}"
                )

    @property
    def turn(self) -> Floats:
        """(3, 3) rotation of the object."""
        roll, pitch, yaw = np.radians((self.roll_deg, self.pitch_deg, self.yaw_deg))
        return rotation("z", yaw) @ rotation("y", pitch) @ rotation("x", roll)

    @property
    def across(self) -> Floats:
        """(3, 3) rotation into a frame in which the object's way is along -y."""
        heading, climb = np.radians((self.heading_deg, self.climb_deg))
        return rotation("x", climb) @ rotation("z", -heading)


LIMITS = {
    "size_mm": (1e-3, 1e4),
    "speed_mm_s": (1e-3, 1e4),
    "gap_mm": (0.0, 1e4),
    "heading_deg": (-60.0, 60.0),  # beyond, it comes at the head itself
    "climb_deg": (-60.0, 60.0),
    "ramp_ms": (0.0, 1e4),
    "head_moves": (0.0, 1.0),
    "surface_friction": (0.0, 10.0),
    "shake_g": (0.0, 5.0),
    "shake_hz": (0.1, 200.0),  # samples are a millisecond apart
}


def usual_distance(animals: tuple[WhiskerArray, ...]) -> float:
    """A mouse's 6.5 mm, for other arrays as much more as their whiskers reach further, mm.

    So an object comes to the same share of the whiskers: 20 of a mouse's 30 reach beyond its
    6.5 mm, 19 of a rat's 30 beyond its 8.75.
    """
    return round(Sweep.distance_mm * lateral_reach(animals) / _mouse_reach(), 2)


def usual_size(animals: Sequence[WhiskerArray]) -> float:
    """A mouse's 40 mm, or as far as the base points of an array are apart where that is more, mm.

    So an object is no smaller than what it passes.
    """
    apart = [float(np.ptp([w.base for w in a.whiskers], axis=0).max()) for a in animals]
    return max(Sweep.size_mm, *apart)


@cache
def _mouse_reach() -> float:
    return lateral_reach(load_animals("mouse"))


def draw_sweep(
    rng: np.random.Generator,
    distance_mm: float = Sweep.distance_mm,
    chosen: Mapping[str, float] = NOTHING,
) -> Sweep:
    """Draw the parameters of one sweep: any yaw, a spread of heights, distances and speeds.

    Args:
        distance_mm: about which distances spread, see `usual_distance`.
        chosen: parameters that are not drawn, by their names.
    """
    drawn = {
        "speed_mm_s": float(rng.uniform(28, 40)),
        "yaw_deg": float(rng.uniform(0, 360)),
        "height_mm": float(rng.uniform(-8, 4)),
        "distance_mm": float(rng.uniform(5.5, 8)) * distance_mm / Sweep.distance_mm,
        "gap_mm": float(rng.uniform(0.5, 4)),
    }
    return Sweep(**{**drawn, **chosen})
