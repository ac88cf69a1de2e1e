"""The world of an array and an object, stepped whisker by whisker."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from tactile_rt.core.errors import ConfigError, SourceError
from tactile_rt.sim_backend.arrays.whiskers import Floats, Whisker
from tactile_rt.sim_backend.rods.chains import Chain
from tactile_rt.sim_backend.rods.resting import linearise, settle
from tactile_rt.sim_backend.rods.rod import Rod, make_rod
from tactile_rt.sim_backend.rods.stepping import RodState, RowBounds, advance
from tactile_rt.sim_backend.rods.touching import Object, Segments, unseen
from tactile_rt.sim_backend.world import JAMMED, SAMPLE_MS

WEIGHTLESS, NO_EDGES = np.zeros(3), np.zeros((0, 2), np.int64)
FASTEST = 3.01  # mm/ms, or m/s
FEW_CORNERS = 64  # for so many corners or fewer, trying all is faster

_make_rod = lru_cache(maxsize=512)(make_rod)  # 10 ms each; the same whiskers meet many objects


@dataclass(frozen=True)
class Piece:
    """A convex piece of an object: the hull of its corners, grown by a radius.

    Attributes:
        corners: The (corner, 3) corners, mm, relative to the object's position.
        faces: The (face, 4) outward normals and offsets of the hull; none for a point or a line.
        rounding: The radius by which the hull is grown, mm.
        edges: The (2 * edge, 2) corners that an edge joins, both ways, sorted; none for few
            corners, which are all tried.
    """

    corners: Floats
    faces: Floats
    rounding: float = 0.0
    edges: NDArray[np.int64] = field(default_factory=lambda: NO_EDGES)

    @classmethod
    def of(cls, mesh: trimesh.Trimesh) -> "Piece":
        """Make a piece from a convex mesh."""
        normals = np.asarray(mesh.face_normals, dtype=np.float64)
        offsets = np.einsum("fi,fi->f", normals, mesh.triangles[:, 0])
        faces = np.concatenate([normals, offsets[:, None]], axis=1)
        corners = np.array(mesh.vertices, dtype=np.float64)
        if len(corners) <= FEW_CORNERS:
            return cls(corners, faces)
        triangles = np.asarray(mesh.faces)
        if len(triangles) != 2 * len(corners) - 4:  # unused or duplicate corners
            hull = ConvexHull(corners)
            number = np.zeros(len(corners), np.int64)
            number[hull.vertices] = np.arange(len(hull.vertices))
            corners, triangles = corners[hull.vertices], number[hull.simplices]
        edges, n = np.concatenate([triangles[:, [i, i - 1]] for i in range(3)]), len(corners)
        both = np.sort(np.concatenate([edges @ (n, 1), edges @ (1, n)]))[::2]  # in two triangles
        return cls(corners, faces, 0.0, np.stack(np.divmod(both, n), axis=1))


class RodWorld:
    """The `rods` engine: whiskers on fixed or rotating bases, and an object that only translates.

    Args:
        roots: (whisker, 4, 3) base point (mm) and, in the rows after it, the element's frame in the
            world.
        steps_per_sample: the fewest steps in a sample of 1 ms.
        gravity: (3,) in the world, mm/ms^2; the whiskers begin at rest under their weight.

    Raises:
        ConfigError: a whisker is too soft to carry itself.

    Attributes:
        angles: The (joint,) angles of all whiskers' hinges, one whisker after the other, rad.
        turns: The (sample, whisker, 2) mean rotations of compliant bases in the samples of the last
            `advance`, about the element's y and z, rad.
        sag: The (link + 1, 3) displacements of each whisker's nodes by gravity, mm.
        overlap: The (sample, whisker) depth of overlap with the object in those samples, mm;
            negligible unless a whisker is wedged.
    """

    def __init__(
        self,
        whiskers: Sequence[Whisker],
        roots: Floats,
        pieces: Sequence[Piece],
        links: int,
        steps_per_sample: int,
        gravity: Floats = WEIGHTLESS,
    ) -> None:
        self.rods = rods = [_cut_rod(w, links, steps_per_sample) for w in whiskers]
        self.angles, self.turns = np.zeros(0), np.zeros((0, len(rods), 2))
        self.overlap = np.zeros((0, len(rods)))
        self._gravity, self._weights = gravity, np.zeros((len(rods), 6))
        self.sag: list[Floats] = []
        if not rods:
            return
        self._bases, self._frames = roots[:, :1], roots[:, 1:]
        self._to_links = np.array([rod.to_element.T for rod in rods])
        chains, segments = [rod.chain for rod in rods], [rod.segments for rod in rods]
        rows = RowBounds(
            _find_starts([c.length for c in chains]),
            _find_starts([c.stiffness for c in chains]),
            _find_starts([s.link for s in segments]),
            np.zeros(len(rods) + 1, np.int64),
        )
        cells = links
        links, joints, parts, _ = (int(each[-1]) for each in rows)
        rest, answers = np.zeros(joints), []
        for i, (rod, at) in enumerate(zip(rods, rows.joints, strict=False)):
            nodes = np.zeros((2, len(rod.chain.length) + 1, 3))
            angles = rest[at : at + len(rod.chain.stiffness)]
            if gravity.any():
                root = np.concatenate([roots[i, :1], roots[i, 1:] @ rod.to_element.T])
                if not settle(rod.chain, root, gravity, angles, self._weights[i], nodes):
                    name = whiskers[i].name
                    raise ConfigError(f"whisker {name} is too soft to carry its own weight")
                answers.append(_linearise(rod, root[1:].T @ gravity, angles))
            else:
                answers.append(_linearise_bare(_strip_pose(whiskers[i]), cells, steps_per_sample))
            self.sag.append(nodes[1] - nodes[0])
        rows = rows._replace(answers=_find_starts(answers))
        degrees = [np.bincount(p.edges[:, 0], minlength=len(p.corners)) for p in pieces]
        self.angles = rest.copy()
        self._advance = partial(
            advance,
            np.array([r.steps_per_sample for r in rods]),
            rows,
            Chain(*(_stack(each) for each in zip(*chains, strict=True))),
            Segments(*(_stack(each) for each in zip(*segments, strict=True))),
            Object(
                np.concatenate([np.zeros((0, 3)), *(p.corners for p in pieces)]),
                _find_starts([p.corners for p in pieces]),
                np.concatenate([np.zeros((0, 4)), *(p.faces for p in pieces)]),
                _find_starts([p.faces for p in pieces]),
                np.array([p.rounding for p in pieces]),
                np.concatenate([NO_EDGES, *(p.edges for p in pieces)])[:, 1].copy(),
                np.cumsum(np.concatenate([[0], *degrees])),
            ),
            RodState(
                self.angles,
                np.zeros(joints),
                np.zeros((links, 6)),
                rest,
                self._weights,
                _stack(answers),
            ),
            unseen(len(rods), parts, len(pieces)),
        )

    def rest_loads(self) -> Floats:
        """Compute base loads (whisker, 6) at rest under gravity, N and N m."""
        return _rotate_loads(-self._weights, self._frames)

    def advance(
        self,
        way: Floats,
        look_every: int = 0,
        shaken: Floats | None = None,
        turning: Floats | None = None,
    ) -> tuple[Floats, Floats]:
        """Simulate samples, see `sweep_simulation.World`; loads and contacts are sample means.

        Args:
            shaken: (sample, 3) acceleration of the head, mm/ms^2, in the world; `way` is then
                relative to the head. If None, the head is not accelerated.
            turning: (sample + 3, whisker, 3, 3) frames of the elements in the world if bases
                rotate: at the beginning of each sample, from the sample before the first to the
                sample after the last, and at the end of that. Each rotates at a constant rate in a
                sample, by less than 90 degrees. Loads are in the frame at the middle of their
                sample. If None, the frames stay as at construction.
        """
        samples = len(way) - 1
        fastest = np.linalg.norm(np.diff(way, axis=0), axis=1).max(initial=0.0)
        if fastest > FASTEST:
            raise ConfigError(f"the object moves at {fastest:.3g} m/s; at most {FASTEST:g} m/s")
        if not self.rods:
            return np.zeros((samples, 0, 6)), np.zeros((samples, 0, 3))
        loads = np.zeros((len(self.rods), samples, 6))
        contacts = np.zeros((len(self.rods), samples, 6))
        frames = middle = self._frames[:, None]  # (whisker, sample or 1, 3, 3)
        moves = shaken is not None or turning is not None
        bases = np.zeros((1, samples if moves else 1, 4, 3))
        if turning is not None:
            rates = _compute_rates(turning)
            bases = np.zeros((len(self.rods), samples, 4, 3))
            bases[:, :, 1] = rates[:, 1:-1]
            bases[:, :, 3] = (rates[:, 2:] - rates[:, :-2]) / 2
            frames = turning[1:-2].swapaxes(0, 1)
            half = rates[:, 1:-1] * SAMPLE_MS / 2
            turned = Rotation.from_rotvec(half.reshape(-1, 3)).as_matrix()
            middle = turned.reshape(frames.shape) @ frames
        if shaken is not None:
            bases[:, :, 2] = shaken
        bases[:, :, 2] -= self._gravity
        roots = np.empty((*frames.shape[:2], 4, 3))
        roots[:, :, 0] = self._bases
        roots[:, :, 1:] = frames @ self._to_links[:, None]
        done = self._advance(
            roots, bases, not moves, self._gravity, np.ascontiguousarray(way), loads, contacts
        )
        if done < 0:
            raise SourceError(JAMMED)
        # Sums in a fixed order: a matrix product's rounding may depend on the number of samples.
        felt = _rotate_loads(loads, middle)
        self.turns = contacts[..., 3:5].swapaxes(0, 1)
        self.overlap = contacts[..., 5].swapaxes(0, 1)
        return felt.swapaxes(0, 1), contacts[..., :3].swapaxes(0, 1) * (1.0, 1e-3, 1e-6)


def _cut_rod(whisker: Whisker, links: int, steps_per_sample: int) -> Rod:
    """Return a whisker's rod, cached for all whiskers of the same shape and material."""
    rod = _make_rod(_strip_pose(whisker), links, steps_per_sample)
    return replace(rod, chain=rod.chain._replace(friction=whisker.friction))


