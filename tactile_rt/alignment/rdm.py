"""Representational dissimilarity matrices of the six stimuli, and their comparison.

An RDM here is its 15 entries above the diagonal, row by row: 1 - Pearson's r over units between the
mean responses to two stimuli. RSA is Pearson's r between two RDMs (Chung et al. 2025, section
Neural Evaluation; Kriegeskorte 2008).
"""

from functools import cache
from itertools import combinations, permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import DISTANCES, SHAPES, STIMULI

Floats = NDArray[np.float64]

PAIRS = tuple(combinations(range(len(STIMULI)), 2))
# The paper says near where the recordings say close.
SYNONYMS = {"near": "close"}
# Centred values below this share of the values themselves are rounding: the vector is constant.
CONSTANT = 1e-13

UPPER = np.triu_indices(len(STIMULI), k=1)


def stimulus_index(shape: str, distance: str) -> int:
    """Place of a stimulus on the named axis; ``near`` is ``close``."""
    distance = SYNONYMS.get(distance, distance)
    if shape not in SHAPES:
        raise ConfigError(f"no shape {shape!r}: there are {', '.join(SHAPES)}")
    if distance not in DISTANCES:
        raise ConfigError(f"no distance {distance!r}: there are {', '.join(DISTANCES)} (or near)")
    return SHAPES.index(shape) * len(DISTANCES) + DISTANCES.index(distance)


def rdm(patterns: ArrayLike) -> Floats:
    """RDM of responses.

    Args:
        patterns: (..., 6, unit), any finite scale; at least two units.

    Returns:
        (..., 15). NaN where one of the two responses is not finite or the same in all units.
    """
    unit_length = normalised(patterns)
    correlation = np.matmul(unit_length, np.swapaxes(unit_length, -1, -2))
    return np.asarray(1 - correlation[..., UPPER[0], UPPER[1]])


def pearson(a: ArrayLike, b: ArrayLike) -> Floats:
    """Pearson's r along the last axis of (..., n) and (..., n), which broadcast.

    Returns:
        (...), NaN where a vector is constant or not finite.
    """
    return np.asarray((normalised(a) * normalised(b)).sum(axis=-1))


def rsa(a: ArrayLike, b: ArrayLike) -> float:
    """RSA of two sets of responses (6, unit), with numbers of units of their own."""
    return float(pearson(rdm(a), rdm(b)))


def square(rdms: ArrayLike) -> Floats:
    """RDMs (..., 15) as symmetric matrices (..., 6, 6) with a diagonal of zeros."""
    entries = np.asarray(rdms, dtype=np.float64)
    matrix = np.zeros((*entries.shape[:-1], len(STIMULI), len(STIMULI)))
    matrix[..., UPPER[0], UPPER[1]] = entries
    matrix[..., UPPER[1], UPPER[0]] = entries
    return matrix


@cache
def relabellings() -> NDArray[np.intp]:
    """Every relabelling of the six stimuli as a reordering of an RDM's entries.

    Returns:
        (720, 15): ``rdms[..., relabellings()[k]]`` are the RDMs after the k-th; the first changes
        nothing.
    """
    place = square(np.arange(len(PAIRS), dtype=np.float64)).astype(np.intp)
    orders = np.array(list(permutations(range(len(STIMULI)))), dtype=np.intp)
    entries: NDArray[np.intp] = place[orders[:, UPPER[0]], orders[:, UPPER[1]]]
    entries.flags.writeable = False
    return entries


def normalised(values: ArrayLike) -> Floats:
    """Vectors (..., n) centred and of length one: their products are Pearson's r.

    Returns:
        (..., n), NaN throughout a vector that is constant or not finite.
    """
    values = np.asarray(values, dtype=np.float64)
    finite = np.isfinite(values).all(axis=-1, keepdims=True)
    values = np.where(finite, values, np.nan)
    centred = values - values.mean(axis=-1, keepdims=True)
    length = np.sqrt((centred**2).sum(axis=-1, keepdims=True))
    scale = np.sqrt((values**2).sum(axis=-1, keepdims=True))
    return np.asarray(centred / np.where(length > CONSTANT * scale, length, np.nan))
