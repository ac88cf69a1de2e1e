"""Protocol `strict`: the default.

- Stimuli are named; sessions pool by name, and nothing that was not shown counts.
- Trials are first split in two within every session and stimulus: on one half units are chosen
  (split-half Spearman-Brown > 0.5), on the other everything is scored. The same scoring without the
  choice of units stands beside it.
- Halves are drawn within every session and stimulus. Sessions and trials are put in an order that
  depends on their values alone, so that neither the order of files nor of trials matters.
- An animal's reliability is that of its mean split-half correlation over all bootstraps, negative
  ones included; it corrects for noise once, and an animal at or below zero is not scored. Only
  animals whose RDM has a reliability of at least 0.5 count in a mean.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tactile_rt.models.alignment.benchmark import Benchmark, Consistency, Frozen, Target
from tactile_rt.models.alignment.neural import Animal, NeuralSession, rates_sha256
from tactile_rt.models.alignment.pooling import Moments, moments_of
from tactile_rt.models.alignment.rdm import STIMULI, pearson
from tactile_rt.models.alignment.reliability import BOOTSTRAPS, SEED, spearman_brown
from tactile_rt.stream import ConfigError

__all__ = [
    "MINIMUM_RELIABILITY",
    "MINIMUM_TRIALS",
    "MINIMUM_UNITS",
    "disjoint_trials",
    "freeze_strict",
]

Floats = NDArray[np.float64]
Trials = tuple[NDArray[np.intp], ...]  # of every stimulus

MINIMUM_RELIABILITY = 0.5  # of a unit, and of an animal's RDM
MINIMUM_TRIALS = 4  # of every stimulus in a session: two halves of two halves
MINIMUM_UNITS = 5  # of an RDM: with fewer its correlations are mostly 1 or -1
SELECTION_BOOTSTRAPS = 100


@dataclass(frozen=True, eq=False)
class _Pool:
    """Units of an animal, or of several.

    Attributes:
        full: The moments of the mean responses over all scoring trials.
        halves: (bootstrap, 2, ...) The moments of both half-means of every bootstrap.
    """

    full: Moments
    halves: Moments

    def __add__(self, other: "_Pool") -> "_Pool":
        return _Pool(self.full + other.full, self.halves + other.halves)

    def freeze(self) -> Frozen:
        """RDM, reliability and the factor that corrects for noise."""
        units = self.full.units
        reliability = np.nan
        dissimilarities = np.full(15, np.nan)
        if units >= MINIMUM_UNITS:
            dissimilarities = self.full.rdm()
            halves = self.halves.rdm()
            r = pearson(halves[:, 0], halves[:, 1])
            there = r[np.isfinite(r)]
            if there.size and np.isfinite(dissimilarities).all():
                reliability = float(spearman_brown(there.mean()))
        factor = 1 / np.sqrt(reliability) if reliability > 0 else np.nan
        return Frozen(np.nan_to_num(dissimilarities), reliability, float(factor), units)


def freeze_strict(
    animals: Sequence[Animal],
    bootstraps: int = BOOTSTRAPS,
    seed: int = SEED,
    progress: Callable[[float], None] = lambda share: None,
) -> Benchmark:
    """Reliabilities and RDMs of animals, and their consistency.

    Args:
        animals: whose rates count from first contact to choice.
        bootstraps, seed: of the splits.
        progress: called with the share done, 0 to 1.

    Raises:
        ConfigError: a session given twice, or an animal without a usable session.
    """
    _refuse_copies(animals)
    names, notes = [], []
    targets: list[Target] = []
    pools: list[_Pool] = []
    for done, animal in enumerate(sorted(animals, key=lambda a: a.name), start=1):
        sessions = []
        for session in sorted(animal.sessions, key=lambda s: s.name):
            few = [f"{n} of {s}" for s, n in zip(STIMULI, session.trials, strict=True)
                   if n < MINIMUM_TRIALS]  # fmt: skip
            if few:
                notes.append(
                    f"session {session.name} left out: it has {', '.join(few)}, "
                    f"and every stimulus needs {MINIMUM_TRIALS} correct trials"
                )
            else:
                sessions.append(_canonical(session))
        if not sessions:
            notes.append(f"animal {animal.name} left out: none of its sessions can be used")
            progress(done / len(animals))
            continue
        sessions.sort(key=_sha256)
        every, kept = _pools(sessions, bootstraps, seed)
        chosen = kept.freeze()
        names.append(animal.name)
        pools.append(kept)
        targets.append(
            Target(
                name=animal.name,
                chosen=chosen,
                unfiltered=every.freeze(),
                reliable=bool(chosen.reliability >= MINIMUM_RELIABILITY),
                trials=sum(len(s.stimulus) for s in sessions),
                sha256=_sha256(*sessions),
            )
        )
        progress(done / len(animals))
    if not targets:
        raise ConfigError("no animal can be used: " + "; ".join(notes))
    return Benchmark(
        protocol="strict",
        targets=tuple(targets),
        pooled=None,
        a2a=_consistency(tuple(names), targets, pools),
        bootstraps=bootstraps,
        seed=seed,
        notes=tuple(notes),
    )


def _refuse_copies(animals: Sequence[Animal]) -> None:
    """Two copies of a session would be split alike, and agree with each other perfectly."""
    seen: dict[str, str] = {}
    for session in (s for animal in animals for s in animal.sessions):
        key = _sha256(_canonical(session))
        if key in seen:
            raise ConfigError(
                f"sessions {seen[key]} and {session.name} hold the same trials: give one of them"
            )
        seen[key] = session.name


def _canonical(session: NeuralSession) -> NeuralSession:
    """The same trials in an order that depends on their values alone."""
    order = np.lexsort((*session.rates.T, session.stimulus))
    return NeuralSession(
        session.animal, session.name, session.rates[order], session.stimulus[order]
    )


def _sha256(*sessions: NeuralSession) -> str:
    arrays = {f"{i} rates": s.rates for i, s in enumerate(sessions)}
    return rates_sha256(arrays | {f"{i} stimulus": s.stimulus for i, s in enumerate(sessions)})


def _pools(sessions: Sequence[NeuralSession], bootstraps: int, seed: int) -> tuple[_Pool, _Pool]:
    """All units, and the reliable ones, of an animal's sessions."""
    every, kept = [], []
    for session in sessions:
        rng = np.random.default_rng([seed, int(_sha256(session)[:16], 16)])
        choosing, scoring = disjoint_trials(session, rng)
        tuned = _half_means(session.rates, choosing, SELECTION_BOOTSTRAPS, rng).swapaxes(-1, -2)
        r = pearson(tuned[:, 0], tuned[:, 1])  # (bootstrap, unit), over stimuli
        there = np.isfinite(r)
        # A unit that is silent in a half says nothing there; silent in all, it is not reliable.
        mean = np.where(there, r, 0).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
        reliable = spearman_brown(mean) > MINIMUM_RELIABILITY
        halves = _half_means(session.rates, scoring, bootstraps, rng)
        full = np.stack([session.rates[trials].mean(axis=0) for trials in scoring])
        every.append(_Pool(moments_of(full), moments_of(halves)))
        kept.append(_Pool(moments_of(full[..., reliable]), moments_of(halves[..., reliable])))
    return _sum(every), _sum(kept)


