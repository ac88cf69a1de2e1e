"""Similarity of two geometries: of a layer's and of an animal's responses to the stimuli.

- `rsa`: Pearson's r of the dissimilarities 1 - r (Kriegeskorte 2008) of mean responses over time.
- `rsa_time`: the same in each bin of 45 ms, which is a step of the model, both counted from the
  first contact; r and ceiling are each averaged over the bins in which the animal is reliable. In
  a bin in which a layer responds to all stimuli alike, its fit is 0.
- `cka`: the cosine of the U-centred linear kernels. Dropping the diagonal and U-centring make the
  mean of HSIC, and of the noise in it, zero (Song et al. 2012, equation 5), whereas the usual
  linear CKA of few stimuli and many units is near 1 for any pair.

The ceiling is the root of the Spearman-Brown reliability of the animal's own geometry.
"""

import warnings
from collections.abc import Callable

import numpy as np

from tactile_rt.alignment.metrics import Measure, noise_ceiling
from tactile_rt.alignment.neural import Animal
from tactile_rt.alignment.rdm import Floats, pearson, rdm, upper_indices

NOTHING = Measure(float("nan"), lambda layer: float("nan"))  # for too few trials or units


def rsa(animal: Animal) -> Measure:
    """Prepare a measure: the RSA of a layer and an animal, from time-averaged responses."""
    return _compare_means(animal, rdm, pearson)


def rsa_time(animal: Animal) -> Measure:
    """Prepare a measure: the RSA of a layer and an animal, averaged over time bins."""
    found = time_course(animal)
    if found is None:
        return NOTHING
    goal, ceilings = found
    usable = np.isfinite(ceilings)
    if not usable.any():
        return NOTHING

    def fit(layer: Floats) -> float:
        bins = min(len(goal), layer.shape[1])
        r = pearson(rdm(layer[:, :bins].swapaxes(0, 1)), goal[:bins])
        if not np.isfinite(r).any():
            return float("nan")
        whole = np.zeros(len(goal))
        whole[:bins] = np.nan_to_num(r)
        return float(whole[usable].mean())

    return Measure(float(ceilings[usable].mean()), fit)


def time_course(animal: Animal) -> tuple[Floats, Floats] | None:
    """Compute an animal's RDMs (bin, pair) and ceilings (bin,); None without time bins."""
    sessions = noise_ceiling.sessions_of(animal)
    bins = noise_ceiling.bins_of(sessions) if sessions else 0
    if not bins:
        return None
    goal = rdm(noise_ceiling.means_of(sessions, bins).swapaxes(0, 1))
    whole = np.concatenate([noise_ceiling.half_means(s, bins) for s in sessions], axis=-1)
    parts = rdm(np.moveaxis(whole, 3, 0))  # (bin, division, 2, pair)
    r = pearson(parts[:, :, 0], parts[:, :, 1])
    return goal, np.array([noise_ceiling.ceiling_of(row) for row in r])


def cka(animal: Animal) -> Measure:
    """Prepare a measure: the U-centred CKA of a layer and an animal's time-averaged responses."""
    return _compare_means(animal, u_centred, cosine)


def _compare_means(
    animal: Animal, form: Callable[[Floats], Floats], agree: Callable[[Floats, Floats], Floats]
) -> Measure:
    """Prepare a measure that compares mean responses after conversion by `form`, e.g. to RDMs."""
    sessions = noise_ceiling.sessions_of(animal)
    if not sessions:
        return NOTHING
    goal = form(noise_ceiling.means_of(sessions, 0)[:, 0])
    halves = [noise_ceiling.half_means(session, 0)[..., 0, :] for session in sessions]
    parts = form(np.concatenate(halves, axis=-1))
    return Measure(
        noise_ceiling.ceiling_of(agree(parts[:, 0], parts[:, 1])),
        lambda layer: float(agree(form(mean_pattern(layer)), goal)),
    )


def u_centred(patterns: Floats) -> Floats:
    """Compute the U-centred linear kernel's upper entries from responses (..., n, unit).

    The entries are (..., n (n - 1) / 2); n is at least 4.
    """
    kernel = np.matmul(patterns, np.swapaxes(patterns, -1, -2))
    n = kernel.shape[-1]
    i, j = upper_indices(n)
    kernel = kernel * (1 - np.eye(n))
    rows = kernel.sum(axis=-1)
    centred = (
        kernel
        - (rows[..., :, None] + rows[..., None, :]) / (n - 2)
        + rows.sum(axis=-1)[..., None, None] / ((n - 1) * (n - 2))
    )
    return np.asarray(centred[..., i, j])


def cosine(a: Floats, b: Floats) -> Floats:
    """Return the cosine along the last axis; NaN where a vector is zero."""
    with np.errstate(invalid="ignore", divide="ignore"):
        lengths = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
        return np.asarray((a * b).sum(axis=-1) / np.where(lengths > 0, lengths, np.nan))


def mean_pattern(layer: Floats) -> Floats:
    """Average a layer (stimulus, step, unit) over its finite steps; return (stimulus, unit)."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # NaN for a layer that no input reaches
        return np.asarray(np.nanmean(layer, axis=1))
