"""An array and an object as one MuJoCo model: the reference engine and the source of pictures.

The object is a mocap body: prescribed motion leaves the whiskers independent of each other.
"""

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
import trimesh
from mujoco import rollout
from numpy.typing import NDArray

from tactile_rt.core.errors import SourceError
from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Floats, Whisker, link_nodes
from tactile_rt.sim_backend.world import (
    JAMMED,
    OBJECT_BIT,
    SAMPLE_MS,
    WHISKER_BIT,
    Profile,
    add_whiskers,
    empty_world,
    read_base_loads,
    set_damping,
)

# Additive, so that they can be averaged over time like loads.
CONTACT_CHANNELS = ("touching", "normal force, N", "normal force x arc length, N m")
TOUCHING_SHARE = 0.5  # of a sample's time
UNSTABLE = tuple(
    int(kind)
    for kind in (
        mujoco.mjtWarning.mjWARN_BADQPOS,
        mujoco.mjtWarning.mjWARN_BADQVEL,
        mujoco.mjtWarning.mjWARN_BADQACC,
    )
)


class ContactProbe:
    """A reader that computes contacts from simulation states, on its own MuJoCo data."""

    def __init__(
        self, model: mujoco.MjModel, whiskers: Sequence[Whisker], profile: Profile
    ) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._owner = np.full(model.ngeom, -1)
        self._start, self._stretch = np.zeros(model.ngeom), np.zeros(model.ngeom)
        self._ends = np.zeros(model.ngeom)
        self._count = len(whiskers)
        for i, whisker in enumerate(whiskers):
            nodes = link_nodes(whisker, profile.links)
            first = model.body(whisker.name).id + 1  # a chain's bodies are consecutive
            geoms = model.body_geomadr[first : first + len(nodes) - 1]
            self._owner[geoms] = i
            self._start[geoms], self._ends[geoms] = nodes[:-1], np.diff(nodes)
            # Links are chords: on a curved whisker a mm of chord is more than a mm of arc.
            self._stretch[geoms] = np.diff(nodes) / (2 * model.geom_size[geoms, 1])

    def read(self, state: Floats, place: Floats) -> Floats:
        """Compute each whisker's contact with the object in one state.

        Args:
            place: (3,) position of the object during the step, mm.

        Returns:
            (whisker, 3) `CONTACT_CHANNELS`, summed over the whisker's contacts.
        """
        model, data = self._model, self._data
        mujoco.mj_setState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        data.mocap_pos[0] = place
        mujoco.mj_forwardSkip(model, data, mujoco.mjtStage.mjSTAGE_NONE, 1)
        data.qacc_warmstart[:] = data.qacc
        felt = np.zeros((self._count, len(CONTACT_CHANNELS)))
        if not data.ncon:
            return felt
        pairs, row = data.contact.geom, data.contact.efc_address
        # One of a contact's two geoms is a link; elliptic cones have the normal force first.
        link = np.where(self._owner[pairs[:, 0]] >= 0, pairs[:, 0], pairs[:, 1])
        other = pairs.sum(axis=1) - link
        force = np.where(row >= 0, data.efc_force[np.maximum(row, 0)], 0.0) * 1e-3
        real = (force > 0) & (self._owner[link] >= 0) & (model.geom_contype[other] == OBJECT_BIT)
        link, force = link[real], force[real]
        body = model.geom_bodyid[link]
        along = np.einsum(
            "ci,ci->c",
            data.contact.pos[real] - data.xpos[body],
            data.xmat[body].reshape(-1, 3, 3)[:, :, 0],
        )
        into = np.clip(along * self._stretch[link], 0.0, self._ends[link])
        arc = (self._start[link] + into) * 1e-3
        for channel, value in enumerate((np.ones_like(force), force, force * arc)):
            np.add.at(felt[:, channel], self._owner[link], value)
        felt[:, 0] = felt[:, 0] > 0
        return felt


