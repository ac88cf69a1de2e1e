"""Augmentations of tactile windows: variants that the same touch could have produced.

- "tactile": the array is mirrored across its columns or rows, rotated by 90 degrees, reversed in
  time; drawn for every window, on the loads in SI units. Whiskers are only permuted, and force
  and moment vectors are mirrored and rotated with the array.
- "tactile-paper": as published (Chung et al. 2025, Fig. 2b, and its code) on the frames: one draw
  for a whole batch, vectors unchanged, and a rotated 5 x 7 grid loses its outer columns.
- "image": the control: colour jitter, greyscale, blur and noise (Chen et al. 2020), with the
  loads of a cell as its colours.
- "image-paper", "image-paper-weak": the published controls, of SimCLR and of SimSiam: forces are
  the colours of one picture, moments those of a second, from 0 to 1; one draw for a batch.

Each symmetry and the reversal of "tactile" is applied to half of the windows; each operation of
"image" with SimCLR's probability. Temporal masking sets whole steps to zero.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Generator, Tensor

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream import ArraySpec, rotation_matrices
from tactile_rt.models import published_pictures

# A symmetry S (a reflection or a rotation of the mount frame) takes element i to the place of
# element j, whose own direction is R_j x. Loads are in each element's own frame: what j would feel
# is the image S R_i f of the force, rotated by the smallest rotation Q that takes the image of i's
# direction to j's, in j's frame: f_j = R_j' Q S R_i f_i, m_j = det(S) R_j' Q S R_i m_i. So an axial
# load stays axial, a bending keeps its direction in the head, and M = r x F holds before and after.
VECTORS = {"f": "N", "m": "N m"}  # name of a vector's components and their unit
AXES = "xyz"


@dataclass(frozen=True)
class Symmetry:
    """A symmetry of an array: a permutation of elements and matrices for their loads.

    Attributes:
        source: (element,) The index of the element whose loads each element receives.
        matrix: (element, channel, channel) The matrix that multiplies the received loads.
    """

    source: NDArray[np.int64]
    matrix: NDArray[np.float64]


def symmetries(spec: ArraySpec) -> tuple[Symmetry, Symmetry, Symmetry]:
    """Return an array's symmetries: mirrored across columns, across rows, rotated by 90 degrees.

    In a ragged grid every row (column) is reversed by itself, so that no whisker is lost. For the
    rotation, a grid that is not square (5 x 7) is first stretched to a square; then every whisker
    is assigned to the nearest place, each to a different one.

    Raises:
        ConfigError: the grid is a single line, or a channel is part of no force or moment vector.
    """
    column, row = _fit_directions(spec)
    grid = np.array(spec.grid)
    turn = np.outer(row, column) - np.outer(column, row) + np.outer(*[np.cross(column, row)] * 2)
    return (
        _symmetry(spec, _mirror_places(grid, 0), _reflection(column)),
        _symmetry(spec, _mirror_places(grid, 1), _reflection(row)),
        _symmetry(spec, _turn_places(grid), turn),
    )


def compose(spec: ArraySpec, *steps: Symmetry) -> Symmetry:
    """Compose symmetries, applied from last to first; return the identity if none is given."""
    n, channels = spec.shape
    source = np.arange(n)
    matrix = np.tile(np.eye(channels), (n, 1, 1))
    for step in reversed(steps):
        source, matrix = source[step.source], step.matrix @ matrix[step.source]
    return Symmetry(source, matrix)


def _mirror_places(grid: NDArray[np.int64], line: int) -> NDArray[np.int64]:
    """Return every whisker's mirror image (element,) in its row (line 0) or column (line 1)."""
    source = np.arange(len(grid))
    for value in np.unique(grid[:, line]):
        members = np.flatnonzero(grid[:, line] == value)
        members = members[np.argsort(grid[members, 1 - line])]
        source[members] = members[::-1]
    return source