def disjoint_trials(session: NeuralSession, rng: np.random.Generator) -> tuple[Trials, Trials]:
    """Trials to choose units on, and the others, to score on: rows of every stimulus."""
    choosing, scoring = [], []
    for stimulus in range(len(STIMULI)):
        trials = rng.permutation(np.flatnonzero(session.stimulus == stimulus))
        choosing.append(np.sort(trials[: len(trials) // 2]))
        scoring.append(np.sort(trials[len(trials) // 2 :]))
    return tuple(choosing), tuple(scoring)


def _half_means(rates: Floats, trials: Trials, bootstraps: int, rng: np.random.Generator) -> Floats:
    """Means of two random halves of every stimulus's trials: (bootstrap, 2, 6, unit)."""
    means = np.empty((bootstraps, 2, len(trials), rates.shape[1]))
    for stimulus, rows in enumerate(trials):
        n = len(rows)
        draws = rng.permuted(np.broadcast_to(np.arange(n), (bootstraps, n)), axis=1)
        first = draws < n // 2
        weights = np.stack([first / (n // 2), ~first / (n - n // 2)], axis=1)
        means[:, :, stimulus] = weights @ rates[rows]
    return means


def _consistency(
    names: tuple[str, ...], targets: Sequence[Target], pools: Sequence[_Pool]
) -> Consistency:
    """Each reliable animal against all other reliable ones pooled, and against each of them."""
    pooled = np.full(len(names), np.nan)
    pairwise = np.full((len(names), len(names)), np.nan)
    usable = [i for i, target in enumerate(targets) if target.reliable]
    for i in usable:
        mine = targets[i].chosen
        others = [j for j in usable if j != i]
        if not others:
            break
        source = _sum([pools[j] for j in others]).freeze()
        pooled[i] = pearson(source.rdm, mine.rdm) * source.factor * mine.factor
        for j in others:
            other = targets[j].chosen
            pairwise[i, j] = pearson(mine.rdm, other.rdm) * mine.factor * other.factor
    return Consistency(names, pooled, pairwise)


def _sum(pools: Sequence[_Pool]) -> _Pool:
    total = pools[0]
    for pool in pools[1:]:
        total = total + pool
    return total