def contact_distances(felt: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return force-weighted arc lengths (m) from base to contact; NaN without contact.

    A whisker touches if it is in contact for at least half of the sample's time.

    Args:
        felt: (..., 3) `CONTACT_CHANNELS`, averaged over the time of each sample.
    """
    touching = (felt[..., 0] >= TOUCHING_SHARE) & (felt[..., 1] > 0)
    distances: NDArray[np.float32] = np.where(
        touching, felt[..., 2] / np.where(touching, felt[..., 1], 1.0), np.nan
    ).astype(np.float32)
    return distances


def add_piece(
    world: mujoco.MjSpec, body: mujoco.MjsBody, name: str, corners: Floats, **faces: Any
) -> None:
    """Add a convex piece with (corner, 3) corners, mm, to an object's body."""
    world.add_mesh(name=name, uservert=corners.astype(np.float32).ravel(), **faces)
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        contype=OBJECT_BIT,
        conaffinity=WHISKER_BIT,
        group=OBJECT_BIT,
        rgba=(0.75, 0.55, 0.3, 1.0),
    )


def sweep_model(
    animals: Sequence[WhiskerArray],
    names: set[str],
    pieces: Sequence[trimesh.Trimesh],
    profile: Profile,
) -> mujoco.MjModel:
    """Compile the MuJoCo model of a sweep, with the named whiskers only."""
    world = empty_world(profile)
    for animal in animals:
        some = tuple(w for w in animal.whiskers if w.name in names)
        add_whiskers(world, some, profile, animal.mount, f"head {animal.name}")
    body = world.worldbody.add_body(name="object", mocap=True)
    for i, piece in enumerate(pieces):
        faces = piece.faces.astype(np.int32).ravel()
        add_piece(world, body, f"piece {i}", piece.vertices, userface=faces)
    model = world.compile()
    set_damping(model, [w for animal in animals for w in animal.whiskers])
    return model


class MujocoWorld:
    """The `sweep_simulation.World` whose engine is MuJoCo.

    Args:
        start: (3,) initial position of the object, mm.
    """

    def __init__(
        self, model: mujoco.MjModel, whiskers: Sequence[Whisker], profile: Profile, start: Floats
    ) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._count = len(whiskers)
        self._steps = round(SAMPLE_MS / profile.timestep_ms)
        self._probe = ContactProbe(model, whiskers, profile)
        self._data.mocap_pos[0] = start
        # The solver assumes that a mocap body stands still; friction needs its surface velocity.
        # The compiler sets this flag only for non-zero velocities; without it they are ignored.
        model.flg_surfacevel = True
        mujoco.mj_forward(model, self._data)

    @property
    def turns(self) -> Floats:
        """An empty array, (0, whisker, 2), because this engine's bases are rigid."""
        return np.zeros((0, self._count, 2))

    @property
    def angles(self) -> Floats:
        """The (joint,) angles of all whiskers' hinges, rad."""
        angles: Floats = self._data.qpos.copy()
        return angles

    def advance(
        self, way: Floats, look_every: int = 0, shaken: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Simulate samples, see `sweep_simulation.World`; the head stands still."""
        assert shaken is None
        model, data, steps = self._model, self._data, self._steps
        samples = len(way) - 1
        shares = np.arange(1, steps + 1)[:, None] / steps
        path = (way[:-1, None] + np.diff(way, axis=0)[:, None] * shares).reshape(-1, 3)
        velocity = (way[-1] - way[0]) / (samples * SAMPLE_MS)
        for geom in np.flatnonzero(model.geom_contype == OBJECT_BIT):
            frame = data.geom_xmat[geom].reshape(3, 3)
            model.geom_surfacevel[geom, :3] = frame.T @ velocity
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        state = np.empty(mujoco.mj_stateSize(model, spec))
        mujoco.mj_getState(model, data, state, spec)
        states, sensors = rollout.rollout(
            model,
            data,
            state[None],
            path[None],
            control_spec=int(mujoco.mjtState.mjSTATE_MOCAP_POS),
            initial_warmstart=data.qacc_warmstart.copy()[None],
        )
        if any(data.warning[kind].number for kind in UNSTABLE):
            raise SourceError(JAMMED)
        loads = read_base_loads(sensors[0].reshape(samples, steps, -1).mean(axis=1))
        contacts = np.zeros((samples, loads.shape[1], len(CONTACT_CHANNELS)))
        if look_every:
            before = np.concatenate([state[None], states[0, :-1]])
            for k in range(0, samples, look_every):
                step = (k + 1) * steps - 1
                contacts[k : k + look_every] = self._probe.read(before[step], path[step])
        return loads, contacts
