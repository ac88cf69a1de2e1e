"""Random objects of no kind, from which a model can learn to refuse unknown objects.

Each builder draws one object from `rng`, upright, in a unit of its own.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.random import Generator
from trimesh import Trimesh

from tactile_rt.sim_backend.objects.solids import (
    fit_unit_box,
    hull,
    ring,
    shift_points,
    slab,
    stretch_pieces,
)

Builder = Callable[[Generator], list[Trimesh]]


def assembly(rng: Generator) -> list[Trimesh]:
    """Build two to seven random solids, each overlapping an earlier one."""
    pieces = [_draw_solid(rng)]
    for _ in range(int(rng.integers(1, 7))):
        other = _draw_solid(rng)
        host = pieces[int(rng.integers(len(pieces)))]
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        # put its nearest corner inside its host, close to the host's farthest corner
        far = host.vertices[(host.vertices @ direction).argmax()]
        near = other.vertices[(other.vertices @ direction).argmin()]
        inside = far + rng.uniform(0.2, 0.5) * (host.centroid - far)
        pieces.append(hull(other.vertices + (inside - near)))
    return pieces


def medley(rng: Generator, builders: Sequence[Builder]) -> list[Trimesh]:
    """Build one kind's lower half, a board on it, and another kind's upper half.

    Pieces that the board does not reach hang in the air.
    """
    first, second = rng.choice(len(builders), 2, replace=False)
    lower = _take_half(builders[first](rng), below=True)
    upper = _take_half(builders[second](rng), below=False)
    top = max(float(piece.bounds[1, 2]) for piece in lower)
    foot = min(float(piece.bounds[0, 2]) for piece in upper)
    raised = [hull(shift_points(piece.vertices, z=top - foot)) for piece in upper]
    parts = [np.ptp(np.vstack([p.vertices for p in part]), axis=0) for part in (lower, raised)]
    width, depth, _ = np.minimum(*parts)
    thin = rng.uniform(0.02, 0.1)
    board = hull(slab(width, depth, top - thin), slab(width, depth, top + thin))
    return stretch_pieces([*lower, board, *raised], 1.25 ** rng.uniform(-1, 1, 3))


def _draw_solid(rng: Generator) -> Trimesh:
    """Draw a stretched, perhaps rotated box, prism, cone or ball, about 1 large."""
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


def _take_half(pieces: Sequence[Trimesh], below: bool) -> list[Trimesh]:
    """Return the pieces centred below or above the middle of an object; all if none."""
    whole = fit_unit_box(pieces)
    mine = [piece for piece in whole if (float(piece.centroid[2]) < 0) == below]
    return mine or list(whole)
