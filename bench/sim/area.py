"""Benchmark area `sim`: what the simulated array costs, and how near the truth it is."""

import time
from collections.abc import Iterable

import numpy as np
import trimesh
from numpy.typing import NDArray

from bench.sim.active import active
from bench.sim.catalogue import catalogue
from bench.sim.mechanics import mechanics
from bench.sim.reference_model import PROTOTYPE_CPU_S, reference_cost
from tactile_rt.models.evaluation.records import Record
from tactile_rt.sim_backend.arrays.files import load_array
from tactile_rt.sim_backend.objects.catalogue import TactileObject, load_object
from tactile_rt.sim_backend.source import REST_SAMPLES
from tactile_rt.sim_backend.sweep import Sweep
from tactile_rt.sim_backend.sweep_simulation import SweepSimulation
from tactile_rt.sim_backend.world import PROFILES, SAMPLE_MS, Profile

Floats = NDArray[np.float64]

BULLET_CPU_S = 156.0  # per simulated second at 1 kHz x 100 sub-steps, the faster of two objects
COST_BARS = {"dataset": 1.5, "realtime": 0.5}  # CPU s per simulated s on the prototype's machine
# The prototype's object, and others of many pieces.
SWEEPS = {
    "icosphere": Sweep(),
    "mug-50": Sweep(yaw_deg=100, height_mm=0, distance_mm=6),
    "chair-50": Sweep(yaw_deg=30, height_mm=-4, distance_mm=7, speed_mm_s=40),
    "gear-50": Sweep(yaw_deg=200, height_mm=2, distance_mm=5.6),
}
QUICK, QUICK_MS = ("icosphere", "mug-50"), 400


def run(quick: bool) -> list[Record]:
    """Measure both profiles on sweeps, and single whiskers beside beam theory and the elastica.

    Quick: the cost of two objects for 0.4 s from shortly before contact, nine drawn sweeps, every
    twentieth press; full: four objects, whole sweeps, every category of the catalogue three times,
    every press, and a record for each of the 30 whiskers.
    """
    names, ms = (QUICK, QUICK_MS) if quick else (tuple(SWEEPS), None)
    return [*_costs(names, ms), *active(quick), *catalogue(quick), *mechanics(quick)]


def simulate(name: str, profile: Profile) -> SweepSimulation:
    """One of `SWEEPS`, built: where the object starts does not depend on the profile."""
    return SweepSimulation(load_array("mouse"), _object(name), SWEEPS[name], profile)


def _object(name: str) -> TactileObject:
    if name != "icosphere":
        return load_object(name)
    ball = trimesh.creation.icosphere(subdivisions=2)
    ball.apply_scale(1 / ball.extents.max())
    return TactileObject(name, name, (ball,))


def _frames(simulation: SweepSimulation, samples: int) -> Floats:
    """CPU s of each frame of 1 ms, stepped one at a time, as a live source does."""
    cpu = np.empty(samples)
    for i in range(samples):
        began = time.thread_time()
        simulation.advance(1)
        cpu[i] = time.thread_time() - began
    return cpu


def cost(simulation: SweepSimulation, samples: int) -> float:
    """CPU s per simulated s of the next samples, in one go."""
    began = time.process_time()
    simulation.advance(samples)
    return (time.process_time() - began) / (samples * SAMPLE_MS * 1e-3)


def _costs(names: Iterable[str], ms: int | None) -> list[Record]:
    """The reference model beside every run: what slows the machine slows both."""
    simulate(QUICK[0], PROFILES["realtime"]).advance(50)  # compiled, once
    records, references = [], []
    costs: dict[str, list[float]] = {key: [] for key in COST_BARS}
    shares: dict[str, list[float]] = {key: [] for key in COST_BARS}
    frames, setups, each = [], [], []
    for name in names:
        reference = reference_cost(ms) if ms else reference_cost()
        references.append(reference)
        for key in COST_BARS:
            began = time.process_time()
            simulation = simulate(name, PROFILES[key])
            built = time.process_time() - began
            samples = ms or round(simulation.duration_ms / SAMPLE_MS)
            if key == "realtime":
                cpu = _frames(simulation, samples)
                setups.append(built)
                frames.append(float(np.percentile(cpu, 99)) * 1e3)
                costs[key].append(cpu.sum() / (samples * SAMPLE_MS * 1e-3))
            else:
                costs[key].append(cost(simulation, samples))
            shares[key].append(costs[key][-1] / reference)
            each.append(f"{name} {costs[key][-1]:.2f} {key}")
    sample = ", ".join(names) + (f", {ms} ms of each" if ms else ", whole sweeps")
    how = f"30 whiskers, one thread, process time; {sample}"
    records.append(
        Record(
            "sim.reference.cpu_s_per_s",
            float(np.median(references)),
            "CPU s/s",
            anchor=f"{PROTOTYPE_CPU_S} when its settings were chosen; "
            "the yardstick of the figures below",
            how=f"a fixed model, icosphere, {min(references):.2f} to {max(references):.2f}",
        )
    )
    for key, bar in COST_BARS.items():
        live = key == "realtime"
        way = "a 1 ms frame at a time, " if live else ""
        share = max(shares[key])
        records += [
            Record(
                f"sim.{key}.cost_over_reference",
                share,
                "x",
                f"<= {bar / PROTOTYPE_CPU_S:.2f}",
                f"{bar} CPU s/s where the reference costs {PROTOTYPE_CPU_S}",
                f"{way}{how}; dearest of {', '.join(f'{s:.2f}' for s in shares[key])}",
            ),
            Record(
                f"sim.{key}.cpu_s_per_s",
                max(costs[key]),
                "CPU s/s",
                anchor=f"{bar} is wanted of a quiet core of the prototype's machine",
                how=f"{way}dearest of {', '.join(e for e in each if e.endswith(key))}",
            ),
            Record(
                f"sim.{key}.speed_over_bullet",
                BULLET_CPU_S / max(costs[key]),
                "x",
                anchor="published simulator (Bullet, 1 kHz x 100 sub-steps): 156-179 CPU s/s",
                how=f"{BULLET_CPU_S:.0f} CPU s/s over the figure above",
            ),
        ]
    records += [
        Record(
            "sim.realtime.frame_p99",
            max(frames),
            "ms",
            "<= 1",
            "a frame is 1 ms of the array's life",
            f"CPU time of single frames; worst of {', '.join(f'{f:.2f}' for f in frames)}",
        ),
        Record(
            "sim.realtime.setup",
            1e3 * max(setups),
            "ms",
            f"<= {REST_SAMPLES * SAMPLE_MS:.0f}",
            "the rest between two objects, in which a live source builds the next",
            "process time; worst of all",
        ),
    ]
    return records