def _turn_places(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the whisker (element,) that a rotation by 90 degrees moves to each place."""
    low, high = grid.min(0), grid.max(0)
    square = 2 * (grid - low) / (high - low) - 1  # (row, column) in [-1, 1]
    image = np.stack([square[:, 1], -square[:, 0]], axis=1)
    cost = ((square[:, None] - image[None]) ** 2).sum(-1)  # (place, whisker)
    source: NDArray[np.int64] = linear_sum_assignment(cost)[1]
    return source


def _fit_directions(spec: ArraySpec) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Fit unit vectors in the mount frame along columns and, perpendicular to them, along rows."""
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
    for vector, parts in _find_vectors(spec).items():
        matrix[:, parts[:, None], parts] = polar if vector == "f" else axial
    return Symmetry(source, matrix)


def _find_vectors(spec: ArraySpec) -> dict[str, NDArray[np.int64]]:
    """Return the channel indices (x, y, z) of the vectors "f" and "m", if present."""
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
    """Return the smallest rotation that takes unit vector a to unit vector b (Rodrigues)."""
    v, c = np.cross(a, b), float(a @ b)
    if c < -1 + 1e-9:  # opposite: half a turn about any normal axis, the same for b to a
        across = np.cross(a, np.eye(3)[np.abs(a).argmin()])
        across /= np.linalg.norm(across)
        half: NDArray[np.float64] = 2 * np.outer(across, across) - np.eye(3)
        return half
    k = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    rotation: NDArray[np.float64] = np.eye(3) + k + k @ k / (1 + c)
    return rotation


HALF = 0.5
JITTER, JITTER_CHANCE, GREY_CHANCE, NOISE = 0.8, 0.8, 0.2, 0.1  # SimCLR's; noise on log loads
BLUR = (1.0, 2.0, 1.0)

T = TypeVar("T")
Loads = tuple[Tensor, Tensor, Tensor]  # samples, offset, sigma: the input of `InputStage`


def _as_is(x: T, _: Generator) -> T:
    return x


@dataclass(frozen=True)
class Augmentation:
    """Random augmentations of a batch: of loads, of frames, and by masked steps.

    Attributes:
        loads: Function of (samples, offset, sigma) in SI units and a CPU generator; returns the
            three augmented. It runs before the input stage.
        frames: Function of frames (batch, step, sub-step * channel, row, column) and a generator on
            their device; returns them augmented. It runs after the input stage.
        mask: Function of the same arguments as `frames` that sets some steps to zero.
    """

    loads: Callable[[Loads, Generator], Loads]
    frames: Callable[[Tensor, Generator], Tensor]
    mask: Callable[[Tensor, Generator], Tensor] = _as_is


def build(name: str, spec: ArraySpec, masking: float = 0.0) -> Augmentation:
    """Build an augmentation by name.

    Args:
        masking: share of each window's steps that are also set to zero.

    Raises:
        ConfigError: the array has no symmetries ("tactile"), or its channels are not the colours
            of pictures or its grid is too small for one ("image-paper").
    """
    colours = len(spec.channels)
    loads: Callable[[Loads, Generator], Loads] = _as_is
    frames: Callable[[Tensor, Generator], Tensor] = _as_is
    if name == "tactile":
        loads = Tactile(spec)
    elif name == "tactile-paper":
        frames = partial(tactile_paper, channels=colours)
    elif name == "image":
        frames = partial(image, colours=colours)
    elif name != "none":
        if colours % published_pictures.COLOURS:
            raise ConfigError(
                f"augmentation {name} takes channels for the three colours of pictures: this "
                f"array has {colours}; take image"
            )
        if min(spec.grid_shape) < 2:
            raise ConfigError(
                f"augmentation {name} blurs pictures of 2 x 2 cells or more: this array has "
                f"{' x '.join(map(str, spec.grid_shape))}; take image"
            )
        jitter = published_pictures.JITTERS[name]
        frames = partial(published_pictures.augment, jitter=jitter)

    def mask(x: Tensor, generator: Generator) -> Tensor:
        return mask_steps(x, masking, generator)

    return Augmentation(loads, frames, mask if masking else _as_is)


class Tactile:
    """Augmentation of loads by mirroring, rotation and time reversal, drawn for every window.

    Raises:
        ConfigError: a channel is part of no force or moment, or the array is a single line.
    """

    def __init__(self, spec: ArraySpec) -> None:
        every = [compose(spec)]
        for symmetry in symmetries(spec):
            every += [compose(spec, symmetry, known) for known in every]
        self._source = torch.from_numpy(np.stack([s.source for s in every]))
        self._matrix = torch.from_numpy(np.stack([s.matrix for s in every]).astype(np.float32))

    def __call__(self, loads: Loads, generator: Generator) -> Loads:
        n = len(loads[0])
        which = torch.randint(len(self._source), (n,), generator=generator)
        reverse = torch.rand(n, generator=generator) < HALF
        return self.transform(loads, which, reverse)

    def transform(self, loads: Loads, which: Tensor, reverse: Tensor) -> Loads:
        """Apply symmetry number `which` (batch,); reverse time where `reverse` (batch,) is True.

        A reversed movement bends a whisker the other way, so its loads change their sign.
        """
        samples, offset, sigma = loads
        device = samples.device
        source, matrix = self._source[which].to(device), self._matrix[which].to(device)
        each, reverse = torch.arange(len(which), device=device)[:, None], reverse.to(device)
        sign = 1.0 - 2.0 * reverse.float()
        flat = samples.flatten(1, 2).transpose(1, 2)[each, source]  # (batch, element, sample, c)
        moved = torch.einsum("besj,beij->besi", flat, matrix * sign[:, None, None, None])
        moved = torch.where(reverse[:, None, None, None], moved.flip(2), moved)
        offset = torch.einsum("bej,beij->bei", offset[each, source], matrix)
        # A rotated channel mixes several: the variances of their independent noises add up.
        variance = torch.einsum("bej,beij->bei", sigma[each, source] ** 2, matrix**2)
        return (
            moved.transpose(1, 2).reshape(samples.shape),
            offset * sign[:, None, None],
            variance.sqrt(),
        )


def tactile_paper(frames: Tensor, generator: Generator, channels: int = 6) -> Tensor:
    """Flip, rotate and reverse frames as published, with one draw for the batch.

    Half of the batches are flipped, along columns or rows with equal probability; rotations by 0,
    90, 180 and 270 degrees are equally likely; half of the batches are reversed in time.

    Args:
        frames: (batch, step, sub-step * channel, row, column).
    """

    def draw(below: int) -> int:
        return int(torch.randint(below, (), generator=generator, device=generator.device))

    axis, flipped, turns, reverse = (draw(n) for n in (2, 2, 4, 2))
    mirrored = (-1, -2)[axis] if flipped else 0
    return augment_as_published(frames, mirrored, turns, bool(reverse), channels)


def augment_as_published(
    frames: Tensor, mirrored: int, turns: int, reverse: bool, channels: int = 6
) -> Tensor:
    """Flip, rotate and time-reverse frames as augmentation `tactile_paper` does.

    The caller draws the parameters.

    Args:
        frames: (batch, step, sub-step * channel, row, column).
        mirrored: the axis to flip, -1 or -2; 0: none.
        turns: counter-clockwise rotations by 90 degrees; cells that leave the grid are lost.
        reverse: reverse all sub-steps in time, with the opposite sign.
    """
    if mirrored:
        frames = frames.flip(mirrored)
    frames = turn_images(frames, turns)
    if not reverse:
        return frames
    steps = frames.unflatten(2, (-1, channels))  # (batch, step, sub-step, channel, row, column)
    back: Tensor = -steps.flip(1, 2).flatten(2, 3)
    return back


def turn_images(frames: Tensor, turns: int) -> Tensor:
    """Rotate images counter-clockwise by `turns` * 90 degrees; cells outside the grid are lost."""
    if turns % 2 == 0:
        return frames.flip((-2, -1)) if turns % 4 else frames
    side = min(frames.shape[-2:])
    top, left = (frames.shape[-2] - side) // 2, (frames.shape[-1] - side) // 2
    out = torch.zeros_like(frames)
    square = frames[..., top : top + side, left : left + side]
    out[..., top : top + side, left : left + side] = square.rot90(turns, (-2, -1))
    return out


def image(frames: Tensor, generator: Generator, colours: int = 6) -> Tensor:
    """Augment frames as SimCLR augments pictures, with a separate draw for every window.

    Args:
        frames: (batch, step, sub-step * colour, row, column).
    """
    n, device = len(frames), frames.device
    x = frames.unflatten(2, (-1, colours))  # (batch, step, sub-step, colour, row, column)

    def draw() -> Tensor:
        return torch.rand(n, 1, 1, 1, 1, 1, generator=generator, device=device)

    def factor() -> Tensor:
        return 1 + JITTER * (2 * draw() - 1)

    brightness = x * factor()
    mean = brightness.mean(dim=(1, 2, 3, 4, 5), keepdim=True)
    contrast = mean + (brightness - mean) * factor()
    grey = contrast.mean(3, keepdim=True)
    saturated = grey + (contrast - grey) * factor()
    x = torch.where(draw() < JITTER_CHANCE, saturated, x)
    x = torch.where(draw() < GREY_CHANCE, x.mean(3, keepdim=True).expand_as(x), x)
    x = torch.where(draw() < HALF, _blur(x), x)
    noise = torch.randn(x.shape, generator=generator, device=device)
    x = x + NOISE * (draw() < HALF) * noise
    return x.flatten(2, 3)


def _blur(x: Tensor) -> Tensor:
    """Blur frames (..., row, column); cells at an edge are repeated beyond it.

    One matrix product over all cells: a convolution by channel takes twenty times as long.
    """
    rows, columns = (_blur_matrix(n).to(x) for n in x.shape[-2:])
    return (x.flatten(-2) @ torch.kron(rows, columns).T).view(x.shape)


def _blur_matrix(cells: int) -> Tensor:
    """Return the matrix (blurred cell, cell) that blurs a line of `cells` cells."""
    weights = torch.tensor(BLUR) / sum(BLUR)
    reach = len(BLUR) // 2
    shares = torch.zeros(cells, cells)
    for shift, weight in zip(range(-reach, reach + 1), weights, strict=True):
        at = torch.arange(cells)
        shares[at, (at + shift).clamp(0, cells - 1)] += weight
    return shares


def mask_steps(frames: Tensor, share: float, generator: Generator) -> Tensor:
    """Set a share of every window's steps to zero, drawn at random for each window."""
    n, steps = frames.shape[:2]
    order = torch.rand(n, steps, generator=generator, device=frames.device).argsort(1).argsort(1)
    kept = order >= round(share * steps)
    return frames * kept[:, :, None, None, None]
