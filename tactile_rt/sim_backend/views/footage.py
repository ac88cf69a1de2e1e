"""A simulation as it went: the loads, and its states at even intervals, to draw pictures from."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.sim_backend.world import SAMPLE_MS
from tactile_rt.stream import ArraySpec

__all__ = ["Footage", "Simulation", "record"]

# What places everything: joint angles, and the poses of the bodies that are moved.
_STATE = int(
    mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_MOCAP_POS
    | mujoco.mjtState.mjSTATE_MOCAP_QUAT
)


class Simulation(Protocol):
    """What `record` runs, e.g. a `SweepSimulation`."""

    duration_ms: float

    @property
    def model(self) -> mujoco.MjModel:
        """What pictures are drawn of."""

    def show(self, data: mujoco.MjData) -> None:
        """Put everything in the model's data where it is now."""

    def advance(self, samples: int) -> NDArray[np.float64]:
        """Simulate the next samples of 1 ms: (samples, element, 6) base loads, N and N m."""


@dataclass(frozen=True)
class Footage:
    """A simulation as it went, moment by moment.

    Attributes:
        period_ms: The time between moments, ms.
        loads: The (moment, element, 6) base loads, N and N m, each the mean over the period before.
        states: The (moment, n) places of everything at the end of each period.
    """

    model: mujoco.MjModel
    spec: ArraySpec
    period_ms: float
    loads: NDArray[np.float64]
    states: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.loads)

    @property
    def times_ms(self) -> NDArray[np.float64]:
        """(moment,) end of each period, ms since the start."""
        return self.period_ms * np.arange(1, len(self) + 1, dtype=np.float64)

    @property
    def forces(self) -> NDArray[np.float64]:
        """(moment, element) size of the force on each base, N."""
        size: NDArray[np.float64] = np.sqrt((self.loads[..., :3] ** 2).sum(axis=2))
        return size

    @property
    def strongest(self) -> int:
        """The moment in which the forces add up to most; the middle one if there are none."""
        total = self.forces.sum(axis=1)
        return int(total.argmax()) if total.any() else len(self) // 2

    def at(self, ms: float) -> int:
        """The moment nearest to a time, ms since the start."""
        return int(np.clip(round(ms / self.period_ms) - 1, 0, len(self) - 1))

    def restore(self, moment: int, data: mujoco.MjData) -> None:
        """Place everything in `data`, of this model or a copy of it, as it was."""
        mujoco.mj_setState(self.model, data, self.states[moment], _STATE)
        mujoco.mj_kinematics(self.model, data)


def _ignore(done: float) -> None:
    pass


def record(
    simulation: Simulation,
    spec: ArraySpec,
    period_ms: int = 4,
    progress: Callable[[float], None] = _ignore,
) -> Footage:
    """Run a simulation to its end.

    Args:
        simulation: fresh or advanced; it goes on from where it is. All whiskers of the array
            must be in it: a `SweepSimulation` is to be made with `whole=True`.
        period_ms: between moments, whole ms.
        progress: called with the share that is done, 0 to 1.
    """
    moments = max(1, int(np.ceil(simulation.duration_ms / period_ms)))
    samples = round(period_ms / SAMPLE_MS)
    loads = np.empty((moments, len(spec.elements), 6))
    model = simulation.model
    data = mujoco.MjData(model)
    states = np.empty((moments, mujoco.mj_stateSize(model, _STATE)))
    for k in range(moments):
        loads[k] = simulation.advance(samples).mean(axis=0)
        simulation.show(data)
        mujoco.mj_getState(model, data, states[k], _STATE)
        progress((k + 1) / moments)
    return Footage(model, spec, samples * SAMPLE_MS, loads, states)
