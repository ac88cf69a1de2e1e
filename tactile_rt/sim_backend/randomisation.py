"""Domain randomisation: an array that differs from its description, as those of real robots do.

Half-ranges of uniform distributions (Tobin et al. 2017), not standard deviations: no draw ever
leaves the stated range, so no whisker comes out unphysical.
"""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.sim_backend.arrays.whisker_array import Mount, WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Whisker

MATERIAL = ("young_modulus", "density", "damping_ratio", "friction")
SHAPE = ("length", "radius", "curvature")


@dataclass(frozen=True, kw_only=True)
class Randomisation:
    """The ranges in which an array may differ from its description; 0 for no difference.

    Each value is the half-range of a uniform distribution: relative (0.1 is +-10 %) for material
    and shape, in degrees or mm for poses. Material and mount are drawn once, because all whiskers
    share them; the geometry is drawn for each whisker. Names and cells of the grid never change.

    Attributes:
        young_modulus, density, damping_ratio, friction: The ranges of the material's properties,
            relative.
        length, radius, curvature: The ranges of each whisker's shape, relative; both radii by one
            factor, and density at base and tip too.
        angles_deg: The range of each of a whisker's base angles (theta, phi, zeta), degrees.
        base_mm: The range of each coordinate of a whisker's base point, mm.
        mount_mm: The range of each coordinate of the mount's position, mm.
        mount_deg: The range of the mount's roll, pitch and yaw, degrees.

    Raises:
        ConfigError: a negative or infinite value, or a relative one of 1 or more.
    """

    young_modulus: float = 0.0
    density: float = 0.0
    damping_ratio: float = 0.0
    friction: float = 0.0
    length: float = 0.0
    radius: float = 0.0
    curvature: float = 0.0
    angles_deg: float = 0.0
    base_mm: float = 0.0
    mount_mm: float = 0.0
    mount_deg: float = 0.0

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(Randomisation)):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ConfigError(f"{name} must be 0 or more, not {value}")
            if name in (*MATERIAL, *SHAPE) and value >= 1:
                raise ConfigError(f"{name} is relative and must be less than 1, not {value}")

    def draw(self, rng: np.random.Generator, array: WhiskerArray) -> WhiskerArray:
        """Draw a randomised copy of an array; the array itself if all ranges are 0.

        The stream must still be described by the original array (`array_spec`): a robot does not
        know by how much its own differs. The draws come from a child of `rng`, so that later draws
        from it are the same with and without randomisation. Each quantity's draw is independent of
        the other ranges.

        Raises:
            ConfigError: a whisker comes out too thick for its length, which takes both a stubby
                whisker and wide ranges.
        """
        child = rng.spawn(1)[0]
        if self == Randomisation():
            return array
        material = _draw_factors(child, [getattr(self, name) for name in MATERIAL])
        position, turn = child.uniform(-1, 1, (2, 3))
        mount = Mount(
            _shift(array.mount.position, self.mount_mm * position),
            _shift(array.mount.roll_pitch_yaw, math.radians(self.mount_deg) * turn),
        )
        whiskers = tuple(self._draw_whisker(child, whisker, material) for whisker in array.whiskers)
        return replace(array, whiskers=whiskers, mount=mount)

    def _draw_whisker(
        self, rng: np.random.Generator, whisker: Whisker, material: list[float]
    ) -> Whisker:
        young_modulus, density, damping_ratio, friction = material
        length, radius, curvature = _draw_factors(rng, [getattr(self, name) for name in SHAPE])
        angles, base = rng.uniform(-1, 1, (2, 3))
        return replace(
            whisker,
            young_modulus=whisker.young_modulus * young_modulus,
            density_base=whisker.density_base * density,
            density_tip=whisker.density_tip * density,
            damping_ratio=whisker.damping_ratio * damping_ratio,
            friction=whisker.friction * friction,
            length=whisker.length * length,
            base_radius=whisker.base_radius * radius,
            tip_radius=whisker.tip_radius * radius,
            curvature=whisker.curvature * curvature,
            angles=_shift(whisker.angles, math.radians(self.angles_deg) * angles),
            base=_shift(whisker.base, self.base_mm * base),
        )


def _draw_factors(rng: np.random.Generator, half_ranges: list[float]) -> list[float]:
    """Draw a uniformly distributed factor from 1 +- each half-range."""
    factors: list[float] = (
        1 + np.array(half_ranges) * rng.uniform(-1, 1, len(half_ranges))
    ).tolist()
    return factors


def _shift(
    point: tuple[float, float, float], by: NDArray[np.float64]
) -> tuple[float, float, float]:
    x, y, z = (np.array(point) + by).tolist()
    return x, y, z
