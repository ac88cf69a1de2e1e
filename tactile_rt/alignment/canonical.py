"""One order of a session's trials and units, whatever order and scale they came in.

Random divisions of trials are the same for the same data only if trials stand in an order that the
data decide. Sorting by value will not do: it depends on the order of units, and sorting units by
value on that of trials. So trials and units are told apart together, by colour refinement
(Weisfeiler and Leman): a unit's key is made from its rates in trials of which keys, a trial's key
from its rates in units of which keys, again and again. Sums of keys are whole numbers modulo 2^64,
so that no order of summation matters. Rates enter by their rank, which no scale changes. What has
the same key in the end is interchangeable.
"""

import numpy as np
from numpy.typing import NDArray

from tactile_rt.alignment.neural import NeuralSession

__all__ = ["canonical"]

Keys = NDArray[np.uint64]

ROUNDS = 3
SAME = 1e-9  # rates that differ by a smaller share are the same, but for rounding


def canonical(session: NeuralSession) -> tuple[NeuralSession, int]:
    """The same trials and units in one order, and a number that tells this session from others.

    Returns:
        The session's rates and stimuli alone, its trials sorted by stimulus; and a key below 2^64
        that no order of trials or units and no common factor of the rates changes.
    """
    ranks = _ranks(session.rates)
    trial = _mixed(session.stimulus.astype(np.uint64) + np.uint64(1))
    trial, unit = _refined(ranks, trial)
    key = int(trial.sum(dtype=np.uint64))
    while len(found := _twice(trial)):
        # These may change places, but only together with units: one of them is put first.
        trial[found[0]] = _mixed(trial[found[:1]])[0]
        trial, unit = _refined(ranks, trial)
    rows, columns = np.lexsort((trial, session.stimulus)), np.argsort(unit)
    ordered = NeuralSession(
        session.animal, session.name, session.rates[np.ix_(rows, columns)], session.stimulus[rows]
    )
    return ordered, key


def _refined(ranks: Keys, start: Keys) -> tuple[Keys, Keys]:
    """Keys of trials and units that tell apart what the keys of trials to start with do."""
    trial = start
    for _ in range(ROUNDS):
        unit = _mixed(_mixed(ranks + trial[:, None]).sum(axis=0, dtype=np.uint64))
        trial = _mixed(_mixed(ranks ^ unit).sum(axis=1, dtype=np.uint64) + start)
    return trial, unit


def _twice(keys: Keys) -> NDArray[np.intp]:
    """Where the lowest of the keys stands that are there more than once."""
    values, counts = np.unique(keys, return_counts=True)
    return (
        np.flatnonzero(keys == values[counts > 1][:1]) if (counts > 1).any() else np.array([], int)
    )


def _ranks(rates: NDArray[np.float64]) -> Keys:
    """Rank of each rate among all of them, mixed into 64 bits; equal rates have equal ranks."""
    order = np.argsort(rates, axis=None)
    sorted_ = rates.ravel()[order]
    steps = np.diff(sorted_) > SAME * np.maximum(np.abs(sorted_[1:]), np.abs(sorted_[:-1]))
    ranks = np.empty(rates.size, dtype=np.uint64)
    ranks[order] = np.concatenate([[0], np.cumsum(steps)])[: rates.size]
    return _mixed(ranks.reshape(rates.shape))


def _mixed(keys: Keys) -> Keys:
    """Each key scattered over 64 bits (the finaliser of SplitMix64, Steele et al. 2014)."""
    keys = keys + np.uint64(0x9E3779B97F4A7C15)
    keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(keys ^ (keys >> np.uint64(31)))
