"""Split-half reliability of RDMs, vectorised over bootstraps, and the correction for noise.

A bootstrap assigns half of the rows (trials) at random to each half; the RDMs of the two half-means
correlate by r. Spearman-Brown, 2r / (1 + r), is the reliability of the mean of all rows. The score
of a source x against a target y is r_xy / sqrt(SB(r_xx) SB(r_yy)) (Chung et al. 2025, equation in
section Neural Evaluation, with the numerator of the published code: RSA of full trial means).
"""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tactile_rt.alignment.rdm import Floats, pearson, rdm, upper
from tactile_rt.core.errors import ConfigError

BOOTSTRAPS = 1000
SEED = 1234  # of the first bootstrap in the published analysis
CUTOFF = 0.5
NOUGHT = 1e-8  # a product of reliabilities below this is zero: the score would be rounding
# Bootstraps at a time: half-means of this many stay in a processor's cache.
AT_ONCE = 64


def spearman_brown(r: ArrayLike) -> Floats:
    """Reliability of twice as many trials: 2r / (1 + r); -inf at r = -1."""
    r = np.asarray(r, dtype=np.float64)
    with np.errstate(divide="ignore"):
        return np.asarray(2 * r / (1 + r))


def noise_corrected(r_xy: ArrayLike, r_xx: ArrayLike, r_yy: ArrayLike) -> Floats:
    """Score r_xy / sqrt(SB(r_xx) SB(r_yy)); arrays broadcast.

    Two negative reliabilities make a positive product, and a finite score that means nothing:
    whoever cannot rule them out checks the signs.

    Returns:
        NaN where the product under the root is negative, nearly zero or not finite.
    """
    with np.errstate(invalid="ignore"):
        product = spearman_brown(r_xx) * spearman_brown(r_yy)
    usable = np.isfinite(product) & (product > NOUGHT)
    return np.asarray(np.asarray(r_xy) / np.sqrt(np.where(usable, product, np.nan)))


@lru_cache(maxsize=32)
def first_halves(rows: int, bootstraps: int = BOOTSTRAPS, seed: int = SEED) -> NDArray[np.bool_]:
    """Which rows are in the first half, as in the published analysis.

    Bootstrap b shuffles the rows with the Mersenne twister of seed ``seed + b``; the first
    ``rows // 2`` make the first half. Rows of padding count.

    Returns:
        (bootstrap, row), read-only.
    """
    first = np.zeros((bootstraps, rows), dtype=np.bool_)
    generator = np.random.RandomState()
    for b in range(bootstraps):
        generator.seed(seed + b)  # a new generator costs more than the shuffle
        first[b, generator.permutation(rows)[: rows // 2]] = True
    first.flags.writeable = False
    return first


def trial_mean(rates: ArrayLike) -> Floats:
    """Mean over rows of (row, 6, unit), NaN left out: (6, unit), NaN where there is no value."""
    rates = np.asarray(rates, dtype=np.float64)
    there = np.isfinite(rates)
    return _ratio(np.where(there, rates, 0).sum(axis=0), there.sum(axis=0))


def half_rdms(rates: ArrayLike, first: NDArray[np.bool_]) -> Floats:
    """RDMs of the two half-means of every bootstrap.

    Args:
        rates: (row, 6, unit), NaN where there is no value.
        first: (bootstrap, row), whether a row is in the first half.

    Returns:
        (bootstrap, 2, pair). A bootstrap with a half-mean that is not finite is NaN throughout.
    """
    rates = np.asarray(rates, dtype=np.float64)
    if rates.ndim != 3 or first.ndim != 2 or rates.shape[0] != first.shape[1]:
        raise ConfigError(f"rates {rates.shape} and halves {first.shape} do not fit")
    rows = rates.shape[0]
    flat = rates.reshape(rows, -1)
    there = np.isfinite(flat)
    values = np.where(there, flat, 0)
    # Sessions are padded to one length, so few columns differ in where they have values.
    patterns, column = _distinct_columns(there)
    result = np.empty((first.shape[0], 2, len(upper(rates.shape[1])[0])))
    for begin in range(0, first.shape[0], AT_ONCE):
        part = first[begin : begin + AT_ONCE]
        # Both halves are summed: a difference from the total would turn zeros into rounding.
        weights = np.stack([part, ~part], axis=1).reshape(-1, rows).astype(np.float64)
        means = _ratio(weights @ values, (weights @ patterns)[:, column])
        means = means.reshape(-1, 2, *rates.shape[1:])
        kept = np.isfinite(means).all(axis=(1, 2, 3))
        result[begin : begin + AT_ONCE] = np.nan
        if kept.any():
            result[begin : begin + AT_ONCE][kept] = rdm(means[kept])
    return result


def split_half(rates: ArrayLike, first: NDArray[np.bool_]) -> Floats:
    """Pearson's r between the RDMs of the halves, (bootstrap,); NaN where it was dropped."""
    halves = half_rdms(rates, first)
    return pearson(halves[:, 0], halves[:, 1])


def filtered_mean(score: ArrayLike, r_yy: ArrayLike, r_xx: ArrayLike = 1.0) -> float:
    """The published aggregate: mean of a score over the bootstraps that pass the filter.

    The filter, at `CUTOFF`, is on raw split-half correlations of whole bootstraps. No neuron is
    ever filtered, and no Spearman-Brown correction is made, though the paper's text says both.

    Args:
        score: (bootstrap,), NaN where there is none.
        r_yy, r_xx: (bootstrap,) of target and source; a model's own is 1.

    Returns:
        NaN if no bootstrap is left.
    """
    score, r_yy, r_xx = np.broadcast_arrays(score, r_yy, r_xx)
    # As published, NaN is not below the cutoff; its score is NaN as well.
    kept = score[~((r_yy < CUTOFF) | (r_xx < CUTOFF)) & ~np.isnan(score)]
    return float(kept.mean()) if kept.size else float("nan")


def _ratio(total: Floats, number: NDArray[np.generic]) -> Floats:
    count = np.asarray(number, dtype=np.float64)
    return np.asarray(total / np.where(count > 0, count, np.nan))


def _distinct_columns(there: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.intp]]:
    """The different columns of (row, column) and which of them each column is."""
    packed = np.ascontiguousarray(np.packbits(there, axis=0).T)
    keys = packed.view(np.dtype((np.void, packed.shape[1]))).ravel()
    _, index, inverse = np.unique(keys, return_index=True, return_inverse=True)
    return there[:, index].astype(np.float64), np.asarray(inverse.ravel(), dtype=np.intp)
