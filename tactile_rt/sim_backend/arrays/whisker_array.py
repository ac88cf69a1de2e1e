"""Whisker arrays: whiskers and the poses of the heads that carry them.

Lengths in mm and angles in rad, as in `whiskers`. The frame of a head is x lateral (to the
animal's right), y rostral, z dorsal; the left side of an animal is its right side mirrored in x.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.sensor_spec import SensorSpec
from tactile_rt.sim_backend.arrays.whiskers import Whisker, rotation

Point = tuple[float, float, float]
MOST_GRAVITY = 50.0  # m/s^2; more must be a typing error


@dataclass(frozen=True)
class Mount:
    """Pose of the array frame in the world: position (mm), then Rz(yaw) Ry(pitch) Rx(roll)."""

    position: Point
    roll_pitch_yaw: Point

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (*self.position, *self.roll_pitch_yaw))):
            raise ConfigError("a mount's position and angles must be finite")

    @property
    def rotation(self) -> NDArray[np.float64]:
        """Rotation (3, 3) from the array frame to the world frame."""
        roll, pitch, yaw = self.roll_pitch_yaw
        return rotation("z", yaw) @ rotation("y", pitch) @ rotation("x", roll)

    def mirror(self) -> "Mount":
        """Return the pose mirrored in the world's y-z plane."""
        x, y, z = self.position
        roll, pitch, yaw = self.roll_pitch_yaw
        return Mount((-x, y, z), (roll, -pitch, -yaw))


# The pose of the published sweeps (Chung et al. 2025, code): the whiskers reach along world +x.
MOUNT = Mount(
    (-6.934, -11.642, -2.598), (0.0, float(np.radians(15.366)), float(np.radians(-16.198)))
)


@dataclass(frozen=True)
class WhiskerArray:
    """A whisker array: the whiskers of one head, its pose, and their sensor.

    Attributes:
        whiskers: The whiskers in the frame of the head, mm and rad.
        sensor: The sensor that reads the whiskers; None if the base loads are read as they are.
        gravity: The gravity in the world frame, m/s^2; zero (weightless) by default. Loads are
            relative to a tare under this gravity.

    Raises:
        ConfigError: no whiskers, or two with the same name or grid cell.
    """

    name: str
    whiskers: tuple[Whisker, ...]
    mount: Mount = MOUNT
    sensor: SensorSpec | None = field(default=None, hash=False)
    gravity: Point = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.whiskers:
            raise ConfigError(f"array {self.name}: has no whiskers; give at least one")
        if not all(abs(g) <= MOST_GRAVITY for g in self.gravity):
            raise ConfigError(
                f"array {self.name}: gravity_m_s2 must be within +-{MOST_GRAVITY:g} m/s^2"
            )
        names: dict[object, str] = {}
        for w in self.whiskers:
            for key, what in ((w.name, "name"), ((w.row, w.column), "cell of the grid")):
                if key in names:
                    raise ConfigError(
                        f"array {self.name}: whiskers {names[key]} and {w.name} have the same "
                        f"{what}; give each its own"
                    )
                names[key] = w.name


def mirror_whisker(whisker: Whisker) -> Whisker:
    """Return a whisker's mirror image, on the other side of the head.

    All points are reflected in x; the curvature stays. The frame stays right-handed: x along the
    whisker and y towards its concave side are reflected, and z = x cross y is opposite to the
    reflected z (so the base angles are -theta, phi, -zeta). A mirrored contact gives the same fx,
    fy and mz, and fz, mx and my of the opposite sign.
    """
    x, y, z = whisker.base
    theta, phi, zeta = whisker.angles
    return replace(whisker, base=(-x, y, z), angles=(-theta, phi, -zeta))


def both_sides(right: WhiskerArray, name: str) -> WhiskerArray:
    """Return an array joined with its mirror image on one head (``R.C2``, ``L.C2``).

    The grid is the face seen from the front: the right side keeps its cells, on the viewer's left,
    and the left side mirrors them, on the viewer's right, so that the most rostral columns meet in
    the middle (5 x 14 for mouse and rat).
    """
    columns = 2 * max(w.column for w in right.whiskers) + 1
    left = (
        replace(mirror_whisker(w), name=f"L.{w.name}", column=columns - w.column)
        for w in right.whiskers
    )
    kept = (replace(w, name=f"R.{w.name}") for w in right.whiskers)
    return replace(right, name=name, whiskers=(*kept, *left))


def place(arrays: Sequence[WhiskerArray]) -> tuple[WhiskerArray, ...]:
    """Return several animals' arrays for one world, with distinct element names and grid cells.

    The k-th animal's whiskers are called ``k.C2`` or ``k.R.C2`` (k from 1), and its rows of the
    grid follow below those of the animals before it. A single animal keeps its names.

    Raises:
        ConfigError: two arrays have the same pose, or different gravity.
    """
    if len(arrays) == 1:
        return (arrays[0],)
    if len({array.gravity for array in arrays}) > 1:
        raise ConfigError("the arrays of one world must have the same gravity_m_s2, or none")
    for k, array in enumerate(arrays):
        if array.mount in [a.mount for a in arrays[:k]]:
            raise ConfigError(f"animal {k + 1} ({array.name}) overlaps another; move its mount")
    placed, above = [], 0
    for k, array in enumerate(arrays, start=1):
        whiskers = tuple(
            replace(w, name=f"{k}.{w.name}", row=w.row + above) for w in array.whiskers
        )
        sensor = array.sensor
        if sensor is not None:
            matrix = {f"{k}.{name}": rows for name, rows in sensor.matrix.items()}
            sensor = replace(sensor, matrix=matrix)
        placed.append(replace(array, name=f"{k}.{array.name}", whiskers=whiskers, sensor=sensor))
        above = max(w.row for w in whiskers) + 1
    return tuple(placed)


def centred_mount(
    whiskers: Sequence[Whisker],
    centre: Point = (0.0, 0.0, 0.0),
    roll_pitch_yaw: Point = (0.0, 0.0, 0.0),
) -> Mount:
    """Return the mount that places the whiskers' mean base point at `centre` (world, mm)."""
    turned = Mount((0.0, 0.0, 0.0), roll_pitch_yaw).rotation
    x, y, z = (centre - turned @ np.mean([w.base for w in whiskers], axis=0)).tolist()
    return Mount((x, y, z), roll_pitch_yaw)
