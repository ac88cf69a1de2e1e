"""The whisker array as a MuJoCo model: tapered beams as chains of rigid links.

MuJoCo works in mm, mg and ms here (so forces are mN and moments uN m): in SI the inertia of a
link falls below the smallest that MuJoCo accepts. `read_base_loads` converts to N and N m.

Each whisker is cut into equal cells. The two hinges of a joint sit at a cell's midpoint and bend
the tip as much as the cell's piece of the Euler-Bernoulli beam would (see `joint_stiffness`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.core.stream import ArraySpec, Chunk
from tactile_rt.sim_backend.arrays.whisker_array import MOUNT, Mount, WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import (
    DAMPING_RATIO,
    Whisker,
    joint_stiffness,
    link_inertia,
    link_nodes,
    rotation,
)

__all__ = [
    "CHANNELS",
    "ENGINE",
    "JAMMED",
    "MOUNT",
    "PROFILES",
    "SAMPLE_MS",
    "UNITS",
    "Mount",
    "Profile",
    "add_whiskers",
    "array_spec",
    "empty_world",
    "engine_of",
    "engine_version",
    "quaternion",
    "read_base_loads",
    "set_damping",
    "stamp_samples",
    "world_spec",
]

CHANNELS = ("fx", "fy", "fz", "mx", "my", "mz")
UNITS = ("N", "N", "N", "N m", "N m", "N m")
SAMPLE_MS = 1.0  # output period: 1 kHz
ENGINE = "2"  # version of `rods`; other versions give other numbers
JAMMED = (
    "the simulation has become unstable: a whisker jams that is too stiff for this profile; "
    "sweep at a larger distance, or at a finer profile"
)
WHISKER_BIT, OBJECT_BIT = 1, 2  # collision groups: whiskers touch objects, never each other

# Contact is a soft layer on both surfaces. Whiskers sink through most of it under a usual load, so
# that on average they bend where the hard surfaces would bend them. Its impedance rises from a low
# value: if it were hard at its outside, a light tip would leave it after every touch, fall back by
# a whole time step's bend, and strike with a hundredfold force.
IMPEDANCE = (0.2, 0.99)  # at the outside of the layer, and deep in it
STIFFEST_AT = 1.2  # depth of full impedance, in thicknesses of both layers

# MuJoCo would print and write MUJOCO_LOG.TXT into the working directory;
# `MujocoWorld.advance` reads its warning counters instead.
mujoco.set_mju_user_warning(lambda message: None)


@dataclass(frozen=True)
class Profile:
    """The resolution of a simulation, and its engine.

    Attributes:
        links: The number of cells of every whisker, whatever its length.
        timestep_ms: The length of a physics step, ms; divides the 1 ms output period.
        layer_mm: The thickness of the soft layer that MuJoCo's contacts need on each of two
            touching surfaces, mm: thin for accurate moments at a light touch, thick against
            chatter at a coarse step.
        engine: The engine that steps sweeps: ``rods`` (the folder of that name) or ``mujoco``.
    """

    links: int
    timestep_ms: float
    layer_mm: float
    engine: str = "rods"


PROFILES = {
    "realtime": Profile(7, 0.5, 0.05),
    "dataset": Profile(10, 0.25, 0.025),
    "accurate": Profile(20, 0.1, 0.01),
    "mujoco": Profile(10, 0.25, 0.025, "mujoco"),
}


def engine_of(profile: Profile) -> str:
    """Return the profile's engine, or ``mujoco`` if numba, which compiles `rods`, is missing."""
    return profile.engine if find_spec("numba") is not None else "mujoco"


def engine_version(profile: Profile) -> str:
    """Return the `rods` engine's version, or ``mujoco``, to store with sets and recordings."""
    return ENGINE if engine_of(profile) == "rods" else "mujoco"


def array_spec(whiskers: tuple[Whisker, ...], name: str) -> ArraySpec:
    """Describe the base loads of an array.

    Mount frame: the head frame of the morphology, x lateral (away from the head), y rostral,
    z dorsal. Element frame: x along the whisker at its base, y towards the concave side of its
    plane, z = x cross y. Values are the force (N) and the moment about the base point (N m) that
    the whisker exerts on its follicle: a push on the tip along +y reads as fy > 0 and mz > 0.
    """
    return ArraySpec(
        name=name,
        elements=tuple(w.name for w in whiskers),
        grid=tuple((w.row, w.column) for w in whiskers),
        positions=tuple((w.base[0] * 1e-3, w.base[1] * 1e-3, w.base[2] * 1e-3) for w in whiskers),
        orientations=tuple(quaternion(w.orientation) for w in whiskers),
        channels=CHANNELS,
        units=UNITS,
        rate_hz=1e3 / SAMPLE_MS,
        frame="head",
    )


