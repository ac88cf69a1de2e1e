"""Where whiskers touch, as the simulation knows it: the truth that an estimate is held against."""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from tactile_rt.sim_backend.arrays.cells import link_nodes
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.world import OBJECT_BIT, Profile

__all__ = ["CONTACT_CHANNELS", "ContactProbe", "contact_distances"]

Floats = NDArray[np.float64]

# Additive, so that they can be averaged over time as loads are.
CONTACT_CHANNELS = ("touching", "normal force, N", "normal force x arc length, N m")
TOUCHING_SHARE = 0.5  # of a sample's time


class ContactProbe:
    """Reads contacts off states of a simulation, in a copy of its own: the simulation goes on as if
    it had not been looked at.

    Args:
        model: with the whiskers, and one object as mocap body.
        whiskers: those in the model, in the order in which they are to be reported.
    """

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
            first = model.body(whisker.name).id + 1  # a chain's bodies follow one another
            geoms = model.body_geomadr[first : first + len(nodes) - 1]
            self._owner[geoms] = i
            self._start[geoms], self._ends[geoms] = nodes[:-1], np.diff(nodes)
            # Links are chords: along a curved whisker a mm of chord is more than a mm of arc.
            self._stretch[geoms] = np.diff(nodes) / (2 * model.geom_size[geoms, 1])

    def read(self, state: Floats, place: Floats) -> Floats:
        """Contacts of one state.

        Args:
            state: mjSTATE_FULLPHYSICS that a step begins with.
            place: (3,) of the object during the step, mm.

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
        # Of the two geoms of a contact one is a link; elliptic cones have the normal force first.
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
    """Arc length (m) from the base to the contact, weighed by normal force; NaN: not touching.

    A whisker touches that is in contact for at least half of the sample's time.

    Args:
        felt: (..., 3) `CONTACT_CHANNELS`, averaged over the time of each sample.
    """
    touching = (felt[..., 0] >= TOUCHING_SHARE) & (felt[..., 1] > 0)
    distances: NDArray[np.float32] = np.where(
        touching, felt[..., 2] / np.where(touching, felt[..., 1], 1.0), np.nan
    ).astype(np.float32)
    return distances
