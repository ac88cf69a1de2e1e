"""Benchmark area `sim`: what the simulated array costs, and how near it is to beam theory."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.benchmarks.records import Record
from tactile_rt.sim_backend.array import (
    MOUNT,
    PROFILES,
    Mount,
    Profile,
    add_whiskers,
    empty_world,
    set_damping,
)
from tactile_rt.sim_backend.objects import TactileObject, load_object
from tactile_rt.sim_backend.solids import box
from tactile_rt.sim_backend.sweep import Sweep, SweepSimulation, draw_sweep
from tactile_rt.sim_backend.whiskers import FRICTION, Whisker, mouse_whiskers

__all__ = ["BEAMS", "run"]

Floats = NDArray[np.float64]

BULLET_CPU_S = 156.0  # per simulated second at 1 kHz x 100 sub-steps, the faster of two objects
BEAM_BARS = {"realtime": "<= 4", "dataset": "<= 1.5", "accurate": "<= 1"}  # per cent
OBJECTS = ("mug-50", "chair-50", "gear-50", "bottle-50", "car-50", "table-50")


@dataclass(frozen=True)
class Beam:
    """A whisker as an Euler-Bernoulli beam.

    Attributes:
        resonance_hz: first resonance, Hz.
        compliance: deflection of the tip along y per force on it, m/N.
    """

    resonance_hz: float
    compliance: float


# Solved in tests/sim_backend/test_array.py, which checks these figures.
BEAMS = {"B0": Beam(103.83, 529.9), "C2": Beam(186.48, 289.1), "E5": Beam(1378.9, 11.108)}


def run(quick: bool) -> list[Record]:
    """Measure every profile on sweeps of unseen objects and on single whiskers.

    Quick: two objects for 0.3 s each from shortly before contact; full: six, whole sweeps.
    """
    names = OBJECTS[:2] if quick else OBJECTS
    sweeps = [_Measured(name, 300 if quick else None) for name in names]
    sample = f"{len(names)} objects, " + ("0.3 s of each" if quick else "whole sweeps")
    records = []
    for name, profile in PROFILES.items():
        records += _cost(name, sweeps, sample)
        if name != "accurate":
            records += _nearness(name, sweeps, sample)
        records += _mechanics(name, profile)
    return records


class _Measured:
    """One sweep at every profile, the object at the same place at the same time."""

    def __init__(self, name: str, ms: int | None) -> None:
        target, whiskers = load_object(name), mouse_whiskers()
        rng = np.random.default_rng(OBJECTS.index(name))
        while True:
            sweep = draw_sweep(rng)
            # The coarser the chain, the more it cuts corners, and `gap_mm` counts from first
            # contact: the finest profile says where the object starts.
            finest = SweepSimulation(whiskers, target, sweep, PROFILES["accurate"])
            if finest.touches:
                break
        start = finest.data.mocap_pos[0, 1]
        samples = ms or round(finest.duration_ms)
        self.loads: dict[str, Floats] = {}  # by profile: (sample, whisker, 6), N and N m
        self.cpu: dict[str, float] = {}  # by profile: CPU s per simulated s
        self.setup: dict[str, float] = {}  # by profile: CPU s to build the simulation
        for key, profile in PROFILES.items():
            late = start - SweepSimulation(whiskers, target, sweep, profile).data.mocap_pos[0, 1]
            moved = replace(sweep, gap_mm=sweep.gap_mm + float(late))
            began = time.process_time()
            simulation = SweepSimulation(whiskers, target, moved, profile)
            built = time.process_time()
            self.loads[key] = simulation.advance(samples)
            self.setup[key] = built - began
            self.cpu[key] = (time.process_time() - built) / (samples * 1e-3)

    def error(self, profile: str, channels: slice, average: int) -> float:
        """RMS difference from the accurate profile over the latter's RMS, per cent.

        Args:
            profile: name of the profile.
            channels: forces or moments.
            average: samples averaged into one before comparing.
        """
        pair = []
        for key in (profile, "accurate"):
            loads = self.loads[key][..., channels]
            whole = loads[: len(loads) // average * average]
            pair.append(whole.reshape(-1, average, *whole.shape[1:]).mean(axis=1))
        return 100 * float(np.sqrt(np.mean((pair[0] - pair[1]) ** 2) / np.mean(pair[1] ** 2)))


def _cost(profile: str, sweeps: list[_Measured], sample: str) -> list[Record]:
    cpu = [s.cpu[profile] for s in sweeps]
    how = f"median of {sample}; 30 whiskers, one thread, process time"
    cost = float(np.median(cpu))
    live = profile == "realtime"  # the others are for making data, where slower than life is fine
    records = [
        Record(
            f"sim.{profile}.cpu_s_per_s",
            cost,
            "CPU s/s",
            "<= 0.5" if live else "",
            "half a core leaves the other half to the network and the robot" if live else "",
            f"{how}; {min(cpu):.2f} to {max(cpu):.2f}",
        ),
        Record(
            f"sim.{profile}.speed_over_life",
            1 / cost,
            "x real time",
            ">= 1" if live else "",
            "1: a sweep takes as long as it lasts",
            how,
        ),
        Record(
            f"sim.{profile}.speed_over_bullet",
            BULLET_CPU_S / cost,
            "x",
            ">= 100" if live else "",
            "published simulator (Bullet, 1 kHz x 100 sub-steps): 156-179 CPU s/s",
            f"{BULLET_CPU_S:.0f} CPU s/s over the first figure; other objects",
        ),
    ]
    if live:
        records.append(
            Record(
                f"sim.{profile}.setup",
                1e3 * float(np.median([s.setup[profile] for s in sweeps])),
                "ms",
                "<= 270",
                "the rest between two objects, in which a live source builds the next",
                how,
            )
        )
    return records


def _nearness(profile: str, sweeps: list[_Measured], sample: str) -> list[Record]:
    records = []
    for what, channels in (("force", slice(0, 3)), ("moment", slice(3, 6))):
        for ms in (1, 9):
            errors = [s.error(profile, channels, ms) for s in sweeps]
            records.append(
                Record(
                    f"sim.{profile}.{what}_error_{ms}ms",
                    float(np.median(errors)),
                    "% NRMSE",
                    anchor="accurate profile; two integrators agree on moments to 1.5 %",
                    how=f"median of {sample}; all whiskers and axes, means over {ms} ms; "
                    f"worst {max(errors):.0f}",
                )
            )
    return records


def _mechanics(name: str, profile: Profile) -> list[Record]:
    whiskers = {w.name: w for w in mouse_whiskers() if w.name in BEAMS}

    def worst(of: Callable[[Whisker, Beam], float]) -> tuple[float, str]:
        errors = {n: 100 * of(w, BEAMS[n]) for n, w in whiskers.items()}
        each = ", ".join(f"{n} {e:+.2f}" for n, e in errors.items())
        return max(abs(e) for e in errors.values()), f"worst of {each}"

    stiff, how_stiff = worst(lambda w, b: _tip_compliance(w, profile, b) / b.compliance - 1)
    tuned, how_tuned = worst(lambda w, b: _resonance(w, profile) / b.resonance_hz - 1)
    return [
        Record(
            f"sim.{name}.tip_compliance_error",
            stiff,
            "%",
            BEAM_BARS[name],
            "Euler-Bernoulli, tapered and curved",
            f"{how_stiff}; tip pushed by 1e-4 of the length",
        ),
        Record(
            f"sim.{name}.resonance_error",
            tuned,
            "%",
            BEAM_BARS[name],
            "Euler-Bernoulli, tapered",
            f"{how_tuned}; undamped, before the time step shifts it",
        ),
        Record(
            f"sim.{name}.friction_error",
            100 * abs(_sliding_friction(profile) / FRICTION - 1),
            "%",
            "<= 2",
            f"Coulomb: {FRICTION} of the normal force, along the object's motion",
            "C2 on the flat side of a block, the last 50 of 500 ms",
        ),
    ]


def _alone(whisker: Whisker, profile: Profile) -> tuple[mujoco.MjModel, float]:
    """One whisker in the plane of the world's x and y, and its first resonance (Hz)."""
    flat = replace(whisker, base=(0.0, 0.0, 0.0), angles=(np.pi / 2, 0.0, -np.pi / 2))
    world = empty_world(profile)
    add_whiskers(world, (flat,), profile, Mount((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    model = world.compile()
    return model, set_damping(model)[whisker.name]


def _resonance(whisker: Whisker, profile: Profile) -> float:
    return _alone(whisker, profile)[1]


def _tip_compliance(whisker: Whisker, profile: Profile, beam: Beam) -> float:
    """Deflection of the tip along y per small force on it, m/N."""
    model, _ = _alone(whisker, profile)
    data = mujoco.MjData(model)

    def tip() -> Floats:
        mujoco.mj_kinematics(model, data)
        along = data.xmat[-1].reshape(3, 3)[:, 0]
        end: Floats = data.xpos[-1] + 2 * model.geom_size[-1, 1] * along  # mm
        return end

    mujoco.mj_forward(model, data)
    rest = tip()
    force = 1e-4 * whisker.length / beam.compliance  # mm per m/N: mN
    data.xfrc_applied[-1, 1] = force
    data.xfrc_applied[-1, 3:] = np.cross(rest - data.xipos[-1], (0.0, force, 0.0))
    for _ in range(round(20e3 / beam.resonance_hz / profile.timestep_ms)):
        mujoco.mj_step(model, data)
    return float((tip() - rest)[1] / force)


def _sliding_friction(profile: Profile) -> float:
    """Drag along the motion (-y) over the normal force (along x) of a face sliding past C2."""
    c2 = next(w for w in mouse_whiskers() if w.name == "C2")
    block = TactileObject("block", "block", (box((0, 0, 0), (1, 1, 1)),))
    simulation = SweepSimulation((c2,), block, Sweep(gap_mm=0.2), profile)
    force = simulation.advance(500)[-50:, 0, :3].mean(axis=0)
    normal, drag, _ = MOUNT.rotation @ c2.orientation @ force
    return float(drag / normal)