def world_spec(animals: Sequence[WhiskerArray]) -> ArraySpec:
    """Describe the base loads of all arrays in one world, as `array_spec` does for one.

    With several arrays, positions and orientations are in world axes.
    """
    if len(animals) == 1:
        return array_spec(animals[0].whiskers, animals[0].name)
    whiskers = [(a.mount.rotation, a.mount.position, w) for a in animals for w in a.whiskers]
    places = [(turn @ np.array(w.base) + np.array(at)) * 1e-3 for turn, at, w in whiskers]
    return replace(
        array_spec(tuple(w for _, _, w in whiskers), " and ".join(a.name for a in animals)),
        positions=tuple((float(x), float(y), float(z)) for x, y, z in places),
        orientations=tuple(quaternion(turn @ w.orientation) for turn, _, w in whiskers),
        frame="world",
    )


def stamp_samples(values: NDArray[np.float32], first: int = 0, start_ns: int = 0) -> Chunk:
    """Make a chunk of values, all valid, at the simulator's rate from sample `first` on."""
    seq = first + np.arange(len(values), dtype=np.int64)
    valid = np.ones(values.shape[:2], dtype=np.bool_)
    return Chunk(seq, start_ns + seq * round(SAMPLE_MS * 1e6), values, valid)


def quaternion(matrix: NDArray[np.float64]) -> tuple[float, float, float, float]:
    """Convert a rotation matrix to a unit quaternion (w, x, y, z), w >= 0."""
    q = np.empty(4)
    mujoco.mju_mat2Quat(q, np.ascontiguousarray(matrix, dtype=np.float64).ravel())
    q = q if q[0] >= 0 else -q
    # Rounding makes specs equal that were computed with different machines' libm.
    w, x, y, z = np.round(q, 9).tolist()
    return w, x, y, z


def empty_world(profile: Profile) -> mujoco.MjSpec:
    """Make a MuJoCo world without bodies, with solver settings for whisker contact."""
    world = mujoco.MjSpec()
    option = world.option
    option.timestep = profile.timestep_ms
    # Implicit in stiffness: stable although the step is long against a short whisker's period.
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.gravity = (0.0, 0.0, 0.0)  # a whisker sags by less than its own diameter
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = 5.0  # below, contacts creep under slow slip and lose 15-40 % of the force
    option.enableflags |= mujoco.mjtEnableBit.mjENBL_DIAGEXACT
    default = world.default.geom
    default.solref = (2 * profile.timestep_ms, 1.0)
    default.solimp = (*IMPEDANCE, STIFFEST_AT * 2 * profile.layer_mm, 0.5, 2.0)
    default.margin = profile.layer_mm
    default.friction = (0.0, 0.0, 0.0)  # of objects: only the whisker's own friction counts
    default.condim = 3
    return world


def add_whiskers(
    world: mujoco.MjSpec,
    whiskers: tuple[Whisker, ...],
    profile: Profile,
    mount: Mount = MOUNT,
    head: str = "head",
) -> mujoco.MjsBody:
    """Add an array to a world, with force and torque sensors at every whisker's base."""
    body = world.worldbody.add_body(name=head, pos=mount.position, quat=quaternion(mount.rotation))
    for whisker in whiskers:
        _add_whisker(world, body, whisker, profile)
    return body


