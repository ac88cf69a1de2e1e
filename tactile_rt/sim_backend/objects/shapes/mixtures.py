"""Things of no kind, from which a model can learn what it does not know.

Each builder draws one object from `rng`, upright, in a unit of its own.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import hull, moved, normalised, ring, slab, stretched

Builder = Callable[[Generator], list[Trimesh]]


def assembly(rng: Generator) -> list[Trimesh]:
    """Two to seven solids of any form, each grown into one that was there before."""
    pieces = [_solid(rng)]
    for _ in range(int(rng.integers(1, 7))):
        other = _solid(rng)
        host = pieces[int(rng.integers(len(pieces)))]
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        # its nearest corner inside its host, towards the host's farthest
        far = host.vertices[(host.vertices @ direction).argmax()]
        near = other.vertices[(other.vertices @ direction).argmin()]
        inside = far + rng.uniform(0.2, 0.5) * (host.centroid - far)
        pieces.append(hull(other.vertices + (inside - near)))
    return pieces


def medley(rng: Generator, builders: Sequence[Builder]) -> list[Trimesh]:
    """The lower part of a thing of one kind, a board on it, the upper part of another's on that.

    What the board does not reach hangs in the air.
    """
    first, second = rng.choice(len(builders), 2, replace=False)
    lower = _half(builders[first](rng), below=True)
    upper = _half(builders[second](rng), below=False)
    top = max(float(piece.bounds[1, 2]) for piece in lower)
    foot = min(float(piece.bounds[0, 2]) for piece in upper)
    raised = [hull(moved(piece.vertices, z=top - foot)) for piece in upper]
    parts = [np.ptp(np.vstack([p.vertices for p in part]), axis=0) for part in (lower, raised)]
    width, depth, _ = np.minimum(*parts)
    thin = rng.uniform(0.02, 0.1)
    board = hull(slab(width, depth, top - thin), slab(width, depth, top + thin))
    return stretched([*lower, board, *raised], 1.25 ** rng.uniform(-1, 1, 3))


def _solid(rng: Generator) -> Trimesh:
    """A box, a prism, a cone or a ball, stretched and turned; about 1 large."""
    form = rng.integers(4)
    if form == 0:
        points = np.vstack([slab(1, 1, -0.5), slab(1, 1, 0.5)])
    elif form == 1:
        sides = int(rng.integers(3, 25))
        points = np.vstack([ring(0.5, -0.5, sides), ring(0.5, 0.5, sides)])
    elif form == 2:
        tip = rng.uniform(0.02, 0.4)
        points = np.vstack([ring(0.5, -0.5), ring(tip, 0.5)])
    else:
        points = np.vstack([ring(0.5 * np.cos(a), 0.5 * np.sin(a), 12)
                            for a in np.linspace(-1.45, 1.45, 7)])  # fmt: skip
    points = points * np.exp(rng.uniform(-1.2, 0.4, 3))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    if rng.random() < 0.5:
        points = points @ turn.T
    return hull(points)


def _half(pieces: Sequence[Trimesh], below: bool) -> list[Trimesh]:
    """The pieces of a thing whose middle is below that of the whole, or the others; or all."""
    whole = normalised(pieces)
    mine = [piece for piece in whole if (float(piece.centroid[2]) < 0) == below]
    return mine or list(whole)
