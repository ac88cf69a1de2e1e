"""Representational dissimilarity matrices (RDMs) of stimuli, and their comparison.

An RDM of n stimuli is stored as its n (n - 1) / 2 entries above the diagonal, row by row, 15 for
six stimuli: 1 - Pearson's r over units between the mean responses to two stimuli. RSA is Pearson's
r between two RDMs (Chung et al. 2025, section Neural Evaluation; Kriegeskorte 2008).
"""

import math
from functools import cache
from itertools import permutations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.core.errors import ConfigError
from tactile_rt.core.stream.stimuli import DISTANCES, SHAPES

Floats = NDArray[np.float64]

# The paper's name of a distance: the recordings' name.
SYNONYMS = {"near": "close"}
# A vector counts as constant if its centred norm is below this share of its norm: rounding errors.
CONSTANT = 1e-13
EXACT = 7  # most stimuli for which all relabellings are used
DRAWN = 5000  # relabellings that are drawn for more stimuli


def stimulus_index(shape: str, distance: str) -> int:
    """Return the index in `STIMULI` of a shape at a distance; "near" means "close"."""
    distance = SYNONYMS.get(distance, distance)
    if shape not in SHAPES:
        raise ConfigError(f"no shape {shape!r}: there are {', '.join(SHAPES)}")
    if distance not in DISTANCES:
        raise ConfigError(f"no distance {distance!r}: there are {', '.join(DISTANCES)} (or near)")
    return SHAPES.index(shape) * len(DISTANCES) + DISTANCES.index(distance)


@cache
def upper_indices(stimuli: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return rows and columns of the entries above the diagonal of an RDM."""
    return np.triu_indices(stimuli, k=1)


def count_stimuli(entries: int) -> int:
    """Return the number of stimuli of an RDM with the given number of entries."""
    return (1 + math.isqrt(1 + 8 * entries)) // 2


def rdm(patterns: ArrayLike) -> Floats:
    """Compute the RDM (..., pair) of responses.

    Args:
        patterns: (..., stimulus, unit), at any scale; at least two units.

    Returns:
        1 - r by pair; NaN where one of the two responses is not finite or the same in all units.
    """
    unit_length = normalise_vectors(patterns)
    correlation = np.matmul(unit_length, np.swapaxes(unit_length, -1, -2))
    i, j = upper_indices(unit_length.shape[-2])
    return np.asarray(1 - correlation[..., i, j])


def pearson(a: ArrayLike, b: ArrayLike) -> Floats:
    """Compute Pearson's r along the last axis of (..., n) and (..., n), which broadcast.

    Returns:
        (...), NaN where a vector is constant or not finite.
    """
    return np.asarray((normalise_vectors(a) * normalise_vectors(b)).sum(axis=-1))


def rsa(a: ArrayLike, b: ArrayLike) -> float:
    """Compute the RSA of two sets of responses (stimulus, unit), which may differ in units."""
    return float(pearson(rdm(a), rdm(b)))


def to_matrices(rdms: ArrayLike) -> Floats:
    """Convert RDMs (..., pair) to symmetric matrices (..., n, n) with a zero diagonal."""
    entries = np.asarray(rdms, dtype=np.float64)
    stimuli = count_stimuli(entries.shape[-1])
    i, j = upper_indices(stimuli)
    matrix = np.zeros((*entries.shape[:-1], stimuli, stimuli))
    matrix[..., i, j] = matrix[..., j, i] = entries
    return matrix


@cache
def relabellings(stimuli: int) -> NDArray[np.intp]:
    """Return all relabellings of stimuli, as permutations of an RDM's entries.

    For more than `EXACT` stimuli, it returns a fixed random sample of `DRAWN`.

    Returns:
        (way, pair), 720 ways for six stimuli: ``rdms[..., relabellings(6)[k]]`` are the RDMs after
        relabelling k; the first is the identity.
    """
    i, j = upper_indices(stimuli)
    place = to_matrices(np.arange(len(i), dtype=np.float64)).astype(np.intp)
    if stimuli <= EXACT:
        orders = np.array(list(permutations(range(stimuli))), dtype=np.intp)
    else:
        same = np.tile(np.arange(stimuli), (DRAWN, 1))
        orders = np.random.default_rng(0).permuted(same, axis=1)
        orders[0] = same[0]
    entries: NDArray[np.intp] = place[orders[:, i], orders[:, j]]
    entries.flags.writeable = False
    return entries


def normalise_vectors(values: ArrayLike) -> Floats:
    """Centre vectors (..., n) and scale them to length 1, so products are Pearson's r.

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
