"""An array and an object, stepped whisker by whisker."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from tactile_rt.core.errors import SourceError
from tactile_rt.sim_backend.arrays.whiskers import Whisker
from tactile_rt.sim_backend.rods.chains import Chain
from tactile_rt.sim_backend.rods.rod import make_rod
from tactile_rt.sim_backend.rods.stepping import RodState, RowBounds, advance
from tactile_rt.sim_backend.rods.touching import Object, Segments, unseen
from tactile_rt.sim_backend.world import JAMMED, SAMPLE_MS

__all__ = ["Piece", "RodWorld"]

Floats = NDArray[np.float64]

_cut = lru_cache(maxsize=512)(make_rod)  # 10 ms each, and the same whiskers meet many objects


@dataclass(frozen=True)
class Piece:
    """A convex piece of an object: the hull of its corners, grown by a radius.

    Attributes:
        corners: The (corner, 3) corners, mm, about the object's place.
        faces: The (face, 4) outward normals and offsets of the hull; none of a point or a line.
        rounding: The radius by which the hull is grown, mm.
    """

    corners: Floats
    faces: Floats
    rounding: float = 0.0

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> "Piece":
        """The piece that a convex mesh is."""
        normals = np.asarray(mesh.face_normals, dtype=np.float64)
        offsets = np.einsum("fi,fi->f", normals, mesh.triangles[:, 0])
        return cls(
            np.array(mesh.vertices, dtype=np.float64),
            np.concatenate([normals, offsets[:, None]], axis=1),
        )


class RodWorld:
    """Whiskers on bases that turn or stand still, and an object that moves among them, not turning.

    Args:
        roots: (whisker, 4, 3) base point (mm) and, in the rows after it, the element's frame in the
            world.
        steps_per_sample: the fewest steps in a sample of 1 ms.

    Attributes:
        angles: The (joint,) angles of all whiskers' hinges, one whisker after the other, rad.
        turns: The (sample, whisker, 2) turns of bases that give in the samples of the last
            `advance`, means, about the element's y and z, rad.
    """

    def __init__(
        self,
        whiskers: Sequence[Whisker],
        roots: Floats,
        pieces: Sequence[Piece],
        links: int,
        steps_per_sample: int,
    ) -> None:
        self.rods = rods = [_cut(w, links, steps_per_sample) for w in whiskers]
        self.angles, self.turns = np.zeros(0), np.zeros((0, len(rods), 2))
        if not rods:
            return
        self._bases, self._frames = roots[:, :1], roots[:, 1:]
        self._to_links = np.array([rod.to_element.T for rod in rods])
        chains, segments = [rod.chain for rod in rods], [rod.segments for rod in rods]
        rows = RowBounds(
            _begins([c.length for c in chains]),
            _begins([c.stiffness for c in chains]),
            _begins([s.link for s in segments]),
        )
        links, joints, parts = (int(each[-1]) for each in rows)
        self.angles = np.zeros(joints)
        self._advance = partial(
            advance,
            np.array([r.steps_per_sample for r in rods]),
            rows,
            Chain(*(_stacked(each) for each in zip(*chains, strict=True))),
            Segments(*(_stacked(each) for each in zip(*segments, strict=True))),
            Object(
                np.concatenate([np.zeros((0, 3)), *(p.corners for p in pieces)]),
                _begins([p.corners for p in pieces]),
                np.concatenate([np.zeros((0, 4)), *(p.faces for p in pieces)]),
                _begins([p.faces for p in pieces]),
                np.array([p.rounding for p in pieces]),
            ),
            RodState(self.angles, np.zeros(joints), np.zeros((links, 4))),
            unseen(len(rods), parts, len(pieces)),
        )

    def advance(
        self,
        way: Floats,
        look_every: int = 0,
        shaken: Floats | None = None,
        turning: Floats | None = None,
    ) -> tuple[Floats, Floats]:
        """See `sweep_simulation.World`; loads and contacts are means over each sample.

        Args:
            shaken: (sample, 3) acceleration of the head, mm/ms^2, in the world; the object's way is
                then relative to the head. None: it is not accelerated.
            turning: (sample + 3, whisker, 3, 3) frames of the elements in the world where bases
                turn, at the beginning of each sample, from the one before the first to the one
                after the last, and at the end of that; each turns by less than 90 degrees in a
                sample, and at an even rate. Loads are in the frame at the middle of their sample.
                None: they are where they were when this was made.
        """
        samples = len(way) - 1
        if not self.rods:
            return np.zeros((samples, 0, 6)), np.zeros((samples, 0, 3))
        loads = np.zeros((len(self.rods), samples, 6))
        contacts = np.zeros((len(self.rods), samples, 5))
        frames, middle = (
            self._frames[:, None],
            self._frames[:, None],
        )  # (whisker, sample or 1, 3, 3)
        bases = np.zeros((1, 1 if shaken is None and turning is None else samples, 4, 3))
        if turning is not None:
            rates = _rates(turning)
            bases = np.zeros((len(self.rods), samples, 4, 3))
            bases[:, :, 1] = rates[:, 1:-1]
            bases[:, :, 3] = (rates[:, 2:] - rates[:, :-2]) / 2
            frames = turning[1:-2].swapaxes(0, 1)
            middle = _turns(rates[:, 1:-1] / 2) @ frames
        if shaken is not None:
            bases[:, :, 2] = shaken
        roots = np.empty((*frames.shape[:2], 4, 3))
        roots[:, :, 0] = self._bases
        roots[:, :, 1:] = frames @ self._to_links[:, None]
        done = self._advance(roots, bases, np.ascontiguousarray(way), loads, contacts)
        if done < 0:
            raise SourceError(JAMMED)
        # Sums in a fixed order: a matrix product's rounding may depend on the number of samples.
        felt = np.zeros_like(loads)
        for k in range(3):
            felt[..., :3] += loads[..., k, None] * middle[..., k, :] * 1e-3
            felt[..., 3:] += loads[..., 3 + k, None] * middle[..., k, :] * 1e-6
        self.turns = contacts[..., 3:].swapaxes(0, 1)
        return felt.swapaxes(0, 1), contacts[..., :3].swapaxes(0, 1) * (1.0, 1e-3, 1e-6)


def _rates(frames: Floats) -> Floats:
    """(whisker, sample, 3) angular velocities, rad/ms, from frames (sample + 1, whisker, 3, 3)."""
    step = (frames[1:] @ frames[:-1].swapaxes(-1, -2)).swapaxes(0, 1)
    axis = np.stack(
        [step[..., k, j] - step[..., j, k] for j, k in ((1, 2), (2, 0), (0, 1))], axis=-1
    )
    sine = np.linalg.norm(axis, axis=-1, keepdims=True) / 2
    # of a small angle, the ratio to its sine is 1
    ratio = np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-12)
    rates: Floats = axis / 2 * np.where(sine < 1e-9, 1.0, ratio) / SAMPLE_MS
    return rates


def _turns(rates: Floats) -> Floats:
    """(..., 3, 3) rotations after a sample at angular velocities (..., 3), rad/ms."""
    by = rates * SAMPLE_MS
    angle = np.linalg.norm(by, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(by, -1, 0)
    o = np.zeros_like(x)
    cross = np.stack([o, -z, y, z, o, -x, -y, x, o], axis=-1).reshape(*x.shape, 3, 3)
    small = np.maximum(angle, 1e-12)
    turns: Floats = (
        np.eye(3)
        + np.sinc(angle / np.pi) * cross
        + (1 - np.cos(angle)) / small**2 * (cross @ cross)
    )
    return turns


def _stacked(each: Sequence[Any]) -> NDArray[Any]:
    """Rows one below the other, those of narrower matrices filled up with zeros; numbers as one."""
    if np.ndim(each[0]) == 0:
        return np.array(each)
    wide = max(rows.shape[-1] for rows in each)
    if np.ndim(each[0]) == 2:
        each = [np.pad(rows, ((0, 0), (0, wide - rows.shape[1]))) for rows in each]
    return np.concatenate(each)


def _begins(each: Sequence[Any]) -> NDArray[np.int64]:
    """Where each one's rows begin when they stand one after the other, and where the last end."""
    return np.cumsum([0, *(len(rows) for rows in each)])
