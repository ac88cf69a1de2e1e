"""Whiskers pressed on a peg, beside the elastica: what contact does to the base loads.

The solutions stand in `data/elastica.csv.gz`, one press a line; `tests/helpers/beams.py` works them
out and a test compares the two.
"""

import csv
import gzip
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import NDArray

from bench.sim.beams import ORIGIN, flat
from tactile_rt.sim_backend.rods.rod import make_rod
from tactile_rt.sim_backend.rods.world import Piece, RodWorld
from tactile_rt.sim_backend.world import (
    OBJECT_BIT,
    SAMPLE_MS,
    WHISKER_BIT,
    Profile,
    add_whiskers,
    empty_world,
    engine_of,
    read_base_loads,
    set_damping,
)

Floats = NDArray[np.float64]

PEG_RADIUS_MM = 1.0
PEG = Piece(np.array([[0.0, 0.0, -5.0], [0.0, 0.0, 5.0]]), np.zeros((0, 4)), PEG_RADIUS_MM)
CLEAR = 0.03  # how far from the whisker the peg starts, of the whisker's length
RUN_UP, RUN_UP_MM = 0.1, 5.0  # how far it slides before it is at its place: of the length, at most
FASTEST_MM_S = 30.0  # of pressing, and never more than a length per second
SLIDE_MM_S = 30.0  # as objects do in sweeps
SETTLE_MS, SLOW_MS = 10.0, 10.0  # rest before; of whiskers with longer periods
SETTLE_PERIODS = 3.0  # of theirs: a long one is thrown off the peg, and comes back
WINDOW_MS = 2.0  # averaged over, around the moment at the place
RIPPLE_MS = 8  # before the end, over which samples should lie on a line


@dataclass(frozen=True)
class Press:
    """A rigid peg pressed on one whisker and slid along it, and what the elastica says of it.

    The whisker lies in the x-y plane with its base at the origin, leaves it along +x and curves
    towards +y. Attributes are in mm, mN and uN m.

    Attributes:
        whisker: The array and the name of the whisker, e.g. ``mouse C2``.
        bend: ``straight``: the whisker without its curve; ``convex``, ``concave``: the side of
            the curved whisker that the peg presses on, from below and from above.
        place: Coordinate x of the peg's centre, as a share of the whisker's length.
        depth: Way of the peg along y past first touch, mm.
        friction: Coulomb coefficient; negative: of a peg that slides towards the base.
        centre: Place (x, y) of the peg's centre when it is pressed, mm.
        moment: Moment on the whisker's base about z, uN m.
        force: Force (x, y) on the whisker's base, mN.
        contact: Place (x, y) at which the surfaces touch, mm.
        arc: Arc length of the contact from the base, mm.
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
    arc: float

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
        contact_error: Distance between the points of contact along the whisker, mm.
        ripple: Standard deviation of the samples of the base moment about their trend, relative
            to the moment.
        lost: Share of the time without contact.
    """

    moment_error: float
    force_error: float
    contact_error: float
    ripple: float
    lost: float


@cache
def presses() -> tuple[Press, ...]:
    """The presses whose elastica is known."""
    packed = resources.files(__package__).joinpath("data/elastica.csv.gz").read_bytes()
    lines = gzip.decompress(packed).decode().splitlines()
    return tuple(
        Press(
            whisker=row["whisker"],
            bend=row["bend"],
            place=float(row["place"]),
            depth=float(row["depth_mm"]),
            friction=float(row["friction"]),
            centre=(float(row["centre_x_mm"]), float(row["centre_y_mm"])),
            moment=float(row["moment_uNm"]),
            force=(float(row["force_x_mN"]), float(row["force_y_mN"])),
            contact=(float(row["contact_x_mm"]), float(row["contact_y_mm"])),
            arc=float(row["arc_mm"]),
        )
        for row in csv.DictReader(x for x in lines if not x.startswith("#"))
    )


def press(case: Press, profile: Profile, slide_mm_s: float = SLIDE_MM_S) -> Pressed:
    """Simulate a press: the peg comes along y, rests, and slides along the whisker past its place.

    It slides at a constant depth, by the parabola of the resting whisker.
    """
    if engine_of(profile) == "mujoco":
        loads, contacts = _by_mujoco(case, profile, slide_mm_s)
    else:
        loads, contacts = _by_rods(case, profile, slide_mm_s)
    moments, steps = loads[-RIPPLE_MS:, 5], np.arange(RIPPLE_MS)
    trend = np.polynomial.Polynomial.fit(steps, moments, 1)
    window = round(WINDOW_MS / SAMPLE_MS)
    load = loads[-window:].mean(axis=0)
    _, force, lever = contacts[-window:].mean(axis=0)
    return Pressed(
        moment_error=float(load[5] / case.moment - 1),
        force_error=float(np.linalg.norm(load[:2] - case.force) / np.linalg.norm(case.force)),
        contact_error=float(abs(lever / force - case.arc)) if force else np.inf,
        ripple=float(np.std(moments - trend(steps)) / abs(case.moment)),
        lost=round(float(1 - contacts[-RIPPLE_MS:, 0].mean()), 9),  # shares of steps add up so
    )


