"""Means over an animal's trials and over random halves of the trials, and the noise ceiling.

Halves are drawn within every session and stimulus; their agreement gives the reliability of the
whole (Spearman-Brown). A bin that some trials do not reach is averaged over the other trials.
"""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.neural import Animal, NeuralSession
from tactile_rt.alignment.rdm import Floats
from tactile_rt.alignment.reliability import spearman_brown

DIVISIONS = 100
SEED = 1234
MINIMUM_TRIALS = 4  # of every stimulus in a session: two in each half
MINIMUM_UNITS = 5  # of an animal: with fewer, correlations over units are mostly 1 or -1
LONGEST = 22  # largest number of bins: the steps of the models


def sessions_of(animal: Animal) -> tuple[NeuralSession, ...]:
    """Return an animal's sessions with enough trials per stimulus, or () with too few units."""
    kept = tuple(s for s in animal.sessions if s.trials.min() >= MINIMUM_TRIALS)
    return kept if sum(s.rates.shape[1] for s in kept) >= MINIMUM_UNITS else ()


def bins_of(sessions: tuple[NeuralSession, ...]) -> int:
    """Return the number of bins that enough trials reach in all sessions; 0 without courses."""
    reached = [LONGEST]
    for session in sessions:
        if session.course is None:
            return 0
        finite = np.asarray(np.isfinite(session.course).all(axis=2))  # (trial, bin)
        trials = [finite[session.stimulus == k].sum(axis=0) for k in range(len(session.stimuli))]
        enough = np.min(trials, axis=0) >= MINIMUM_TRIALS
        reached.append(int(enough.size if enough.all() else enough.argmin()))
    return min(reached)


def values_of(session: NeuralSession, bins: int) -> Floats:
    """Return rates (trial, bin, unit) in the first `bins` bins, or whole-trial rates."""
    if bins and session.course is not None:
        return session.course[:, :bins]
    return session.rates[:, None]


def divisions(session: NeuralSession, number: int = DIVISIONS) -> NDArray[np.bool_]:
    """Draw random halves of a session's trials: masks (division, trial), True for half 1."""
    rng = np.random.default_rng([SEED, len(session.stimulus)])
    first = np.zeros((number, len(session.stimulus)), dtype=np.bool_)
    for stimulus in range(len(session.stimuli)):
        rows = np.flatnonzero(session.stimulus == stimulus)
        places = rng.permuted(np.tile(np.arange(len(rows)), (number, 1)), axis=1)
        first[:, rows] = places < len(rows) // 2
    return first


def half_means(session: NeuralSession, bins: int, number: int = DIVISIONS) -> Floats:
    """Compute means of both halves of every division: (division, 2, stimulus, bin, unit)."""
    values = values_of(session, bins)
    first = divisions(session, number)
    return np.stack([_average_trials(values, session, half) for half in (first, ~first)], axis=1)


def means_of(sessions: tuple[NeuralSession, ...], bins: int) -> Floats:
    """Compute means over all trials, for the units of all sessions: (stimulus, bin, unit)."""
    return np.concatenate(
        [
            _average_trials(values_of(s, bins), s, np.ones((1, len(s.stimulus)), np.bool_))[0]
            for s in sessions
        ],
        axis=-1,
    )


def ceiling_of(agreements: Floats) -> float:
    """Return the noise ceiling, the root of the reliability, from the agreement of halves.

    The agreements (division,) are correlations or cosines. NaN if the reliability is not above 0.
    """
    finite = agreements[np.isfinite(agreements)]
    reliability = float(spearman_brown(finite.mean())) if finite.size else np.nan
    return float(np.sqrt(reliability)) if reliability > 0 else float("nan")


def _average_trials(values: Floats, session: NeuralSession, chosen: NDArray[np.bool_]) -> Floats:
    """Average chosen trials (division, trial) by stimulus: (division, stimulus, bin, unit)."""
    trials, bins, units = values.shape
    finite = np.asarray(np.isfinite(values).all(axis=2), dtype=np.float64)  # (trial, bin)
    flat = np.nan_to_num(values).reshape(trials, -1)
    out = np.empty((len(chosen), len(session.stimuli), bins, units))
    for k in range(len(session.stimuli)):
        rows = np.flatnonzero(session.stimulus == k)
        weights = chosen[:, rows].astype(np.float64)
        number = weights @ finite[rows]
        total = (weights @ flat[rows]).reshape(-1, bins, units)
        out[:, k] = total / np.where(number > 0, number, np.nan)[..., None]
    return out
