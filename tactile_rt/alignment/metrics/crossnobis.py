"""Squared distances between responses in units of the noise, without the bias that noise adds.

Every session's units are whitened by the covariance of their trials about the stimulus's mean,
shrunk towards its diagonal by an estimate of its uncertainty (Schäfer & Strimmer 2005). Products
run over all pairs of *different* trials only: noise then lengthens no distance, 0 means the same
response, and the result does not depend on a division of the trials (Walther et al. 2016;
Diedrichsen et al. 2021). Each session has its own units, so the distances of sessions add up.

A layer has no noise: its distances are Euclidean. The fit is Pearson's r of the two.
"""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.metrics import Measure
from tactile_rt.alignment.metrics.noise_ceiling import ceiling_of, divisions, sessions_of
from tactile_rt.alignment.metrics.rsa_cka import NOTHING, mean_pattern
from tactile_rt.alignment.neural import Animal, NeuralSession
from tactile_rt.alignment.rdm import Floats, pearson, upper_indices


def crossnobis(animal: Animal) -> Measure:
    """Prepare a measure: the correlation of a layer's distances with an animal's crossnobis."""
    sessions = sessions_of(animal)
    if not sessions:
        return NOTHING
    units = sum(s.rates.shape[1] for s in sessions)
    pairs = len(upper_indices(len(sessions[0].stimuli))[0])
    whole, halves = np.zeros(pairs), np.zeros((2, 1, pairs))
    for session in sessions:
        white = session.rates @ _compute_whitening(session)
        every = np.ones((1, len(white)), dtype=np.bool_)
        first = divisions(session)
        whole = whole + distances(white, session.stimulus, every)[0] / units
        halves = halves + np.stack(
            [distances(white, session.stimulus, half) / units for half in (first, ~first)]
        )
    goal = whole
    return Measure(
        ceiling_of(pearson(halves[0], halves[1])),
        lambda layer: float(pearson(_measure_distances(mean_pattern(layer)), goal)),
    )


def distances(white: Floats, stimulus: NDArray[np.int64], chosen: NDArray[np.bool_]) -> Floats:
    """Compute cross-validated squared distances (division, pair), summed over units.

    Args:
        white: (trial, unit) whitened responses.
        stimulus: (trial,) indices from 0 on without gaps.
        chosen: (division, trial) True for trials that count; at least two of every stimulus.
    """
    of_each = [chosen * (stimulus == k) for k in range(int(stimulus.max()) + 1)]
    weights = np.stack(of_each, axis=1).astype(np.float64)  # (division, stimulus, trial)
    number = weights.sum(axis=-1)
    total = weights @ white
    alone = weights @ (white**2).sum(axis=-1)
    own = ((total**2).sum(axis=-1) - alone) / (number * (number - 1))
    mean = total / number[..., None]
    between = np.matmul(mean, mean.swapaxes(-1, -2))
    i, j = upper_indices(len(of_each))
    return np.asarray(own[:, i] + own[:, j] - 2 * between[:, i, j])


def shrunk_covariance(residuals: Floats, freedom: int) -> Floats:
    """Estimate the covariance of residuals (trial, unit), with correlations shrunk to zero."""
    n = len(residuals)
    products = residuals.T @ residuals
    squares = (residuals**2).T @ residuals**2
    variance = np.diag(products) / freedom
    scale = np.sqrt(np.outer(variance, variance))
    r, r2 = products / scale / (n - 1), squares / scale**2 / (n - 1)
    off = ~np.eye(len(products), dtype=bool)
    uncertain = (n / freedom**2 * (r2 - r**2))[off].sum()
    size = (r[off] ** 2).sum()
    shrinkage = min(max(uncertain / size, 0.0), 1.0) if size > 0 else 1.0
    return np.asarray(products / freedom * np.where(off, 1 - shrinkage, 1.0))


def _compute_whitening(session: NeuralSession) -> Floats:
    """Compute the whitening matrix (unit, unit), the root of the inverse noise covariance."""
    rates, stimulus = session.rates, session.stimulus
    residuals = rates.copy()
    for k in range(len(session.stimuli)):
        residuals[stimulus == k] -= rates[stimulus == k].mean(axis=0)
    live = (residuals**2).sum(axis=0) > 0  # the noise of a constant unit is unknown
    out = np.zeros((len(live), len(live)))
    if live.any():
        freedom = len(rates) - len(session.stimuli)
        covariance = shrunk_covariance(residuals[:, live], freedom)
        # With few trials some eigenvalues may not be positive: their directions are left out.
        values, vectors = np.linalg.eigh(covariance)
        kept = values > 1e-9 * values.max()
        roots = np.where(kept, 1 / np.sqrt(np.where(kept, values, 1)), 0)
        out[np.ix_(live, live)] = (vectors * roots) @ vectors.T
    return out


def _measure_distances(patterns: Floats) -> Floats:
    """Compute squared Euclidean distances (pair,) of responses (stimulus, unit)."""
    i, j = upper_indices(len(patterns))
    return np.asarray(((patterns[i] - patterns[j]) ** 2).sum(axis=-1))