def _by_rods(case: Press, profile: Profile, slide_mm_s: float) -> tuple[Floats, Floats]:
    """(sample, 6) loads in mN and uN m, (sample, 3) contacts with arc lengths in mm."""
    whisker = replace(flat(case.whisker, case.bend), friction=abs(case.friction))
    root = np.concatenate([np.zeros((1, 3)), whisker.orientation])[None]
    steps = round(SAMPLE_MS / profile.timestep_ms)
    world = RodWorld((whisker,), root, (PEG,), profile.links, steps)
    loads, contacts = world.advance(_path(case, SAMPLE_MS, slide_mm_s))
    return loads[:, 0] * ([1e3] * 3 + [1e6] * 3), contacts[:, 0] * (1.0, 1e3, 1e6)


def _by_mujoco(case: Press, profile: Profile, slide_mm_s: float) -> tuple[Floats, Floats]:
    loads, contacts = [], []
    for model, data in _steps(case, profile, slide_mm_s):
        loads.append(read_base_loads(data.sensordata)[0] * ([1e3] * 3 + [1e6] * 3))
        contacts.append(_contact(model, data))
    steps = round(SAMPLE_MS / profile.timestep_ms)

    def samples(values: list[Floats]) -> Floats:
        rows = np.array(values)
        kept = rows[len(rows) % steps :]
        means: Floats = kept.reshape(-1, steps, rows.shape[1]).mean(axis=1)
        return means

    return samples(loads), samples(contacts)


def press_states(case: Press, profile: Profile) -> Floats:
    """(joint, 3) where the joints of a pressed whisker are, mm, from the clamp outwards."""
    places = [data.xanchor[::2].copy() for _, data in _steps(case, profile, SLIDE_MM_S)]
    middle: Floats = places[-round(WINDOW_MS / 2 / profile.timestep_ms)]
    return np.concatenate([np.zeros((1, 3)), middle])


def _steps(
    case: Press, profile: Profile, slide_mm_s: float
) -> Iterator[tuple[mujoco.MjModel, mujoco.MjData]]:
    """The simulation by MuJoCo after each step."""
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
    model.flg_surfacevel = True  # as in `MujocoWorld`: friction must see the peg move
    data = mujoco.MjData(model)
    peg = int(np.flatnonzero(model.geom_contype == OBJECT_BIT)[0])
    path = _path(case, profile.timestep_ms, slide_mm_s)[:, :2]
    for before, after in pairwise(path):
        model.geom_surfacevel[peg, :2] = (after - before) / profile.timestep_ms
        data.mocap_pos[0, :2] = after
        mujoco.mj_step(model, data)
        yield model, data


def _path(case: Press, step: float, slide_mm_s: float) -> Floats:
    """(step + 1, 3) places of the peg, mm; it is at its place half a window before the end."""
    whisker = flat(case.whisker, case.bend)
    length, a = whisker.length, whisker.curvature
    slope = 2 * a * case.contact[0]
    slide = slide_mm_s * 1e-3 * step / np.hypot(1.0, slope)
    run_up = min(RUN_UP * length, RUN_UP_MM)
    count = round((run_up / (slide_mm_s * 1e-3) + WINDOW_MS / 2) / step)
    dx = slide * (np.arange(count + 1) - (count - round(WINDOW_MS / 2 / step)))
    dx *= -1.0 if case.friction < 0 else 1.0
    x, y = case.centre
    along = np.stack([x + dx, y + slope * dx + a * dx**2, 0 * dx], axis=1)
    speed = min(FASTEST_MM_S, length) * 1e-3 * step * case.side
    down = along[0] + np.outer(
        np.arange(round((case.depth + CLEAR * length) / abs(speed)), -1, -1), (0.0, speed, 0.0)
    )
    period = 1e3 / make_rod(whisker, 10, 1).resonance_hz
    settle = SETTLE_PERIODS * period if period > SLOW_MS else SETTLE_MS
    rest = np.repeat(along[:1], round(settle / step), axis=0)
    return np.concatenate([down, rest, along[1:]])


def _contact(model: mujoco.MjModel, data: mujoco.MjData) -> Floats:
    """(3,) whether there is contact, its force (mN), and that times the distance from the base."""
    force, felt = np.zeros(6), np.zeros(3)
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, force)
        felt += (0.0, force[0], force[0] * float(np.linalg.norm(data.contact.pos[i])))
    felt[0] = felt[1] > 0
    return felt
