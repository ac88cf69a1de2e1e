"""Recorded simulations: loads, readings and states at even intervals, for pictures."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec
from tactile_rt.core.stream.sensor_spec import LOADS, SensorSpec
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.transducer import Transducer
from tactile_rt.sim_backend.world import SAMPLE_MS

# Azimuth and elevation (degrees) of the named views. `side` and `front` face the array, `top` has
# its y upward; `oblique` looks outward from behind the bases, whiskers before the object.
VIEWS: dict[str, tuple[float, float]] = {
    "front": (-90.0, 0.0),
    "side": (180.0, 0.0),
    "top": (90.0, -90.0),
    "oblique": (26.0, -27.0),
}
MARGIN = 1.2  # around the framed points: room for arrows
# The state that determines all positions: joint angles and the poses of mocap bodies.
_STATE = int(
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_MOCAP_POS
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)


@dataclass(frozen=True)
class Camera:
    """A perspective camera.

    Attributes:
        azimuth, elevation: The direction of view, degrees.
        lookat: The point (x, y, z) in the middle of the picture, world, mm.
        extent_mm: The height of the field of view at that point, mm.
        fovy_deg: The vertical angle of view, degrees; a small angle means a distant camera.
    """

    azimuth: float
    elevation: float
    lookat: tuple[float, float, float]
    extent_mm: float
    fovy_deg: float = 35.0

    @property
    def distance_mm(self) -> float:
        """The distance from the camera to `lookat`, mm."""
        return float(self.extent_mm / 2 / np.tan(np.radians(self.fovy_deg) / 2))

    @property
    def forward(self) -> NDArray[np.float64]:
        """The (3,) direction of view in the world."""
        a, e = np.radians((self.azimuth, self.elevation))
        return np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    @property
    def right(self) -> NDArray[np.float64]:
        """The (3,) direction in the world that points right in the picture."""
        a = np.radians(self.azimuth)
        return np.array([np.sin(a), -np.cos(a), 0.0])

    @property
    def up(self) -> NDArray[np.float64]:
        """The (3,) direction in the world that points up in the picture."""
        return np.cross(self.right, self.forward)

    def aim(self, model: mujoco.MjModel, camera: mujoco.MjvCamera) -> None:
        """Apply this camera to MuJoCo's free camera and to the model's view settings."""
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = self.lookat
        camera.distance = self.distance_mm
        camera.azimuth, camera.elevation = self.azimuth, self.elevation
        model.vis.global_.fovy = self.fovy_deg
        model.stat.extent = self.extent_mm
        model.vis.map.znear = 0.02
        model.vis.map.zfar = 50 * (1 + self.distance_mm / self.extent_mm)


def framing(
    view: str, points: NDArray[np.float64], aspect: float = 1.5, left: bool = False
) -> Camera:
    """Fit the camera of a named view to points.

    Args:
        points: (n, 3) world, mm: the whiskers at rest, and the object.
        left: whether the whiskers are on the animal's left side, which mirrors the view.
    """
    if view not in VIEWS:
        raise ConfigError(f"no camera {view!r}: there are {', '.join(VIEWS)}")
    azimuth, elevation = VIEWS[view]
    azimuth = 180 - azimuth if left else azimuth
    axes = Camera(azimuth, elevation, (0.0, 0.0, 0.0), 1.0)
    frame = np.stack([axes.right, axes.up, axes.forward])
    seen = points @ frame.T
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    x, y, z = (frame.T @ middle).tolist()
    right, up, forward = (seen - middle).T
    near = 2 * np.tan(np.radians(axes.fovy_deg) / 2) * np.maximum(-forward, 0)  # perspective
    extent = float((2 * np.maximum(abs(right) / aspect, abs(up)) + near).max())
    return Camera(azimuth, elevation, (x, y, z), MARGIN * max(extent, 1e-3))


@dataclass(frozen=True)
class Footage:
    """A recorded simulation, moment by moment.

    Attributes:
        loads: The (moment, element, 6) base loads, N and N m, each the mean over the period before.
        states: The (moment, n) MuJoCo states at the end of each period.
        sizes: The (moment, element) norm of the force on each base or, with a sensor, of its
            readings with the first channel's unit less those of the first moment, SI.
    """

    model: mujoco.MjModel
    spec: ArraySpec
    period_ms: float
    loads: NDArray[np.float64]
    states: NDArray[np.float64]
    sizes: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.loads)

    @property
    def times_ms(self) -> NDArray[np.float64]:
        """The (moment,) ends of the periods, ms since the start."""
        return self.period_ms * np.arange(1, len(self) + 1, dtype=np.float64)

    @property
    def strongest(self) -> int:
        """Index of the moment of the largest total force; the middle if all are 0."""
        total = self.sizes.sum(axis=1)
        return int(total.argmax()) if total.any() else len(self) // 2

    def at(self, ms: float) -> int:
        """Return the index of the moment nearest to a time, ms since the start."""
        return int(np.clip(round(ms / self.period_ms) - 1, 0, len(self) - 1))

    def restore(self, moment: int, data: mujoco.MjData) -> None:
        """Set `data`, of this model or a copy, to the state of a moment."""
        mujoco.mj_setState(self.model, data, self.states[moment], _STATE)
        mujoco.mj_kinematics(self.model, data)


def record(
    simulation: SweepSimulation,
    spec: ArraySpec,
    period_ms: int = 4,
    progress: Callable[[float], None] = lambda done: None,
    sensor: SensorSpec | None = None,
) -> Footage:
    """Run a simulation to its end; return loads and states every `period_ms` ms.

    Args:
        simulation: made with `whole=True`, so that it has all whiskers of the array; it continues
            from its present state.
        sensor: the array's sensor, which `spec` describes; None if `spec` describes base loads.
    """
    moments = max(1, int(np.ceil(simulation.duration_ms / period_ms)))
    samples = round(period_ms / SAMPLE_MS)
    loads = np.empty((moments, len(spec.elements), len(LOADS)))
    model = simulation.model
    data = mujoco.MjData(model)
    states = np.empty((moments, mujoco.mj_stateSize(model, _STATE)))
    for k in range(moments):
        loads[k, :, :6] = simulation.advance(samples).mean(axis=0)
        loads[k, :, 6:] = simulation.turns().mean(axis=0)
        simulation.show(data)
        mujoco.mj_getState(model, data, states[k], _STATE)
        progress((k + 1) / moments)
    read = Transducer(sensor, spec.elements).read(loads) if sensor else loads[..., :6]
    first = [unit == spec.units[0] for unit in spec.units]
    sizes = np.linalg.norm((read - (read[0] if sensor else 0))[..., first], axis=2)
    return Footage(model, spec, samples * SAMPLE_MS, loads[..., :6], states, sizes)
