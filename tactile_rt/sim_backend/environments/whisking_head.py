"""A whisking head that moves on command beside a stationary object.

`rods` steps the whiskers in the frame of the head: the object moves the other way, and whiskers
feel the head's acceleration. `whisking_drive` rotates the bases.

The head follows a point that moves at the commanded velocity within the workspace, through three
first-order lags like those of whisking: position, velocity and acceleration never jump, and the
head never leaves its workspace.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.linalg import expm

from tactile_rt.sim_backend.arrays.whisker_array import WhiskerArray
from tactile_rt.sim_backend.arrays.whiskers import Floats, rotation
from tactile_rt.sim_backend.mujoco_world import TOUCHING_SHARE
from tactile_rt.sim_backend.objects.catalogue import TactileObject, load_object
from tactile_rt.sim_backend.rods.world import Piece, RodWorld
from tactile_rt.sim_backend.sweep import centrelines, faces_right, way_to_contact
from tactile_rt.sim_backend.trajectories import base_angles
from tactile_rt.sim_backend.whisking_drive import LAG_S, Drive, Whisking
from tactile_rt.sim_backend.world import SAMPLE_MS, Profile

FAR_MM = 200.0  # where the object is when the way to first contact is measured
APART_MS = 10  # a contact after so long without contact is a new touch
LAG_MS = LAG_S * 1e3
BELOW_MM, ASIDE_MM, PAST_MM = 15.0, 12.0, 5.0  # the workspace for an array of a mouse's size


@dataclass(frozen=True)
class Placed:
    """An object placed beside an array, and the head's workspace.

    Attributes:
        centre: The (3,) position of the object's centre in the world, mm.
        low, high: The (3,) corners of the head's workspace, a box, relative to its start, mm.
    """

    name: str
    pieces: tuple[Piece, ...]
    centre: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True)
class Stretch:
    """The loads, angles and contacts of consecutive samples.

    Attributes:
        loads: The (sample, element, 6) base loads, N and N m, in the rotating element frames.
        angle: The (sample,) protraction from rest, mean over the sample, rad, rostral positive.
        touching: The (sample, element) flags of contact with the object.
    """

    loads: Floats
    angle: Floats
    touching: NDArray[np.bool_]
    touches: int


@lru_cache(maxsize=128)
def _load_object(name: str) -> TactileObject:
    return load_object(name)


def place_beside(
    array: WhiskerArray,
    name: str,
    *,
    size_mm: float,
    yaw_deg: float,
    height_mm: float,
    distance_mm: float,
    gap_mm: float,
) -> Placed | None:
    """Place an object ahead of an array, on the side to which its whiskers reach.

    Returns:
        The placed object; None if no whisker would touch it as the head passes.
    """
    lines = centrelines(array.whiskers, array.mount)
    right = faces_right((array,), lines).mean() >= 0.5
    turn = rotation("z", np.radians(yaw_deg))
    parts = [
        trimesh.Trimesh(p.vertices * size_mm @ turn.T, p.faces, process=False)
        for p in _load_object(name).pieces
    ]
    corners = np.concatenate([part.vertices for part in parts])
    face = np.mean([line[0, 0] for line in lines])
    nearest = corners[:, 0].min() if right else corners[:, 0].max()
    side = 1.0 if right else -1.0
    centre = np.array([face + side * distance_mm - nearest, FAR_MM, height_mm])
    there = [trimesh.Trimesh(p.vertices + centre, p.faces, process=False) for p in parts]
    way, _ = way_to_contact(array.whiskers, lines, there)
    if not np.isfinite(way):
        return None
    centre[1] += gap_mm - way
    last = min(line[:, 1].min() for line in lines)
    scale = distance_mm / 6.5
    past = centre[1] + corners[:, 1].max() - last + PAST_MM * scale
    aside = -side * ASIDE_MM * scale
    low = np.array([min(aside, 0.0), 0.0, -BELOW_MM * scale])
    high = np.array([max(aside, 0.0), past, BELOW_MM * scale])
    return Placed(name, tuple(map(Piece.of, parts)), centre, low, high)


class WhiskingHead:
    """A simulated array on a head that moves and whisks, beside a stationary object.

    Args:
        array: the whiskers, on their head, which faces +y of the world.
        profile: the resolution; the profile's engine is ignored, `rods` is used.

    Attributes:
        position, velocity: The (3,) displacement of the head from its start, mm, and its velocity,
            mm/s, in the world.
    """

    def __init__(
        self, array: WhiskerArray, placed: Placed, profile: Profile, whisking: Whisking
    ) -> None:
        self.array, self.placed = array, placed
        self.samples = self.touches = 0
        self._turn = array.mount.rotation
        bases = np.array([w.base for w in array.whiskers]) @ self._turn.T + array.mount.position
        rest = self._turn @ np.array([w.orientation for w in array.whiskers])
        self.world = RodWorld(
            array.whiskers,
            np.concatenate([bases[:, None], rest], axis=1),
            placed.pieces,
            profile.links,
            round(SAMPLE_MS / profile.timestep_ms),
        )
        self._drive = Drive(whisking)
        self._target = np.zeros(3)
        self._lags = np.zeros((3, 3))  # (lag, axis), the last the head's position, mm
        self._free = np.full(len(array.whiskers), APART_MS)
        self.touching = np.zeros(len(array.whiskers), dtype=np.bool_)

    @property
    def position(self) -> Floats:
        """The (3,) displacement of the head from its start, mm."""
        here: Floats = self._lags[2].copy()
        return here

    @property
    def velocity(self) -> Floats:
        """The (3,) velocity of the head, mm/s."""
        found: Floats = (self._lags[1] - self._lags[2]) / LAG_MS * 1e3
        return found

    def command(self, whisking: Whisking) -> None:
        """Change the whisking from the next sample on; the motion changes smoothly."""
        self._drive.command(whisking, self.samples * SAMPLE_MS * 1e-3)

    def frames(self, samples: NDArray[np.int64]) -> Floats:
        """Compute the elements' frames (sample, whisker, 3, 3) in the world at samples' starts."""
        times = samples.astype(np.float64) * (SAMPLE_MS * 1e-3)
        angles = base_angles(self._drive, times, self.array.whiskers)
        signs, offsets = np.array([1.0, -1.0, 1.0]), np.array([-np.pi / 2, 0.0, np.pi / 2])
        z, y, x = np.moveaxis(angles * signs + offsets, -1, 0)
        return self._turn @ rotation("z", z) @ rotation("y", y) @ rotation("x", x)

    def advance(self, samples: int, velocity_mm_s: Sequence[float] | Floats = (0, 0, 0)) -> Stretch:
        """Move and whisk for `samples` samples of 1 ms, and return loads and contacts.

        Args:
            velocity_mm_s: (3,) commanded velocity of the head, mm/s, in the world.

        Raises:
            SourceError: the simulation has become unstable: whiskers jam.
        """
        at = np.arange(self.samples - 1, self.samples + samples + 2)
        way, shaken = self._move(samples, np.asarray(velocity_mm_s, dtype=np.float64))
        loads, contacts = self.world.advance(
            self.placed.centre - way, shaken=shaken, turning=self.frames(at)
        )
        # The value at the middle of a sample is its mean within 1e-4 at 8 Hz.
        times = (at[1:-2].astype(np.float64) + 0.5) * (SAMPLE_MS * 1e-3)
        angle = self._drive.protraction(times)
        touching = contacts[..., 0] > TOUCHING_SHARE
        touches = self._count_touches(touching)
        self.samples += samples
        self.touches += touches
        self.touching = touching[-1]
        return Stretch(loads, angle, touching, touches)

    def _count_touches(self, touching: NDArray[np.bool_]) -> int:
        """Count touches in (sample, element) flags: contacts after `APART_MS` or more without."""
        at = np.arange(len(touching))[:, None]
        last = np.maximum.accumulate(np.where(touching, at, -self._free - 1), axis=0)
        before = np.concatenate([-self._free[None] - 1, last[:-1]])
        self._free = len(touching) - 1 - last[-1]
        return int((touching & (at - before > APART_MS)).sum())

    def _move(self, samples: int, velocity_mm_s: Floats) -> tuple[Floats, Floats]:
        """Move the head; return path (sample + 1, 3), mm, and acceleration (sample, 3), mm/ms^2."""
        steps = np.arange(1, samples + 1)[:, None] * velocity_mm_s * (SAMPLE_MS * 1e-3)
        aims = np.clip(self._target + steps, self.placed.low, self.placed.high)
        fading, following = _compute_response(samples)
        lags = fading @ self._lags + np.einsum("kli,ia->kla", following, aims)
        pulls = (lags[:, 0] - 2 * lags[:, 1] + lags[:, 2]) / LAG_MS**2
        self._target, self._lags = aims[-1], lags[-1]
        return lags[:, 2], (pulls[1:] + pulls[:-1]) / 2


@lru_cache(maxsize=8)
def _compute_response(samples: int) -> tuple[Floats, Floats]:
    """Compute the discrete response of the three lags in series to their input.

    Returns:
        (sample + 1, lag, lag) weights of the lags' initial outputs, and (sample + 1, lag, sample)
        weights of the input in each sample.
    """
    decay = expm((np.diag([1.0, 1.0], -1) - np.eye(3)) * SAMPLE_MS / LAG_MS)
    fading = np.empty((samples + 1, 3, 3))
    fading[0] = np.eye(3)
    for k in range(samples):
        fading[k + 1] = decay @ fading[k]
    gained = fading @ (1.0 - decay.sum(axis=1))  # (sample + 1, lag) weight of an input so long ago
    following = np.zeros((samples + 1, 3, samples))
    for k in range(1, samples + 1):
        following[k, :, :k] = gained[:k][::-1].T
    return fading, following
