"""Cameras: from where a simulation is seen.

World frame as in `sweep`: x away from the head, y rostral, z up; mm. Azimuth and elevation are
MuJoCo's: the direction of view is (cos e cos a, cos e sin a, sin e), so azimuth 0 looks along +x
and a negative elevation looks down.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.errors import ConfigError

__all__ = ["VIEWS", "Camera", "framing"]

# Azimuth and elevation (degrees) of the named views. `side` and `front` face the animal, `top` has
# its nose upward; `oblique` looks outward from behind the cheek, whiskers before the object.
VIEWS: dict[str, tuple[float, float]] = {
    "front": (-90.0, 0.0),
    "side": (180.0, 0.0),
    "top": (90.0, -90.0),
    "oblique": (26.0, -27.0),
}
MARGIN = 1.15  # around the framed points: room for arrows


@dataclass(frozen=True)
class Camera:
    """A point of view. Both projections show the same height at the point looked at.

    Attributes:
        azimuth, elevation: The direction of view, degrees.
        lookat: The point (x, y, z) in the middle of the picture, world, mm.
        extent_mm: The height of what the picture shows at that point, mm.
        orthographic: Whether there is no perspective: sizes are independent of depth, parallels
            stay parallel.
        fovy_deg: The vertical field of view in perspective, degrees; small is far away.
    """

    azimuth: float
    elevation: float
    lookat: tuple[float, float, float]
    extent_mm: float
    orthographic: bool = False
    fovy_deg: float = 35.0

    @property
    def distance_mm(self) -> float:
        """From the eye to the point looked at, mm."""
        return float(self.extent_mm / 2 / np.tan(np.radians(self.fovy_deg) / 2))

    @property
    def forward(self) -> NDArray[np.float64]:
        """(3,) direction of view in the world."""
        a, e = np.radians((self.azimuth, self.elevation))
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    @property
    def right(self) -> NDArray[np.float64]:
        """(3,) direction in the world that points right in the picture."""
        a = np.radians(self.azimuth)
        return np.array([np.sin(a), -np.cos(a), 0.0])

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) direction in the world that points up in the picture."""
        return np.cross(self.right, self.forward)

    def aim(self, model: mujoco.MjModel, camera: mujoco.MjvCamera) -> None:
        """Set MuJoCo's free camera, and the model's view settings that go with it."""
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = self.lookat
        camera.distance = self.distance_mm
        camera.azimuth, camera.elevation = self.azimuth, self.elevation
        camera.orthographic = int(self.orthographic)
        # MuJoCo reads the field of view of an orthographic camera as its extent.
        model.vis.global_.fovy = self.extent_mm if self.orthographic else self.fovy_deg
        model.stat.extent = self.extent_mm
        model.vis.map.znear = 0.02
        model.vis.map.zfar = 50 * (1 + self.distance_mm / self.extent_mm)


def framing(
    view: str,
    points: NDArray[np.float64],
    orthographic: bool = False,
    aspect: float = 1.5,
    left: bool = False,
) -> Camera:
    """The camera of a named view, set so that all points are in the picture.

    Args:
        view: one of `VIEWS`.
        points: (n, 3) world, mm: the whiskers at rest, and what they touch.
        aspect: width of the picture over its height.
        left: whether these are whiskers of the animal's left side: the view's mirror image.
    """
    if view not in VIEWS:
        raise ConfigError(f"no camera {view!r}: there are {', '.join(VIEWS)}")
    azimuth, elevation = VIEWS[view]
    azimuth = 180 - azimuth if left else azimuth
    axes = Camera(azimuth, elevation, (0.0, 0.0, 0.0), 1.0)
    frame = np.stack([axes.right, axes.up, axes.forward])
    seen = points @ frame.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    x, y, z = (frame.T @ ((low + high) / 2)).tolist()
    wide, tall = (high - low)[:2]
    extent = MARGIN * max(float(wide) / aspect, float(tall), 1e-3)
    return Camera(azimuth, elevation, (x, y, z), extent, orthographic)
