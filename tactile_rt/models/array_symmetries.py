"""Symmetries of a whisker array: who takes whose place, and how its load vectors change.

Loads are in each element's own frame. A symmetry S (a reflection or a rotation of the mount frame)
takes element i to the place of element j, whose own direction is R_j x. What j would feel is the
image S R_i f of the force, turned by the smallest rotation Q that takes the image of i's
direction to j's, in j's frame:

    f_j = R_j' Q S R_i f_i        m_j = det(S) R_j' Q S R_i m_i

So a load along the whisker stays one, and a bending keeps its direction in the head. A moment is
an axial vector: M = r x F holds before and after. Doing a reflection twice is the identity.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, rotation_matrices

__all__ = ["Symmetry", "compose", "symmetries"]

VECTORS = {"f": "N", "m": "N m"}  # name of a vector's components and their unit
AXES = "xyz"


@dataclass(frozen=True)
class Symmetry:
    """One of an array.

    Attributes:
        source: (element,) The index of the element whose loads each element takes.
        matrix: (element, channel, channel) The matrix that those loads are multiplied by.
    """

    source: NDArray[np.int64]
    matrix: NDArray[np.float64]


def symmetries(spec: ArraySpec) -> tuple[Symmetry, Symmetry, Symmetry]:
    """Mirrored across its columns, across its rows, and turned by a quarter.

    In a ragged grid every row (column) is reversed by itself, so that no whisker is lost. For a
    quarter turn, which a grid of 5 x 7 does not have, the grid is stretched to a square and every
    whisker goes to the nearest place, no two to one.

    Raises:
        ConfigError: the grid is a single line, or a channel is part of no force or moment vector.
    """
    column, row = _directions(spec)
    grid = np.array(spec.grid)
    turn = np.outer(row, column) - np.outer(column, row) + np.outer(*[np.cross(column, row)] * 2)
    return (
        _symmetry(spec, _reversed(grid, 0), _reflection(column)),
        _symmetry(spec, _reversed(grid, 1), _reflection(row)),
        _symmetry(spec, _turned(grid), turn),
    )


def compose(spec: ArraySpec, *steps: Symmetry) -> Symmetry:
    """The last of the symmetries first, then the one before it ...; of none: the identity."""
    n, channels = spec.shape
    source = np.arange(n)
    matrix = np.tile(np.eye(channels), (n, 1, 1))
    for step in reversed(steps):
        source, matrix = source[step.source], step.matrix @ matrix[step.source]
    return Symmetry(source, matrix)


def _reversed(grid: NDArray[np.int64], line: int) -> NDArray[np.int64]:
    """(element,) the whisker that mirrors each in its row (line 0) or column (line 1)."""
    source = np.arange(len(grid))
    for value in np.unique(grid[:, line]):
        members = np.flatnonzero(grid[:, line] == value)
        members = members[np.argsort(grid[members, 1 - line])]
        source[members] = members[::-1]
    return source


def _turned(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """(element,) the whisker that a quarter turn (column direction to row direction) puts there."""
    low, high = grid.min(0), grid.max(0)
    square = 2 * (grid - low) / (high - low) - 1  # (row, column) in [-1, 1]
    image = np.stack([square[:, 1], -square[:, 0]], axis=1)
    cost = ((square[:, None] - image[None]) ** 2).sum(-1)  # (place, whisker)
    source: NDArray[np.int64] = linear_sum_assignment(cost)[1]
    return source


def _directions(spec: ArraySpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Unit vectors of the mount frame along growing columns and, across them, growing rows."""
    grid = np.array(spec.grid, dtype=np.float64)
    positions = np.array(spec.positions, dtype=np.float64)
    design = np.column_stack([grid, np.ones(len(grid))])
    (row, column, _), *_ = np.linalg.lstsq(design, positions, rcond=None)
    size = np.linalg.norm(column)
    column = column / size if size > 0 else column
    row = row - (row @ column) * column
    if np.linalg.matrix_rank(design) < 3 or not (size > 0 and np.linalg.norm(row) > 0):
        raise ConfigError(
            f"array {spec.name!r} is no grid of whiskers in space: it cannot be mirrored and "
            "turned (augmentation 'tactile')"
        )
    return column, row / np.linalg.norm(row)


def _reflection(normal: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.eye(3) - 2 * np.outer(normal, normal)


def _symmetry(spec: ArraySpec, source: NDArray[np.int64], image: NDArray[np.float64]) -> Symmetry:
    frames = rotation_matrices(spec.orientations)
    polar = np.empty_like(frames)
    for j, i in enumerate(source):
        seen = image @ frames[i]
        x = image @ frames[i, :, 0]
        polar[j] = frames[j].T @ _smallest_rotation(x, frames[j, :, 0]) @ seen
    axial = np.linalg.det(image).round() * polar
    matrix = np.zeros((len(source), *[len(spec.channels)] * 2))
    for vector, parts in _vectors(spec).items():
        matrix[:, parts[:, None], parts] = polar if vector == "f" else axial
    return Symmetry(source, matrix)


def _vectors(spec: ArraySpec) -> dict[str, NDArray[np.int64]]:
    """Channel indices (x, y, z) of the force and the moment."""
    found = {}
    for vector, unit in VECTORS.items():
        names = [vector + axis for axis in AXES]
        if all(name in spec.channels for name in names):
            at = np.array([spec.channels.index(name) for name in names])
            if all(spec.units[k] == unit for k in at):
                found[vector] = at
    used = {int(k) for at in found.values() for k in at}
    rest = [name for k, name in enumerate(spec.channels) if k not in used]
    if rest:
        raise ConfigError(
            f"array {spec.name!r}: {rest[0]} is no component of a force (fx fy fz, N) or a moment "
            "(mx my mz, N m), so it cannot be mirrored and turned (augmentation 'tactile')"
        )
    return found


def _smallest_rotation(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation by the smallest angle that takes unit vector a to b (Rodrigues)."""
    v, c = np.cross(a, b), float(a @ b)
    if c < -1 + 1e-9:  # opposite: half a turn about any axis across, the same one for b to a
        across = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        across /= np.linalg.norm(across)
        half: NDArray[np.float64] = 2 * np.outer(across, across) - np.eye(3)
        return half
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    rotation: NDArray[np.float64] = np.eye(3) + k + k @ k / (1 + c)
    return rotation
