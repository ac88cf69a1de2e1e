"""Whiskers pressed on a peg, beside the elastica: what contact does to the base loads.

The solutions stand in `data/elastica.csv`, one press a line; `tests/helpers/beams.py` works them
out and a test compares the two.
"""

import csv
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import resources

import mujoco
import numpy as np
from numpy.typing import NDArray

from bench.sim.beams import ORIGIN, flat
from tactile_rt.sim_backend.world import (
    OBJECT_BIT,
    WHISKER_BIT,
    Profile,
    add_whiskers,
    empty_world,
    read_base_loads,
    set_damping,
)

__all__ = ["PEG_RADIUS_MM", "Press", "Pressed", "press", "press_states", "presses"]

Floats = NDArray[np.float64]

PEG_RADIUS_MM = 1.0
CLEAR = 0.03  # how far from the whisker the peg starts, of the whisker's length
RUN_UP = 0.1  # how far it slides along the whisker before it is at its place, of the length
PRESS_PER_S = 1.0  # whisker lengths per second
SLIDE_MM_S = 30.0  # as objects do in sweeps
SETTLE_MS, WINDOW_MS = 30.0, 2.0  # window: averaged over, around the moment at the place


@dataclass(frozen=True)
class Press:
    """A rigid peg pressed on one whisker and slid along it, and what the elastica says of it.

    The whisker lies in the x-y plane with its base at the origin, leaves it along +x and curves
    towards +y. Attributes are in mm, mN and uN m.

    Attributes:
        whisker: The name of the whisker.
        bend: ``straight``: the whisker without its curve; ``convex``, ``concave``: the side of
            the curved whisker that the peg presses on, from below and from above.
        place: Coordinate x of the peg's centre, as a share of the whisker's length.
        depth: Way of the peg along y past first touch, as a share of the whisker's length.
        friction: Coulomb coefficient; negative: of a peg that slides towards the base.
        centre: Place (x, y) of the peg's centre when it is pressed, mm.
        moment: Moment on the whisker's base about z, uN m.
        force: Force (x, y) on the whisker's base, mN.
        contact: Place (x, y) at which the surfaces touch, mm.
    """

    whisker: str
    bend: str
    place: float
    depth: float
    friction: float
    centre: tuple[float, float]
    moment: float
    force: tuple[float, float]
    contact: tuple[float, float]

    @property
    def side(self) -> int:
        """+1: the peg comes from above; -1: from below."""
        return -1 if self.bend == "convex" else 1


@dataclass(frozen=True)
class Pressed:
    """What the simulated whisker does on the peg, beside the elastica.

    Attributes:
        moment_error: Relative error of the base moment.
        force_error: Length of the error of the base force, relative to the force.
        contact_error: Distance between the points of contact, mm.
        deepest: Largest depth that a link went into the peg, mm.
        ripple: Standard deviation of the base moment about its trend, relative to the moment.
        lost: Share of the steps without contact.
    """

    moment_error: float
    force_error: float
    contact_error: float
    deepest: float
    ripple: float
    lost: float


def presses() -> list[Press]:
    """The presses whose elastica is known."""
    text = resources.files(__package__).joinpath("data/elastica.csv").read_text(encoding="utf-8")
    return [
        Press(
            whisker=row["whisker"],
            bend=row["bend"],
            place=float(row["place"]),
            depth=float(row["depth"]),
            friction=float(row["friction"]),
            centre=(float(row["centre_x_mm"]), float(row["centre_y_mm"])),
            moment=float(row["moment_uNm"]),
            force=(float(row["force_x_mN"]), float(row["force_y_mN"])),
            contact=(float(row["contact_x_mm"]), float(row["contact_y_mm"])),
        )
        for row in csv.DictReader(x for x in text.splitlines() if not x.startswith("#"))
    ]


