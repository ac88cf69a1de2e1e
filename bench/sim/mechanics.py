"""Records of single whiskers beside beam theory, and of the array at rest."""

from collections.abc import Callable
from dataclasses import replace

import mujoco
import numpy as np

from bench.sim.beams import BeamErrors, beams, flat, measure
from bench.sim.pegs import SLIDE_MM_S, press, presses
from tactile_rt.evidence.records import Record
from tactile_rt.sim_backend.arrays.species import mouse_whiskers
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import FRICTION
from tactile_rt.sim_backend.objects.catalogue import TactileObject
from tactile_rt.sim_backend.objects.solids import box
from tactile_rt.sim_backend.sweep import Sweep, SweepSimulation
from tactile_rt.sim_backend.world import (
    MOUNT,
    PROFILES,
    Profile,
    add_whiskers,
    empty_world,
    read_base_loads,
    set_damping,
)

__all__ = ["FINE", "HEARD_HZ", "drift", "mechanics"]

SHORT_MIDDLE_LONG = ("E5", "C2", "B0")
HEARD_HZ = 400.0  # resonances above are too near the Nyquist frequency of a 1 kHz output
FINE = 0.05  # ms: steps of the profile in which whiskers ring as they should
GATED = ("dataset",)


def mechanics(quick: bool) -> list[Record]:
    """Beams, pegs, rest and friction, of both profiles; quick: three whiskers and their pegs."""
    names = SHORT_MIDDLE_LONG if quick else tuple(beams())
    records = []
    for key in ("dataset", "realtime"):
        records += _beams(key, names)
        records += _pegs(key)
        records += _array(key)
    return records + _ringing(names)


def _worst(errors: dict[str, BeamErrors], of: Callable[[BeamErrors], float]) -> tuple[float, str]:
    """Largest absolute value, and whose."""
    name = max(errors, key=lambda n: abs(of(errors[n])))
    return abs(of(errors[name])), f"worst of {len(errors)} whiskers: {name}"


def _beams(key: str, names: tuple[str, ...]) -> list[Record]:
    known, profile = beams(), PROFILES[key]
    errors = {n: measure(flat(n), known[n], profile) for n in names}
    kinds: tuple[tuple[str, str, float, str, str, Callable[[BeamErrors], float]], ...] = (
        ("static_error", "%", 100, "<= 1", "tip pushed by 1e-4 of the length", lambda e: e.static),
        ("resonance_error", "%", 100, "<= 0.5", "the chain linearised", lambda e: e.resonance),
        ("sag_error", "%", 100, "<= 1", "under gravity in the whisker's plane", lambda e: e.sag),
        ("reaction_error", "", 1, "<= 1e-6", "base loads under a known tip force; both profiles",
         lambda e: e.reaction),
    )  # fmt: skip
    records = []
    for what, unit, scale, bar, how, of in kinds:
        value, whose = _worst(errors, of)
        gated = bar if key in GATED or what == "reaction_error" else ""
        anchor = "Euler-Bernoulli, tapered and curved"
        records.append(
            Record(f"sim.{key}.{what}", scale * value, unit, gated, anchor, f"{whose}; {how}")
        )
    if len(names) > len(SHORT_MIDDLE_LONG):
        records += [
            Record(
                f"sim.{key}.whisker.{n}",
                100 * e.static,
                "% static",
                how=f"{known[n].resonance_hz:.0f} Hz; resonance {100 * e.resonance:+.2f} %, rings "
                f"{100 * e.ringing:+.1f} % off with a damping ratio of {e.damping:+.3f} more, "
                f"sag {100 * e.sag:+.2f} %",
            )
            for n, e in errors.items()
        ]
    return records


def _ringing(names: tuple[str, ...]) -> list[Record]:
    known = beams()
    profile = replace(PROFILES["accurate"], timestep_ms=FINE)
    errors = {
        n: measure(flat(n), known[n], profile) for n in names if known[n].resonance_hz < HEARD_HZ
    }
    ringing, whose = _worst(errors, lambda e: e.ringing)
    damping, whose_damping = _worst(errors, lambda e: e.damping)
    how = f"below {HEARD_HZ:.0f} Hz, at {FINE} ms; Prony's method on the first mode set free"
    return [
        Record("sim.fine.ringing_error", 100 * ringing, "%", "<= 3",
               "Euler-Bernoulli, tapered and curved", f"{whose}; {how}"),
        Record("sim.fine.damping_error", damping, "", "<= 0.02",
               "damping ratio of the first mode, 0.32", f"{whose_damping}; {how}"),
    ]  # fmt: skip


def _pegs(key: str) -> list[Record]:
    cases = presses()
    found = [press(case, PROFILES[key]) for case in cases]
    gated, records = key in GATED, []
    for what, unit, bar, values in (
        ("peg_moment_error", "%", "<= 5", [100 * abs(p.moment_error) for p in found]),
        ("peg_force_error", "%", "", [100 * p.force_error for p in found]),
        ("peg_contact_error", "mm", "<= 0.2", [p.contact_error for p in found]),
        ("peg_lost", "%", "", [100 * p.lost for p in found]),
    ):
        worst = cases[int(np.argmax(values))]
        by_whisker = ", ".join(
            f"{n} {max(v for v, c in zip(values, cases, strict=True) if c.whisker == n):.2f}"
            for n in SHORT_MIDDLE_LONG
        )
        records.append(
            Record(
                f"sim.{key}.{what}",
                max(values),
                unit,
                bar if gated else "",
                "elastica over a peg, frictionless and sliding either way at 0.5",
                f"worst of {len(cases)}: {worst.whisker} {worst.bend} at {worst.place:g} L, "
                f"{worst.depth:g} L deep, friction {worst.friction:g}, {SLIDE_MM_S:g} mm/s; "
                f"{by_whisker}; median {float(np.median(values)):.2f}",
            )
        )
    return records


def _array(key: str) -> list[Record]:
    return [
        Record(
            f"sim.{key}.drift",
            drift(PROFILES[key]),
            "N or N m",
            "== 0",
            "nothing touches the array",
            "largest reading of 200 ms at rest, 30 whiskers on their mount",
        ),
        Record(
            f"sim.{key}.friction_error",
            100 * abs(_sliding_friction(PROFILES[key]) / FRICTION - 1),
            "%",
            "<= 2",
            f"Coulomb: {FRICTION} of the normal force, along the object's motion",
            "C2 on the flat side of a block, the last 50 of 500 ms",
        ),
    ]


def drift(profile: Profile) -> float:
    """Largest base load (N or N m) of the untouched array over 200 ms."""
    world = empty_world(profile)
    add_whiskers(world, mouse_whiskers(), profile)
    model = world.compile()
    set_damping(model)
    data, largest = mujoco.MjData(model), 0.0
    for _ in range(round(200 / profile.timestep_ms)):
        mujoco.mj_step(model, data)
        largest = max(largest, float(abs(read_base_loads(data.sensordata)).max()))
    return largest


def _sliding_friction(profile: Profile) -> float:
    """Drag along the motion (-y) over the normal force (along x) of a face sliding past C2."""
    c2 = next(w for w in mouse_whiskers() if w.name == "C2")
    block = TactileObject("block", "block", (box((0, 0, 0), (1, 1, 1)),))
    simulation = SweepSimulation(WhiskerArray("C2", (c2,)), block, Sweep(gap_mm=0.2), profile)
    force = simulation.advance(500)[-50:, 0, :3].mean(axis=0)
    normal, drag, _ = MOUNT.rotation @ c2.orientation @ force
    return float(drag / normal)