def _add_whisker(
    world: mujoco.MjSpec, head: mujoco.MjsBody, whisker: Whisker, profile: Profile
) -> None:
    n = profile.links
    cell = whisker.length / n
    s = link_nodes(whisker, n)
    nodes = whisker.centreline(s)
    middle = (s[:-1] + s[1:]) / 2
    radii = whisker.radius(middle)
    lengths = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
    stiffness = [joint_stiffness(whisker, i * cell, (i + 1) * cell) for i in range(n)]
    headings = np.arctan2(np.diff(nodes[:, 1]), np.diff(nodes[:, 0]))

    body = head.add_body(name=whisker.name, pos=whisker.base, quat=quaternion(whisker.orientation))
    site = body.add_site(name=whisker.name)
    for kind, what in (
        (mujoco.mjtSensor.mjSENS_FORCE, "force"),
        (mujoco.mjtSensor.mjSENS_TORQUE, "torque"),
    ):
        world.add_sensor(
            name=f"{what} {whisker.name}",
            type=kind,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=site.name,
        )
    heading, origin = 0.0, np.zeros(3)
    for i in range(n + 1):
        # Each link's frame: x along the link, z normal to the whisker's resting plane.
        turn = headings[i] - heading
        body = body.add_body(
            pos=rotation("z", -heading) @ (nodes[i] - origin),
            quat=quaternion(rotation("z", turn)),
        )
        heading, origin = headings[i], nodes[i]
        # The first half cell is clamped, or rotates on a compliant mount.
        if i > 0 or whisker.mount_stiffness:
            for axis in ((0, 1, 0), (0, 0, 1)):
                body.add_joint(
                    name=f"{whisker.name} {i} {'yz'[axis[2]]}",
                    type=mujoco.mjtJoint.mjJNT_HINGE,
                    axis=axis,
                    stiffness=[stiffness[i - 1] if i else whisker.mount_stiffness * 1e6, 0, 0],
                )
        mass, centre, axial, transverse = link_inertia(whisker, s[i], s[i + 1])
        body.explicitinertial = True
        body.mass = mass
        body.ipos = (centre, 0, 0)
        body.inertia = (axial, transverse, transverse)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=(0, 0, 0, lengths[i], 0, 0),
            size=(radii[i], 0, 0),
            contype=WHISKER_BIT,
            conaffinity=0,
            friction=(whisker.friction, 0.0, 0.0),
            group=WHISKER_BIT,
            rgba=(0.25, 0.2, 0.15, 1.0),
        )


def set_damping(model: mujoco.MjModel, whiskers: Iterable[Whisker] = ()) -> dict[str, float]:
    """Set every whisker's joint damping to give its first mode the described damping ratio.

    It is Rayleigh damping: c = beta k with beta = 2 zeta / omega_1. The integrator itself adds h k,
    which is subtracted; where that alone exceeds the target (short whiskers, coarse steps) the
    whisker stays over-damped.

    Args:
        whiskers: their damping ratios are used; other whiskers of the model get the published one.

    Returns:
        First resonance of every whisker, Hz.
    """
    ratios = {w.name: w.damping_ratio for w in whiskers}
    mounts = {w.name: w.mount_damping * 1e9 for w in whiskers}  # uN m ms / rad
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    stiffness = model.jnt_stiffness[model.dof_jntid]
    words = [model.joint(j).name.split() for j in model.dof_jntid]
    owner = np.array([w[0] for w in words])
    at_base = np.array([w[1] == "0" for w in words])
    resonances = {}
    for name in dict.fromkeys(owner[stiffness > 0].tolist()):
        dofs = np.flatnonzero((owner == name) & (stiffness > 0))
        k = stiffness[dofs]
        # The largest eigenvalue of K^-1 M is 1 / omega_1^2.
        flexible = mass[np.ix_(dofs, dofs)] / np.sqrt(np.outer(k, k))
        omega = 1 / np.sqrt(np.linalg.eigvalsh(flexible)[-1])  # rad / ms
        beta = 2 * ratios.get(name, DAMPING_RATIO) / omega
        model.dof_damping[dofs] = max(beta - model.opt.timestep, 0.0) * k
        given = dofs[at_base[dofs]]
        own = mounts.get(name, 0.0) - model.opt.timestep * stiffness[given]
        model.dof_damping[given] = np.maximum(own, 0.0)
        resonances[name] = float(omega / (2 * np.pi) * 1e3)
    return resonances


def read_base_loads(sensors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert MuJoCo's sensor readings (..., 6 elements) into (..., element, 6) N and N m.

    MuJoCo reports the load of the follicle on the whisker, in mN and uN m; this is the reaction.
    """
    to_si = np.array([1e-3] * 3 + [1e-6] * 3)
    loads: NDArray[np.float64] = -sensors.reshape(*sensors.shape[:-1], -1, 6) * to_si
    return loads