def press(case: Press, profile: Profile, slide_mm_s: float = SLIDE_MM_S) -> Pressed:
    """Simulate a press: the peg comes along y, rests, and slides along x past its place."""
    loads, contacts, deepest = [], [], 0.0
    for model, data in _window(case, profile, slide_mm_s):
        loads.append(read_base_loads(data.sensordata)[0] * ([1e3] * 3 + [1e6] * 3))
        deepest = max(deepest, -float(data.contact.dist.min(initial=0.0)))
        contacts.append(_contact(model, data))
    load, held = np.mean(loads, axis=0), [c for c in contacts if c is not None]
    point = np.mean(held, axis=0) if held else np.full(2, np.inf)
    moments, steps = np.array(loads)[:, 5], np.arange(len(loads))
    trend = np.polynomial.Polynomial.fit(steps, moments, 1)
    return Pressed(
        moment_error=float(load[5] / case.moment - 1),
        force_error=float(np.linalg.norm(load[:2] - case.force) / np.linalg.norm(case.force)),
        contact_error=float(np.linalg.norm(point - case.contact)),
        deepest=deepest,
        ripple=float(np.std(moments - trend(steps)) / abs(case.moment)),
        lost=1 - len(held) / len(contacts),
    )


def press_states(case: Press, profile: Profile) -> Floats:
    """(joint, 3) where the joints of a pressed whisker are, mm, from the clamp outwards."""
    places = [data.xanchor.copy() for _, data in _window(case, profile, SLIDE_MM_S)]
    middle: Floats = places[len(places) // 2]
    return np.concatenate([np.zeros((1, 3)), middle])


def _window(
    case: Press, profile: Profile, slide_mm_s: float
) -> Iterator[tuple[mujoco.MjModel, mujoco.MjData]]:
    """The simulation after each step around the moment when the peg is at its place."""
    friction = abs(case.friction)
    whisker = replace(flat(case.whisker, case.bend), friction=friction)
    world = empty_world(profile)
    world.default.geom.friction = (friction, 0.0, 0.0)
    add_whiskers(world, (whisker,), profile, ORIGIN)
    world.worldbody.add_body(name="peg", mocap=True).add_geom(
        type=mujoco.mjtGeom.mjGEOM_CYLINDER,
        size=(PEG_RADIUS_MM, 5.0, 0.0),
        friction=(friction, 0.0, 0.0),
        contype=OBJECT_BIT,
        conaffinity=WHISKER_BIT,
    )
    model = world.compile()
    set_damping(model, (whisker,))
    model.flg_surfacevel = True  # as in `SweepSimulation`: friction must see the peg move
    data = mujoco.MjData(model)
    peg = int(np.flatnonzero(model.geom_contype == OBJECT_BIT)[0])
    window = round(WINDOW_MS / profile.timestep_ms)
    path = _path(case, whisker.length, profile.timestep_ms, slide_mm_s * 1e-3)
    for step, (place, velocity) in enumerate(zip(*path, strict=True)):
        model.geom_surfacevel[peg, :2] = velocity
        data.mocap_pos[0, :2] = place
        mujoco.mj_step(model, data)
        if step >= len(path[0]) - window:
            yield model, data


def _path(case: Press, length: float, step: float, slide: float) -> tuple[Floats, Floats]:
    """Places (step, 2) mm and velocities (step, 2) mm/ms of the peg."""
    way = np.array([-1.0 if case.friction < 0 else 1.0, 0.0])
    down = np.array([0.0, -float(case.side)])
    press = length * PRESS_PER_S * 1e-3
    velocity = np.concatenate(
        [
            np.tile(press * down, (round((case.depth + CLEAR) * length / press / step), 1)),
            np.zeros((round(SETTLE_MS / step), 2)),
            np.tile(slide * way, (round((RUN_UP * length / slide + WINDOW_MS / 2) / step), 1)),
        ]
    )
    places = np.cumsum(velocity * step, axis=0)
    at = len(places) - round(WINDOW_MS / 2 / step)
    middle = (places[at - 1] + places[at]) / 2  # between the two steps in the window's middle
    return places - middle + case.centre, velocity


def _contact(model: mujoco.MjModel, data: mujoco.MjData) -> Floats | None:
    """(2,) mean of the points of contact (mm), weighed by their forces."""
    force, total, moment = np.zeros(6), 0.0, np.zeros(2)
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, force)
        total += force[0]
        moment += force[0] * data.contact.pos[i, :2]
    return moment / total if total else None
