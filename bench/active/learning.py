"""A policy by the cross-entropy method: what is felt shall tell kinds apart, with few touches.

It begins with what the script does. Every candidate plays the same episodes. Two recognisers learn
from all episodes so far, one from the even instances of every kind and one from the odd ones; each
judges episodes of the others. So a candidate is worth the mean log-probability of the true kind,
at each of the `BUDGETS`, that a recogniser gives which never felt that object.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.active.episodes import Episodes, feel, joined
from bench.active.policies import WEIGHTS, Learnt
from bench.active.recogniser import log_likelihoods, trained

Floats = NDArray[np.float64]

CANDIDATES, BEST, EPISODES, ROUNDS = 12, 4, 24, 5
SPREAD, LEAST_SPREAD = 0.4, 0.1


def learn(
    known: Episodes, instances: tuple[int, int], kinds: int, seed: int, say: Callable[[str], None],
    kept: Path,
) -> tuple[Learnt, list[float]]:  # fmt: skip
    """Learn a policy.

    Args:
        known: what other policies felt of these objects, for the recognisers to begin with.
        instances: of every kind, the first and the one after the last.
        kinds: how many there are.
        seed: of all that is drawn.
        say: told how it goes.
        kept: a folder that keeps what was felt.

    Returns:
        The policy, and the mean worth of the candidates of every round.
    """
    rng = np.random.default_rng(seed)
    mean, spread = _script(), np.full(WEIGHTS, SPREAD)
    course = []
    for turn in range(ROUNDS):
        weights = mean + spread * rng.standard_normal((CANDIDATES, *WEIGHTS))
        seeds = rng.integers(1 << 31, size=EPISODES)
        tasks = [(Learnt(w), instances, int(s), "") for w in weights for s in seeds]
        played = feel(tasks, kept / f"round{turn + 1}")
        known = joined([known, played])
        worth = _worth(known, played, kinds, seed).reshape(CANDIDATES, EPISODES).mean(axis=1)
        best = weights[np.argsort(worth)[-BEST:]]
        mean, spread = best.mean(axis=0), np.maximum(best.std(axis=0), LEAST_SPREAD)
        course.append(float(worth.mean()))
        say(f"round {turn + 1}: mean {worth.mean():.3f}, best {worth.max():.3f}")
    return Learnt(mean), course


def _script() -> Floats:
    """About what `Scripted` does: whisk, go ahead, slower where something is felt, up and down."""
    weights: Floats = np.zeros(WEIGHTS)
    weights[0, 0] = 0.55
    weights[3, :2] = 1.1, -1.5
    weights[4, 3] = 0.42
    return weights


def _worth(known: Episodes, played: Episodes, kinds: int, seed: int) -> Floats:
    """(episode,) mean log-probability of the truth over the budgets."""
    worth = np.zeros(len(played))
    for odd in (0, 1):
        net = trained(known.some(known.instances % 2 == odd), kinds, seed, epochs=20)
        others = played.instances % 2 != odd
        if others.any():
            theirs = played.some(others)
            said = log_likelihoods(net, theirs)
            worth[others] = said[:, np.arange(len(theirs)), theirs.labels].mean(axis=0)
    return worth
