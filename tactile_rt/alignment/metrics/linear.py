"""Share of units' variance that a linear readout of a layer predicts for a held-out stimulus.

One stimulus is held out at a time. A ridge regression from the layer's steps to the units'
bins of 45 ms (without a time course: from means to means) is fitted to the others, its penalty
chosen by holding out each of these in turn. In each bin, the mean of the training stimuli is
subtracted from layer and units: a time course that all stimuli share, such as the onset of touch,
then adds nothing, and a regression without information scores 0 (a correlation would be negative:
the mean of the others lies opposite to the held-out response).

The score is 1 - error / variance over all bins and units, each unit in units of its noise, so that
units that distinguish stimuli weigh most. A perfect model is expected to reach the ceiling, the
share of the variance that remains without the noise of the means (from the spread of trials).
"""

import numpy as np

from tactile_rt.alignment.metrics import MINIMUM_CEILING, Measure
from tactile_rt.alignment.metrics.noise_ceiling import bins_of, means_of, sessions_of, values_of
from tactile_rt.alignment.metrics.rsa_cka import NOTHING, mean_pattern
from tactile_rt.alignment.neural import Animal, NeuralSession
from tactile_rt.alignment.rdm import Floats

PENALTIES = tuple(10.0**k for k in range(-4, 3))  # times the mean of the kernel's diagonal


def linear(animal: Animal) -> Measure:
    """Prepare a measure: the share of variance that a layer predicts for held-out stimuli."""
    sessions = sessions_of(animal)
    if not sessions:
        return NOTHING
    bins = bins_of(sessions)
    goal = means_of(sessions, bins)
    noise = np.concatenate([_estimate_noise(s, bins) for s in sessions], axis=-1)
    spread = (goal - goal.mean(axis=0)).std(axis=(0, 1))
    live = spread > 1e-12 * np.abs(goal).max(initial=0.0)
    if not live.any():
        return NOTHING
    scale = np.sqrt(noise.mean(axis=(0, 1)))
    scale = np.where(scale > 0, scale, spread)[live]
    goal, noise = goal[..., live] / scale, noise[..., live] / scale**2
    variance = sum(
        float(((goal[i] - np.delete(goal, i, axis=0).mean(axis=0)) ** 2).sum())
        for i in range(len(goal))
    )
    # Noise of the held-out response, and of the mean of the others that is subtracted from it.
    others = len(goal) - 1
    unexplained = float(noise.sum() * (1 + 1 / others))

    def fit(layer: Floats) -> float:
        steps = np.nan_to_num(layer[:, : goal.shape[1]]) if bins else mean_pattern(layer)[:, None]
        if not np.isfinite(steps).all() or not np.ptp(steps, axis=0).any():
            return float("nan")
        missing = goal.shape[1] - steps.shape[1]
        steps = np.pad(steps, ((0, 0), (0, max(missing, 0)), (0, 0)))
        return 1 - float(((goal - predict_held_out(steps, goal)) ** 2).sum()) / variance

    return Measure(1 - unexplained / variance, fit, MINIMUM_CEILING**2)


def predict_held_out(layer: Floats, goal: Floats) -> Floats:
    """Predict the goal's response to each stimulus by a regression on the other stimuli.

    The layer is (stimulus, bin, feature), the goal and the result are (stimulus, bin, unit).
    """
    out = np.empty_like(goal)
    for i in range(len(goal)):
        rest = [k for k in range(len(goal)) if k != i]
        errors = np.zeros(len(PENALTIES))
        for j in rest:
            inner = [k for k in rest if k != j]
            for p, guess in enumerate(_predict_ridge(layer, goal, inner, j, PENALTIES)):
                errors[p] += ((guess - goal[j]) ** 2).sum()
        best = PENALTIES[int(errors.argmin())]
        out[i] = _predict_ridge(layer, goal, rest, i, (best,))[0]
    return out


def _predict_ridge(
    layer: Floats, goal: Floats, known: list[int], held: int, penalties: tuple[float, ...]
) -> list[Floats]:
    """Predict the response (bin, unit) to a held-out stimulus, once for every penalty."""
    middle, level = layer[known].mean(axis=0), goal[known].mean(axis=0)
    x = (layer[known] - middle).reshape(-1, layer.shape[-1])
    y = (goal[known] - level).reshape(-1, goal.shape[-1])
    new = layer[held] - middle
    values, vectors = np.linalg.eigh(x @ x.T)
    values = np.maximum(values, 0)
    size = float(values.mean())
    if size <= 0:
        return [level] * len(penalties)
    rotated, projected = vectors.T @ y, (new @ x.T) @ vectors
    return [level + (projected / (values + penalty * size)) @ rotated for penalty in penalties]


def _estimate_noise(session: NeuralSession, bins: int) -> Floats:
    """Estimate the squared standard error (stimulus, bin, unit) of mean responses."""
    values = values_of(session, bins)
    out = np.empty((len(session.stimuli), *values.shape[1:]))
    for k in range(len(session.stimuli)):
        trials = values[session.stimulus == k]
        number = np.isfinite(trials).sum(axis=0)
        out[k] = np.nanvar(trials, axis=0, ddof=1) / number
    return out
