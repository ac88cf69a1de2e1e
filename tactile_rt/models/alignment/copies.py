"""Recordings that are there twice, if in another sorting, in another order or with units less.

Two copies of a session would be split into the same halves and agree with each other perfectly.
Two sessions are copies if they share most of their trials (when each began, and its stimulus), or
most of their units (how often which rate came with which stimulus), whatever the order.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from tactile_rt.errors import ConfigError
from tactile_rt.models.alignment.neural import NeuralSession

__all__ = ["refuse_copies"]

MOST = 0.5  # of the smaller one's trials or units
FEWEST = 3  # of trials or units that say something


def refuse_copies(sessions: Sequence[NeuralSession]) -> None:
    """Refuse recordings that hold a session twice.

    Raises:
        ConfigError: naming two sessions that are copies.
    """
    trials = [_trials(session) for session in sessions]
    units = [_units(session) for session in sessions]
    for j, later in enumerate(sessions):
        for i, earlier in enumerate(sessions[:j]):
            if _shared(units[i], units[j]):
                how = ""
            elif _shared(trials[i], trials[j]):
                how = " with other units"
            else:
                continue
            raise ConfigError(
                f"sessions {earlier.name} and {later.name} hold the same trials{how}: "
                "give one of them"
            )


def _shared(one: Counter[bytes], other: Counter[bytes]) -> bool:
    fewer = min(one.total(), other.total())
    return fewer >= FEWEST and (one & other).total() > MOST * fewer


def _trials(session: NeuralSession) -> Counter[bytes]:
    """Each trial by when it began, to a ms, and its stimulus."""
    if session.begin is None:
        return Counter()
    began = np.round(session.begin * 1e3).astype(np.int64)
    return Counter(row.tobytes() for row in np.stack([began, session.stimulus], axis=1))


def _units(session: NeuralSession) -> Counter[bytes]:
    """Each unit by its rates, sorted within stimuli; one of fewer than three rates says nothing."""
    found: Counter[bytes] = Counter()
    for rates in session.rates.T:
        if len(np.unique(rates)) >= FEWEST:
            order = np.lexsort((rates, session.stimulus))
            found[session.stimulus[order].tobytes() + rates[order].tobytes()] += 1
    return found
