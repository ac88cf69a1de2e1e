"""Split-half reliability of RDMs, vectorised over bootstraps, and the correction for noise.

A bootstrap divides the rows (trials) at random into two halves; r is the correlation of the RDMs of
the two half-means. Spearman-Brown, 2r / (1 + r), is the reliability of the mean of all rows. A
source x scores r_xy / sqrt(SB(r_xx) SB(r_yy)) against a target y (Chung et al. 2025, equation in
section Neural Evaluation, with the numerator of the published code: RSA of full trial means).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.rdm import Floats, pearson, rdm, upper_indices
from tactile_rt.core.errors import ConfigError

BOOTSTRAPS = 1000
SEED = 1234  # seed of the first bootstrap in the published analysis
CUTOFF = 0.5
NOUGHT = 1e-8  # a product of reliabilities up to this counts as 0: scores would be rounding error
AT_ONCE = 64  # bootstraps per batch: their half-means fit a processor's cache


def spearman_brown(r: ArrayLike) -> Floats:
    """Return the Spearman-Brown reliability 2r / (1 + r) of a split-half r. It is -inf for -1."""
    r = np.asarray(r, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(2 * r / (1 + r))


def noise_corrected(r_xy: ArrayLike, r_xx: ArrayLike, r_yy: ArrayLike) -> Floats:
    """Compute the score r_xy / sqrt(SB(r_xx) SB(r_yy)); arrays broadcast.

    Two negative reliabilities make a positive product, and a finite score without meaning: check
    the signs if that can happen.

    Returns:
        The score; NaN where the product under the root is negative, nearly zero or not finite.
    """
    with np.errstate(invalid="ignore"):
        product = spearman_brown(r_xx) * spearman_brown(r_yy)
    usable = np.isfinite(product) & (product > NOUGHT)
    return np.asarray(np.asarray(r_xy) / np.sqrt(np.where(usable, product, np.nan)))


@lru_cache(maxsize=32)
def first_halves(rows: int, bootstraps: int = BOOTSTRAPS, seed: int = SEED) -> NDArray[np.bool_]:
    """Draw the rows of the first half for every bootstrap, as in the published analysis.

    Bootstrap b shuffles the rows with the Mersenne twister of seed ``seed + b``; the first
    ``rows // 2`` are the first half. Padding rows count too.

    Returns:
        (bootstrap, row), True for rows in the first half; read-only.
    """
    first = np.zeros((bootstraps, rows), dtype=np.bool_)
    generator = np.random.RandomState()
    for b in range(bootstraps):
        generator.seed(seed + b)  # a new generator costs more than the shuffle
        first[b, generator.permutation(rows)[: rows // 2]] = True
    first.flags.writeable = False
    return first


def trial_mean(rates: ArrayLike) -> Floats:
    """Average rates (row, 6, unit) over finite rows; return (6, unit), NaN without any."""
    rates = np.asarray(rates, dtype=np.float64)
    finite = np.isfinite(rates)
    return _divide_by_count(np.where(finite, rates, 0).sum(axis=0), finite.sum(axis=0))


def half_rdms(rates: ArrayLike, first: NDArray[np.bool_]) -> Floats:
    """Compute the RDMs (bootstrap, 2, pair) of the two half-means of every bootstrap.

    A bootstrap is all NaN if any of its half-means is not finite.

    Args:
        rates: (row, 6, unit), NaN for missing values.
        first: (bootstrap, row), True for rows in the first half.
    """
    rates = np.asarray(rates, dtype=np.float64)
    if rates.ndim != 3 or first.ndim != 2 or rates.shape[0] != first.shape[1]:
        raise ConfigError(f"rates {rates.shape} and halves {first.shape} do not fit")
    rows = rates.shape[0]
    flat = rates.reshape(rows, -1)
    finite = np.isfinite(flat)
    values = np.where(finite, flat, 0)
    # Sessions are padded to one length, so there are few patterns of missing values.
    patterns, column = _find_distinct_columns(finite)
    result = np.empty((first.shape[0], 2, len(upper_indices(rates.shape[1])[0])))
    for begin in range(0, first.shape[0], AT_ONCE):
        part = first[begin : begin + AT_ONCE]
        # Both halves are summed, since differences from the total would make zeros inexact.
        weights = np.stack([part, ~part], axis=1).reshape(-1, rows).astype(np.float64)
        means = _divide_by_count(weights @ values, (weights @ patterns)[:, column])
        means = means.reshape(-1, 2, *rates.shape[1:])
        kept = np.isfinite(means).all(axis=(1, 2, 3))
        result[begin : begin + AT_ONCE] = np.nan
        if kept.any():
            result[begin : begin + AT_ONCE][kept] = rdm(means[kept])
    return result


def split_half(rates: ArrayLike, first: NDArray[np.bool_]) -> Floats:
    """Return the correlation (bootstrap,) of the halves' RDMs; NaN if a half-mean is not finite."""
    halves = half_rdms(rates, first)
    return pearson(halves[:, 0], halves[:, 1])


def filtered_mean(score: ArrayLike, r_yy: ArrayLike, r_xx: ArrayLike = 1.0) -> float:
    """Average a score over the bootstraps that pass the published filter; NaN without any.

    The filter keeps bootstraps whose raw split-half correlations reach `CUTOFF`. It filters no
    neurons and applies no Spearman-Brown correction, though the paper's text states both.

    Args:
        score: (bootstrap,), NaN if missing.
        r_yy, r_xx: (bootstrap,) split-half correlations of target and source; 1 for a model.
    """
    score, r_yy, r_xx = np.broadcast_arrays(score, r_yy, r_xx)
    # As published, NaN is not below the cutoff; its score is NaN as well.
    kept = score[~((r_yy < CUTOFF) | (r_xx < CUTOFF)) & ~np.isnan(score)]
    return float(kept.mean()) if kept.size else float("nan")


def _divide_by_count(total: Floats, number: NDArray[np.generic]) -> Floats:
    count = np.asarray(number, dtype=np.float64)
    return np.asarray(total / np.where(count > 0, count, np.nan))


def _find_distinct_columns(mask: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.intp]]:
    """Return the distinct columns of a mask (row, column) and their index for each column."""
    packed = np.ascontiguousarray(np.packbits(mask, axis=0).T)
    keys = packed.view(np.dtype((np.void, packed.shape[1]))).ravel()
    _, index, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return mask[:, index].astype(np.float64), np.asarray(inverse.ravel(), dtype=np.intp)
