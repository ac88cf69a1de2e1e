"""Single whiskers beside Euler-Bernoulli beams: stiffness, resonance, ringing, sag, base loads.

What the beams do stands in `data/beams.csv`; `tests/helpers/beams.py` works it out and a test
compares.
"""

import csv
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.sim_backend.arrays.files import load_array, mouse_whiskers
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.world import (
    Mount,
    Profile,
    add_whiskers,
    empty_world,
    read_base_loads,
    set_damping,
)

Floats = NDArray[np.float64]

ARRAYS = Path(__file__).parents[2] / "docs" / "arrays"
ORIGIN = Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
SMALL = 1e-4  # deflections, of the whisker's length: linear to 1e-6
SETTLE_PERIODS = 30.0  # of the first mode; what is over-damped creeps back more slowly
GRAVITY = 9.81e-3  # mm/ms^2


@dataclass(frozen=True)
class Beam:
    """A mouse's whisker as an Euler-Bernoulli beam, tapered and curved.

    Attributes:
        compliance: Deflection of the tip per force on the tip, both along the whisker's y, mm/N.
        resonance_hz: Frequency of the first resonance, Hz.
        sag_mm: Deflection of the tip under gravity along y, mm.
    """

    compliance: float
    resonance_hz: float
    sag_mm: float


@dataclass(frozen=True)
class BeamErrors:
    """A simulated whisker beside its beam.

    Attributes:
        static: Relative error of the tip's deflection under a small force.
        resonance: Relative error of the linearised chain's first resonance.
        sag: Relative error of the tip's deflection under gravity.
        reaction: Relative error of base force and base moment under the small force.
    """

    static: float
    resonance: float
    sag: float
    reaction: float


def beams() -> dict[str, Beam]:
    """The beams by the whisker's name."""
    text = resources.files(__package__).joinpath("data/beams.csv").read_text(encoding="utf-8")
    return {
        row["whisker"]: Beam(
            float(row["compliance_mm_per_N"]), float(row["resonance_hz"]), float(row["sag_mm"])
        )
        for row in csv.DictReader(x for x in text.splitlines() if not x.startswith("#"))
    }


def flat(name: str, bend: str = "") -> Whisker:
    """A whisker in the plane of the world's x and y, its base at the origin.

    Args:
        name: of an array and its whisker: ``mouse C2``, ``robot A0`` of `docs/arrays/robot.toml`;
            without an array a mouse's.
        bend: ``straight`` takes its curve away.
    """
    array, _, one = name.rpartition(" ")
    own = array in {"", "mouse"}
    whiskers = mouse_whiskers() if own else load_array(str(ARRAYS / f"{array}.toml")).whiskers
    whisker = next(w for w in whiskers if w.name == one)
    curvature = 0.0 if bend == "straight" else whisker.curvature
    angles = (np.pi / 2, 0.0, -np.pi / 2)
    return replace(whisker, base=(0.0, 0.0, 0.0), angles=angles, curvature=curvature)


class _Chain:
    """One whisker alone in the world."""

    def __init__(self, whisker: Whisker, profile: Profile) -> None:
        world = empty_world(profile)
        add_whiskers(world, (whisker,), profile, ORIGIN)
        self.model = world.compile()
        self.resonance_hz = set_damping(self.model, (whisker,))[whisker.name]
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        end = whisker.centreline(np.array([whisker.length]))[0]
        self._end = self.data.xmat[-1].reshape(3, 3).T @ (end - self.data.xpos[-1])

    def tip(self) -> Floats:
        """(3,) where the tip is, mm."""
        mujoco.mj_kinematics(self.model, self.data)
        place: Floats = self.data.xpos[-1] + self.data.xmat[-1].reshape(3, 3) @ self._end
        return place

    def settle(self) -> None:
        """Step until nothing moves."""
        ms = SETTLE_PERIODS * max(1e3 / self.resonance_hz, self.model.opt.timestep)
        for _ in range(round(ms / self.model.opt.timestep)):
            mujoco.mj_step(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)


def measure(whisker: Whisker, beam: Beam, profile: Profile) -> BeamErrors:
    """Push it and let it hang; the whisker as `flat` lays it."""
    chain = _Chain(whisker, profile)
    rest = chain.tip()
    force = np.array([0.0, SMALL * whisker.length / beam.compliance * 1e3, 0.0])  # mN
    chain.data.xfrc_applied[-1, :3] = force
    chain.data.xfrc_applied[-1, 3:] = np.cross(rest - chain.data.xipos[-1], force)
    chain.settle()
    bent = chain.tip()
    torque = np.cross(chain.data.xipos[-1], force) + chain.data.xfrc_applied[-1, 3:]
    load = read_base_loads(chain.data.sensordata)[0] * ([1e3] * 3 + [1e6] * 3)
    wrong = (
        np.linalg.norm(load[:3] - force) / np.linalg.norm(force),
        np.linalg.norm(load[3:] - torque) / np.linalg.norm(torque),
    )
    hanging = _Chain(whisker, profile)
    hanging.model.opt.gravity = (0.0, GRAVITY, 0.0)
    hanging.settle()
    return BeamErrors(
        static=float((bent - rest)[1] / force[1] * 1e3 / beam.compliance - 1),
        resonance=chain.resonance_hz / beam.resonance_hz - 1,
        sag=float((hanging.tip() - rest)[1] / beam.sag_mm - 1),
        reaction=float(max(wrong)),
    )


def ring(whisker: Whisker, profile: Profile) -> tuple[float, float]:
    """Natural frequency (Hz) and damping ratio of the first mode as the simulation steps it.

    Released from the shape of its first mode, a linear whisker obeys y'' = a y' + b y from step
    to step; a least-squares fit of a and b gives the two poles (Prony's method), also where the
    step over-damps the mode or is longer than its period.
    """
    chain = _Chain(whisker, profile)
    model, data = chain.model, chain.data
    mass = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    sprung = np.sqrt(model.jnt_stiffness[model.dof_jntid])
    in_plane = np.flatnonzero(model.jnt_axis[model.dof_jntid, 2] != 0)
    _, shapes = np.linalg.eigh(mass[np.ix_(in_plane, in_plane)] / np.outer(*[sprung[in_plane]] * 2))
    shape = shapes[:, -1] / sprung[in_plane]
    data.qpos[in_plane] = shape * SMALL / abs(shape).sum()
    weight = mass[np.ix_(in_plane, in_plane)] @ shape
    period = 1e3 / chain.resonance_hz / profile.timestep_ms  # steps
    series = [float(weight @ data.qpos[in_plane])]
    for _ in range(max(4, round(1.5 * period))):
        mujoco.mj_step(model, data)
        series.append(float(weight @ data.qpos[in_plane]))
    y = np.array(series) / series[0]
    (a, b), *_ = np.linalg.lstsq(np.stack([y[1:-1], y[:-2]], axis=1), y[2:], rcond=None)
    poles = np.log(np.roots([1, -a, -b]).astype(complex)) / profile.timestep_ms  # 1/ms
    omega = float(np.sqrt(abs(np.prod(poles))))
    return omega / (2 * np.pi) * 1e3, float(-poles.sum().real / (2 * omega))