def _linearise(rod: Rod, gravity: Floats, rest: Floats) -> Floats:
    n = len(rest)
    answers = np.empty((2 * n + 6 + 2 * (rod.chain.clamped == 0), 2 * n + 3))
    linearise(rod.steps_per_sample, rod.chain, gravity, rest, answers)
    return answers


@lru_cache(maxsize=512)
def _linearise_bare(shape: Whisker, links: int, steps_per_sample: int) -> Floats:
    """Compute the linear response of a weightless whisker, cached by its shape."""
    rod = _make_rod(shape, links, steps_per_sample)
    return _linearise(rod, WEIGHTLESS, np.zeros(len(rod.chain.stiffness)))


def _strip_pose(whisker: Whisker) -> Whisker:
    """Return a copy without name, pose and friction: a cache key of shape and material."""
    here = (0.0, 0.0, 0.0)
    return replace(whisker, name="any", row=0, column=0, base=here, angles=here, friction=0.0)


def _rotate_loads(loads: Floats, frames: Floats) -> Floats:
    """Rotate loads from the world, mN and uN m, into frames, N and N m."""
    felt = np.zeros_like(loads)
    for k in range(3):
        felt[..., :3] += loads[..., k, None] * frames[..., k, :] * 1e-3
        felt[..., 3:] += loads[..., 3 + k, None] * frames[..., k, :] * 1e-6
    return felt


def _compute_rates(frames: Floats) -> Floats:
    """Compute rotation rates (whisker, sample, 3), rad/ms, of frames at samples' starts."""
    step = (frames[1:] @ frames[:-1].swapaxes(-1, -2)).swapaxes(0, 1)
    turns = Rotation.from_matrix(step.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(turns.reshape(step.shape[:-1]) / SAMPLE_MS)


def _stack(each: Sequence[Any]) -> NDArray[Any]:
    """Concatenate rows, padding narrower matrices with zeros; put scalars into one array."""
    if np.ndim(each[0]) == 0:
        return np.array(each)
    wide = max(rows.shape[-1] for rows in each)
    if kept := [(0, 0)] * (np.ndim(each[0]) - 1):
        each = [np.pad(rows, (*kept, (0, wide - rows.shape[-1]))) for rows in each]
    return np.concatenate(each)


def _find_starts(each: Sequence[Any]) -> NDArray[np.int64]:
    """Return the offset of each array's rows when concatenated, and the end of the last."""
    return np.cumsum([0, *(len(rows) for rows in each)])
